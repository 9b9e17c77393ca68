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
from dvrk_drake.processes.recorder import FIRST_STATUS, ArmRecorder, MissingMessages
from dvrk_drake.recordings.reader_rosbag import JOINT_STATE
from dvrk_drake.recordings.writer_mcap import FrameMessages, GrowingMcap, Topic, joint_state_topics
from dvrk_drake.recordings.writer_stream import check_stream_output
from dvrk_drake.systems.ros.discovery import find_topic
from dvrk_drake.systems.ros.open_domain import open_ros_domain

if TYPE_CHECKING:
    from dvrk_drake.systems.ros.domain import RosDomain, Subscription
    from dvrk_drake.systems.ros.messages import JointState

#: Messages of one topic that may arrive while the recorder writes. Older messages are lost.
_DEPTH = 5000


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
        self._num_valid = 0
        self._num_invalid = 0
        self._subscriptions: list[Subscription[JointState]] = []
        self._silent: set[str] = set()
        self._missing: dict[str, MissingMessages] = {}
        self._frames: FrameMessages | None = None
        self._positions: dict[str, float] = {}

    @property
    def num_rows(self) -> int:
        """Number of recorded valid messages of the arm, without those on a separate topic, e.g. of the jaw."""
        return self._num_valid

    def run(self, duration: float, stopped: Callable[[], bool], show: Callable[[Callable[[], str]], None]) -> None:
        """Records, then leaves the domain; see `ArmRecorder.run`."""
        with closing(self._domain):
            super().run(duration, stopped, show)

    def update(self) -> None:
        """Records the messages that have arrived."""
        for subscription in self._subscriptions:
            for message, published in subscription.take():
                self._record(subscription, message, published)

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
        """Waits for the topic of the arm, then subscribes to it and to the separate topic, if there is one."""
        from dvrk_drake.systems.ros.messages import JointState

        main = find_topic(self._domain, self.arm, self._topic, stopped=stopped, report=self._report)
        topics = self._domain.joint_state_topics()
        others = joint_state_topics(self.arm, main.rpartition("/")[0])[1:]
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
            self._missing[subscription.topic].add(message.header.nanoseconds)
        self._silent.discard(subscription.topic)
        if subscription is self._subscriptions[0]:
            self._num_valid += is_valid
            self._rate.add(time.monotonic())

    def _write_frames(self, bag: GrowingMcap, message: JointState, arrived: int) -> None:
        """Writes the transforms at the latest positions of all joints, once all joints have been measured."""
        assert self._frames is not None
        self._positions |= zip(message.name, message.position, strict=False)
        if all(joint in self._positions for joint in self.arm.joint_names):
            q = np.array([self._positions[joint] for joint in self.arm.joint_names])
            stamp = message.header.stamp.sec * 1_000_000_000 + message.header.stamp.nanosec
            self._frames.write(bag, stamp, q, arrived)

    def _check_joints(self, message: JointState) -> None:
        needed = [joint for joint in self.arm.joint_names if joint != self.arm.separate_joint]
        if missing := [joint for joint in needed if joint not in message.name]:
            raise RecordingError(
                f"{self._subscriptions[0].topic} has the joints {', '.join(message.name) or 'none'}; {self.arm.name} "
                f"also needs {', '.join(missing)}. Check --arm, --topic and the instrument."
            )

    def _wait(self, seconds: float) -> None:
        self._domain.wait(seconds)

    def _awaited(self) -> str:
        return f"a valid message on {self._subscriptions[0].topic}"

    def _details(self) -> list[str]:
        return [f"{self._num_missing()} missing", *(f"no message on {topic}" for topic in sorted(self._silent))]

    def _no_measurement_reason(self, was_stopped: bool) -> str:
        topic = f"{self._subscriptions[0].topic} of {self.source}"
        if self._num_invalid:
            return f"{topic}: all {self._num_invalid} messages have header stamp 0 (invalid data). Home the arm first."
        if was_stopped:
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
