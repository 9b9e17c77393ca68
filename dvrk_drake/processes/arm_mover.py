"""Moves an arm over LCM along trajectories, with checks of the arm at each status."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Generator

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.errors import CollectionError, DvrkDrakeError
from dvrk_drake.lcmtypes import lcmt_dvrk_status
from dvrk_drake.processes.arm_controller import ArmController
from dvrk_drake.processes.live_status import AnswerTimes, takeover_reason
from dvrk_drake.processes.teacher import RestDetector
from dvrk_drake.systems.cubic_trajectory import CubicTrajectory

#: Largest time step of the trajectory between two statuses [s]. This limit prevents a jump of the desired state after a
#: pause of the computer.
_MAX_STEP = 0.01
#: Longest time until the arm applies the commanded efforts [s].
_START = 10.0
#: Position tolerance [rad], [m] of an arm at rest, to which 1.5 encoder counts are added. Time for which the arm must
#: stay within the tolerance [s]. Longest time until the arm comes to rest [s].
REST, REST_TIME, SETTLE = (2e-3, 2e-4), 0.5, 10.0
#: Duration of braking after a stop during a motion [s].
_BRAKE = 0.3
#: Largest allowed tracking error of a joint, as a fraction of the range of the joint.
MAX_TRACKING_ERROR = 0.1

Steps = Generator[None, None, None]


class TrackingError(CollectionError):
    """Error for a joint that does not follow its target."""


class ArmMover(ABC):
    """Computes the desired state of a controller in mode "hold" for each status, until its task is finished.

    The task is the generator `_task` of a subclass, which advances by one step per status. The task also ends if
    `stopped` returns true, after the arm has braked. It ends with an error if the guard holds the arm or if a joint
    does not follow its target. After the end of the task, the caller must command HOLD.

    Attributes:
        finished: True after the end of the task.
        problem: Error that ended the task early, or None.
    """

    def __init__(
        self,
        controller: ArmController,
        traverse_time: float,
        *,
        stopped: Callable[[], bool] = lambda: False,
        report: Callable[[str], None] = lambda line: None,
    ) -> None:
        """Creates a mover for the arm of `controller`.

        Args:
            controller: Controller that computes the commands.
            traverse_time: Time in which a joint may cross its range [s].
            stopped: Function that returns whether to stop. It is called once per status.
            report: Function that is called with lines of text about the progress.
        """
        self.finished = False
        self.problem: DvrkDrakeError | None = None
        self._arm = arm = controller.arm
        self._controller, self._stopped, self._report = controller, stopped, report
        span = arm.position_upper - arm.position_lower
        self._speed, self._tracking_tolerance = span / traverse_time, MAX_TRACKING_ERROR * span
        self._time, self._status_time = 0.0, 0.0
        self._answers, self._last_applied = AnswerTimes(), lcmt_dvrk_status()
        self._q = self._tau = np.zeros(arm.num_joints)
        self._desired = np.zeros(2 * arm.num_joints)
        self._motion_end = 0.0
        self._stopping = self._in_control = False
        self._activity = "waiting for the arm"
        self._steps = self._task()

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

    @abstractmethod
    def close(self) -> None:
        """Closes the files of the task."""

    def describe(self) -> str:
        """Returns a short description of the progress."""
        return self._activity

    @abstractmethod
    def _task(self) -> Steps:
        """Generator of the task. It sets the desired state and yields once per status."""

    @property
    def _tracking_error(self) -> NDArray[np.float64]:
        """Absolute tracking errors (n,), divided by the tolerances."""
        return np.asarray(np.abs(self._q - self._desired[: self._arm.num_joints]) / self._tracking_tolerance)

    def _check(self, status: lcmt_dvrk_status) -> None:
        if not self._controller.acting:
            reason = takeover_reason(status, self._last_applied, self._answers)
            raise CollectionError(f"the guard of {self._arm.name} holds the arm: {reason}")
        error = self._tracking_error
        if not error.max() <= 1:  # also for NaN
            j = int(np.argmax(error))
            unit = "m" if self._arm.prismatic[j] else "rad"
            raise TrackingError(
                f"{self._arm.name} does not follow: {self._arm.joint_names[j]} is at {self._q[j]:.3g} {unit}, its "
                f"target is {self._desired[j]:.3g} {unit}. Check for an obstacle, then validate the model."
            )

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

    def _move_to(self, q_end: NDArray[np.float64], share: float = 1.0) -> Steps:
        """Moves the arm to a pose (n,) on a straight line in joint space, with a share of the usual speed."""
        trajectory = CubicTrajectory.rest_to_rest(self._desired[: self._arm.num_joints], q_end, share * self._speed)
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

    def _brake(self) -> Steps:
        """Brakes the arm to rest before the present trajectory would end, so that the arm stays inside the limits."""
        self._activity = "stopping"
        if self._in_control:
            duration = min(_BRAKE, max(self._motion_end - self._time, 1e-3))
            yield from self._follow(CubicTrajectory.braking(self._desired, duration))
