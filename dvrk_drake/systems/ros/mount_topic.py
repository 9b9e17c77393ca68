"""Orientation of an arm's base, from a topic of the setup joints of a dVRK."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from dvrk_drake.errors import DvrkDrakeError
from dvrk_drake.models.arm import GRAVITY
from dvrk_drake.systems.ros.discovery import topic_fault
from dvrk_drake.systems.ros.open_domain import open_ros_domain

if TYPE_CHECKING:
    from dvrk_drake.systems.ros.domain import RosDomain

#: Longest time until the first message [s]. Discovery takes up to 2 s, and setup joints publish at about 10 Hz.
_FIRST = 5.0
#: Largest difference of the norm of a quaternion from 1. A dVRK publishes 64-bit numbers.
_NORM_TOLERANCE = 1e-3


def topic_gravity(topic: str, domain: RosDomain | None = None) -> tuple[float, float, float]:
    """Returns the gravity vector (3,) in the frame of a base whose pose a ROS 2 topic states [m/s^2].

    A dVRK publishes the base of an arm on its setup joints as `/SUJ/PSM1/local/measured_cp`, in the frame of the cart.

    Args:
        topic: Name of a topic of type PoseStamped. The z axis of its reference frame points up.
        domain: ROS domain. None: the domain of the environment variable ROS_DOMAIN_ID, or else 0.

    Raises:
        DvrkDrakeError: The name is not valid, no message arrives, or the orientation is not a unit quaternion.

    Example:
        >>> topic_gravity("/SUJ/PSM1/local/measured_cp")  # doctest: +SKIP
        (0.0, -3.355, -9.218)
    """
    if fault := topic_fault(topic):
        raise DvrkDrakeError(f"topic {fault}")
    if domain is not None:
        return _received_gravity(topic, domain)
    own = open_ros_domain()
    try:
        return _received_gravity(topic, own)
    finally:
        own.close()


def _received_gravity(topic: str, domain: RosDomain) -> tuple[float, float, float]:
    from dvrk_drake.systems.ros.messages import PoseStamped

    subscription, messages = domain.subscribe(topic, PoseStamped, reliable=False), list[PoseStamped]()

    def receive() -> bool:
        messages.extend(message for message, _ in subscription.take())
        return bool(messages)

    if not domain.wait_until(receive, _FIRST):
        raise DvrkDrakeError(
            f"{domain.name}: no message of type PoseStamped on {topic} within {_FIRST:g} s. Start the dVRK's console, "
            "or check ROS_DOMAIN_ID and the network"
        )
    r = messages[-1].pose.orientation
    norm = math.hypot(r.x, r.y, r.z, r.w)
    if not abs(norm - 1.0) <= _NORM_TOLERANCE:  # also for NaN
        raise DvrkDrakeError(f"{topic}: the norm of the quaternion is {norm:g}; allowed: 1")
    x, y, z, w = r.x / norm, r.y / norm, r.z / norm, r.w / norm
    # The negative third row of the rotation matrix from the frame of the base to the frame of the cart.
    return (
        -GRAVITY * 2.0 * (x * z - w * y),
        -GRAVITY * 2.0 * (y * z + w * x),
        -GRAVITY * (1.0 - 2.0 * (x * x + y * y)),
    )
