"""Recorders of the measurements of one arm over LCM or ROS 2, started by `dvrk-drake record`."""

from __future__ import annotations

import os
import time
from abc import ABC, abstractmethod
from array import array
from collections import Counter, deque
from collections.abc import Callable, Sequence
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING

import lcm
import numpy as np

from dvrk_drake.errors import RecordingError
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.lcm_messages import STATUS_PREFIX, MessageKey, StatusFilter, describe_state, status_channel
from dvrk_drake.recordings.reader_lcm import StatusStream
from dvrk_drake.recordings.reader_rosbag import JOINT_STATE
from dvrk_drake.recordings.writer_mcap import FrameMessages, GrowingMcap, Topic, joint_state_topics
from dvrk_drake.recordings.writer_stream import (
    RecordingFile,
    check_stream_output,
    open_recording_file,
)
from dvrk_drake.systems.lcm.messages import handle_message
from dvrk_drake.systems.ros.discovery import find_topic
from dvrk_drake.systems.ros.open_domain import open_ros_domain

if TYPE_CHECKING:
    from dvrk_drake.systems.ros.domain import RosDomain, Subscription
    from dvrk_drake.systems.ros.messages import JointState

#: Longest time until the first status [s]. Time without a status after which the status line reports missing statuses
#: [s].
FIRST_STATUS, SILENCE = 10.0, 0.5
#: Time without a status of the session after which the statuses of a new session are recorded [s].
_RESTART = 1.0
#: Length of the queue of messages over LCM, and number of messages of one ROS topic that may arrive while the recorder
#: writes. If it is exceeded, messages are lost.
_QUEUE, _DEPTH = 20_000, 5000
#: Reasons why messages do not belong to the arm's session.
_FOREIGN = (StatusFilter.OTHER_SESSION, StatusFilter.JUMP, StatusFilter.NOT_AUTHENTIC)
#: Longest wait for a message between two checks for a stop [s].
_POLL = 0.1


def missing_messages(stamps: Sequence[int]) -> tuple[int, float]:
    """Returns the number of messages that are missing on a periodic topic, and the longest time between two [s].

    DDS does not number messages for its users, and does not report messages that it overwrites.

    Args:
        stamps: Time stamps of the received messages [ns].
    """
    intervals = np.diff(np.array(stamps))
    # An interval is 0 if a measurement was published twice, and negative if the clock was set back.
    intervals = intervals[intervals > 0]
    if len(intervals) < 2:
        return 0, 0.0
    # The stamps are times of an arm's own loop. If messages are published with a period that is no multiple of the
    # period of this loop, long and short intervals alternate. The sum of two intervals is nearly constant.
    period = float(np.median(intervals[1:] + intervals[:-1])) / 2
    # A message that was published late is followed by intervals that are shorter than half a period.
    return max(int(np.sum(np.rint(intervals / period) - 1)), 0), 1e-9 * float(intervals.max())


