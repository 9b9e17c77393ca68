"""Measures holding torques of a dVRK arm at poses through CRTK: the arm's own controller moves the arm with `move_jp`.

The goals of `move_jp` follow a straight line in joint space, which is inside all limits if both ends are. The arm never
has a goal that is far away: each goal is at most a tenth of a joint's range ahead of the measured pose. If this program
or its network connection ends, the arm therefore stops after this distance and holds its pose. A deadman process is
only needed for efforts, which act until another command arrives.

A position command also has this advantage: the dVRK's own gravity compensation does not act in position mode, so the
measured efforts are those that hold the arm.
"""

from __future__ import annotations

from collections.abc import Callable, Generator
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.dynamics.identified_model import ControlModel
from dvrk_drake.errors import CollectionError, DvrkDrakeError
from dvrk_drake.models.approach import approach_offset, offset_pose
from dvrk_drake.models.schema_fault import number_fault, within
from dvrk_drake.processes.arm_mover import MAX_TRACKING_ERROR, REST, REST_TIME, SETTLE, Steps
from dvrk_drake.processes.collector import MEASURE, CollectionSettings
from dvrk_drake.processes.crtk_monitor import CrtkMonitor, unit
from dvrk_drake.processes.teacher import RestDetector
from dvrk_drake.recordings.pose_file import CollectionFile
from dvrk_drake.systems.cubic_trajectory import CubicTrajectory

if TYPE_CHECKING:
    from dvrk_drake.models.arm import Arm
    from dvrk_drake.systems.ros.crtk_client import CrtkClient

#: Time between two goals of a motion [s].
GOAL_PERIOD = 0.1
#: Time without progress towards the goal after which a motion is stopped [s]. Smallest progress, as a fraction of the
#: range of the joint.
STALL, _PROGRESS = 2.0, 0.005
#: Speed of an approach as a fraction of the speed of other motions. A fast approach would end with an overshoot, which
#: changes the friction at the pose.
_APPROACH_SPEED = 0.4
#: Time for which the arm must be at rest at the start of an approach [s].
APPROACH_REST = 0.2
#: Distance outside the limits that is accepted at the start [rad], [m], because the limits of two arms differ.
_START_TOLERANCE = 0.05, 0.005
#: Time after a pause during which the Enter key has no effect [s], because an operator may press it repeatedly.
_PAUSE = 1.0
#: Largest time step of a motion [s]. It prevents a distant goal after this process was suspended.
_MAX_STEP = 0.05
#: Typical delay of an arm behind the goal [s], for the estimated duration.
DELAY = 0.7


@dataclass(frozen=True)
class CrtkCollectionSettings(CollectionSettings):
    """Settings of a pose collection through CRTK.

    Attributes:
        max_effort: Largest absolute difference between the measured effort and the gravity effort of the model, as a
            fraction of the effort limit of the joint. A larger difference for 50 ms stops the collection.
    """

    max_effort: float = field(default=0.6, metadata=within(0.05, 2.0))

    def __post_init__(self) -> None:
        if fault := number_fault(self):
            raise CollectionError(f"collection settings: {fault}")


