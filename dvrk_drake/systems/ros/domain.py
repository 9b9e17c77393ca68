"""ROS 2 domain over Cyclone DDS, without an installation of ROS.

DDS (Data Distribution Service) is the middleware of ROS 2.
"""

import contextlib
import ctypes
import os
import select
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from textwrap import shorten
from weakref import WeakSet, finalize

from cyclonedds.__library__ import library_path
from cyclonedds.builtin import BuiltinDataReader, BuiltinTopicDcpsPublication, BuiltinTopicDcpsSubscription
from cyclonedds.core import DDSException, InstanceState, Policy, ReadCondition, SampleState, ViewState
from cyclonedds.domain import DomainParticipant
from cyclonedds.sub import DataReader

from dvrk_drake.errors import DvrkDrakeError
from dvrk_drake.systems.ros.messages import JointState, dds_type_name, ros_type_name, type_hash
from dvrk_drake.systems.ros.topic import DDS_PREFIX, Message, Publisher, Subscription, ros_qos

#: Number of messages that a latched topic keeps for subscribers that join later, as in the dVRK's ROS interface.
_LATCHED = 100
#: Time after which other processes consider a killed process as ended [s]. Cyclone DDS uses 10 s by default.
_LEASE = 1
#: Interval in which a process announces itself [ms]. Cyclone DDS uses 30 s by default. If a process or the network was
#: suspended for the time `_LEASE`, other processes consider the process as ended until its next announcement.
_ANNOUNCEMENT = 500
_CONFIG = "CYCLONEDDS_URI"
#: Masks for the log of Cyclone DDS: only errors that end the process. Also other errors and warnings.
_LOG_FATAL, _LOG_DEFAULT = 1, 7
#: Largest number of discovered endpoints.
_MAX_ENDPOINTS = 10_000


@dataclass(frozen=True)
class Endpoint:
    """Publisher or subscription of a topic, in any process of the domain.

    Attributes:
        topic: ROS 2 name of the topic.
        type_name: ROS 2 name of the message type.
        reliable: Whether lost messages are sent again.
        latched: Whether subscriptions that join later receive earlier messages.
        type_hash: Announced type hash, or "" if there is none.
        is_own: Whether the endpoint belongs to this participant.
    """

    topic: str
    type_name: str
    reliable: bool
    latched: bool
    type_hash: str
    is_own: bool


class _WakeUpPipe:
    """Pipe to which listeners write, because Cyclone DDS has no file descriptor for arriving messages.

    Attributes:
        readable: File descriptor that is readable after a message has arrived, or -1 after the end.
    """

    def __init__(self) -> None:
        self.readable, self._writable = os.pipe2(os.O_NONBLOCK | os.O_CLOEXEC)
        self._lock = threading.Lock()

    def notify(self, reader: DataReader) -> None:
        """Makes the pipe readable. Cyclone DDS calls this function in a thread of its own, also after `close`."""
        # A full pipe already wakes up the reader. The number of a closed descriptor may belong to another file.
        with self._lock, contextlib.suppress(BlockingIOError):
            if self._writable >= 0:
                os.write(self._writable, b"\0")

    def close(self) -> None:
        """Closes both ends. Repeated calls have no effect."""
        with self._lock:
            for descriptor in (self.readable, self._writable):
                if descriptor >= 0:
                    os.close(descriptor)
            self.readable = self._writable = -1


