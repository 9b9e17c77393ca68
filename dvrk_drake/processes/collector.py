"""Moves an arm to poses and measures holding torques: steps 4 to 6 of section III.G of Rutfield et al. (WPI, 2015)."""

from __future__ import annotations

from collections.abc import Callable, Generator
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.errors import CollectionError, DvrkDrakeError
from dvrk_drake.lcmtypes import lcmt_dvrk_status
from dvrk_drake.models.coupled_limits import offset_pose
from dvrk_drake.models.schema_fault import number_fault, within
from dvrk_drake.processes.arm_controller import ArmController
from dvrk_drake.processes.live_status import AnswerTimes, takeover_reason
from dvrk_drake.processes.teacher import RestDetector
from dvrk_drake.recordings.pose_file import CollectionFile
from dvrk_drake.systems.cubic_trajectory import CubicTrajectory

#: Largest time step of the trajectory between two statuses [s]. This limit prevents a jump of the desired state after a
#: pause of the computer.
_MAX_STEP = 0.01
#: Longest time until the arm applies the commanded efforts [s].
_START = 10.0
#: Position tolerance [rad], [m] of an arm at rest, to which 1.5 encoder counts are added. Time for which the arm must
#: stay within the tolerance [s]. Time after which a pose is skipped if the arm has not come to rest [s].
REST, REST_TIME, SETTLE = (2e-3, 2e-4), 0.5, 10.0
#: Time over which measurements are averaged [s].
MEASURE = 0.25
#: Duration of braking after a stop during a motion [s].
_BRAKE = 0.3
#: Largest allowed tracking error of a joint, as a fraction of the range of the joint.
MAX_TRACKING_ERROR = 0.1
#: Proportional effort of the controller at the start of an approach, divided by the effort limit. This effort
#: determines the distance of the approach. Static friction that is at most half of this effort changes its sign during
#: the approach.
APPROACH = 0.3

Steps = Generator[None, None, None]


@dataclass(frozen=True)
class CollectionSettings:
    """Settings of a pose collection.

    Attributes:
        traverse_time: Time in which a joint may cross its range [s]. It determines the speed between poses.
        both_sides: If true, each pose is approached from below and from above in all joints. Coulomb friction cancels
            in the average of the two measurements. If false, each pose is measured once, as in Rutfield et al.
    """

    traverse_time: float = field(default=5.0, metadata=within(1.0, 60.0, "s"))
    both_sides: bool = True

    def __post_init__(self) -> None:
        if fault := number_fault(self):
            raise CollectionError(f"collection settings: {fault}")


