"""Publishers and subscriptions of ROS 2 topics over Cyclone DDS.

The ROS 2 topic `/<ARM>/measured_js` is the DDS topic `rt/<ARM>/measured_js`
(https://design.ros2.org/articles/topic_and_service_names.html).
"""

import atexit
import contextlib
import functools
import queue
import threading
import weakref
from collections.abc import Callable
from typing import Generic, TypeVar
from uuid import UUID

from cyclonedds.core import DDSException, Listener, Policy, Qos
from cyclonedds.domain import DomainParticipant
from cyclonedds.idl import IdlStruct
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration

from dvrk_drake.errors import DvrkDrakeError
from dvrk_drake.systems.ros.messages import type_hash

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
