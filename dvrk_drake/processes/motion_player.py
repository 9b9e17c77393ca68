"""Moves an arm along a designed motion and records it."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Executor, Future, ThreadPoolExecutor, wait
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.analysis.excitation.motion_limits import execution_limits, motion_violations
from dvrk_drake.analysis.excitation.periodic_motion import PeriodicMotion
from dvrk_drake.errors import CollectionError, DvrkDrakeError
from dvrk_drake.lcmtypes import lcmt_dvrk_status
from dvrk_drake.processes import motion_parts
from dvrk_drake.processes.arm_controller import ArmController
from dvrk_drake.processes.arm_mover import MAX_TRACKING_ERROR, SETTLE, ArmMover, Steps, TrackingError
from dvrk_drake.processes.arm_session import ArmSession
from dvrk_drake.processes.motion_parts import MotionPartFile

#: Speed of a rehearsal, relative to the motion.
REHEARSAL_SPEED = 0.2
#: Time in which a joint may cross its range on the way to the start of the motion [s].
TRAVERSE_TIME = 5.0
#: Time in which the motion reaches its speed, and in which it stops [s].
_RAMP = 0.5
#: Largest distance from the pose at which the path to the start was checked, as a fraction of the range of the joint.
_CHECKED = 0.03
#: Longest pause [s]. A longer pause ends the command, and the guard holds the arm.
MAX_PAUSE = 60.0
#: Time that is removed from the end of the recording after a tracking error, because an obstacle may have exerted
#: forces on the arm [s].
_REMOVED = 3.0
#: Number of rows that are written at once.
_BLOCK = 100


@dataclass(frozen=True)
class PlayedMotion:
    """Result of a motion.

    Attributes:
        begin, end: Time of the motion at which it began and ended [s].
        duration: Duration of the motion [s].
        path: File with the measurements, or with the rehearsal. None: nothing was written.
        tracking_error: Largest tracking error as a fraction of the range of a joint.
        is_complete: Whether the motion ended at its end.
        recordings: Files with the recorded parts of the motion, without those that are too short for `identify`.
    """

    begin: float
    end: float
    duration: float
    path: Path | None
    tracking_error: float
    is_complete: bool
    recordings: tuple[Path, ...] = ()


class MotionPlayer(ArmMover):
    """Moves an arm to a pose of a motion, and then along the motion.

    The arm starts and stops along the path of the motion, so it never leaves this path. While the motion is paused, the
    recording continues. The task ends with an error if a joint does not follow its target by more than
    `MAX_TRACKING_ERROR` of its range, if a pause is too long, or if the file cannot be written.

    Attributes:
        motion_time: Present time of the motion [s].
        paused: Whether the motion is paused.
        largest_error: Largest tracking error (n,) of each joint during the motion [rad, m].
    """

    def __init__(
        self,
        motion: PeriodicMotion,
        controller: ArmController,
        q_checked: NDArray[np.float64],
        *,
        output: Callable[[], MotionPartFile] | None = None,
        begin: float = 0.0,
        end: float | None = None,
        speed: float = 1.0,
        stopped: Callable[[], bool] = lambda: False,
        enter: Callable[[], bool] = lambda: False,
        report: Callable[[str], None] = lambda line: None,
        writer: Executor | None = None,
    ) -> None:
        """Creates a player for the arm of `controller`.

        Args:
            motion: Motion of the arm.
            controller: Controller that computes the commands.
            q_checked: Pose (n,) from which the straight path to the start of the motion was checked.
            output: Function that creates the file for the measurements at the start of the motion. None: the motion is
                not recorded.
            begin: Time of the motion at which the arm starts [s].
            end: Time of the motion at which the arm stops [s], at which the motion is at rest. None: the end.
            speed: Speed relative to that of the motion.
            stopped: Function that returns whether to stop. It is called once per status.
            enter: Function that returns whether the Enter key was pressed. The key pauses and continues.
            report: Function that is called with lines of text about the progress.
            writer: Executor that writes the file. None: a separate thread is used.
        """
        self.motion_time, self.paused = begin, False
        self._motion, self._q_checked, self._create, self._enter = motion, q_checked, output, enter
        self._end = motion.duration if end is None else end
        self._full_speed, self._rate, self._paused_at = speed, 0.0, 0.0
        self._is_playing = self._is_recording = False
        self._output: MotionPartFile | None = None
        self._rows: list[tuple[lcmt_dvrk_status, float]] = []
        self._writing: Future[None] | None = None
        super().__init__(controller, TRAVERSE_TIME, stopped=stopped, report=report)
        self.largest_error = np.zeros(self._arm.num_joints)
        # Writing to disk may take longer than the arm waits for a command.
        self._writer = writer or ThreadPoolExecutor(max_workers=1)

    def update(self, status: lcmt_dvrk_status, time: float) -> NDArray[np.float64] | None:
        """Processes a status and returns the desired state (2n,); see `ArmMover.update`."""
        desired = super().update(status, time)
        if self._is_recording:
            self._rows.append((status, self.motion_time))
            self._is_recording = not self.finished
            if len(self._rows) >= _BLOCK or self.finished:
                self._flush()
        return desired

    def close(self) -> None:
        """Waits until all rows are written, then closes the file."""
        if self._writing is not None:
            wait([self._writing])
        self._flush()
        self._writer.shutdown()
        self._flush()
        if self._output is not None:
            if isinstance(self.problem, TrackingError):
                self._output.remove_end(_REMOVED)
            self._output.close()

    def describe(self) -> str:
        """Returns a short description of the progress."""
        if not self._is_playing:
            return self._activity
        left = (self._end - self.motion_time) / self._full_speed
        error = MAX_TRACKING_ERROR * float(np.max(self._tracking_error))
        text = f"{self.motion_time:.0f} of {self._end:.0f} s, tracking error {100 * error:.1f} % of the range"
        return f"paused, {text}; Enter continues" if self.paused else f"{text}, {left:.0f} s left; Enter pauses"

    def _task(self) -> Steps:
        yield from self._begin()
        span = self._arm.position_upper - self._arm.position_lower
        if not np.all(np.abs(self._q - self._q_checked) <= _CHECKED * span):  # also for NaN
            raise CollectionError(f"{self._arm.name} moved before the control started. Run the command again")
        self._activity = "going to the start of the motion"
        yield from self._move_to(self._motion.evaluate([self.motion_time]).q[0])
        yield from self._come_to_rest()
        if self._create is not None:
            creating = self._writer.submit(self._create)
            while not creating.done():
                yield
            self._output = creating.result()
            self._is_recording = True
        self._is_playing = True
        self._enter()  # ignores the key before the motion
        yield from self._play()
        yield from self._come_to_rest()

    def _come_to_rest(self) -> Steps:
        self._is_playing, self._activity = False, "settling"
        if not (yield from self._settle()):
            raise CollectionError(f"{self._arm.name} did not come to rest within {SETTLE:.0f} s")

    def _play(self) -> Steps:
        last, n = self._time, self._arm.num_joints
        while self.motion_time < self._end:
            step, last = self._time - last, self._time
            if self._enter():
                self._pause_or_continue()
            wanted = 0.0 if self.paused or self._stopping else self._full_speed
            change = self._full_speed * step / _RAMP
            self._rate += float(np.clip(wanted - self._rate, -change, change))
            if self._stopping and self._rate <= 0:
                return
            if self.paused and self._time > self._paused_at + MAX_PAUSE:
                self._report(f"paused for {MAX_PAUSE:.0f} s; the same command continues the motion")
                self._stopping = True
                return
            self.motion_time = min(self.motion_time + self._rate * step, self._end)
            motion = self._motion.evaluate([self.motion_time])
            self._desired = np.concatenate([motion.q[0], self._rate * motion.v[0]])
            self.largest_error = np.maximum(self.largest_error, np.abs(self._q - self._desired[:n]))
            yield

    def _pause_or_continue(self) -> None:
        self.paused, self._paused_at = not self.paused, self._time
        self._report("paused: the arm holds its pose; Enter continues" if self.paused else "continued")

    def _brake(self) -> Steps:
        """Stops along the path of the motion, or as `ArmMover` before the motion."""
        if not self._is_playing:
            yield from super()._brake()
            return
        yield from self._play()
        self._is_playing, self._activity = False, "stopped"

    def _flush(self) -> None:
        """Writes the rows, unless earlier rows are still being written. Their error ends the task."""
        if self._writing is not None:
            if not self._writing.done():
                return
            try:
                self._writing.result()
            except DvrkDrakeError as error:
                self.problem, self.finished, self._is_recording = self.problem or error, True, False
                return
        if self._rows and self._output is not None:
            rows, self._rows = self._rows, []
            self._writing = self._writer.submit(self._output.append, rows)


def play_motion(session: ArmSession, path: str | Path, output: str | Path | None) -> PlayedMotion:
    """Moves an arm along a motion, and records it; see `ArmConnection.play`."""
    arm, dialog = session.arm, session.dialog
    motion = PeriodicMotion.load(path, arm)
    begin, end, part, create = 0.0, motion.period, None, None
    if output is not None:
        parts = motion_parts.recorded_parts(output, arm, motion)
        rest, end = motion_parts.begin_of_rest(parts, motion.duration), motion.duration
        if rest is None:
            return PlayedMotion(end, end, end, None, 0.0, True, _recordings(parts, end))
        if not motion_parts.is_rehearsed(path, arm, motion):
            raise CollectionError(
                f"{path}: the motion was not rehearsed on {arm.name}. First run: dvrk-drake collect motion "
                f"{path} {session.options} --rehearse"
            )
        begin, part = rest, motion_parts.next_part(output, parts)
        create = partial(MotionPartFile, part, arm, motion)
    # The limits of the arm and of its guard are checked independently of those of the design.
    if violations := motion_violations(motion, arm, execution_limits(motion.environment), session.model):
        raise CollectionError(f"{path}: {violations[0]}; design a motion within the limits of {arm.name}")
    controller, link = session.start("hold")
    q, link = session.check_path(link, motion.evaluate([begin]).q[0], motion.environment)
    speed = REHEARSAL_SPEED if output is None else 1.0
    player = MotionPlayer(
        motion,
        controller,
        q,
        output=create,
        begin=begin,
        end=end,
        speed=speed,
        stopped=dialog.stopped,
        enter=dialog.enter or (lambda: False),
        report=dialog.report,
    )
    what = f"rehearsal of {path} at {100 * speed:.0f} % speed" if output is None else str(path)
    seconds = (end - begin) / speed
    dialog.report(f"{arm.name} moves to the start and then for {seconds:.0f} s: {what}")
    with closing(player):
        session.control(link, controller, lambda: player.finished, player.describe, player.update)
    if player.problem is not None:
        raise player.problem
    span, is_complete = arm.position_upper - arm.position_lower, player.motion_time >= end
    if output is None and is_complete:
        errors = player.largest_error.tolist()
        rehearsal = motion_parts.Rehearsal(arm=arm.name, motion=motion.digest(), speed=speed, tracking_error=errors)
        part = rehearsal.save(path)
    written = part if player.motion_time > begin and (is_complete or output is not None) else None
    largest = float((player.largest_error / span).max())
    parts = [] if output is None else motion_parts.recorded_parts(output, arm, motion)
    files = _recordings(parts, motion.duration)
    return PlayedMotion(begin, player.motion_time, motion.duration, written, largest, is_complete, files)


def _recordings(parts: list[motion_parts.MotionPart], duration: float) -> tuple[Path, ...]:
    return tuple(part.path for part in motion_parts.useful(parts, duration))