class ArmRecorder(ABC):
    """Writes the measurements of one arm to a new file while they arrive. A subclass receives and writes them.

    Attributes:
        arm: Recorded arm.
        path: Path of the new file, which is created at the first measurement.
        source: Network, for messages.
        num_rows: Number of recorded measurements.
    """

    source: str
    _awaited: str

    def __init__(self, arm: Arm, path: str | Path) -> None:
        """Creates a recorder without a file."""
        self.arm, self.path, self.num_rows = arm, path, 0
        self._file: RecordingFile | GrowingMcap | None = None
        self._arrivals: deque[float] = deque()

    def run(self, duration: float, stopped: Callable[[], bool], show: Callable[[Callable[[], str]], None]) -> None:
        """Records until `stopped` returns true, or until `duration` has elapsed since the first measurement.

        Args:
            duration: Duration of the recording [s], which may be infinite.
            stopped: Function that returns whether to stop. It is called at least every 0.1 s.
            show: Function that is called after every message, and every 0.1 s without messages. Its argument is a
                function that returns the text of the status line.

        Raises:
            RecordingError: The arm was not found, no valid measurement arrived within 10 s, the recording ended before
                the first one, or the file cannot be written.
        """
        try:
            end, has_begun = time.monotonic() + FIRST_STATUS, False
            while not stopped() and time.monotonic() < end:
                self._receive(_POLL)
                if not has_begun and self._file is not None:
                    end, has_begun = time.monotonic() + duration, True
                show(self.describe)
        finally:
            self.close()
        if self._file is None:
            raise RecordingError(self._no_measurement_reason(stopped()))

    def close(self) -> None:
        """Ends the file."""
        if self._file is not None:
            self._file.close()

    def describe(self) -> str:
        """Returns the text of the status line: the number of rows, the rate, and details of the transport."""
        now, arrivals = time.monotonic(), self._arrivals
        while arrivals and arrivals[0] < now - 1:
            arrivals.popleft()
        if self._file is None:
            return f"waiting for {self._awaited}"
        if not arrivals or arrivals[-1] < now - SILENCE:
            return f"{self.arm.name}: no more messages; {self.num_rows} rows"
        return ", ".join([f"{self.arm.name}: {self.num_rows} rows", f"{len(arrivals)} Hz", *self._details()])

    @abstractmethod
    def notes(self) -> list[str]:
        """Returns one line for each reason why messages were not recorded, and for missing messages."""

    @abstractmethod
    def _receive(self, seconds: float) -> None:
        """Waits for a message, at most `seconds` [s], and records the messages that have arrived."""

    @abstractmethod
    def _details(self) -> list[str]:
        """Returns the end of the status line."""

    @abstractmethod
    def _no_measurement_reason(self, was_stopped: bool) -> str:
        """Returns the reason why there was no measurement."""