class CrtkCollector:
    """Commands an arm through CRTK and writes one row per pose, until all poses are measured.

    The collection ends after the last pose, or if `stopped` returns true. It ends with an error in these cases:

    - The measured effort differs too much from the gravity effort of the model.
    - The arm does not follow the goals.
    - measured_js stops, or a position or a time stamp jumps, or a value is not finite.
    - The arm is not enabled and homed any more, or does not subscribe to `move_jp` any more.
    - Another process could move the arm.

    After the end of the collection, the caller must publish `hold`.

    Attributes:
        finished: True after the end of the collection.
        problem: Error that ended the collection early, or None.
        paused: Whether the collection is paused. The arm then holds its pose.
        unsettled: Numbers (from 1) of the poses that were skipped because the arm did not come to rest.
        done: Boolean array (m,), true for poses that are in the file.
    """

    def __init__(
        self,
        poses: NDArray[np.float64],
        client: CrtkClient,
        output: CollectionFile,
        settings: CrtkCollectionSettings,
        model: ControlModel,
        *,
        stopped: Callable[[], bool] = lambda: False,
        enter: Callable[[], bool] = lambda: False,
        report: Callable[[str], None] = lambda line: None,
    ) -> None:
        """Creates a collector.

        Args:
            poses: Poses (m, n) [rad, m], checked by `check_poses`. Poses that are already in `output` are skipped.
            client: Client of the arm.
            output: File for the measurements.
            settings: Settings of the collection.
            model: Model of the arm, for the limit of the effort.
            stopped: Function that returns whether to stop.
            enter: Function that returns whether the Enter key was pressed. The key pauses and continues.
            report: Function that is called with one line per completed pose.

        Raises:
            CollectionError: `output` contains other poses.
        """
        self.finished = self.paused = False
        self.problem: DvrkDrakeError | None = None
        self.unsettled: list[int] = []
        self.done = output.finished(poses)
        self._arm = arm = client.arm
        self._poses, self._client, self._output, self._settings = poses, client, output, settings
        self._stopped, self._enter, self._report = stopped, enter, report
        self._monitor = CrtkMonitor(client, model, settings.max_effort)
        self._span = arm.position_upper - arm.position_lower
        self._tolerance = MAX_TRACKING_ERROR * self._span
        self._now = self._time = self._pose_end = self._paused_at = 0.0
        self._goal = np.zeros(arm.num_joints)
        self._num_before = np.count_nonzero(self.done)
        self._activity = "starting"
        self._steps = self._collect()

    def update(self, now: float) -> None:
        """Receives measurements and publishes the next goal, if there is one.

        Call this method when a message has arrived, and at least every 50 ms.

        Args:
            now: Present time of the monotonic clock [s].
        """
        if self.finished:
            return
        step = min(now - self._now, _MAX_STEP) if self._now else 0.0
        self._now = now
        try:
            self._monitor.update(now, with_effort=not self.paused)
            if self._stopped():
                self.finished = True
                return
            if self._enter():
                self._pause_or_continue()
            if not self.paused:
                self._time += step
                next(self._steps)
        except StopIteration:
            self.finished = True
        except DvrkDrakeError as error:
            self.problem, self.finished = error, True

    def describe(self) -> str:
        """Returns a short description of the progress."""
        text = f"{np.count_nonzero(self.done)} of {len(self.done)} poses, {self._activity}"
        return f"{text}; Enter continues" if self.paused else f"{text}{self._time_left()}; Enter pauses"

    def _time_left(self) -> str:
        count = np.count_nonzero(self.done) - self._num_before
        if not count or self.done.all():
            return ""
        left = self._pose_end * (1 + np.count_nonzero(~self.done) / count) - self._time
        return f"; about {max(left, 0.0) / 60:.1f} min left"

    def _pause_or_continue(self) -> None:
        if not self.paused:
            self._client.hold()
            self.paused, self._paused_at, self._activity = True, self._now, "paused"
            self._report("paused: the arm holds its pose; Enter continues")
        elif self._now >= self._paused_at + _PAUSE:
            self.paused = False
            self._steps = self._collect()
            self._report("continued")

    def _collect(self) -> Steps:
        """Measures the remaining poses. After a pause, a new call repeats the present pose from the beginning."""
        if outside := self._arm.limit_violations(self._monitor.q, self._arm.per_limit(*_START_TOLERANCE)):
            raise CollectionError(
                f"{self._arm.name} cannot start: {'; '.join(outside)} [rad, m]. Move the arm inside its limits first"
            )
        self._goal = self._monitor.q
        for k in range(len(self._poses)):
            if not self.done[k] and k + 1 not in self.unsettled:
                yield from self._measure_pose(k)

    def _measure_pose(self, k: int) -> Steps:
        """Moves the arm to pose `k` from one or both sides and writes the measurement."""
        pose = self._poses[k]
        measured: list[NDArray[np.float64]] = []
        for begin in approaches(self._arm, pose, self._settings):
            for goal, rest, speed in _motions(begin, pose):
                self._activity = f"going to pose {k + 1}"
                yield from self._move_to(goal, speed)
                self._activity = f"settling at pose {k + 1}"
                if not (yield from self._settle(rest)):
                    self.unsettled.append(k + 1)
                    self._report(f"pose {k + 1} skipped: the arm did not come to rest within {SETTLE:.0f} s")
                    return
            self._activity = f"measuring pose {k + 1}"
            measured.append((yield from self._measure()))
        row = np.split(np.mean(measured, axis=0), 2)
        if self._settings.both_sides:
            row.append((measured[0] - measured[1])[self._arm.num_joints :] / 2)
        self._output.append(pose, *row)
        self.done[k], self._pose_end = True, self._time
        self._report(f"pose {k + 1} measured, {np.count_nonzero(self.done)} of {len(self.done)}{self._time_left()}")

    def _move_to(self, q_end: NDArray[np.float64], speed: float) -> Steps:
        """Publishes goals on a line to `q_end`. The goals wait while the measured pose is too far behind.

        Args:
            q_end: Last goal (n,).
            speed: Fraction of the speed that the settings define.
        """
        path = CubicTrajectory.rest_to_rest(self._goal, q_end, speed * self._span / self._settings.traverse_time)
        elapsed = waited = 0.0
        least = np.inf
        before = next_goal = self._time
        while elapsed < path.duration:
            step, before = self._time - before, self._time
            behind = float(np.max(np.abs(self._goal - self._monitor.q) / self._span))
            if behind <= MAX_TRACKING_ERROR:
                elapsed, waited, least = elapsed + step, 0.0, np.inf
            elif behind < least - _PROGRESS:
                waited, least = 0.0, behind
            elif (waited := waited + step) > STALL:
                raise self._does_not_follow()
            if self._time >= next_goal:
                next_goal = self._time + GOAL_PERIOD
                self._publish(path.state(elapsed)[: self._arm.num_joints])
            yield
        self._publish(q_end)

    def _publish(self, goal: NDArray[np.float64]) -> None:
        self._goal = goal
        self._client.move_jp(goal)

    def _settle(self, duration: float) -> Generator[None, None, bool]:
        """Waits until the arm is at rest for `duration` [s] at the last goal. Returns False if it does not settle.

        Raises:
            CollectionError: The arm is not near the goal.
        """
        detector = RestDetector(self._arm.per_joint(*REST) + 1.5 * self._arm.encoder_counts(), duration)
        end = self._time + SETTLE
        while True:
            state = self._client.operating_state
            assert state is not None
            near = np.all(np.abs(self._goal - self._monitor.q) <= self._tolerance)
            if detector.is_at_rest(self._time, self._monitor.q) and near and not state.is_busy:
                return True
            if self._time > end:
                if not near:
                    raise self._does_not_follow()
                return False
            yield

    def _measure(self) -> Generator[None, None, NDArray[np.float64]]:
        """Returns the means of q (n,) and tau (n,), concatenated, over the messages of the next `MEASURE` seconds."""
        end = self._time + MEASURE
        samples: list[NDArray[np.float64]] = []
        last = self._monitor.num_received
        while self._time < end or not samples:
            if self._monitor.num_received != last:
                samples.append(np.concatenate([self._monitor.q, self._monitor.effort]))
                last = self._monitor.num_received
            yield
        return np.mean(samples, axis=0)

    def _does_not_follow(self) -> CollectionError:
        j = int(np.argmax(np.abs(self._goal - self._monitor.q) / self._tolerance))
        return CollectionError(
            f"{self._arm.name} stopped: it does not follow. {self._arm.joint_names[j]} is at {self._monitor.q[j]:.3g} "
            f"{unit(self._arm, j)}, its goal is {self._goal[j]:.3g} {unit(self._arm, j)}. Check for an obstacle"
        )


