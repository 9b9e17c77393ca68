"""Poses that a person shows by hand on an arm whose weight is carried: steps 1 to 3 of the paper's section III.G."""

from __future__ import annotations

import os
import select
from collections.abc import Callable
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from pathlib import Path
from typing import IO

import numpy as np

from dvrk_drake.lcmtypes import lcmt_dvrk_status
from dvrk_drake.models.arm import Arm
from dvrk_drake.processes.arm_controller import ArmController
from dvrk_drake.processes.leg import RestDetector
from dvrk_drake.recordings.pose_file import load_poses_if_any, same_pose, save_poses

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
        self._told, self._report = told, report
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
        told = self._told()
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
