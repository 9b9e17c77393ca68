"""Estimates the delay of the efforts of a robot whose model file does not state one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.analysis.estimation.motion_problem import DynamicProblem
from dvrk_drake.analysis.observations.low_pass import resample
from dvrk_drake.analysis.observations.motion_grid import MotionGrid
from dvrk_drake.analysis.observations.observations import Observations

#: Tested delays [s]. Those of the public robots are at most 12 ms.
DELAYS = np.arange(-4, 5) * 0.005
#: A delay is significant if two ratios exceed these numbers: the ratio of the residual variances without and with the
#: delay, and the ratio of the delay to its standard error. Half or twice these values changes only notes on delays of
#: the public recordings.
MIN_GAIN, MIN_ERRORS = 1.12, 5.0


def common_delay(problem: DynamicProblem, observations: Sequence[Observations]) -> float:
    """Returns the delay of all efforts relative to the positions [s], or 0 if it is not significant.

    The delay minimises the squared errors on held-out folds, each relative to the smallest one of the same effort. Its
    standard error follows from the delays without one fold each (jackknife). It is significant as in
    `check`. All efforts have one delay, because that of a single one resembles its friction and inertia.

    Args:
        problem: Regression problem without delays.
        observations: Motions of the problem.
    """
    errors = []
    for delay in DELAYS:
        shifted = [_delayed(grid, own.tau, delay) for grid, own in zip(problem.grids, observations, strict=True)]
        columns = replace(problem.columns, tau=np.concatenate(shifted)[problem.kept])
        selection = replace(problem, columns=columns).selection()
        used = np.arange(selection.num_rigid + problem.num_mandatory)
        selection.fit(used)
        errors.append(selection.fold_errors(used))
    curves, total = np.array(errors), np.sum(errors, axis=1)
    size = np.min(total, axis=0)
    relative = np.sum(np.divide(curves, size, out=np.zeros_like(curves), where=size > 0), axis=(2, 3))
    summed = np.sum(relative, axis=1)
    delay = minimiser(DELAYS, summed)
    others = [minimiser(DELAYS, summed - own) for own in relative.T]
    error = np.sqrt((len(others) - 1) * np.var(others))
    gain = summed[np.argmin(np.abs(DELAYS))] / np.min(summed)
    return delay if gain > MIN_GAIN and abs(delay) > MIN_ERRORS * error else 0.0


def _delayed(grid: MotionGrid, tau: NDArray[np.float64], delay: float) -> NDArray[np.float64]:
    """Returns the filtered efforts (r, n) at later times, of efforts (m, n) at all rows [N m, N]."""
    later = np.empty_like(tau)
    for own, _, rows in grid.each_segment():
        later[rows] = resample(own.clock.t, tau[rows][own.clock.rows], own.row_times + delay)
    return grid.filter_efforts(later @ grid.channels.T)


def minimiser(x: NDArray[np.number], values: NDArray[np.float64]) -> float:
    """Returns the minimiser of a curve with given values at equidistant x, from parabolic interpolation."""
    i = int(np.clip(np.argmin(values), 1, len(values) - 2))
    before, minimum, after = values[i - 1 : i + 2]
    curvature = before - 2 * minimum + after
    offset = 0.5 * (before - after) / curvature if curvature > 0 else 0.0
    return float(x[i] + np.clip(offset, -1, 1) * (x[1] - x[0]))
