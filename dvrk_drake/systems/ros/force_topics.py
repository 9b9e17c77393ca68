"""Topics of the estimated external force on an arm."""

from __future__ import annotations

from dvrk_drake.lcmtypes import lcmt_dvrk_force
from dvrk_drake.systems.ros.domain import RosDomain
from dvrk_drake.systems.ros.messages import (
    Float64MultiArray,
    Header,
    MultiArrayDimension,
    MultiArrayLayout,
    Time,
    Vector3,
    Wrench,
    WrenchStamped,
)

#: Names below the namespace of an arm. They differ from `body/measured_cf`, the wrench that a dVRK computes from the
#: measured efforts without friction and inertia.
FORCE, COVARIANCE = "external_force/body/estimated_cf", "external_force/body/covariance"
_LAYOUT = MultiArrayLayout([MultiArrayDimension("row", 3, 9), MultiArrayDimension("column", 3, 3)])


class ForceTopics:
    """Publishers of the estimated force on an arm and of its covariance."""

    def __init__(self, domain: RosDomain, namespace: str) -> None:
        """Creates the publishers below a namespace, e.g. "/PSM1"."""
        self._force = domain.advertise(f"{namespace}/{FORCE}", WrenchStamped)
        self._covariance = domain.advertise(f"{namespace}/{COVARIANCE}", Float64MultiArray)

    def publish(self, force: lcmt_dvrk_force) -> None:
        """Publishes an estimate.

        Raises:
            DvrkDrakeError: DDS cannot send a message.
        """
        wrench, covariance = force_messages(force)
        self._force.publish(wrench)
        self._covariance.publish(covariance)


def force_messages(force: lcmt_dvrk_force) -> tuple[WrenchStamped, Float64MultiArray]:
    """Returns the force as a wrench at the origin of its frame, without torque, and its covariance (3 x 3)."""
    stamp = Time(*divmod(1000 * force.utime, 10**9))
    header = Header(stamp, f"{force.arm_name}/{force.frame_name}")
    covariance = [float(x) for row in force.force_covariance for x in row]
    return WrenchStamped(header, Wrench(Vector3(*force.force))), Float64MultiArray(_LAYOUT, covariance)
