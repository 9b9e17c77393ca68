"""Parts of a motion that are predicted from the rest of it: by phase where it repeats, else stretch by stretch."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.analysis.signals.motion_grid import GRID_RATE, MotionGrid
from dvrk_drake.analysis.signals.repetition import find_period

FOLDS = 12
#: What is nearer than this to the part that is predicted is not learnt from: the filters reach over [s].
GAP = 0.1


def period_of(grid: MotionGrid) -> float | None:
    """After which the motion repeats [s]; None if it does not."""
    return find_period(grid.arm.transmission.position(grid.q), GRID_RATE)


def phase_folds(
    grid: MotionGrid, period: float | None, folds: int = FOLDS
) -> tuple[NDArray[np.int_], NDArray[np.bool_]]:
    """The fold of each inner row, and which of them lie at its edge.

    A motion that repeats is cut by its phase: cut by time, every stretch would be learnt from its own repetition.

    Returns:
        fold: (r,) 0..folds - 1.
        edge: (r, 2) True within `GAP` of the fold before, of the fold after.
    """
    t = grid.row_times[grid.inner]
    length = period if period is not None else float(t[-1] - t[0]) * (1 + 1e-9)
    part = ((t - t[0]) % length) / length * folds
    fold = np.minimum(part.astype(int), folds - 1)
    gap = GAP * folds / length
    return fold, np.column_stack([part - fold < gap, part - fold > 1 - gap])
