"""Records the joint states of one arm from ROS 2 to a bag, for `dvrk-drake record --transport ros`."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from dvrk_drake.errors import RecordingError
from dvrk_drake.models.arm import Arm
from dvrk_drake.processes.recorder import FIRST_STATUS, MissingMessages, Rate
from dvrk_drake.recordings.reader_rosbag import JOINT_STATE
from dvrk_drake.recordings.writer_mcap import FrameMessages, GrowingMcap, Topic, joint_state_topics
from dvrk_drake.recordings.writer_stream import check_stream_output
from dvrk_drake.systems.ros.discovery import find_topic
from dvrk_drake.systems.ros.open_domain import open_ros_domain

if TYPE_CHECKING:
    from dvrk_drake.systems.ros.domain import RosDomain
    from dvrk_drake.systems.ros.messages import JointState
    from dvrk_drake.systems.ros.topic import Subscription

#: Longest wait for a message between two checks for a stop [s].
_POLL = 0.1
#: Messages of one topic that may arrive while the recorder writes. Older messages are lost.
_DEPTH = 5000


class RosRecorder:
    """Writes the unmodified JointState messages of one arm to a new bag while they arrive, with its transforms.

    Attributes:
        path: Path of the bag.
        source: Name of the ROS domain, for messages.
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
        self._arm, self.path, self._topic = arm, path, topic
        self._report = report
        self._domain = open_ros_domain(domain) if domain is None or isinstance(domain, int) else domain
        self.source = self._domain.name
        self.num_rows = 0
        self._num_invalid = 0
        self._rate = Rate()
        self._subscriptions: list[Subscription[JointState]] = []
        self._silent: set[str] = set()
        self._missing: dict[str, MissingMessages] = {}
        self._bag: GrowingMcap | None = None
        self._frames: FrameMessages | None = None
        self._positions: dict[str, float] = {}

    def run(self, duration: float, stopped: Callable[[], bool], show: Callable[[Callable[[], str]], None]) -> None:
        """Records until `stopped` returns true, or until `duration` has elapsed since the first message.

        Args:
            duration: Duration of the recording [s], which may be infinite.
            stopped: Function that returns whether to stop. It is called at least every 0.1 s.
            show: Function that is called after every message, and every 0.1 s without messages. Its argument is a
                function that returns the text of the status line.

        Raises:
            RecordingError: The arm was not found, see `find_topic`. No valid message arrived within 10 s, the messages
                have other joints, or the file cannot be written.
        """
        with closing(self._domain):
            self.subscribe(stopped)
            self._record_until(duration, stopped, show)
        if self._bag is None:
            raise RecordingError(self._no_message_reason(stopped()))

    def _record_until(
        self, duration: float, stopped: Callable[[], bool], show: Callable[[Callable[[], str]], None]
    ) -> None:
        end = time.monotonic() + FIRST_STATUS
        try:
            while not stopped() and time.monotonic() < end:
                self._domain.wait(_POLL)
                before = self._bag
                self.update()
                if before is None and self._bag is not None:
                    end = time.monotonic() + duration
                show(self.describe)
        finally:
            self.close()

    def update(self) -> None:
        """Records the messages that have arrived.

        Raises:
            RecordingError: The messages have other joints, or the file cannot be written.
        """
        for subscription in self._subscriptions:
            for message, published in subscription.take():
                self._record(subscription, message, published)

    def close(self) -> None:
        """Ends the file."""
        if self._bag is not None:
            self._bag.close()

    def describe(self) -> str:
        """Returns the text of the status line: the number of messages, the rate, and missing messages."""
        rate = self._rate.per_second(time.monotonic())
        if self._bag is None:
            return f"waiting for a valid message on {self._subscriptions[0].topic}"
        if rate is None:
            return f"{self._arm.name}: no more messages; {self.num_rows} rows"
        parts = [f"{self._arm.name}: {self.num_rows} rows", f"{rate} Hz", f"{self._num_missing()} missing"]
        return ", ".join([*parts, *(f"no message on {topic}" for topic in sorted(self._silent))])

    def notes(self) -> list[str]:
        """Returns one line each for missing messages, invalid messages, and topics without messages."""
        counts = {
            "messages missing (gaps of the time stamps)": self._num_missing(),
            "messages with header stamp 0, which marks invalid data": self._num_invalid,
        }
        lines = [f"{text}: {count}" for text, count in counts.items() if count]
        if self._num_missing():
            lines[0] += f", longest gap {max(missing.longest for missing in self._missing.values()):.3g} s"
        silent = [f"no message on {topic}; commands of dvrk-drake need this topic" for topic in sorted(self._silent)]
        return [*lines, *silent]

    def subscribe(self, stopped: Callable[[], bool]) -> None:
        """Waits for the topic of the arm, then subscribes to it and to the separate topic, if there is one.

        Raises:
            RecordingError: The arm was not found, see `find_topic`.
        """
        from dvrk_drake.systems.ros.messages import JointState

        main = find_topic(self._domain, self._arm, self._topic, stopped=stopped, report=self._report)
        topics = self._domain.joint_state_topics()
        others = joint_state_topics(self._arm, main.rpartition("/")[0])[1:]
        for name in (main, *(topic.name for topic in others)):
            subscription = self._domain.subscribe(name, JointState, depth=_DEPTH, reliable=topics.get(name, True))
            self._subscriptions.append(subscription)
            self._silent.add(name)
            self._missing[name] = MissingMessages()

    def _record(self, subscription: Subscription[JointState], message: JointState, published: int) -> None:
        """Writes a message. The bag is created at the first valid message of the arm."""
        is_valid = bool(message.header.stamp.sec or message.header.stamp.nanosec)
        if subscription is self._subscriptions[0]:
            self._num_invalid += not is_valid
            if self._bag is None and is_valid:
                self._check_joints(message)
                self._frames = FrameMessages(self._arm, subscription.topic.rpartition("/")[0])
                measured = [Topic(each.topic, JOINT_STATE) for each in self._subscriptions]
                self._bag = GrowingMcap(self.path, [*measured, *self._frames.topics])
        if self._bag is None:
            return
        # ROS 2 uses version 1 of the CDR encoding.
        arrived = time.time_ns()
        self._bag.write_encoded(subscription.topic, message.serialize(use_version_2=False), published, arrived)
        if is_valid:
            self._write_frames(message, arrived)
            self._missing[subscription.topic].add(message.header.nanoseconds)
        self._silent.discard(subscription.topic)
        if subscription is self._subscriptions[0]:
            self.num_rows += is_valid
            self._rate.add(time.monotonic())

    def _write_frames(self, message: JointState, arrived: int) -> None:
        """Writes the transforms at the latest positions of all joints, once all joints have been measured."""
        assert self._bag is not None and self._frames is not None
        self._positions |= zip(message.name, message.position, strict=False)
        if all(joint in self._positions for joint in self._arm.joint_names):
            q = np.array([self._positions[joint] for joint in self._arm.joint_names])
            stamp = message.header.stamp.sec * 1_000_000_000 + message.header.stamp.nanosec
            self._frames.write(self._bag, stamp, q, arrived)

    def _check_joints(self, message: JointState) -> None:
        needed = [joint for joint in self._arm.joint_names if joint != self._arm.separate_joint]
        if missing := [joint for joint in needed if joint not in message.name]:
            raise RecordingError(
                f"{self._subscriptions[0].topic} has the joints {', '.join(message.name) or 'none'}; {self._arm.name} "
                f"also needs {', '.join(missing)}. Check --arm, --topic and the instrument."
            )

    def _no_message_reason(self, stopped: bool) -> str:
        topic = f"{self._subscriptions[0].topic} of {self.source}"
        if self._num_invalid:
            return f"{topic}: all {self._num_invalid} messages have header stamp 0 (invalid data). Home the arm first."
        if stopped:
            return f"{self.path} was not written: the recording ended before the first message on {topic}"
        return f"no message within {FIRST_STATUS:.0f} s on {topic}"

    def _num_missing(self) -> int:
        return sum(missing.count for missing in self._missing.values())


def bag_path(output: str | Path) -> Path:
    """Returns the path of the first bag of an output that does not exist: poses_1.mcap, poses_2.mcap for poses.csv."""
    output, number = Path(output), 1
    while os.path.lexists(path := output.with_name(f"{output.stem}_{number}.mcap")):
        number += 1
    return path
