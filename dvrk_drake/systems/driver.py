"""Configuration of an arm's driver over LCM or ROS 2, as a schema for yaml_load_typed.

CRTK (Collaborative Robotics Toolkit) is the convention for the topics of a dVRK, such as `measured_js` and `servo_jf`.

This file has no postponed annotations, because yaml_load_typed reads the types at run time.
"""

from dataclasses import dataclass, field
from pathlib import Path

from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.errors import StationError
from dvrk_drake.lcmtypes import lcmt_dvrk_command
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.lcm_messages import MessageKey
from dvrk_drake.models.ranges import number_fault, within
from dvrk_drake.systems.guard.settings import GuardSettings
from dvrk_drake.systems.ros.discovery import topic_fault

_MODES = {
    "position": lcmt_dvrk_command.POSITION,
    "effort": lcmt_dvrk_command.EFFORT,
    "off": lcmt_dvrk_command.OFF,
}


@dataclass
class ArmDriver:
    """Configuration of the driver of one arm that does not depend on the transport.

    Attributes:
        control_modes: Modes that the guard accepts in addition to hold: position, effort and "off". Write "off" in
            quotes, because YAML reads off as false. "off" is not accepted by default, because an arm falls when its
            motors are off.
        gravity_compensation: If true, the arm adds its own gravity compensation to commanded efforts (an option of a
            dVRK).
        model: File of the identified model of the arm, with which the guard checks measurements. The path is relative
            to the driver's YAML file. If it is empty, the model of the arm's SDF is used.
        guard: Settings of the command guard.
    """

    control_modes: list[str] = field(default_factory=lambda: ["position", "effort"])
    gravity_compensation: bool = False
    model: str = ""
    guard: GuardSettings = field(default_factory=GuardSettings)

    def __post_init__(self) -> None:
        self.check()

    def check(self) -> None:
        """Checks the values. Call this method again if fields are set later, as yaml_load_typed does.

        Raises:
            StationError: A control mode is unknown, a number is out of range, or a setting of the guard is invalid.
        """
        self.guard.check()
        if any(mode not in _MODES for mode in self.control_modes):
            raise StationError(
                f"control_modes contains an unknown mode: {list(self.control_modes)}; allowed: {', '.join(_MODES)}"
            )
        if fault := number_fault(self):
            raise StationError(fault)

    def relative_to(self, folder: Path) -> None:
        """Resolves a relative path in `model` against `folder`."""
        if self.model:
            self.model = str(folder / self.model)

    def load_model(self, arm: Arm) -> IdentifiedModel | None:
        """Returns the model in the file `model`, or None if `model` is empty.

        Raises:
            ModelError: The file cannot be read, or the model is not valid for `arm`.
        """
        return IdentifiedModel.load(self.model, arm) if self.model else None

    def load_key(self) -> MessageKey | None:
        """Returns None: messages are not signed."""
        return None

    def accepted_modes(self) -> tuple[int, ...]:
        """Returns `control_modes` as values of lcmt_dvrk_command.control_mode."""
        return tuple(_MODES[mode] for mode in self.control_modes)


@dataclass
class DvrkDriver(ArmDriver):
    """Configuration of the driver of one arm over LCM, comparable to Drake's IiwaDriver.

    Attributes:
        lcm_url: URL of the LCM network. If it is empty, the environment variable LCM_DEFAULT_URL or LCM's default is
            used.
        status_period: Period in which the arm sends statuses and a controller sends commands [s].
        key_file: File with the key that signs commands and statuses, created by `dvrk-drake keygen`. The path is
            relative to the driver's YAML file. If it is empty, messages are not authenticated, and any process on the
            network can command the arm.
        control_modes, gravity_compensation, model, guard: See `ArmDriver`.

    Example:
        >>> import dvrk_drake as dvrk
        >>> driver = dvrk.DvrkDriver(control_modes=["effort"], lcm_url="memq://")  # messages within this process
        >>> station = dvrk.HardwareArmStation(dvrk.load_arm("mtml"), driver=driver)
    """

    lcm_url: str = ""
    status_period: float = field(default=1e-3, metadata=within(0.0005, 0.01, "s"))
    key_file: str = ""

    def relative_to(self, folder: Path) -> None:
        """Resolves relative paths in `key_file` and `model` against `folder`."""
        super().relative_to(folder)
        if self.key_file:
            self.key_file = str(folder / self.key_file)

    def warnings(self) -> list[str]:
        """Returns a line each on weaker guard settings than the defaults, and on an arm that compensates gravity."""
        lines = []
        if weaker := self.guard.weaker_than_default():
            lines.append(f"the guard protects the arm less than with its default settings: {weaker}")
        if self.gravity_compensation:
            lines.append("the arm adds its own gravity compensation to commanded efforts (gravity_compensation: true)")
        return lines

    def load_key(self) -> MessageKey | None:
        """Returns the key in `key_file`, or None if `key_file` is empty.

        Raises:
            KeyFileError: The key cannot be used; see `MessageKey.load`.
        """
        return MessageKey.load(self.key_file) if self.key_file else None


@dataclass
class CrtkDriver(ArmDriver):
    """Configuration of the driver of one arm over ROS 2, comparable to `DvrkDriver` over LCM.

    Attributes:
        domain: ROS domain. None: the environment variable ROS_DOMAIN_ID, or else 0.
        namespace: Namespace of the topics, e.g. "/MTML". If it is empty, it is the name of the arm. A PSM is then
            /PSM1, because a dVRK numbers its PSMs.
        rate: Rate of the measurements of a simulated arm [Hz].
        gravity_compensation: If true, a simulated arm adds its own gravity compensation to commanded efforts. The topic
            `use_gravity_compensation` changes this setting. The bridge switches it off on a real arm.
        control_modes, model, guard: See `ArmDriver`. The modes and the guard are those of a real arm.

    Example:
        >>> import dvrk_drake as dvrk
        >>> dvrk.CrtkDriver(namespace="/PSM2", control_modes=["effort"]).rate
        1000.0
    """

    domain: int | None = field(default=None, metadata=within(0, 232))
    namespace: str = ""
    rate: float = field(default=1000.0, metadata=within(10.0, 1000.0, "Hz"))

    def check(self) -> None:
        """Checks the values. Call this method again if fields are set later, as yaml_load_typed does.

        Raises:
            StationError: A value is not allowed, or the namespace is not valid in ROS 2.
        """
        super().check()
        if self.namespace.strip("/") and (fault := topic_fault(self.namespace)):
            raise StationError(f"namespace {fault}")

    def arm_namespace(self, arm: Arm) -> str:
        """Returns the namespace of the topics of `arm`, beginning with "/"."""
        name = self.namespace.strip("/")
        return f"/{name or crtk_name(arm)}"


def crtk_name(arm: Arm) -> str:
    """Returns the name of an arm in a dVRK. An arm with an instrument has a number: PSM1 for PSM."""
    is_numbered = bool(arm.separate_joint) and not arm.name[-1].isdigit()
    return f"{arm.name}1" if is_numbered else arm.name
