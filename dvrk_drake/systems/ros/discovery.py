"""Search for the topic measured_js of an arm in a ROS domain, and gravity from a topic of the setup joints of a dVRK.

This module does not import cyclonedds, so that other modules can check the names of topics without it.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from typing import TYPE_CHECKING

from dvrk_drake.errors import ControllerError, DvrkDrakeError, RecordingError
from dvrk_drake.models.arm import GRAVITY, Arm
from dvrk_drake.recordings.reader_options import MEASURED_JS, check_namespace, choose_topic, fitting_topics
from dvrk_drake.systems.ros.open_domain import open_ros_domain

if TYPE_CHECKING:
    from dvrk_drake.systems.ros.domain import RosDomain

#: Advice if another process publishes commands or measurements of the arm. 10 s is the default lease of DDS.
END_OTHER_PROCESS = "End it. A killed process is listed for up to 10 s"
#: Longest time to wait for the topic of an arm [s]. Time after which the search is reported [s]. Time to wait for other
#: topics of the domain after the first one [s].
_DISCOVERY, _NOTICE, _OTHERS = 10.0, 1.0, 1.0
#: Largest number of characters of a received text that is shown.
_SHOWN = 40
_NAME = re.compile(r"/?[A-Za-z_][A-Za-z0-9_]*(/[A-Za-z_][A-Za-z0-9_]*)*/?")


def shown(text: str) -> str:
    """Returns a received text for a message: on one line and with a limited length."""
    return text if text.isprintable() and len(text) <= _SHOWN else repr(text[:_SHOWN])


def topic_fault(name: str) -> str:
    """Returns the end of a message if the name of a topic or namespace is not valid in ROS 2, otherwise ""."""
    if _NAME.fullmatch(name):
        return ""
    return (
        f'is "{name}"; allowed: names of letters, digits and underscores, separated by "/". No name begins with a '
        "digit."
    )


def find_topic(
    domain: RosDomain,
    arm: Arm,
    topic: str | None = None,
    *,
    stopped: Callable[[], bool] = lambda: False,
    report: Callable[[str], None] = lambda line: None,
) -> str:
    """Waits until the topic measured_js of an arm is discovered, and returns its name, e.g. "/PSM1/measured_js".

    Args:
        domain: ROS domain.
        arm: Arm to find.
        topic: Topic measured_js or its namespace. None: the only topic `/<ARM>/measured_js`, in any namespace, where
            ARM is the name of the arm, optionally followed by a number.
        stopped: Function that returns whether to end the search.
        report: Function that is called with one line if the search takes longer than a second.

    Raises:
        RecordingError: The name of the topic is not valid or belongs to another arm. No topic or several topics fit.
            The search was stopped.
    """
    wanted = f"/{arm.name}/{MEASURED_JS}"
    if topic is not None:
        if fault := topic_fault(topic):
            raise RecordingError(f"topic {fault}")
        check_namespace(domain.name, arm, topic)
        wanted = f"/{topic.strip('/')}"

    def is_found() -> bool:
        return stopped() or bool(fitting_topics(arm, topic, domain.joint_state_topics()))

    if not domain.wait_until(is_found, _NOTICE):
        report(f"searching for {wanted} in {domain.name}")
        domain.wait_until(is_found, _DISCOVERY - _NOTICE)
    topics = domain.joint_state_topics()
    if topics:
        domain.wait_until(stopped, _OTHERS)
        topics = domain.joint_state_topics()
    if stopped():
        raise RecordingError(f"{domain.name}: the search for {wanted} was stopped")
    if not topics:
        raise RecordingError(
            f"{domain.name}: no topic {wanted} within {_DISCOVERY:g} s. Start the dVRK's console, or check --domain "
            "and the network"
        )
    return choose_topic(domain.name, arm, topic, {name: name for name in topics})


def wait_unless_stopped(
    domain: RosDomain, condition: Callable[[], bool], seconds: float, stopped: Callable[[], bool], what: str
) -> bool:
    """Waits until a condition is true, at most `seconds` [s]. Returns whether it is true.

    Args:
        domain: ROS domain whose messages may change the condition.
        condition: Condition, checked after each message and at least every 0.02 s.
        seconds: Longest time to wait [s].
        stopped: Function that returns whether to end the wait, e.g. after Ctrl-C. It is called as often as `condition`.
        what: Purpose of the wait, for the message.

    Raises:
        ControllerError: The wait was stopped.
    """
    is_met = domain.wait_until(lambda: stopped() or condition(), seconds)
    if stopped():
        raise ControllerError(f"{what} was stopped; no command was sent to the arm")
    return is_met


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
