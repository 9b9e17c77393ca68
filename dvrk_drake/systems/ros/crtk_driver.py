"""Configuration of an arm's driver over ROS 2, as a schema for yaml_load_typed.

CRTK (Collaborative Robotics Toolkit) is the convention for the topics of a dVRK, such as `measured_js` and `servo_jf`.

This file has no postponed annotations, because yaml_load_typed reads the types at run time.
"""

from dataclasses import dataclass, field
from pathlib import Path

from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.errors import StationError
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.ranges import number_fault, within
from dvrk_drake.systems.guard.settings import GuardSettings
from dvrk_drake.systems.lcm.dvrk_driver import DvrkDriver
from dvrk_drake.systems.ros.discovery import topic_fault


@dataclass
class CrtkDriver:
    """Configuration of the driver of one arm over ROS 2, comparable to `DvrkDriver` over LCM.

    Attributes:
        domain: ROS domain. None: the environment variable ROS_DOMAIN_ID, or else 0.
        namespace: Namespace of the topics, e.g. "/MTML". If it is empty, it is the name of the arm. A PSM is then
            /PSM1, because a dVRK numbers its PSMs.
        rate: Rate of the measurements of a simulated arm [Hz].
        gravity_compensation: If true, a simulated arm adds its own gravity compensation to commanded efforts. The topic
            `use_gravity_compensation` changes this setting. The bridge switches it off on a real arm.
        model: File of the identified model of the arm. The path is relative to the driver's YAML file. If it is empty,
            the model of the arm's SDF is used.
        control_modes: Modes that the guard of a real arm accepts in addition to hold; see `DvrkDriver`.
        guard: Settings of the command guard of a real arm.

    Example:
        >>> import dvrk_drake as dvrk
        >>> dvrk.CrtkDriver(namespace="/PSM2", control_modes=["effort"]).rate
        1000.0
    """

    domain: int | None = field(default=None, metadata=within(0, 232))
    namespace: str = ""
    rate: float = field(default=1000.0, metadata=within(10.0, 1000.0, "Hz"))
    gravity_compensation: bool = False
    model: str = ""
    control_modes: list[str] = field(default_factory=lambda: ["position", "effort"])
    guard: GuardSettings = field(default_factory=GuardSettings)

    def __post_init__(self) -> None:
        self.check()

    def check(self) -> None:
        """Checks the values. Call this method again if fields are set later, as yaml_load_typed does.

        Raises:
            StationError: A value is out of range, or the namespace is not valid in ROS 2.
        """
        if fault := number_fault(self):
            raise StationError(fault)
        self.guard_driver().check()
        if self.namespace.strip("/") and (fault := topic_fault(self.namespace)):
            raise StationError(f"namespace {fault}")

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

    def guard_driver(self) -> DvrkDriver:
        """Returns the configuration of the guard of a real arm, whose commands come from the same process."""
        return DvrkDriver(lcm_url="memq://", control_modes=self.control_modes, model=self.model, guard=self.guard)

    def arm_namespace(self, arm: Arm) -> str:
        """Returns the namespace of the topics of `arm`, beginning with "/"."""
        name = self.namespace.strip("/")
        return f"/{name or crtk_name(arm)}"


def crtk_name(arm: Arm) -> str:
    """Returns the name of an arm in a dVRK. An arm with an instrument has a number: PSM1 for PSM."""
    is_numbered = bool(arm.separate_joint) and not arm.name[-1].isdigit()
    return f"{arm.name}1" if is_numbered else arm.name
