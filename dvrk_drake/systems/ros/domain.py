"""ROS 2 domain over Cyclone DDS, without an installation of ROS.

DDS (Data Distribution Service) is the middleware of ROS 2.
"""

import atexit
import contextlib
import ctypes
import functools
import os
import queue
import select
import threading
import time
import weakref
from collections.abc import Callable
from dataclasses import dataclass
from textwrap import shorten
from typing import Generic, TypeVar
from uuid import UUID
from weakref import WeakSet, finalize

from cyclonedds.__library__ import library_path
from cyclonedds.builtin import BuiltinDataReader, BuiltinTopicDcpsPublication, BuiltinTopicDcpsSubscription
from cyclonedds.core import DDSException, InstanceState, Listener, Policy, Qos, ReadCondition, SampleState, ViewState
from cyclonedds.domain import DomainParticipant
from cyclonedds.idl import IdlStruct
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration

from dvrk_drake.errors import DvrkDrakeError
from dvrk_drake.systems.ros.messages import JointState, dds_type_name, ros_type_name, type_hash

Message = TypeVar("Message", bound=IdlStruct)

#: Beginning of the DDS names of ROS 2 topics.
DDS_PREFIX = "rt"
#: Time that a reliable writer waits for a slow reader [ms], as in the dVRK's ROS interface.
_MAX_BLOCKING = 100
#: Listeners of all readers. DDS may call a listener after its reader was deleted in Python, so none is deleted.
_LISTENERS: list[Listener] = []
#: Readers with a listener.
_READERS: "weakref.WeakSet[DataReader]" = weakref.WeakSet()
#: Readers of subscriptions that ended.
_UNUSED: "queue.SimpleQueue[DataReader]" = queue.SimpleQueue()


def _remove_listener(reader: DataReader) -> None:
    with contextlib.suppress(DDSException):  # DDS has deleted the reader together with its participant
        reader.set_listener(None)


@functools.cache
def _start_deletion() -> None:
    """Starts the thread that deletes unused readers."""
    threading.Thread(target=_delete_unused, daemon=True).start()


def _delete_unused() -> None:
    # While a listener is called, its thread has a reference to the reader. If it were the last one, this thread would
    # delete the reader, and wait for ever for the end of its own call. So the listener is removed before.
    while True:
        reader = _UNUSED.get()
        _remove_listener(reader)
        del reader


@atexit.register
def _remove_listeners() -> None:
    # At the end of the interpreter, a thread of Cyclone DDS that calls a listener would wait for ever, and the deletion
    # of the reader would wait for this thread.
    for reader in list(_READERS):
        _remove_listener(reader)


def dds_topic(topic: str) -> str:
    """Returns the DDS name of a ROS 2 topic, e.g. "rt/PSM1/measured_js" for "/PSM1/measured_js"."""
    return f"{DDS_PREFIX}/{topic.removeprefix('/')}"


def ros_qos(
    depth: int, *, reliable: bool = True, latched: bool = False, type_hash: str = "", ignore_own: bool = False
) -> Qos:
    """Returns the quality of service of the dVRK's topics: by default reliable and volatile.

    Args:
        depth: Number of messages that a publisher or a subscription keeps.
        reliable: Whether lost messages are sent again.
        latched: Whether subscriptions that join later receive earlier messages.
        type_hash: Type hash to announce. "": no type hash is announced.
        ignore_own: Whether a subscription ignores the publishers of its own domain object.
    """
    reliability = Policy.Reliability.Reliable(duration(milliseconds=_MAX_BLOCKING))
    policies = [
        reliability if reliable else Policy.Reliability.BestEffort,
        Policy.Durability.TransientLocal if latched else Policy.Durability.Volatile,
        Policy.History.KeepLast(depth),
    ]
    if latched:
        # This history is for subscriptions that join later. By default, it has one message.
        unlimited = -1
        history = Policy.History.KeepLast(depth)
        policies.append(Policy.DurabilityService(0, history, unlimited, unlimited, unlimited))
    if type_hash:
        policies.append(Policy.Userdata(f"typehash={type_hash};".encode()))
    if ignore_own:
        policies.append(Policy.IgnoreLocal.Participant)
    return Qos(*policies)