def approaches(arm: Arm, pose: NDArray[np.float64], settings: CollectionSettings) -> list[NDArray[np.float64] | None]:
    """Returns the pose (n,) at which each approach to `pose` begins, or None for an approach from anywhere."""
    if not settings.both_sides:
        return [None]
    offset = approach_offset(arm)
    return [offset_pose(arm, pose, side * offset) for side in (-1, 1)]


def estimated_duration(
    arm: Arm, q: NDArray[np.float64], poses: NDArray[np.float64], settings: CollectionSettings
) -> float:
    """Returns the estimated duration [s] of a collection of poses (m, n) that begins at q (n,)."""
    speed, total = (arm.position_upper - arm.position_lower) / settings.traverse_time, 0.0
    for pose in poses:
        for begin in approaches(arm, pose, settings):
            for goal, rest, share in _motions(begin, pose):
                total += CubicTrajectory.rest_to_rest(q, goal, share * speed).duration + rest + DELAY
                q = goal
            total += MEASURE
    return total


def _motions(
    begin: NDArray[np.float64] | None, pose: NDArray[np.float64]
) -> list[tuple[NDArray[np.float64], float, float]]:
    """Returns (goal, time at rest [s], fraction of the speed) of the motions to `pose` through `begin`."""
    if begin is None:
        return [(pose, REST_TIME, 1.0)]
    return [(begin, APPROACH_REST, 1.0), (pose, REST_TIME, _APPROACH_SPEED)]
