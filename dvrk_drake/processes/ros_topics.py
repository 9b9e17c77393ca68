"""Receives JointState topics of ROS 2 with Cyclone DDS, without an installation of ROS.

DDS (Data Distribution Service) is the middleware of ROS 2. The ROS 2 topic `/<ARM>/measured_js` is the DDS topic
`rt/<ARM>/measured_js`. Its type `sensor_msgs/msg/JointState` is the DDS type `sensor_msgs::msg::dds_::JointState_`
(https://design.ros2.org/articles/topic_and_service_names.html).
"""

# mypy: disable-error-code=call-arg
# mypy does not find the keyword `typename` of IdlStruct.

import os
import time
from dataclasses import dataclass, field
from typing import Any

from cyclonedds.builtin import BuiltinDataReader, BuiltinTopicDcpsPublication
from cyclonedds.core import (
    DDSException,
    InstanceState,
    Listener,
    Policy,
    Qos,
    ReadCondition,
    SampleState,
    ViewState,
    WaitSet,
)
from cyclonedds.domain import DomainParticipant
from cyclonedds.idl import IdlStruct
from cyclonedds.idl.types import float64, int32, sequence, uint32
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration

from dvrk_drake.errors import DvrkDrakeError

#: Largest domain whose default UDP ports exist.
MAX_DOMAIN = 232
#: Time that a reliable writer waits for a slow reader [ms], as in the dVRK's ROS interface.
_MAX_BLOCKING = 100
#: Messages of one topic that may arrive between two calls of `take`. Older messages are lost.
_DEPTH = 5000
#: Beginning of the DDS names of ROS 2 topics, and DDS name of the message type.
_PREFIX, _JOINT_STATE = "rt", "sensor_msgs::msg::dds_::JointState_"


@dataclass
class Time(IdlStruct, typename="builtin_interfaces::msg::dds_::Time_"):
    """Time stamp."""

    sec: int32 = 0
    nanosec: uint32 = 0


@dataclass
class Header(IdlStruct, typename="std_msgs::msg::dds_::Header_"):
    """Time stamp and name of a frame."""

    stamp: Time = field(default_factory=Time)
    frame_id: str = ""


@dataclass
class JointState(IdlStruct, typename=_JOINT_STATE):
    """Names, positions, velocities and efforts of joints. An absent quantity is an empty list."""

    header: Header = field(default_factory=Header)
    name: sequence[str] = field(default_factory=list)
    position: sequence[float64] = field(default_factory=list)
    velocity: sequence[float64] = field(default_factory=list)
    effort: sequence[float64] = field(default_factory=list)


def dds_topic(topic: str) -> str:
    """Returns the DDS name of a ROS 2 topic, e.g. "rt/PSM1/measured_js" for "/PSM1/measured_js"."""
    return f"{_PREFIX}/{topic.removeprefix('/')}"


def ros_qos(depth: int, *, reliable: bool = True) -> Qos:
    """Returns the quality of service of the dVRK's topics: volatile, and by default reliable.

    Args:
        depth: Number of messages that a publisher or a subscription keeps.
        reliable: Whether lost messages are sent again.
    """
    reliability = Policy.Reliability.Reliable(duration(milliseconds=_MAX_BLOCKING))
    return Qos(
        reliability if reliable else Policy.Reliability.BestEffort,
        Policy.Durability.Volatile,
        Policy.History.KeepLast(depth),
    )


class RosDomain:
    """DDS participant of a ROS 2 domain.

    Attributes:
        name: Name of the domain, for messages, e.g. "ROS domain 0".
        participant: DDS participant, which publishers and subscriptions need.
    """

    def __init__(self, domain: int | None = None) -> None:
        """Joins a domain.

        Args:
            domain: Number of the domain. None: the environment variable ROS_DOMAIN_ID, or else 0.

        Raises:
            DvrkDrakeError: The number is not valid, or the network of the domain cannot be used.
        """
        text = os.environ.get("ROS_DOMAIN_ID", "") or "0" if domain is None else str(domain)
        if not text.isdecimal() or int(text) > MAX_DOMAIN:
            raise DvrkDrakeError(f"ROS domain {text}: allowed: 0 to {MAX_DOMAIN} (--domain, or ROS_DOMAIN_ID)")
        self.name = f"ROS domain {text}"
        try:
            self.participant = DomainParticipant(int(text))
            self._publications = BuiltinDataReader(self.participant, BuiltinTopicDcpsPublication)
        except DDSException as error:
            raise DvrkDrakeError(
                f"{self.name} cannot be used: {error}. Check the network and CYCLONEDDS_URI"
            ) from error
        self._waitset, self._has_subscriptions = WaitSet(self.participant), False
        self._reliable: dict[str, bool] = {}

    def joint_state_topics(self) -> dict[str, bool]:
        """Returns a mapping from each JointState topic discovered so far to whether all its publishers are reliable."""
        for endpoint in self._publications.take(1000):
            topic = getattr(endpoint, "topic_name", "")
            if not topic.startswith(f"{_PREFIX}/") or endpoint.type_name != _JOINT_STATE:
                continue
            name = topic.removeprefix(_PREFIX)
            reliability = endpoint.qos[Policy.Reliability]
            reliable = isinstance(reliability, Policy.Reliability.Reliable)
            self._reliable[name] = reliable and self._reliable.get(name, True)
        return dict(sorted(self._reliable.items()))

    def subscribe(self, topic: str, *, reliable: bool = True) -> "Subscription":
        """Subscribes to a JointState topic. Use `reliable=False` if a publisher is best-effort."""
        subscription = Subscription(self.participant, topic, reliable)
        self._waitset.attach(subscription.condition)
        self._has_subscriptions = True
        return subscription

    def wait(self, seconds: float) -> None:
        """Waits until a message of a subscription arrives, at most `seconds`."""
        if self._has_subscriptions:
            self._waitset.wait(int(seconds * 1e9))
        else:
            # Without a condition, the wait set returns at once.
            time.sleep(seconds)


class Subscription:
    """Messages of one JointState topic.

    Attributes:
        topic: Name of the topic.
        num_lost: Number of messages that DDS reported as lost.
        condition: DDS condition that is true while messages can be taken.
    """

    def __init__(self, participant: DomainParticipant, topic: str, reliable: bool) -> None:
        """Subscribes to a topic, see `RosDomain.subscribe`."""
        self.topic, self.num_lost = topic, 0
        self._listener = Listener(on_sample_lost=self._count_lost)
        dds = Topic(participant, dds_topic(topic), JointState)
        self._reader = DataReader(participant, dds, qos=ros_qos(_DEPTH, reliable=reliable), listener=self._listener)
        self.condition = ReadCondition(self._reader, SampleState.NotRead | ViewState.Any | InstanceState.Any)

    def take(self) -> list[tuple[JointState, int]]:
        """Returns the messages since the last call, with their times of publication [ns since 1970]."""
        samples = self._reader.take(_DEPTH)
        return [(s, s.sample_info.source_timestamp) for s in samples if isinstance(s, JointState)]

    def _count_lost(self, reader: DataReader, status: Any) -> None:
        # Cyclone DDS calls this function in a thread of its own.
        self.num_lost = status.total_count