class Publisher(Generic[Message]):
    """Publisher of one topic.

    Attributes:
        topic: ROS 2 name of the topic.
    """

    def __init__(
        self, participant: DomainParticipant, topic: str, message_type: type[Message], depth: int, latched: bool
    ) -> None:
        """Creates a publisher, see `RosDomain.advertise`."""
        self.topic = topic
        qos = ros_qos(depth, latched=latched, type_hash=type_hash(message_type))
        self._writer = DataWriter(participant, Topic(participant, dds_topic(topic), message_type), qos=qos)

    def publish(self, message: Message) -> None:
        """Publishes a message.

        Raises:
            DvrkDrakeError: DDS could not send the message, e.g. because a subscription does not acknowledge messages.
        """
        try:
            self._writer.write(message)
        except DDSException as error:
            raise DvrkDrakeError(f"{self.topic}: the message could not be sent: {error}") from error

    def close(self) -> None:
        """Ends the publisher. It must not be used any more."""
        del self._writer

    def num_subscribers(self) -> int:
        """Returns the number of subscriptions that receive the messages."""
        return len(self._writer.get_matched_subscriptions())

    def subscriber_participants(self) -> set[UUID]:
        """Returns the DDS participants with subscriptions that receive the messages."""
        data = map(self._writer.get_matched_subscription_data, self._writer.get_matched_subscriptions())
        return {endpoint.participant_key for endpoint in data if endpoint is not None}

    def wait_until_received(self, seconds: float) -> bool:
        """Waits until all subscriptions have confirmed all messages, at most `seconds`. Returns whether they have."""
        try:
            return bool(self._writer.wait_for_acks(duration(seconds=seconds)))
        except AttributeError:  # cyclonedds 11.0.1 raises this error instead of returning False after the time limit
            return False


class Subscription(Generic[Message]):
    """Messages of one topic.

    Attributes:
        topic: ROS 2 name of the topic.
        num_malformed: Number of messages that could not be decoded, e.g. because a text is not UTF-8. DDS itself
            discards messages of another layout.
    """

    def __init__(
        self,
        participant: DomainParticipant,
        topic: str,
        message_type: type[Message],
        qos: Qos,
        depth: int,
        notify: Callable[[DataReader], None] | None,
    ) -> None:
        """Subscribes to a topic, see `RosDomain.subscribe`."""
        self.topic, self.num_malformed = topic, 0
        self._message_type = message_type
        # DDS keeps `depth` messages. The end of a publisher is a sample as well.
        self._at_once = depth + 1
        # The listener must not refer to this object. In a reference cycle, cyclonedds frees the listener, but does not
        # delete the reader in DDS, and the next event causes a segmentation fault.
        listener = Listener()
        if notify is not None:
            listener.set_on_data_available(notify)
        self._reader = DataReader(
            participant, Topic(participant, dds_topic(topic), message_type), qos=qos, listener=listener
        )
        _READERS.add(self._reader)
        _LISTENERS.append(listener)
        _start_deletion()
        self._end = weakref.finalize(self, _UNUSED.put, self._reader)
        self._end.atexit = False

    def close(self) -> None:
        """Ends the subscription. It must not be used any more."""
        _remove_listener(self._reader)
        del self._reader
        self._end()

    def take(self) -> list[tuple[Message, int]]:
        """Returns messages since the last call, with their times of publication [ns since 1970].

        At most as many samples are taken as DDS keeps, so that a flood of messages cannot delay the caller for ever.
        """
        messages: list[tuple[Message, int]] = []
        for _ in range(self._at_once):
            try:
                samples = self._reader.take(1)
            except DDSException:
                raise
            except Exception:  # the decoder raises exceptions of many types for a malformed message
                self.num_malformed += 1
                continue
            if not samples:
                break
            sample = samples[0]
            if isinstance(sample, self._message_type):
                messages.append((sample, sample.sample_info.source_timestamp))
        return messages

    def num_publishers(self) -> int:
        """Returns the number of publishers whose messages are received."""
        return len(self._reader.get_matched_publications())

    def publisher_participants(self) -> set[UUID]:
        """Returns the DDS participants with publishers whose messages are received."""
        data = map(self._reader.get_matched_publication_data, self._reader.get_matched_publications())
        return {endpoint.participant_key for endpoint in data if endpoint is not None}


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
        """Joins the domain with this number; see `dvrk_drake.systems.ros.discovery.open_ros_domain`.

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
