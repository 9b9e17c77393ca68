"""Moves an arm along trajectories, with checks of the arm at each status."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Generator

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.errors import CollectionError, DvrkDrakeError
from dvrk_drake.lcmtypes import lcmt_dvrk_status
from dvrk_drake.processes.arm_controller import ArmController, GoalController
from dvrk_drake.processes.control import AnswerTimes, takeover_reason
from dvrk_drake.processes.teacher import RestDetector
from dvrk_drake.systems.cubic_trajectory import CubicTrajectory

#: Longest time until the arm applies the commanded efforts [s].
_START = 10.0
#: Position tolerance [rad], [m] of an arm at rest, to which 1.5 encoder counts are added. Time for which the arm must
#: stay within the tolerance [s]. Longest time until the arm comes to rest [s].
REST, REST_TIME, SETTLE = (2e-3, 2e-4), 0.5, 10.0
#: Duration of braking after a stop during a motion [s].
_BRAKE = 0.3
#: Largest allowed tracking error of a joint, as a fraction of the range of the joint.
MAX_TRACKING_ERROR = 0.1
#: Time without progress towards the goal after which a motion that waits is stopped [s]. Smallest progress, relative to
#: the largest tracking error.
STALL, _PROGRESS = 2.0, 0.05

Steps = Generator[None, None, None]


class TrackingError(CollectionError):
    """Error for a joint that does not follow its target."""


class ArmMover(ABC):
    """Computes the desired state of a controller for each status, until its task is finished.

    The task is the generator `_task` of a subclass, which advances by one step per status. The task also ends if
    `stopped` returns true, after the arm has braked. It ends with an error if the guard holds the arm, or if a joint
    does not follow its target; see `MotionStyle.waits`. After the end of the task, the caller must command HOLD.

    Attributes:
        finished: True after the end of the task.
        problem: Error that ended the task early, or None.
    """

    def __init__(
        self,
        controller: ArmController | GoalController,
        traverse_time: float,
        *,
        stopped: Callable[[], bool] = lambda: False,
        report: Callable[[str], None] = lambda line: None,
    ) -> None:
        """Creates a mover for the arm of `controller`.

        Args:
            controller: Controller that computes the commands: an `ArmController` in mode "hold", or a
                `GoalController`.
            traverse_time: Time in which a joint may cross its range [s].
            stopped: Function that returns whether to stop. It is called once per status.
            report: Function that is called with lines of text about the progress.
        """
        self.finished = False
        self.problem: DvrkDrakeError | None = None
        self._arm = arm = controller.arm
        self._controller, self._stopped, self._report = controller, stopped, report
        self._style = controller.style
        span = arm.position_upper - arm.position_lower
        self._speed, self._tracking_tolerance = span / traverse_time, MAX_TRACKING_ERROR * span
        self._time, self._status_time = 0.0, 0.0
        self._answers, self._last_applied = AnswerTimes(), lcmt_dvrk_status()
        self._q = self._tau = np.zeros(arm.num_joints)
        self._desired = np.zeros(2 * arm.num_joints)
        self._motion_end = 0.0
        self._stopping = self._in_control = self._halted = False
        self._activity = "waiting for the arm"
        self._steps = self._task()

    def update(self, status: lcmt_dvrk_status, time: float) -> NDArray[np.float64] | None:
        """Processes a status and returns the desired state.

        The trajectory advances with the arm's clock, which may be slower than the controller's clock.

        Args:
            status: Received status.
            time: Time of arrival on the controller's clock [s].

        Returns:
            Desired state (2n,): q, then v. None: the arm holds its pose.
        """
        measured = 1e-6 * status.utime
        self._time += min(max(measured - self._status_time, 0.0), self._style.max_step)
        self._status_time = measured
        self._answers.add(time)
        # controller.acting refers to the previous status. This status may already report the problem.
        if (status.guard_state, status.command_sender_id) == (status.STATE_EFFORT, self._controller.sender_id):
            self._last_applied = status
        self._q, self._tau = np.array(status.position), np.array(status.effort_measured)
        if self.finished:
            return self._desired_or_hold()
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
        return self._desired_or_hold()

    def _desired_or_hold(self) -> NDArray[np.float64] | None:
        return None if self._style.waits and (self.finished or self._halted) else self._desired

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
        if not self._style.waits and not self._tracking_error.max() <= 1:  # also for NaN
            raise self._does_not_follow()

    def _does_not_follow(self) -> TrackingError:
        j = int(np.argmax(self._tracking_error))
        unit = "m" if self._arm.prismatic[j] else "rad"
        return TrackingError(
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
        before, waited, least = self._time, 0.0, np.inf
        while self._time < self._motion_end:
            step, before = self._time - before, self._time
            behind = float(self._tracking_error.max()) if self._style.waits else 0.0
            if behind > 1:
                began, self._motion_end = began + step, self._motion_end + step
                waited, least = (0.0, behind) if behind < least - _PROGRESS else (waited + step, least)
                if waited > STALL:
                    raise self._does_not_follow()
            else:
                waited, least = 0.0, np.inf
            self._desired = trajectory.state(self._time - began)
            yield
        self._desired = trajectory.state(trajectory.duration)

    def _settle(self, duration: float = REST_TIME) -> Generator[None, None, bool]:
        """Waits until the arm is at rest for `duration` [s]. Returns False if it does not settle within `SETTLE`.

        Raises:
            TrackingError: The arm is not near its target.
        """
        detector = RestDetector(self._arm.per_joint(*REST) + 1.5 * self._arm.encoder_counts(), duration)
        end = self._time + SETTLE
        while True:
            is_at_rest, is_near = detector.is_at_rest(self._time, self._q), bool(self._tracking_error.max() <= 1)
            if is_at_rest and is_near and not self._controller.is_busy():
                return True
            if self._time > end:
                if not is_near:
                    raise self._does_not_follow()
                return False
            yield

    def _brake(self) -> Steps:
        """Brakes the arm to rest before the present trajectory would end, so that the arm stays inside the limits."""
        self._activity = "stopping"
        if self._in_control and not self._style.waits:  # otherwise HOLD stops the arm
            duration = min(_BRAKE, max(self._motion_end - self._time, 1e-3))
            yield from self._follow(CubicTrajectory.braking(self._desired, duration))
