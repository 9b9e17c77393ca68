"""Finds the period of a motion, the repeatability of its efforts, and folds over its phase."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.fft import irfft, next_fast_len, rfft

from dvrk_drake.analysis.observations.motion_grid import MotionGrid, ends_of
from dvrk_drake.analysis.observations.signals import low_pass, minimiser, resample
from dvrk_drake.recordings.recording import SAME_POSE

#: Largest difference D(T) of the positions of a motion that repeats after the period T, see `find_period`. Half or
#: twice the value changes no finding on the public recordings.
SAME_MOTION = 0.1
#: Smallest recorded part of the second period, as a share of the period. Half or twice the value changes no finding on
#: the public recordings.
MIN_OVERLAP = 0.25


def find_period(q: NDArray[np.float64], rate: float) -> float | None:
    """Returns the period of a motion [s], or None if the motion does not repeat.

    The difference of the positions after a time T is

        D(T)^2 = mean_j mean_t (q_j(t) - q_j(t + T))^2 / (2 var(q_j))

    for the joints j that move. D is 0 for an exact repetition and 1 for uncorrelated positions. Candidates for the
    period are the local minima of D below `SAME_MOTION`. Among the candidates near the shortest one, the period is the
    candidate with the smallest D. Parabolic interpolation refines this period.

    Args:
        q: Positions (m, n) at a constant rate [rad, m].
        rate: Sampling rate [Hz].
    """
    deviation = np.std(q, axis=0)
    moving = deviation > SAME_POSE[1]
    if not np.any(moving):
        return None
    x = (q[:, moving] - np.mean(q[:, moving], axis=0)) / deviation[moving]
    count = len(x)
    squares = np.cumsum(np.sum(x**2, axis=1))
    lags = np.arange(count)
    # Autocorrelation sum_j sum_t x_j(t) x_j(t + T), with zeros after the end so that the ends do not overlap.
    size = next_fast_len(2 * count, real=True)
    product = irfft(sum(np.abs(rfft(column, size)) ** 2 for column in x.T), size)[:count]
    # Sum over t of (x(t) - x(t + T))^2, from running sums of squares and the autocorrelation.
    first, last = squares[count - 1 - lags], squares[-1] - np.concatenate([[0.0], squares[:-1]])[lags]
    difference = np.maximum(first + last - 2 * product, 0) / (count - lags) / (2 * x.shape[1])
    longest = int(count / (1 + MIN_OVERLAP))
    inner = difference[1:longest]
    is_minimum = (inner[1:-1] <= inner[:-2]) & (inner[1:-1] < inner[2:]) & (inner[1:-1] < SAME_MOTION**2)
    if not np.any(is_minimum):
        return None
    # Fast joints cause additional minima near the true one. The smallest minimum near the shortest candidate is used.
    candidates = np.flatnonzero(is_minimum) + 2
    near = candidates[candidates < 1.5 * candidates[0]]
    lag = int(near[np.argmin(difference[near])])
    around = np.arange(lag - 1, lag + 2)
    return minimiser(around, difference[around]) / rate


def repeatability_floor(
    tau: NDArray[np.float64], rate: float, period: float, cut_off: ArrayLike
) -> NDArray[np.float64]:
    """Computes the repeatability of efforts: their relative RMS difference between periods [1].

        floor_j = rms(tau_j(t) - tau_j(t + T)) / sqrt(2) / rms(tau_j)

    This value approximates the smallest possible relative error of a model that is a function of q, v and vd. The
    efforts are filtered with a zero-phase low-pass filter, and both ends are omitted, see `ends_of`.

    Args:
        tau: Efforts (m, n) of the actuators at a constant rate [N m, N].
        rate: Sampling rate [Hz].
        period: Period T of the motion [s]. The function rounds it to whole samples.
        cut_off: Cut-off of the low-pass filter [Hz].

    Returns:
        Relative differences (n,), nan for an effort that is always 0.
    """
    ends = int(ends_of(len(tau) / rate) * rate)
    filtered = low_pass(tau, rate, cut_off)[ends : len(tau) - ends]
    shift = round(period * rate)
    difference = filtered[shift:] - filtered[:-shift]
    size = np.sqrt(np.mean(filtered**2, axis=0))
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(np.sqrt(np.mean(difference**2, axis=0) / 2) / size)


def motion_floor(tau: NDArray[np.float64], grid: MotionGrid, period: float) -> NDArray[np.float64]:
    """Returns the repeatability (n,) of the measured efforts in the longest segment of a motion, nan if not measured.

    Args:
        tau: Efforts (m, n) of the actuators at the rows of the recording [N m, N].
        grid: Resampled motion.
        period: Period of the motion [s].
    """
    longest, rows = max(((own, rows) for own, _, rows in grid.each_segment()), key=lambda pair: len(pair[0].row_times))
    efforts, rate, clock = (tau @ grid.channels.T)[rows], grid.rate, longest.clock
    if not clock.reconstructed:
        # Lost rows would shift the later rows against those of the next period.
        rate = 1 / float(np.median(np.diff(clock.t)))
        even = np.arange(clock.t[0], clock.t[-1] + 0.5 / rate, 1 / rate)
        efforts = resample(clock.t, efforts[clock.rows], even)
    return repeatability_floor(efforts, rate, period, grid.settings.effort_cut_off)


#: Number of folds for cross-validation. With 24 folds, the mean cross-validated errors of the public motions `mtm_one`
#: and `psm_one` are 0.2 and 0.1 percentage points lower; with 6 folds, 1.1 and 1.4 higher, which leave out more of the
#: motion.
FOLDS = 12
#: Time over which the errors of low-pass filtered efforts are correlated [s]. The autocorrelation of held-out errors of
#: the public motions `mtm_one` and `psm_one` falls to 1/e after 0.09 s (median of the actuators). Rows within this time
#: of a held-out fold are not used for the fit.
CORRELATION_TIME = 0.1


def correlation_of(errors: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns the matrix (n, n) of the mean products of errors (r, n), divided by their RMS values.

    The elements of a channel without errors are those of the identity.
    """
    size = np.linalg.norm(errors, axis=0)
    unit = errors / np.where(size > 0, size, 1.0)
    correlation = unit.T @ unit
    np.fill_diagonal(correlation, 1.0)
    return np.asarray(correlation)


def phase_folds(
    grid: MotionGrid, period: float | None, folds: int = FOLDS
) -> tuple[NDArray[np.int_], NDArray[np.bool_]]:
    """Assigns each inner row to a fold and marks the rows at the edges of the folds.

    The folds of a periodic motion are intervals of its phase, so that the other folds contain no repetitions of a
    held-out fold. The folds of any other motion are intervals of time.

    Args:
        grid: Resampled motion.
        period: Period of the motion [s], or None if the motion does not repeat.
        folds: Number of folds.

    Returns:
        fold: Index (r,) of the fold of each row, 0 to folds - 1.
        edge: Mask (r, 2) of the rows within `CORRELATION_TIME` of the preceding fold (column 0) and of the following
            fold (column 1).
    """
    t = grid.row_times[grid.inner]
    if period is None and grid.segments:
        # Without the gaps, so that each fold has rows.
        intervals = np.diff(t)
        t = np.concatenate([[0.0], np.cumsum(np.minimum(intervals, np.median(intervals)))])
    length = period if period is not None else float(t[-1] - t[0]) * (1 + 1e-9)
    phase = ((t - t[0]) % length) / length * folds
    fold = np.minimum(phase.astype(int), folds - 1)
    gap = CORRELATION_TIME * folds / length
    return fold, np.column_stack([phase - fold < gap, phase - fold > 1 - gap])
