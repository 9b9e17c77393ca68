"""Moves an arm to poses and measures holding torques: steps 4 to 6 of section III.G of Rutfield et al. (WPI, 2015)."""

from __future__ import annotations

from collections.abc import Callable, Generator
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.errors import CollectionError
from dvrk_drake.models.approach import offset_pose
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.schema_fault import number_fault, within
from dvrk_drake.processes.arm_controller import ArmController
from dvrk_drake.processes.arm_mover import SETTLE, ArmMover, Steps
from dvrk_drake.recordings.pose_file import CollectionFile

#: Proportional effort of the controller at the start of an approach, divided by the effort limit. This effort
#: determines the distance of the approach. Static friction that is at most half of this effort changes its sign during
#: the approach. After a longer approach, the controller's integrator may hold the arm with any part of the friction.
APPROACH = 0.3
#: Time over which measurements are averaged [s].
MEASURE = 0.25


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


def short_approach_offset(arm: Arm) -> NDArray[np.float64]:
    """Returns the offset (n,) of the pose at which the approach of a static pose begins [rad, m]."""
    return np.asarray(APPROACH * arm.effort_limits / np.asarray(arm.gains.kp))


class Collector(ArmMover):
    """Moves an arm to poses and measures them, until all poses are measured.

    The collection ends with an error if the guard holds the arm, if a joint does not follow its target, or if the file
    cannot be written. After the end of the collection, the caller must command HOLD.

    Attributes:
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
        self.unsettled: list[int] = []
        self.done = output.finished(poses)
        self._poses, self._output, self._settings = poses, output, settings
        super().__init__(controller, settings.traverse_time, stopped=stopped, report=report)
        self._approach = short_approach_offset(self._arm)
        # Writing to disk may take longer than the arm waits for a command.
        self._writer = writer or ThreadPoolExecutor(max_workers=1)

    def close(self) -> None:
        """Waits until a pending row is written, then closes the file."""
        self._writer.shutdown()
        self._output.close()

    def describe(self) -> str:
        """Returns a short description of the progress."""
        return f"{np.count_nonzero(self.done)} of {len(self.done)} poses, {self._activity}"

    def _task(self) -> Steps:
        yield from self._begin()
        began, before = self._time, np.count_nonzero(self.done)
        for k in np.flatnonzero(~self.done):
            yield from self._measure_pose(int(k))
            if self.done[k]:
                count = np.count_nonzero(self.done)
                left = (self._time - began) / (count - before) * np.count_nonzero(~self.done[k:])
                self._report(f"pose {k + 1} measured, {count} of {len(self.done)}; about {left / 60:.1f} min left")

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
