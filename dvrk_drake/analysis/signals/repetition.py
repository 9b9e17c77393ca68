"""Motions that repeat: their period, how well the arm repeats its efforts, and parts that are predicted from others."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dvrk_drake.analysis.signals.low_pass import correlation, low_pass
from dvrk_drake.analysis.signals.motion_grid import GRID_RATE, MotionGrid

#: A motion repeats if, a period later, its positions differ by less than this share of their standard deviation
#: (RMS over the joints that move).
SAME_MOTION = 0.1
#: The second pass must cover at least this share of the period.
MIN_OVERLAP = 0.25
#: Left out at each end, where the filter swings in [s].
ENDS = 1.0


def find_period(q: NDArray[np.float64], rate: float) -> float | None:
    """The least time after which a motion repeats [s]; None if it does not.

    It is the least local minimum, at most `SAME_MOTION`, of

        D(T)^2 = mean_j mean_t (q_j(t) - q_j(t + T))^2 / (2 var(q_j))

    over the joints j that move, refined by a parabola. D is 0 for what repeats exactly, and 1 for what is unrelated
    to itself T later.

    Args:
        q: (m, n) positions at a constant rate.
        rate: samples a second [Hz].
    """
    deviation = np.std(q, axis=0)
    moving = deviation > 1e-3
    if not np.any(moving):
        return None
    x = (q[:, moving] - np.mean(q[:, moving], axis=0)) / deviation[moving]
    count = len(x)
    squares = np.cumsum(np.sum(x**2, axis=1))
    lags = np.arange(count)
    product = sum(correlation(column, column)[count - 1 :] for column in x.T)
    # sum over t of (x(t) - x(t + T))^2, from running sums of squares and the autocorrelation.
    first, last = squares[count - 1 - lags], squares[-1] - np.concatenate([[0.0], squares[:-1]])[lags]
    difference = np.maximum(first + last - 2 * product, 0) / (count - lags) / (2 * x.shape[1])
    longest = int(count / (1 + MIN_OVERLAP))
    inner = difference[1:longest]
    is_minimum = (inner[1:-1] <= inner[:-2]) & (inner[1:-1] < inner[2:]) & (inner[1:-1] < SAME_MOTION**2)
    if not np.any(is_minimum):
        return None
    # Fast joints have minima beside the true one: the least of those within half the shortest candidate counts.
    candidates = np.flatnonzero(is_minimum) + 2
    near = candidates[candidates < 1.5 * candidates[0]]
    lag = int(near[np.argmin(difference[near])])
    before, at, after = difference[lag - 1 : lag + 2]
    curvature = before - 2 * at + after
    return float((lag + (0.5 * (before - after) / curvature if curvature > 0 else 0.0)) / rate)


def repeatability_floor(
    tau: NDArray[np.float64], rate: float, period: float, cut_off: ArrayLike
) -> NDArray[np.float64]:
    """How badly the arm repeats its efforts [1]: about the least relative error of a model that knows q, v and vd.

        floor_j = rms(tau_j(t) - tau_j(t + T)) / sqrt(2) / rms(tau_j)

    of efforts behind the zero-phase low-pass, `ENDS` left out.

    Args:
        tau: (m, n) efforts at a constant rate, of the actuators: what they share would hide in the joints' sums.
        rate: samples a second [Hz].
        period: after which the motion repeats [s]; rounded to whole samples.
        cut_off: of the low-pass [Hz]; the floor depends on it.

    Returns:
        (n,), nan where tau is always 0.
    """
    ends = int(ENDS * rate)
    filtered = low_pass(tau, rate, cut_off)[ends : len(tau) - ends]
    shift = round(period * rate)
    difference = filtered[shift:] - filtered[:-shift]
    size = np.sqrt(np.mean(filtered**2, axis=0))
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(np.sqrt(np.mean(difference**2, axis=0) / 2) / size)


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
