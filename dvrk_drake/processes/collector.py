"""Moves an arm to poses and measures holding torques: steps 4 to 6 of section III.G of Rutfield et al. (WPI, 2015)."""

from __future__ import annotations

from collections.abc import Callable, Generator
from concurrent.futures import Executor, ThreadPoolExecutor
from contextlib import ExitStack, closing, nullcontext
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.analysis.excitation.pose_file import CollectionFile, load_poses, offset_pose, pose_environment
from dvrk_drake.dynamics.identified_model import ControlModel
from dvrk_drake.errors import CollectionError
from dvrk_drake.lcmtypes import lcmt_dvrk_status
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.ranges import number_fault, within
from dvrk_drake.processes.arm_controller import ArmController, GoalController, MotionStyle
from dvrk_drake.processes.arm_mover import REST_TIME, SETTLE, ArmMover, Steps
from dvrk_drake.processes.arm_session import ArmSession
from dvrk_drake.processes.control import SILENCE
from dvrk_drake.processes.recorder import RosRecorder, bag_path
from dvrk_drake.systems.cubic_trajectory import CubicTrajectory
from dvrk_drake.systems.lcm.arm_link import ArmLink
from dvrk_drake.systems.ros.open_domain import open_ros_domain

#: Time over which measurements are averaged [s].
MEASURE = 0.25
#: Distance outside the limits that is accepted at the start [rad], [m], because the limits of two arms differ.
_START_TOLERANCE = 0.05, 0.005
#: Time after a pause during which the Enter key has no effect [s], because an operator may press it repeatedly.
_PAUSE = 1.0
#: Typical delay of an arm behind the goal [s], for the estimated duration.
DELAY = 0.7


@dataclass(frozen=True)
class CollectionSettings:
    """Settings of a pose collection.

    Attributes:
        traverse_time: Time in which a joint may cross its range [s]. It determines the speed between poses.
        both_sides: If true, each pose is approached from below and from above in all joints. Coulomb friction cancels
            in the average of the two measurements. If false, each pose is measured once, as in Rutfield et al.
        max_effort: Largest absolute difference between the measured effort and the gravity effort of the model, as a
            fraction of the effort limit of the joint. With the arm's own controller, a larger difference for 50 ms
            stops the collection. Other controllers have a command guard.

    Example:
        >>> import dvrk_drake as dvrk
        >>> dvrk.CollectionSettings(traverse_time=10.0).both_sides
        True
    """

    traverse_time: float = field(default=5.0, metadata=within(1.0, 60.0, "s"))
    both_sides: bool = True
    max_effort: float = field(default=0.6, metadata=within(0.05, 2.0))

    def __post_init__(self) -> None:
        if fault := number_fault(self):
            raise CollectionError(f"collection settings: {fault}")