class LcmRecorder(ArmRecorder):
    """Appends every status of one arm over LCM to a new file in real time.

    Attributes:
        stream: Filter that counts accepted and rejected statuses.
        num_received: Number of messages on the arm's status channel.
        foreign: Number of messages that do not belong to the arm's session and were not recorded, for each reason.
    """

    def __init__(self, arm: Arm, path: str | Path, url: str, key: MessageKey | None = None) -> None:
        """Creates a recorder.

        Args:
            arm: Arm whose statuses are recorded.
            path: Path of the new file.
            url: URL of the LCM network.
            key: Key that must have signed the statuses. None: authentication codes are not verified.

        Raises:
            RecordingError: A new file cannot be created at `path`.
        """
        check_stream_output(path)
        super().__init__(arm, path)
        self.source = f"LCM {url}"
        self.stream = StatusStream(arm.name, arm.num_joints)
        self.num_received = 0
        self.foreign: Counter[str] = Counter()
        self._filter = StatusFilter(arm.name, arm.num_joints, key, follow_after=_RESTART)
        self._url, self._channel = url, status_channel(arm)
        self._awaited = self._channel
        self._other_channels: Counter[str] = Counter()
        self._lcm = lcm.LCM(url)
        # The subscription includes all arms, so that an error message can list the channels with messages.
        self._subscription = self._lcm.subscribe(f"{STATUS_PREFIX}.*", self._on_message)
        self._subscription.set_queue_capacity(_QUEUE)

    def notes(self) -> list[str]:
        """Returns one line for each reason why messages were not recorded, and for lost messages."""
        left_out = [f"messages not recorded, {reason}: {count}" for reason, count in self.foreign.items()]
        return [*left_out, *self.stream.notes()]

    def _on_message(self, channel: str, data: bytes) -> None:
        if channel != self._channel:
            self._other_channels[channel] += 1
            return
        self.num_received += 1
        now = time.monotonic()
        reason = self._filter.examine(data, now)
        if reason in _FOREIGN:
            self.foreign[reason] += 1
            return
        self._arrivals.append(now)
        status = self.stream.accept(data)
        self.num_rows = self.stream.num_used
        if self._file is None:
            if self.stream.last is None:
                return
            self._file = open_recording_file(self.path, self.arm, self.stream)
        assert not isinstance(self._file, GrowingMcap)
        self._file.write(data, time.time_ns() // 1000, status)

    def _receive(self, seconds: float) -> None:
        handle_message(self._lcm, seconds)

    def _details(self) -> list[str]:
        status = self.stream.last
        assert status is not None
        return [f"{self.stream.num_lost} lost", describe_state(status.guard_state, status.fault_text)]

    def _no_measurement_reason(self, was_stopped: bool) -> str:
        if was_stopped:
            return f"{self.path} was not written: the recording ended before the first status of {self.arm.name}"
        where = f"on channel {self._channel} of {self._url}"
        if self.num_received:
            reasons = "; ".join(self.notes())
            return f"no status of {self.arm.name} within {FIRST_STATUS:.0f} s {where}: {reasons}"
        if others := ", ".join(sorted(self._other_channels)):
            return f"no message within {FIRST_STATUS:.0f} s {where}. Channels with messages: {others}"
        return (
            f"no message within {FIRST_STATUS:.0f} s {where}. Check that the arm's process or bridge runs on this "
            "network. Between machines, the URL needs ?ttl=1 and each machine needs a multicast route "
            "(ip route add 239.255.0.0/16 dev DEVICE)"
        )


class RosRecorder(ArmRecorder):
    """Writes the unmodified JointState messages of one arm to a new bag while they arrive, with its transforms.

    Attributes:
        num_rows: Number of recorded valid messages of the arm, without those on a separate topic, e.g. of the jaw.
    """

    def __init__(
        self,
        arm: Arm,
        path: str | Path,
        topic: str | None = None,
        domain: int | RosDomain | None = None,
        report: Callable[[str], None] = lambda line: None,
    ) -> None:
        """Creates a recorder. The file is created when the topic of the arm is found.

        Args:
            arm: Arm whose joint states are recorded. Its `separate_joint` is recorded from a separate topic.
            path: Path of the new bag, *.mcap.
            topic: JointState topic or its namespace. Default: the only topic `/<ARM>/measured_js`, in any namespace,
                where ARM is the name of the arm, optionally followed by a number.
            domain: ROS domain. None: the environment variable ROS_DOMAIN_ID, or else 0. A domain that is open already
                must have received the topics of the arm.
            report: Function that is called with one line if the search for the arm takes longer than a second.

        Raises:
            RecordingError: A new bag cannot be created at `path`.
            DvrkDrakeError: The package cyclonedds is missing, or the domain cannot be used.
        """
        check_stream_output(path, (".mcap",))
        super().__init__(arm, path)
        self._topic, self._report = topic, report
        self._domain = open_ros_domain(domain) if domain is None or isinstance(domain, int) else domain
        self.source = self._domain.name
        self._num_invalid = 0
        self._subscriptions: list[Subscription[JointState]] = []
        self._silent: set[str] = set()
        self._stamps: dict[str, array[int]] = {}
        self._frames: FrameMessages | None = None
        self._positions: dict[str, float] = {}

    def run(self, duration: float, stopped: Callable[[], bool], show: Callable[[Callable[[], str]], None]) -> None:
        """Records, then leaves the domain; see `ArmRecorder.run`."""
        with closing(self._domain):
            self.subscribe(stopped)
            super().run(duration, stopped, show)

    def update(self) -> None:
        """Records the messages that have arrived."""
        for subscription in self._subscriptions:
            for message, published in subscription.take():
                self._record(subscription, message, published)

    def notes(self) -> list[str]:
        """Returns one line each for missing messages, invalid messages, and topics without messages."""
        missing = [missing_messages(stamps) for stamps in self._stamps.values()]
        lines = []
        if count := sum(number for number, _ in missing):
            longest = max(seconds for _, seconds in missing)
            lines.append(f"messages missing (gaps of the time stamps): {count}, longest gap {longest:.3g} s")
        if self._num_invalid:
            lines.append(f"messages with header stamp 0, which marks invalid data: {self._num_invalid}")
        silent = [f"no message on {topic}; commands of dvrk-drake need this topic" for topic in sorted(self._silent)]
        return [*lines, *silent]

    def subscribe(self, stopped: Callable[[], bool]) -> None:
        """Waits for the topic of the arm, then subscribes to it and to the separate topic, if there is one."""
        from dvrk_drake.systems.ros.messages import JointState

        main = find_topic(self._domain, self.arm, self._topic, stopped=stopped, report=self._report)
        self._awaited = f"a valid message on {main}"
        topics = self._domain.joint_state_topics()
        others = joint_state_topics(self.arm, main.rpartition("/")[0])[1:]
        for name in (main, *(topic.name for topic in others)):
            subscription = self._domain.subscribe(name, JointState, depth=_DEPTH, reliable=topics.get(name, True))
            self._subscriptions.append(subscription)
            self._silent.add(name)
            self._stamps[name] = array("q")

    def _record(self, subscription: Subscription[JointState], message: JointState, published: int) -> None:
        """Writes a message. The bag is created at the first valid message of the arm."""
        is_valid = message.header.nanoseconds != 0
        if subscription is self._subscriptions[0]:
            self._num_invalid += not is_valid
            if self._file is None and is_valid:
                self._check_joints(message)
                self._frames = FrameMessages(self.arm, subscription.topic.rpartition("/")[0])
                measured = [Topic(each.topic, JOINT_STATE) for each in self._subscriptions]
                self._file = GrowingMcap(self.path, [*measured, *self._frames.topics])
        if self._file is None:
            return
        assert isinstance(self._file, GrowingMcap)
        # ROS 2 uses version 1 of the CDR encoding.
        arrived = time.time_ns()
        self._file.write_encoded(subscription.topic, message.serialize(use_version_2=False), published, arrived)
        if is_valid:
            self._write_frames(self._file, message, arrived)
            self._stamps[subscription.topic].append(message.header.nanoseconds)
        self._silent.discard(subscription.topic)
        if subscription is self._subscriptions[0]:
            self.num_rows += is_valid
            self._arrivals.append(time.monotonic())

    def _write_frames(self, bag: GrowingMcap, message: JointState, arrived: int) -> None:
        """Writes the transforms at the latest positions of all joints, once all joints have been measured."""
        assert self._frames is not None
        self._positions |= zip(message.name, message.position, strict=False)
        if all(joint in self._positions for joint in self.arm.joint_names):
            q = np.array([self._positions[joint] for joint in self.arm.joint_names])
            self._frames.write(bag, message.header.nanoseconds, q, arrived)

    def _check_joints(self, message: JointState) -> None:
        needed = [joint for joint in self.arm.joint_names if joint != self.arm.separate_joint]
        if missing := [joint for joint in needed if joint not in message.name]:
            raise RecordingError(
                f"{self._subscriptions[0].topic} has the joints {', '.join(message.name) or 'none'}; {self.arm.name} "
                f"also needs {', '.join(missing)}. Check --arm, --topic and the instrument."
            )

    def _receive(self, seconds: float) -> None:
        self._domain.wait(seconds)
        self.update()

    def _details(self) -> list[str]:
        return [f"no message on {topic}" for topic in sorted(self._silent)]

    def _no_measurement_reason(self, was_stopped: bool) -> str:
        topic = f"{self._subscriptions[0].topic} of {self.source}"
        if self._num_invalid:
            return f"{topic}: all {self._num_invalid} messages have header stamp 0 (invalid data). Home the arm first."
        if was_stopped:
            return f"{self.path} was not written: the recording ended before the first message on {topic}"
        return f"no message within {FIRST_STATUS:.0f} s on {topic}"


def bag_path(output: str | Path) -> Path:
    """Returns the path of the first bag of an output that does not exist: poses_1.mcap, poses_2.mcap for poses.csv."""
    output, number = Path(output), 1
    while os.path.lexists(path := output.with_name(f"{output.stem}_{number}.mcap")):
        number += 1
    return path
