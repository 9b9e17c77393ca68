"""Choice of the JointState topic of an arm, among the topics of a ROS bag or of a ROS network."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from pathlib import Path

from dvrk_drake.errors import RecordingError
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.arm_files import is_package_arm

#: Name of the topic with the measured joint states, in the namespace of an arm.
MEASURED_JS = "measured_js"
_DIGITS = "0123456789"


def fitting_topics(arm: Arm, topic: str | None, names: Iterable[str]) -> list[str]:
    """Returns the JointState topics that fit.

    Args:
        arm: Arm whose joints are read. Used only if `topic` is None.
        topic: Topic or its namespace. None: the topics `/<ARM>/measured_js`, in any namespace, where ARM is the name of
            the arm, optionally followed by a number.
        names: Names of the available topics.
    """
    if topic is not None:
        topic = f"/{topic.strip('/')}"
        return [name for name in (topic, f"{topic}/{MEASURED_JS}") if name in names][:1]
    pattern = re.compile(rf"(/.*)?/{re.escape(arm.name)}[0-9]*/{MEASURED_JS}")
    # A dVRK cart publishes the joints of a setup joint arm on /SUJ/<ARM>/measured_js.
    return [name for name in names if pattern.fullmatch(name) and "/SUJ/" not in name]


def choose_topic(source: str | Path, arm: Arm, topic: str | None, topics: Mapping[str, str]) -> str:
    """Returns the only JointState topic that fits, see `fitting_topics`.

    Args:
        source: Bag or network with the topics, for messages.
        arm: Arm whose joints are read.
        topic: Topic or its namespace. None: the topic of the arm.
        topics: Mapping from the name of each topic to its description, for messages.

    Raises:
        RecordingError: No topic fits, or several topics, or the topic is in the namespace of another arm.
    """
    if topic is not None:
        check_namespace(source, arm, topic)
    fitting = fitting_topics(arm, topic, topics)
    if len(fitting) == 1:
        check_namespace(source, arm, fitting[0].rpartition("/")[0])
        return fitting[0]
    available = f"Topics with JointState messages: {', '.join(topics.values()) or 'none'}."
    if topic is not None:
        raise RecordingError(f"{source}: has no JointState topic {topic}. {available}")
    if fitting:
        raise RecordingError(
            f"{source}: several topics fit {arm.name}: {', '.join(fitting)}. Choose one with --topic TOPIC "
            "(topic= in Python)."
        )
    raise RecordingError(
        f"{source}: has no topic /{arm.name}/{MEASURED_JS}. {available} Check --arm, or choose one "
        "with --topic TOPIC (topic= in Python)."
    )


def check_namespace(
    source: str | Path,
    arm: Arm,
    topic: str,
    advice: str = ", or the namespace of {arm} with --topic (topic= in Python)",
) -> None:
    """Rejects the namespace of another arm of this package, because an MTML and an MTMR have the same joint names.

    The last name of a namespace identifies its arm, e.g. "MTML" in "/lab/MTML", or "PSM" in "/PSM2". An arm with
    another name than those of this package may have any namespace.

    Args:
        source: Bag or network with the topic, for messages.
        arm: Arm whose joints are read.
        topic: Namespace, or its topic measured_js.
        advice: Text of the message after the advice to choose the other arm.

    Raises:
        RecordingError: The namespace has the name of another arm.
    """
    namespace = f"/{topic.strip('/')}".removesuffix(f"/{MEASURED_JS}")
    own, other = arm.name.rstrip(_DIGITS).upper(), namespace.rpartition("/")[2].rstrip(_DIGITS).upper()
    if own != other and is_package_arm(own) and is_package_arm(other):
        raise RecordingError(
            f"{source}: {namespace} is the namespace of the arm {other}, not of {arm.name}. Choose --arm "
            f"{other.lower()}{advice.format(arm=arm.name)}."
        )