class Collector(ArmMover):
    """Moves an arm to poses and measures them, until all poses are measured.

    The collection ends with an error if the guard holds the arm, if a joint does not follow its target, or if the file
    cannot be written. After the end of the collection, the caller must command HOLD.

    Attributes:
        unsettled: Numbers (from 1) of the poses that were skipped because the arm did not come to rest.
        done: Boolean array (m,), true for poses that are in the file.
        paused: Whether the collection is paused. The arm then holds its pose.
    """

    def __init__(
        self,
        poses: NDArray[np.float64],
        controller: ArmController | GoalController,
        output: CollectionFile,
        settings: CollectionSettings,
        *,
        stopped: Callable[[], bool] = lambda: False,
        enter: Callable[[], bool] | None = None,
        report: Callable[[str], None] = lambda line: None,
        writer: Executor | None = None,
    ) -> None:
        """Creates a collector for the arm of `controller`.

        Args:
            poses: Poses (m, n) [rad, m], checked by `check_poses`. Poses that are already in `output` are skipped.
            controller: Controller that computes the commands.
            output: File for the measurements.
            settings: Settings of the collection.
            stopped: Function that returns whether to stop. It is called once per status.
            enter: Function that returns whether the Enter key was pressed. The key pauses and continues. After a pause,
                the present pose is approached again. None: there is no such key.
            report: Function that is called with one line per completed pose.
            writer: Executor that writes the rows of the file. None: a separate thread is used.

        Raises:
            CollectionError: `output` contains other poses.
        """
        self.unsettled: list[int] = []
        self.done = output.finished(poses)
        self.paused, self._paused_at, self._pose_end = False, 0.0, 0.0
        self._poses, self._output, self._settings, self._enter = poses, output, settings, enter
        self._num_before = np.count_nonzero(self.done)
        super().__init__(controller, settings.traverse_time, stopped=stopped, report=report)
        # Writing to disk may take longer than the arm waits for a command.
        self._writer = writer or ThreadPoolExecutor(max_workers=1)

    def update(self, status: lcmt_dvrk_status, time: float) -> NDArray[np.float64] | None:
        """Processes a status and returns the desired state (2n,); see `ArmMover.update`."""
        if self._enter is not None and self._in_control and not self._stopping and self._enter():
            self._pause_or_continue()
        return super().update(status, time)

    def close(self) -> None:
        """Waits until a pending row is written, then closes the file."""
        self._writer.shutdown()
        self._output.close()

    def describe(self) -> str:
        """Returns a short description of the progress."""
        text = f"{np.count_nonzero(self.done)} of {len(self.done)} poses, {self._activity}"
        if self._enter is None:
            return text
        return f"{text}; Enter continues" if self.paused else f"{text}{self._time_left()}; Enter pauses"

    def _time_left(self) -> str:
        count = np.count_nonzero(self.done) - self._num_before
        if not count or self.done.all():
            return ""
        left = self._pose_end * (1 + np.count_nonzero(~self.done) / count) - self._time
        return f"; about {max(left, 0.0) / 60:.1f} min left"

    def _pause_or_continue(self) -> None:
        if not self.paused:
            self.paused, self._paused_at = True, self._time
            self._steps = self._pause()
            self._report("paused: the arm holds its pose; Enter continues")
        elif self._time >= self._paused_at + _PAUSE:
            self.paused = self._halted = False
            if self._style.waits:  # the operator may have moved the arm
                self._desired = np.concatenate([self._q, np.zeros_like(self._q)])
            self._steps = self._task()
            self._report("continued")

    def _pause(self) -> Steps:
        yield from self._brake()
        self._halted, self._activity = True, "paused"
        while True:
            yield

    def _task(self) -> Steps:
        """Measures the remaining poses. After a pause, a new call repeats the present pose from the beginning."""
        if outside := self._arm.limit_violations(self._q, self._arm.per_limit(*_START_TOLERANCE)):
            raise CollectionError(
                f"{self._arm.name} cannot start: {'; '.join(outside)} [rad, m]. Move the arm inside its limits first"
            )
        yield from self._begin()
        for k in np.flatnonzero(~self.done):
            if k + 1 not in self.unsettled:
                yield from self._measure_pose(int(k))

    def _measure_pose(self, k: int) -> Steps:
        """Moves the arm to pose `k` from one or both sides and writes the measurement."""
        measured: list[NDArray[np.float64]] = []
        for begin in approaches(self._arm, self._poses[k], self._settings, self._style):
            for goal, rest, share in _motions(begin, self._poses[k], self._style):
                self._activity = f"going to pose {k + 1}"
                yield from self._move_to(goal, share)
                self._activity = f"settling at pose {k + 1}"
                if rest and not (yield from self._settle(rest)):
                    self.unsettled.append(k + 1)
                    self._report(f"pose {k + 1} skipped: the arm did not come to rest within {SETTLE:.0f} s")
                    return
            self._activity = f"measuring pose {k + 1}"
            measured.append((yield from self._measure()))
        row = np.split(np.mean(measured, axis=0), 2)
        if self._settings.both_sides:
            row.append((measured[0] - measured[1])[self._arm.num_joints :] / 2)
        yield from self._write(k, *row)
        self._pose_end = self._time
        self._report(f"pose {k + 1} measured, {np.count_nonzero(self.done)} of {len(self.done)}{self._time_left()}")

    def _measure(self) -> Generator[None, None, NDArray[np.float64]]:
        """Returns the means of q (n,) and tau (n,), concatenated, over the next `MEASURE` seconds."""
        end = self._time + MEASURE
        samples = []
        while self._time < end:
            samples.append(np.concatenate([self._q, self._tau]))
            yield
        return np.mean(samples, axis=0)

    def _write(self, k: int, *row: NDArray[np.float64]) -> Steps:
        self._activity = f"writing pose {k + 1}"
        writing = self._writer.submit(self._store, k, *row)
        while not writing.done():
            yield
        writing.result()

    def _store(self, k: int, *row: NDArray[np.float64]) -> None:
        self._output.append(self._poses[k], *row)
        self.done[k] = True


def approaches(
    arm: Arm, pose: NDArray[np.float64], settings: CollectionSettings, style: MotionStyle
) -> list[NDArray[np.float64] | None]:
    """Returns the pose (n,) at which each approach to `pose` begins, or None for an approach from anywhere."""
    if not settings.both_sides:
        return [None]
    return [offset_pose(arm, pose, side * style.approach_offset) for side in (-1, 1)]