class RosDomain:
    """DDS participant of a ROS 2 domain.

    Attributes:
        name: Name of the domain, for messages, e.g. "ROS domain 0".
        participant: DDS participant.
    """

    def __init__(self, number: int) -> None:
        """Joins the domain with this number; see `dvrk_drake.systems.ros.open_domain.open_ros_domain`.

        Raises:
            DvrkDrakeError: The network of the domain cannot be used.
        """
        self.name = f"ROS domain {number}"
        try:
            self.participant = _participant(number)
            self._publications = BuiltinDataReader(self.participant, BuiltinTopicDcpsPublication)
            self._subscriptions = BuiltinDataReader(self.participant, BuiltinTopicDcpsSubscription)
        except DDSException as error:
            advice = "Check that the network is connected"
            if configured := os.environ.get(_CONFIG):
                advice = (
                    f'{_CONFIG} is "{shorten(configured, 60)}"; allowed: an existing XML file, or XML, with existing '
                    "network interfaces that are connected. Correct it or unset it"
                )
            raise DvrkDrakeError(f"{self.name} cannot be used. {advice}") from error
        self._alive = {
            reader: ReadCondition(reader, SampleState.Any | ViewState.Any | InstanceState.Alive)
            for reader in (self._publications, self._subscriptions)
        }
        self._unread = ReadCondition(self._publications, SampleState.NotRead | ViewState.Any | InstanceState.Any)
        self._num_changes = 0
        self._topics: WeakSet[Publisher | Subscription] = WeakSet()
        self._pipe = _WakeUpPipe()
        finalize(self, self._pipe.close).atexit = False

    def close(self) -> None:
        """Leaves the domain and ends its publishers and subscriptions. None of them must be used any more."""
        for topic in list(self._topics):
            topic.close()
        self._topics.clear()
        self.participant = self._publications = self._subscriptions = None
        self._alive, self._unread = {}, None
        self._pipe.close()

    @property
    def num_changes(self) -> int:
        """Number of times that publishers of the domain appeared or ended, as far as this property was evaluated."""
        self._num_changes += bool(self._publications.read(_MAX_ENDPOINTS, condition=self._unread))
        return self._num_changes

    def publishers(self) -> list[Endpoint]:
        """Returns the ROS 2 publishers discovered so far."""
        return self._endpoints(self._publications)

    def subscribers(self) -> list[Endpoint]:
        """Returns the ROS 2 subscriptions discovered so far."""
        return self._endpoints(self._subscriptions)

    def joint_state_topics(self) -> dict[str, bool]:
        """Returns a mapping from each discovered JointState topic to whether all its publishers are reliable."""
        reliable: dict[str, bool] = {}
        for endpoint in self.publishers():
            if endpoint.type_name == ros_type_name(dds_type_name(JointState)):
                reliable[endpoint.topic] = endpoint.reliable and reliable.get(endpoint.topic, True)
        return dict(sorted(reliable.items()))

    def advertise(
        self, topic: str, message_type: type[Message], *, depth: int = 5, latched: bool = False
    ) -> Publisher[Message]:
        """Creates a publisher of a topic.

        Args:
            topic: ROS 2 name of the topic.
            message_type: Type of the messages.
            depth: Number of messages that are kept for slow subscriptions.
            latched: Whether subscriptions that join later receive the last 100 messages.
        """
        publisher = Publisher(self.participant, topic, message_type, _LATCHED if latched else depth, latched)
        self._topics.add(publisher)
        return publisher

    def subscribe(
        self,
        topic: str,
        message_type: type[Message],
        *,
        depth: int = 1,
        reliable: bool = True,
        latched: bool = False,
        ignore_own: bool = False,
        wakes: bool = True,
    ) -> Subscription[Message]:
        """Subscribes to a topic.

        Args:
            topic: ROS 2 name of the topic.
            message_type: Type of the messages.
            depth: Number of messages that may arrive between two calls of `take`. Older messages are lost.
            reliable: Whether lost messages are sent again. Must be False if a publisher is best-effort.
            latched: Whether earlier messages of a latched topic are received.
            ignore_own: Whether to ignore the publishers of this object.
            wakes: Whether a message makes the file descriptor readable. If not, receiving needs less computing time.
                Use False, or `ignore_own`, if this process and another one publish the topic: cyclonedds can otherwise
                block for ever, because it publishes without releasing the lock of the Python interpreter.
        """
        qos = ros_qos(
            depth, reliable=reliable, latched=latched, type_hash=type_hash(message_type), ignore_own=ignore_own
        )
        notify = self._pipe.notify if wakes else None
        subscription = Subscription(self.participant, topic, message_type, qos, depth, notify)
        self._topics.add(subscription)
        return subscription

    def fileno(self) -> int:
        """Returns a file descriptor that is readable after a message of a subscription has arrived."""
        return self._pipe.readable

    def clear(self) -> None:
        """Makes the file descriptor unreadable until the next message arrives. Call this method before `take`."""
        try:
            while os.read(self._pipe.readable, 4096):
                pass
        except BlockingIOError:
            pass

    def wait(self, seconds: float) -> bool:
        """Waits until a message of a subscription arrives, at most `seconds`. Returns whether one arrived."""
        ready = bool(select.select([self._pipe.readable], [], [], max(seconds, 0.0))[0])
        if ready:
            self.clear()
        return ready

    def wait_until(self, condition: Callable[[], bool], seconds: float, poll: float = 0.02) -> bool:
        """Waits until a condition is true, at most `seconds`. Returns whether it is true.

        Args:
            condition: Condition, checked after each message and every `poll` seconds.
            seconds: Longest time to wait [s].
            poll: Longest time between two checks [s].
        """
        end = time.monotonic() + seconds
        while not (met := condition()) and (left := end - time.monotonic()) > 0:
            self.wait(min(poll, left))
        return met

    def _endpoints(self, reader: BuiltinDataReader) -> list[Endpoint]:
        found = []
        for sample in reader.read(_MAX_ENDPOINTS, condition=self._alive[reader]):
            topic = getattr(sample, "topic_name", "")
            if not topic.startswith(f"{DDS_PREFIX}/"):
                continue
            data = sample.qos[Policy.Userdata] if Policy.Userdata in sample.qos else None  # noqa: SIM401, Qos has no get
            text = b"" if data is None else bytes(data.data)
            found.append(
                Endpoint(
                    topic=topic.removeprefix(DDS_PREFIX),
                    type_name=ros_type_name(sample.type_name),
                    reliable=isinstance(sample.qos[Policy.Reliability], Policy.Reliability.Reliable),
                    latched=sample.qos[Policy.Durability] == Policy.Durability.TransientLocal,
                    type_hash=text.decode(errors="replace").partition("typehash=")[2].partition(";")[0],
                    is_own=sample.participant_key == self.participant.guid,
                )
            )
        return found


