"""Poses that a person shows by hand, steps 1 to 3 of the paper's section III.G, and the motions between poses."""

from __future__ import annotations

import os
import select
from collections.abc import Callable
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from pathlib import Path
from typing import IO

import numpy as np
from numpy.typing import NDArray
from pydrake.trajectories import PiecewisePolynomial

from dvrk_drake.lcmtypes import lcmt_dvrk_status
from dvrk_drake.models.arm import Arm
from dvrk_drake.processes.arm_controller import ArmController
from dvrk_drake.recordings.pose_file import load_poses_if_any, same_pose, save_poses

#: Least time of a leg [s]: short ones would begin and end with a jerk.
MIN_DURATION = 0.3


class Leg:
    """A cubic in time from one joint state to rest.

    Attributes:
        duration: of it [s].
    """

    def __init__(
        self, q_start: NDArray[np.float64], v_start: NDArray[np.float64], q_end: NDArray[np.float64], duration: float
    ) -> None:
        """From q_start, v_start (n,) to rest at q_end (n,) [rad, m, rad/s, m/s] in `duration` [s]."""
        self.duration = duration
        velocities = np.column_stack([v_start, np.zeros_like(v_start)])
        self._q = PiecewisePolynomial.CubicHermite([0.0, duration], np.column_stack([q_start, q_end]), velocities)
        self._v = self._q.derivative()

    @classmethod
    def between(cls, q_start: NDArray[np.float64], q_end: NDArray[np.float64], speed: NDArray[np.float64]) -> Leg:
        """From rest to rest, no joint faster than `speed` (n,) [rad/s, m/s].

        It is straight, so between poses inside linear limits it stays inside of them.
        """
        # A cubic from rest to rest is 1.5 times as fast in its middle as on average.
        duration = max(MIN_DURATION, 1.5 * float(np.max(np.abs(q_end - q_start) / speed)))
        return cls(q_start, np.zeros_like(q_start), q_end, duration)

    @classmethod
    def braking(cls, state: NDArray[np.float64], duration: float) -> Leg:
        """From a state (2n: q, then v) to rest at constant deceleration."""
        q, v = np.split(state, 2)
        return cls(q, v, q + 0.5 * duration * v, duration)

    def state(self, time: float) -> NDArray[np.float64]:
        """(2n,) q, then v at `time` [s] from 0 to the duration; outside of that, of its ends."""
        time = min(max(time, 0.0), self.duration)
        return np.concatenate([self._q.value(time).ravel(), self._v.value(time).ravel()])


class RestDetector:
    """An arm rests when all its joints have stayed near one pose for a while."""

    def __init__(self, tolerance: NDArray[np.float64], duration: float) -> None:
        """Within `tolerance` (n,) [rad, m] of one pose for `duration` [s]."""
        self._tolerance, self._duration = tolerance, duration
        self._since = 0.0
        self._q: NDArray[np.float64] | None = None

    def rests(self, time: float, q: NDArray[np.float64]) -> bool:
        """Whether it rests at `time` [s] with q (n,) measured; to be asked at every measurement."""
        if self._q is None or not np.all(np.abs(q - self._q) <= self._tolerance):  # also true of NaN
            self._q, self._since = q, time
        return time - self._since >= self._duration


#: For --at-rest: a hand that rests keeps all joints within this [rad], [m] for so long [s].
_REST, _REST_TIME = (0.01, 0.001), 1.0


class Teacher:
    """Takes the pose of an arm in "gravity" mode into a file of poses, when told to or whenever it rests.

    Attributes:
        poses: (m, n) in the file and those being written.
    """

    def __init__(
        self,
        controller: ArmController,
        path: str | Path,
        *,
        at_rest: bool,
        told: Callable[[], bool],
        report: Callable[[str], None],
        writer: Executor | None = None,
    ) -> None:
        """Of the controller's arm.

        Args:
            controller: in "gravity" mode.
            path: of the file, which is made or added to; it is whole at any moment.
            at_rest: take each pose at which the arm rests for a second.
            told: whether to take the present pose; asked once a status.
            report: hears of each pose, a line.
            writer: runs the writing of the file; default: a thread of its own.

        Raises:
            CollectionError: the file is there and is none of poses of this arm.
        """
        self.poses = load_poses_if_any(path, controller.arm)
        self._controller, self._path, self._at_rest = controller, path, at_rest
        self._identifiability, self._report = told, report
        self._detector = RestDetector(controller.arm.per_joint(*_REST), _REST_TIME)
        # The disk may take longer than the arm waits for a command.
        self._writer = writer or ThreadPoolExecutor(max_workers=1)
        self._writing: Future[None] | None = None

    def lead(self, status: lcmt_dvrk_status, time: float) -> None:
        """Looks at a status that came at `time` [s]; leads nowhere: the hand does.

        Raises:
            DvrkDrakeError: the file cannot be written.
        """
        q = np.array(status.position)
        rests = self._detector.rests(time, q)
        told = self._identifiability()
        if self._writing is not None:
            if not self._writing.done():
                return
            self._writing.result()
            self._writing = None
            self._report(f"pose {len(self.poses)} taken")
        if not self._controller.ramped:
            return
        arm = self._controller.arm
        known = same_pose(self.poses, q, arm)
        if told:
            if reason := self._refusal(arm, q, known):
                self._report(f"not taken: {reason}")
                return
        elif not (self._at_rest and rests and known is None and not arm.limit_violations(q)):
            return
        self.poses = np.vstack([self.poses, q])
        self._writing = self._writer.submit(save_poses, self.poses, arm, self._path)

    def close(self) -> None:
        """Waits for the file."""
        self._writer.shutdown()

    @staticmethod
    def _refusal(arm: Arm, q: np.ndarray, known: int | None) -> str:
        if violations := arm.limit_violations(q):
            return "; ".join(violations)
        return "" if known is None else f"it is pose {known + 1} again"


class EnterKey:
    """Says whether a line has come on a stream since it was asked last, without waiting for one."""

    def __init__(self, stream: IO[str]) -> None:
        """On `stream`, e.g. sys.stdin; nothing else may read from it."""
        self._descriptor, self._open = stream.fileno(), True

    def __call__(self) -> bool:
        """Whether Enter was pressed; never again after the end of the stream."""
        if not self._open or not select.select([self._descriptor], [], [], 0.0)[0]:
            return False
        data = os.read(self._descriptor, 4096)
        self._open = bool(data)
        return b"\n" in data