def estimated_duration(
    arm: Arm, q: NDArray[np.float64], poses: NDArray[np.float64], settings: CollectionSettings
) -> float:
    """Returns the estimated duration [s] of a collection of poses (m, n) that begins at q (n,), over ROS 2."""
    speed, style, total = (
        (arm.position_upper - arm.position_lower) / settings.traverse_time,
        MotionStyle.of_goals(arm),
        0.0,
    )
    for pose in poses:
        for begin in approaches(arm, pose, settings, style):
            for goal, rest, share in _motions(begin, pose, style):
                total += CubicTrajectory.rest_to_rest(q, goal, share * speed).duration + rest + DELAY
                q = goal
            total += MEASURE
    return total


def summary(arm: Arm, q: NDArray[np.float64], poses: NDArray[np.float64], settings: CollectionSettings) -> list[str]:
    """Returns lines on the poses (m, n) of a collection that begins at q (n,): ranges of the goals, and duration."""
    width, style = max(map(len, arm.joint_names)), MotionStyle.of_goals(arm)
    begins = [begin for pose in poses for begin in approaches(arm, pose, settings, style) if begin is not None]
    goals = np.array([*poses, *begins])
    lines = [f"{'':{width}}     present        goals [{'rad, m' if arm.prismatic.any() else 'rad'}]"]
    for j, name in enumerate(arm.joint_names):
        lines.append(f"{name:{width}}  {q[j]:10.3f}  {goals[:, j].min():10.3f} to {goals[:, j].max():.3f}")
    sides = "both sides" if settings.both_sides else "one side"
    minutes = estimated_duration(arm, q, poses, settings) / 60
    lines.append(f"{len(poses)} poses, each approached from {sides}; estimated duration {minutes:.1f} min")
    return lines


def _motions(
    begin: NDArray[np.float64] | None, pose: NDArray[np.float64], style: MotionStyle
) -> list[tuple[NDArray[np.float64], float, float]]:
    """Returns (goal, time at rest [s], fraction of the speed) of the motions to `pose` through `begin`."""
    if begin is None:
        return [(pose, REST_TIME, 1.0)]
    return [(begin, style.approach_rest, 1.0), (pose, REST_TIME, style.approach_speed)]


def collect_poses(
    session: ArmSession, poses: str | Path, output: str | Path, settings: CollectionSettings
) -> Collector | None:
    """Moves an arm to poses and measures its efforts; see `ArmConnection.collect_poses`."""
    arm, dialog = session.arm, session.dialog
    checked, file = load_poses(poses, arm), CollectionFile(output, arm, settings.both_sides)
    remaining = checked[~file.finished(checked)]
    if not len(remaining):
        dialog.report(f"{output}: contains all {len(checked)} poses already")
        return None
    dialog.report(f"{len(remaining)} poses of {arm.name} remain; a later call continues after an interruption")
    controller: ArmController | GoalController
    link: ArmLink
    bag: RosRecorder | None = None
    if session.transport == "lcm":
        controller, link = session.start("hold")
        (first, *_) = approaches(arm, remaining[0], settings, controller.style)
        _, link = session.check_path(link, remaining[0] if first is None else first, pose_environment(poses))
    else:
        started = _start_goals(session, output, remaining, settings)
        if started is None:
            return None
        controller, link, bag = started
    collector = Collector(
        checked, controller, file, settings, stopped=dialog.stopped, enter=dialog.enter, report=dialog.report
    )

    def on_status(status: lcmt_dvrk_status, time: float) -> NDArray[np.float64] | None:
        if bag is not None:
            bag.update()
        return collector.update(status, time)

    with closing(bag) if bag is not None else nullcontext(), closing(collector):
        session.control(link, controller, lambda: collector.finished, collector.describe, on_status)
    if bag is not None:
        for line in (f"{bag.num_rows} messages; hold was published", *bag.notes()):
            dialog.report(f"{bag.path}: {line}")
    return collector


def _start_goals(
    session: ArmSession, output: str | Path, remaining: NDArray[np.float64], settings: CollectionSettings
) -> tuple[GoalController, ArmLink, RosRecorder] | None:
    """Connects to an arm that the dVRK moves, and starts a bag. Returns None if the operator stopped the command."""
    from dvrk_drake.systems.ros.crtk_link import connect_move_link

    session.ready()
    arm, dialog, model = session.arm, session.dialog, ControlModel(session.model)
    with ExitStack() as after_error:
        ros = after_error.enter_context(closing(open_ros_domain(session.domain)))
        link = connect_move_link(
            ros, arm, model, session.topic, settings.max_effort, report=dialog.report, stopped=dialog.stopped
        )
        for line in summary(arm, np.array(link.next_status(SILENCE).position), remaining, settings):
            dialog.report(line)
        dialog.confirm()
        if dialog.stopped():
            return None
        bag = RosRecorder(arm, bag_path(output), link.where, ros)
        bag.subscribe(dialog.stopped)
        after_error.pop_all()
    return GoalController(arm, lambda: link.is_busy), link, bag
