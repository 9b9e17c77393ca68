"""Search for the topic measured_js of an arm in a ROS domain.

This module does not import cyclonedds, so that other modules can check the names of topics without it.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import TYPE_CHECKING

from dvrk_drake.errors import ControllerError, RecordingError
from dvrk_drake.models.arm import Arm
from dvrk_drake.recordings.reader_options import MEASURED_JS, check_namespace, choose_topic, fitting_topics

if TYPE_CHECKING:
    from dvrk_drake.systems.ros.domain import RosDomain

#: Advice if another process publishes commands or measurements of the arm. 10 s is the default lease of DDS.
END_OTHER_PROCESS = "End it. A killed process is listed for up to 10 s"
#: Longest time to wait for the topic of an arm [s]. Time after which the search is reported [s]. Time to wait for other
#: topics of the domain after the first one [s].
_DISCOVERY, _NOTICE, _OTHERS = 10.0, 1.0, 1.0
_NAME = re.compile(r"/?[A-Za-z_][A-Za-z0-9_]*(/[A-Za-z_][A-Za-z0-9_]*)*/?")


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
