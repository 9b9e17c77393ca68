"""Poses taught by hand.

Teaching consists of steps 1 to 3 of section III.G of Rutfield et al. (WPI, 2015).
"""

from __future__ import annotations

import os
import select
import sys
from collections.abc import Callable
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from contextlib import closing
from pathlib import Path
from typing import IO

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.analysis.excitation.pose_file import load_poses_if_any, same_pose, save_poses
from dvrk_drake.lcmtypes import lcmt_dvrk_status
from dvrk_drake.models.arm import Arm
from dvrk_drake.processes.arm_controller import ArmController
from dvrk_drake.processes.arm_session import ArmSession


class RestDetector:
    """Detects that all joints of an arm have stayed near one pose for some time."""

    def __init__(self, tolerance: NDArray[np.float64], duration: float) -> None:
        """Creates a detector.

        Args:
            tolerance: Largest deviation (n,) [rad, m] from one pose.
            duration: Time for which the joints must stay within the tolerance [s].
        """
        self._tolerance, self._duration = tolerance, duration
        self._since = 0.0
        self._q: NDArray[np.float64] | None = None

    def is_at_rest(self, time: float, q: NDArray[np.float64]) -> bool:
        """Returns whether the arm is at rest at `time` [s]. Call this method for every measurement q (n,)."""
        if self._q is None or not np.all(np.abs(q - self._q) <= self._tolerance):  # also true for NaN
            self._q, self._since = q, time
        return time - self._since >= self._duration


#: Tolerance [rad], [m] and duration [s] for detecting that a hand-guided arm is at rest. They are used with --at-rest.
_REST, _REST_TIME = (0.01, 0.001), 1.0


class Teacher:
    """Records poses of an arm in mode "gravity" to a file, on request or whenever the arm is at rest.

    Attributes:
        poses: Poses (m, n) [rad, m] in the file, including a pose that is being written.
    """

    def __init__(
        self,
        controller: ArmController,
        path: str | Path,
        *,
        at_rest: bool,
        requested: Callable[[], bool],
        report: Callable[[str], None],
        writer: Executor | None = None,
    ) -> None:
        """Creates a teacher for the arm of `controller`.

        Args:
            controller: Controller in mode "gravity".
            path: Path of the file. If the file exists, new poses are added to it. Each change replaces the file
                atomically.
            at_rest: True to record each pose at which the arm is at rest for a second.
            requested: Function that returns whether to record the present pose. It is called once per status.
            report: Function that is called with one line per pose.
            writer: Executor that writes the file. None: a separate thread is used.

        Raises:
            CollectionError: The file exists and does not contain poses of this arm.
        """
        self.poses = load_poses_if_any(path, controller.arm)
        self._controller, self._path, self._at_rest = controller, path, at_rest
        self._requested, self._report = requested, report
        self._detector = RestDetector(controller.arm.per_joint(*_REST), _REST_TIME)
        # Writing to disk may take longer than the arm waits for a command.
        self._writer = writer or ThreadPoolExecutor(max_workers=1)
        self._writing: Future[None] | None = None

    def update(self, status: lcmt_dvrk_status, time: float) -> None:
        """Processes a status that arrived at `time` [s]. Returns no desired state: the operator moves the arm.

        Raises:
            DvrkDrakeError: The file cannot be written.
        """
        q = np.array(status.position)
        at_rest = self._detector.is_at_rest(time, q)
        requested = self._requested()
        if self._writing is not None and not self._writing.done():
            return
        self._finish_writing()
        if not self._controller.ramped:
            return
        arm = self._controller.arm
        known = same_pose(self.poses, q, arm)
        if requested:
            if reason := self._refusal(arm, q, known):
                self._report(f"not recorded: {reason}")
                return
        elif not (self._at_rest and at_rest and known is None and not arm.limit_violations(q)):
            return
        self.poses = np.vstack([self.poses, q])
        self._writing = self._writer.submit(save_poses, self.poses, arm, self._path)

    def close(self) -> None:
        """Waits until the file is written.

        Raises:
            DvrkDrakeError: The file cannot be written.
        """
        self._writer.shutdown()
        self._finish_writing()

    def _finish_writing(self) -> None:
        """Reports the last pose once it is in the file."""
        if self._writing is not None:
            writing, self._writing = self._writing, None
            writing.result()
            self._report(f"pose {len(self.poses)} recorded")

    @staticmethod
    def _refusal(arm: Arm, q: np.ndarray, known: int | None) -> str:
        if violations := arm.limit_violations(q):
            return "; ".join(violations)
        return "" if known is None else f"same as pose {known + 1}"


def teach_poses(session: ArmSession, path: str | Path, *, at_rest: bool) -> int:
    """Adds poses to a pose file while the operator moves the arm; see `ArmConnection.teach`."""
    load_poses_if_any(path, session.arm)  # rejects an invalid file before the arm is connected
    controller, link = session.start("gravity")
    dialog = session.dialog
    enter = dialog.enter or (lambda: False)
    teacher = Teacher(controller, path, at_rest=at_rest, requested=enter, report=dialog.report)
    dialog.report(f"{session.arm.name} compensates gravity; move the arm by hand")
    with closing(teacher):
        session.control(link, controller, dialog.stopped, lambda: f"{len(teacher.poses)} poses", teacher.update)
    return len(teacher.poses)


class EnterKey:
    """Detects a new line on a stream without blocking."""

    def __init__(self, stream: IO[str]) -> None:
        """Starts reading `stream`, e.g. sys.stdin. No other code may read from this stream."""
        self._descriptor, self._open = stream.fileno(), True
        self._is_terminal = os.isatty(self._descriptor)

    @classmethod
    def of_terminal(cls) -> Callable[[], bool]:
        """Returns an object for the terminal of this process, or a function that returns False without a terminal."""
        return cls(sys.stdin) if sys.stdin is not None and sys.stdin.isatty() else lambda: False

    def __call__(self) -> bool:
        """Returns whether Enter was pressed since the last call, or False after the end of the stream."""
        if not self._open:
            return False
        try:
            # The system would stop a background process that reads from its terminal.
            if self._is_terminal and os.tcgetpgrp(self._descriptor) != os.getpgrp():
                return False
            if not select.select([self._descriptor], [], [], 0.0)[0]:
                return False
            data = os.read(self._descriptor, 4096)
        except OSError:  # the terminal was closed
            data = b""
        self._open = bool(data)
        return b"\n" in data
