"""Process that collects static poses of a dVRK arm on ROS 2, started by `dvrk-drake collect poses --transport ros`."""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.dynamics.identified_model import ControlModel, IdentifiedModel
from dvrk_drake.errors import CollectionError
from dvrk_drake.models.arm import Arm
from dvrk_drake.processes.crtk_collector import CrtkCollectionSettings, CrtkCollector, approaches, estimated_duration
from dvrk_drake.processes.recorder import MissingMessages
from dvrk_drake.recordings.pose_file import CollectionFile
from dvrk_drake.recordings.reader_rosbag import JOINT_STATE
from dvrk_drake.recordings.writer_mcap import GrowingMcap, Topic, joint_state_topics
from dvrk_drake.systems.ros.discovery import wait_unless_stopped
from dvrk_drake.systems.ros.open_domain import open_ros_domain

if TYPE_CHECKING:
    from dvrk_drake.systems.ros.crtk_client import CrtkClient
    from dvrk_drake.systems.ros.domain import RosDomain

#: Longest wait for a message between two updates of the collector [s].
_POLL = 0.01
#: Messages of one topic that may arrive between two updates. Older messages are lost.
_DEPTH = 5000
#: Longest time until the first valid measurement of a homed arm, and until the arm confirms `hold` [s].
_FIRST, _CONFIRMATION = 5.0, 4.0
#: Longest time until the latest operating state arrives after an older one [s].
_STATES = 2.0


@dataclass(frozen=True)
class Dialog:
    """Functions for the communication with the operator.

    Attributes:
        stopped: Function that returns whether to stop, e.g. after Ctrl-C.
        confirm: Function that returns after the operator has confirmed the first motion, or after `stopped` returns
            true.
        enter: Function that returns whether the Enter key was pressed since the last call.
        report: Function that is called with each line of text.
        show: Function that is called with a function that returns the text of the status line.
    """

    stopped: Callable[[], bool]
    confirm: Callable[[], None] = lambda: None
    enter: Callable[[], bool] = lambda: False
    report: Callable[[str], None] = lambda line: None
    show: Callable[[Callable[[], str]], None] = lambda text: None


class MeasurementBag:
    """Writes the unmodified messages on measured_js of an arm to a new bag, *.mcap."""

    def __init__(self, domain: RosDomain, arm: Arm, namespace: str, path: Path) -> None:
        """Creates the bag.

        Raises:
            RecordingError: The file exists or cannot be written.
        """
        from dvrk_drake.systems.ros.messages import JointState

        self.path = path
        topics = [topic.name for topic in joint_state_topics(arm, namespace)]
        self._subscriptions = [domain.subscribe(topic, JointState, depth=_DEPTH) for topic in topics]
        self._bag = GrowingMcap(path, [Topic(topic, JOINT_STATE) for topic in topics])
        self._missing = [MissingMessages() for _ in topics]

    def update(self) -> None:
        """Writes the messages that have arrived.

        Raises:
            RecordingError: The messages cannot be written.
        """
        for subscription, missing in zip(self._subscriptions, self._missing, strict=True):
            for message, published in subscription.take():
                if message.header.nanoseconds:  # 0 marks invalid data
                    missing.add(message.header.nanoseconds)
                # ROS 2 uses version 1 of the CDR encoding.
                data = message.serialize(use_version_2=False)
                self._bag.write_encoded(subscription.topic, data, published, time.time_ns())

    @property
    def num_missing(self) -> int:
        """Number of messages that are missing in the bag, from gaps of the time stamps."""
        return sum(missing.count for missing in self._missing)

    def close(self) -> None:
        """Ends the bag.

        Raises:
            RecordingError: The end or the index cannot be written.
        """
        self._bag.close()


def bag_path(output: str | Path) -> Path:
    """Returns the path of the first bag of an output that does not exist: poses_1.mcap, poses_2.mcap for poses.csv."""
    output, number = Path(output), 1
    while os.path.lexists(path := output.with_name(f"{output.stem}_{number}.mcap")):
        number += 1
    return path


