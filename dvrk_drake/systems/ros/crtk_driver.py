"""Configuration of an arm's driver over ROS 2, as a schema for yaml_load_typed.

CRTK (Collaborative Robotics Toolkit) is the convention for the topics of a dVRK, such as `measured_js` and `servo_jf`.

This file has no postponed annotations, because yaml_load_typed reads the types at run time.
"""

from dataclasses import dataclass, field

from dvrk_drake.errors import StationError
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.ranges import within
from dvrk_drake.systems.lcm.dvrk_driver import ArmDriver
from dvrk_drake.systems.ros.discovery import topic_fault


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