class Collector:
    """Computes the desired state of a controller in mode "hold" for each status, until all poses are measured.

    The collection ends after the last pose. It also ends if `stopped` returns true, after the arm has braked. It ends
    with an error if the guard holds the arm, if a joint does not follow its target, or if the file cannot be written.
    After the end of the collection, the caller must command HOLD.

    Attributes:
        finished: True after the end of the collection.
        problem: Error that ended the collection early, or None.
        unsettled: Numbers (from 1) of the poses that were skipped because the arm did not come to rest.
        done: Boolean array (m,), true for poses that are in the file.
    """

    def __init__(
        self,
        poses: NDArray[np.float64],
        controller: ArmController,
        output: CollectionFile,
        settings: CollectionSettings,
        *,
        stopped: Callable[[], bool] = lambda: False,
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
            report: Function that is called with one line per completed pose.
            writer: Executor that writes the rows of the file. None: a separate thread is used.
        """
        self.finished = False
        self.problem: DvrkDrakeError | None = None
        self.unsettled: list[int] = []
        self.done = output.finished(poses)
        self._arm = arm = controller.arm
        self._poses, self._controller, self._output = poses, controller, output
        self._settings, self._stopped, self._report = settings, stopped, report
        span = arm.position_upper - arm.position_lower
        self._speed, self._tracking_tolerance = span / settings.traverse_time, MAX_TRACKING_ERROR * span
        self._approach = APPROACH * arm.effort_limits / np.asarray(arm.gains.kp)
        self._time, self._status_time = 0.0, 0.0
        self._answers, self._last_applied = AnswerTimes(), lcmt_dvrk_status()
        self._q = self._tau = np.zeros(arm.num_joints)
        self._desired = np.zeros(2 * arm.num_joints)
        self._motion_end = 0.0
        self._stopping = self._in_control = False
        self._activity = "waiting for the arm"
        # Writing to disk may take longer than the arm waits for a command.
        self._writer = writer or ThreadPoolExecutor(max_workers=1)
        self._steps = self._collect()

    def update(self, status: lcmt_dvrk_status, time: float) -> NDArray[np.float64]:
        """Processes a status and returns the desired state.

        The trajectory advances with the arm's clock, which may be slower than the controller's clock.

        Args:
            status: Received status.
            time: Time of arrival on the controller's clock [s].

        Returns:
            Desired state (2n,): q, then v.
        """
        measured = 1e-6 * status.utime
        self._time += min(max(measured - self._status_time, 0.0), _MAX_STEP)
        self._status_time = measured
        self._answers.add(time)
        # controller.acting refers to the previous status. This status may already report the problem.
        if (status.guard_state, status.command_sender_id) == (status.STATE_EFFORT, self._controller.sender_id):
            self._last_applied = status
        self._q, self._tau = np.array(status.position), np.array(status.effort_measured)
        if self.finished:
            return self._desired
        try:
            if self._in_control:
                self._check(status)
            if not self._stopping and self._stopped():
                self._stopping = True
                self._steps = self._brake()
            next(self._steps)
        except StopIteration:
            self.finished = True
        except DvrkDrakeError as error:
            self.problem, self.finished = error, True
        return self._desired

    def close(self) -> None:
        """Waits until a pending row is written, then closes the file."""
        self._writer.shutdown()
        self._output.close()

    def describe(self) -> str:
        """Returns a short description of the progress."""
        return f"{np.count_nonzero(self.done)} of {len(self.done)} poses, {self._activity}"

    def _check(self, status: lcmt_dvrk_status) -> None:
        if not self._controller.acting:
            reason = takeover_reason(status, self._last_applied, self._answers)
            raise CollectionError(f"the guard of {self._arm.name} holds the arm: {reason}")
        n = self._arm.num_joints
        away = np.abs(self._q - self._desired[:n]) / self._tracking_tolerance
        if away.max() > 1:
            j = int(np.argmax(away))
            unit = "m" if self._arm.prismatic[j] else "rad"
            raise CollectionError(
                f"{self._arm.name} does not follow: {self._arm.joint_names[j]} is at {self._q[j]:.3g} {unit}, its "
                f"target is {self._desired[j]:.3g} {unit}. Check for an obstacle, then validate the model."
            )

    def _collect(self) -> Steps:
        yield from self._begin()
        began, before = self._time, np.count_nonzero(self.done)
        for k in np.flatnonzero(~self.done):
            yield from self._measure_pose(int(k))
            if self.done[k]:
                count = np.count_nonzero(self.done)
                left = (self._time - began) / (count - before) * np.count_nonzero(~self.done[k:])
                self._report(f"pose {k + 1} measured, {count} of {len(self.done)}; about {left / 60:.1f} min left")

    def _begin(self) -> Steps:
        """Waits until the efforts act and their ramp is complete. During the ramp, the target is constant."""
        began = self._time
        while not self._controller.acting:
            if self._time - began > _START:
                late = self._answers.lateness()
                raise CollectionError(
                    f"{self._arm.name} did not apply efforts within {_START:.0f} s" + (late and f": {late}")
                )
            self._desired = np.concatenate([self._q, np.zeros_like(self._q)])
            yield
        self._in_control = True
        self._activity = "starting the control"
        while not self._controller.ramped:
            yield

    def _measure_pose(self, k: int) -> Steps:
        """Moves the arm to pose `k` from one or both sides and writes the measurement."""
        pose = self._poses[k]
        measured: list[NDArray[np.float64]] = []
        for side in (-1, 1) if self._settings.both_sides else (0,):
            self._activity = f"going to pose {k + 1}"
            if side:
                yield from self._move_to(offset_pose(self._arm, pose, side * self._approach))
            yield from self._move_to(pose)
            self._activity = f"settling at pose {k + 1}"
            if not (yield from self._settle()):
                self.unsettled.append(k + 1)
                self._report(f"pose {k + 1} skipped: the arm did not come to rest within {SETTLE:.0f} s")
                return
            self._activity = f"measuring pose {k + 1}"
            measured.append((yield from self._measure()))
        row = np.split(np.mean(measured, axis=0), 2)
        if self._settings.both_sides:
            row.append((measured[0] - measured[1])[self._arm.num_joints :] / 2)
        yield from self._write(k, *row)

    def _move_to(self, q_end: NDArray[np.float64]) -> Steps:
        trajectory = CubicTrajectory.rest_to_rest(self._desired[: self._arm.num_joints], q_end, self._speed)
        yield from self._follow(trajectory)

    def _follow(self, trajectory: CubicTrajectory) -> Steps:
        began, self._motion_end = self._time, self._time + trajectory.duration
        while self._time < self._motion_end:
            self._desired = trajectory.state(self._time - began)
            yield
        self._desired = trajectory.state(trajectory.duration)

    def _settle(self) -> Generator[None, None, bool]:
        """Waits until the arm is at rest. Returns False if it does not come to rest within `SETTLE`."""
        tolerance = self._arm.per_joint(*REST) + 1.5 * self._arm.encoder_counts()
        detector = RestDetector(tolerance, REST_TIME)
        end = self._time + SETTLE
        while not detector.is_at_rest(self._time, self._q):
            if self._time > end:
                return False
            yield
        return True

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

    def _brake(self) -> Steps:
        """Brakes the arm to rest before the present trajectory would end, so that the arm stays inside the limits."""
        self._activity = "stopping"
        if self._in_control:
            duration = min(_BRAKE, max(self._motion_end - self._time, 1e-3))
            yield from self._follow(CubicTrajectory.braking(self._desired, duration))