def summary(
    arm: Arm, q: NDArray[np.float64], poses: NDArray[np.float64], settings: CrtkCollectionSettings
) -> list[str]:
    """Returns lines on the poses (m, n) of a collection that begins at q (n,): ranges of the goals, and duration."""
    width = max(map(len, arm.joint_names))
    goals = np.array([goal for pose in poses for goal in (pose, *approaches(arm, pose, settings)) if goal is not None])
    lines = [f"{'':{width}}     present        goals [{'rad, m' if arm.prismatic.any() else 'rad'}]"]
    for j, name in enumerate(arm.joint_names):
        lines.append(f"{name:{width}}  {q[j]:10.3f}  {goals[:, j].min():10.3f} to {goals[:, j].max():.3f}")
    sides = "both sides" if settings.both_sides else "one side"
    minutes = estimated_duration(arm, q, poses, settings) / 60
    lines.append(f"{len(poses)} poses, each approached from {sides}; estimated duration {minutes:.1f} min")
    return lines


def run_crtk_collection(
    arm: Arm,
    poses: NDArray[np.float64],
    output: CollectionFile,
    bag: Path,
    settings: CrtkCollectionSettings,
    dialog: Dialog,
    *,
    model: IdentifiedModel | None = None,
    topic: str | None = None,
    domain: int | None = None,
) -> CrtkCollector | None:
    """Collects poses until all are measured, or until `dialog.stopped` returns true. The arm then holds its pose.

    Args:
        arm: Arm on ROS 2.
        poses: Poses (m, n) [rad, m], checked by `check_poses`. Poses that are already in `output` are skipped.
        output: File for the measurements. It is closed at the end.
        bag: Path of the new bag for the messages on measured_js.
        settings: Settings of the collection.
        dialog: Communication with the operator.
        model: Model of the arm, for the limit of the effort. None: the model of the arm's SDF.
        topic: Topic measured_js of the arm or its namespace; see `find_arm`.
        domain: ROS domain. None: the environment variable ROS_DOMAIN_ID, or else 0.

    Returns:
        Collector at the end of the collection, or None if it ended before the first motion.

    Raises:
        DvrkDrakeError: The arm is not found or not ready, another process could move it, or a file cannot be written.
    """
    control_model = ControlModel(model or IdentifiedModel.from_arm(arm))
    remaining = poses[~output.finished(poses)]
    with contextlib.ExitStack() as stack:
        ros = stack.enter_context(contextlib.closing(open_ros_domain(domain)))
        client = _connect(ros, arm, topic, dialog)
        assert client.measurement is not None
        for line in summary(arm, client.measurement.q, remaining, settings):
            dialog.report(line)
        dialog.confirm()
        if dialog.stopped():
            return None
        collector = CrtkCollector(
            poses,
            client,
            output,
            settings,
            control_model,
            stopped=dialog.stopped,
            enter=dialog.enter,
            report=dialog.report,
        )
        recorder = MeasurementBag(ros, arm, client.namespace, bag)
        # In the case of an exception, all three are called, the last one first.
        stack.callback(recorder.close)
        stack.callback(output.close)
        stack.callback(_hold, client, dialog.report)
        while not collector.finished:
            ros.wait(_POLL)
            collector.update(time.monotonic())
            recorder.update()
            dialog.show(collector.describe)
    if recorder.num_missing:
        dialog.report(f"{bag}: messages missing (gaps of the time stamps): {recorder.num_missing}")
    return collector


def _connect(ros: RosDomain, arm: Arm, topic: str | None, dialog: Dialog) -> CrtkClient:
    """Returns a client of an arm that is enabled and homed.

    Raises:
        DvrkDrakeError: The arm is not found or not ready, another process could move it, or `dialog.stopped` returns
            true.
    """
    from dvrk_drake.systems.ros.crtk_client import connect_client

    client = connect_client(ros, arm, topic, ("move_jp", "hold"), report=dialog.report, stopped=dialog.stopped)

    def is_ready() -> bool:
        client.receive()
        return not client.not_ready_reason

    # The first state that arrives may be an older one, because the topic is latched.
    what = f"the connection to {client.namespace}"
    if not wait_unless_stopped(ros, is_ready, _STATES, dialog.stopped, what):
        raise CollectionError(f"{client.namespace}: {client.not_ready_reason}. Enable and home the arm at its console")

    def is_measured() -> bool:
        client.receive()
        return client.measurement is not None and not client.measurement.problem

    if not wait_unless_stopped(ros, is_measured, _FIRST, dialog.stopped, what):
        assert client.measurement is not None
        raise CollectionError(client.measurement.problem)
    return client


def _hold(client: CrtkClient, report: Callable[[str], None]) -> None:
    """Publishes `hold`, and reports if the arm does not confirm it."""
    if not client.hold_until_confirmed(_CONFIRMATION):
        report(f"{client.namespace}: the arm did not confirm hold. PRESS THE STOP BUTTON")