def _participant(domain: int) -> DomainParticipant:
    """Joins a domain with a short lease, so that other processes soon detect the end of a killed process.

    Cyclone DDS by default forgets the addresses of peers after 30 to 60 s without an answer, and then never finds these
    peers again without multicast. Here it keeps them, so that messages continue after a long loss of the network.
    """
    configured = os.environ.get(_CONFIG)
    discovery = (
        f"<LeaseDuration>{_LEASE}s</LeaseDuration><SPDPInterval>{_ANNOUNCEMENT}ms</SPDPInterval>"
        "<InitialLocatorPruneDelay>inf</InitialLocatorPruneDelay>"
        "<DiscoveredLocatorPruneDelay>inf</DiscoveredLocatorPruneDelay>"
    )
    lease = f"<CycloneDDS><Domain><Discovery>{discovery}</Discovery></Domain></CycloneDDS>"
    # A list of configurations is separated by commas. A later entry takes precedence over an earlier one.
    os.environ[_CONFIG] = f"{lease},{configured}" if configured else lease
    # Cyclone DDS would print a line for each packet that it cannot send, thousands during a loss of the network.
    log = ctypes.CDLL(str(library_path))
    log.dds_set_log_mask(_LOG_FATAL)
    try:
        return DomainParticipant(domain)
    except DDSException:
        log.dds_set_log_mask(_LOG_DEFAULT)
        return DomainParticipant(domain)  # prints the reason
    finally:
        if configured is None:
            del os.environ[_CONFIG]
        else:
            os.environ[_CONFIG] = configured
