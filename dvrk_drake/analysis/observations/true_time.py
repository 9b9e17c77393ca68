"""Estimates the true times of the rows of a motion from positions and velocities.

Recorded velocities are used only if they agree in gain and lag with the derivatives of the recorded positions.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.analysis.observations.signals import central_difference, low_pass, resample
from dvrk_drake.errors import RecordingError
from dvrk_drake.recordings.recording import MIN_ROWS, REST_SPEED, Recording

#: Cut-off frequency of the low-pass filter for the comparison of velocities [Hz]. Motions have lower frequencies, and
#: most timing jitter has higher frequencies.
CUT_OFF, ORDER = 10.0, 4
#: Largest deviation of the gain from 1, and largest lag [s], of velocities that agree with dq/dt. Half or twice these
#: values changes no finding on the public recordings.
GAIN_TOLERANCE, LAG_TOLERANCE = 0.03, 0.004
#: Smallest RMS speed for a comparison [rad/s, m/s]. On the public recordings, half or twice the value changes only
#: warnings on the velocities of joints that are held while another joint moves.
MIN_SPEED = 1e-3
#: Duration that is omitted at each end because of filter transients [s], at most a tenth of the motion. Transients
#: decay by a factor of 2e5 in this time.
ENDS = 0.5
#: Largest number of rows in a fit. A motion with more rows is thinned out after low-pass filtering. It limits the time
#: and the memory for a long motion (benchmarks/long_recording.py).
MAX_ROWS = 40_000
#: Number of iterations of a fit. Twice as many change the printed lags on the public recordings by at most 0.1 ms.
_ITERATIONS = 8


class VelocityAgreement(NamedTuple):
    """Least-squares fit of qd(t) = gain * dq/dt(t - lag) below `CUT_OFF`. All arrays have shape (n,).

    Attributes:
        gain: Gain [1], nan if the joint does not move.
        lag: Lag of qd relative to dq/dt [s], nan if the joint does not move.
        mismatch: RMS residual of the fit divided by the RMS of qd [1].
        agrees: True if the gain is within `GAIN_TOLERANCE` of 1 and the lag is within `LAG_TOLERANCE`.
    """

    gain: NDArray[np.float64]
    lag: NDArray[np.float64]
    mismatch: NDArray[np.float64]
    agrees: NDArray[np.bool_]


def velocity_agreement(q: NDArray[np.float64], qd: NDArray[np.float64], rate: float) -> VelocityAgreement:
    """Compares qd with the time derivative of q.

    The function low-pass filters both velocities, which removes most of the effect of timing jitter.

    Args:
        q: Positions (m, n) at a constant rate.
        qd: Velocities (m, n) at the same rate.
        rate: Sampling rate [Hz].
    """
    v, qd = (low_pass(x, rate, min(CUT_OFF, 0.2 * rate), ORDER) for x in (central_difference(q, rate), qd))
    ends = min(int(ENDS * rate), len(q) // 10)
    inner = slice(ends, len(q) - ends, -(-len(q) // MAX_ROWS))
    fits = np.array([_fit(v[:, j], qd[:, j], inner) for j in range(q.shape[1])])
    gain, samples, mismatch = fits.T
    lag = samples / rate
    return VelocityAgreement(gain, lag, mismatch, (np.abs(gain - 1) < GAIN_TOLERANCE) & (np.abs(lag) < LAG_TOLERANCE))


def _fit(v: NDArray[np.float64], qd: NDArray[np.float64], inner: slice) -> tuple[float, float, float]:
    """Returns gain, lag [samples] and mismatch of one joint from Gauss-Newton iterations."""
    size = float(np.sqrt(np.mean(qd[inner] ** 2)))
    if float(np.sqrt(np.mean(v[inner] ** 2))) < MIN_SPEED:
        return np.nan, np.nan, np.nan
    if size < MIN_SPEED:
        return 0.0, 0.0, 1.0
    index, slopes = np.arange(len(v), dtype=float), np.gradient(v)
    rows, measured = index[inner], qd[inner]
    gain, lag = 1.0, 0.0
    for _ in range(_ITERATIONS):
        columns = np.column_stack([np.interp(rows - lag, index, x) for x in (v, -slopes)])
        (gain, slope), *_ = np.linalg.lstsq(columns, measured, rcond=None)
        if gain == 0.0:
            break
        lag += float(np.clip(slope / gain, -3, 3))
    residual = measured - gain * np.interp(rows - lag, index, v)
    return float(gain), lag, float(np.sqrt(np.mean(residual**2))) / size


#: Largest difference between equal values, as a share of the RMS value of the channel. Equal values differ by rounding
#: errors after a conversion of coordinates.
SAME_VALUE = 1e-9
#: Smallest number of joints that determine times. A single joint fits any times, with intervals dq / qd.
MIN_JOINTS = 2
#: Smallest ratio of the residual variance with recorded times to the residual variance with reconstructed times. Below
#: this ratio, the recorded times are kept. Half or twice the value changes no finding on the public recordings.
MIN_VARIANCE_RATIO = 3.0
#: Frequency below which the reconstructed times follow the recorded times [Hz]. Half or twice the value changes no
#: finding on the public recordings.
DRIFT = 0.3
#: Smallest interval between two distinct rows, as a share of the mean interval. Half or twice the value changes no
#: finding on the public recordings.
MIN_INTERVAL = 0.02


#: The arm moves while the speed of at least one joint exceeds MOVING_SHARE of its RMS speed. Without qd, the speed is
#: the displacement over SPEED_ROWS rows: the smaller one of those before and after the row. Half or twice these values
#: changes no finding on the public recordings.
MOVING_SHARE, SPEED_ROWS = 0.05, 10
#: Smallest displacement of a moving joint over SPEED_ROWS rows, in steps of the position (encoder counts). Half or
#: twice the value changes no finding on the public recordings.
MIN_STEPS = 3.0
#: Number of rows between two positions whose difference is compared with the integral of qd. Half or twice the value
#: changes no finding on the public recordings.
BLOCK = 20
#: The motion stalls at repeated rows (`DistinctRows.stalled`) if `time_factor` exceeds 1 by more than MIN_STALL with
#: the intervals of these rows, and if its error without these intervals is less than STALL_RATIO times as large. Half
#: or twice these values changes no finding on the public recordings.
MIN_STALL, STALL_RATIO = 0.02, 0.5


class DistinctRows(NamedTuple):
    """Rows of a motion that do not repeat the previous row.

    Attributes:
        rows: Indices (k,) of the rows.
        t: Recorded times (k,) of the rows [s]. If `stalled`, the intervals of repeated rows are removed.
        stalled: True if the motion stalls at repeated rows while the recorded times continue.
    """

    rows: NDArray[np.int_]
    t: NDArray[np.float64]
    stalled: bool


class TrueTime(NamedTuple):
    """True times of the rows of a motion.

    Attributes:
        rows: Indices (k,) of the rows that do not repeat the previous row.
        t: Times (k,) of these rows, increasing [s]. Recorded times without significant jitter are kept.
        jitter: Standard deviation of the differences between true and recorded intervals, divided by the mean interval
            [1]. 0 if the recorded times are kept.
        reconstructed: True if t is reconstructed from q and qd.
    """

    rows: NDArray[np.int_]
    t: NDArray[np.float64]
    jitter: float
    reconstructed: bool


def true_time(recording: Recording) -> TrueTime:
    """Returns the times of the distinct rows, reconstructed from q and qd if the recorded times have jitter.

    The model is dq_ij = qd_ij dt_i + noise_j, for interval i and the joints j whose qd agrees with dq/dt
    (`velocity_agreement`). The maximum-a-posteriori interval dt_i between two rows, with the mean interval dt_0 as
    prior mean, is

        dt_i = (sum_j dq_ij qd_ij / s_j^2 + dt_0 / s^2) / (sum_j qd_ij^2 / s_j^2 + 1 / s^2)

    Here dq_ij is the position increment and qd_ij the mean velocity of the two rows. The standard deviations s_j of the
    noise and s of the intervals are estimated together with the intervals. Then all intervals are scaled, so that their
    sum is the recorded duration.

    Raises:
        RecordingError: The recording has no times, or they do not increase.
    """
    rows, recorded, _ = distinct_rows(recording)
    if recording.qd is None or len(rows) < MIN_ROWS:
        return TrueTime(rows, recorded, 0.0, False)
    q, qd, mean = recording.q[rows], recording.qd[rows], float(np.mean(np.diff(recorded)))
    reconstructed = recorded
    # With jitter, qd of some joints disagrees with dq/dt at first. The reconstructed times are used for a second test.
    for _ in range(2):
        even = np.linspace(recorded[0], recorded[-1], len(recorded))
        resampled_q, resampled_qd = (resample(reconstructed, x, even) for x in (q, qd))
        agrees = velocity_agreement(resampled_q, resampled_qd, 1 / mean).agrees
        if np.sum(agrees) < MIN_JOINTS:
            return TrueTime(rows, recorded, 0.0, False)
        dq, mean_qd = np.diff(q[:, agrees], axis=0), ((qd[1:] + qd[:-1]) / 2)[:, agrees]
        intervals, noise = _intervals(dq, mean_qd, mean)
        intervals *= (recorded[-1] - recorded[0]) / np.sum(intervals)
        integrated = recorded[0] + np.concatenate([[0.0], np.cumsum(intervals)])
        reconstructed = _without_drift(recorded, integrated, mean)
    variance = _residual_variance(dq, mean_qd, np.diff(recorded), noise)
    if variance < MIN_VARIANCE_RATIO * _residual_variance(dq, mean_qd, intervals, noise):
        return TrueTime(rows, recorded, 0.0, False)
    jitter = float(np.std(np.diff(reconstructed) - np.diff(recorded))) / mean
    return TrueTime(rows, reconstructed, jitter, True)


def _without_drift(
    recorded: NDArray[np.float64], reconstructed: NDArray[np.float64], mean: float
) -> NDArray[np.float64]:
    """Removes the drift (below `DRIFT`) of the reconstructed times. Small errors of qd cause this drift."""
    difference = reconstructed - recorded
    intervals = np.diff(recorded + difference - low_pass(difference, 1 / mean, DRIFT))
    return recorded[0] + np.concatenate([[0.0], np.cumsum(np.maximum(intervals, MIN_INTERVAL * mean))])


def repeated_rows(recording: Recording) -> NDArray[np.bool_]:
    """Returns a mask (m,) of the rows that repeat q, qd and tau of the previous row while the arm moves.

    Rows at rest are not included, because quantised measurements at rest are equal.
    """
    blocks = [block for block in (recording.q, recording.qd, recording.tau) if block is not None]
    repeats = np.all([repeated_block(block) for block in blocks], axis=0)
    if recording.qd is not None:
        speed = np.abs(recording.qd)
    else:
        rows, q = np.arange(len(recording)), recording.q
        after, before = np.minimum(rows + SPEED_ROWS, len(q) - 1), np.maximum(rows - SPEED_ROWS, 0)
        speed = np.minimum(np.abs(q[after] - q), np.abs(q - q[before]))
        steps = np.abs(np.diff(q, axis=0))
        changed = steps > SAME_VALUE * np.sqrt(np.mean(q**2, axis=0))
        count = np.min(np.where(changed, steps, np.inf), axis=0, initial=np.inf)
        speed = np.where(speed >= MIN_STEPS * count, speed, 0.0)
    moves = np.any(speed > MOVING_SHARE * np.sqrt(np.mean(speed**2, axis=0)), axis=1)
    return np.asarray(repeats & moves, dtype=bool)


def distinct_rows(recording: Recording) -> DistinctRows:
    """Returns the rows that do not repeat the previous row, with their recorded times.

    Rows are repeated if the recorder reads faster than the arm publishes. The times of the other rows are then correct.
    In some recordings, however, the motion stalls at repeated rows while the recorded times continue. The intervals of
    these rows are then removed from the times. The integral of qd distinguishes the two cases (`time_factor`).

    Raises:
        RecordingError: The recording has no times, or they do not increase.
    """
    t = increasing_times(recording)
    repeats = repeated_rows(recording)
    rows = np.flatnonzero(~repeats)
    if recording.qd is None or len(rows) < MIN_ROWS or len(rows) == len(t):
        return DistinctRows(rows, t[rows], False)
    running = np.where(repeats, 0.0, np.diff(t, prepend=t[0]))
    candidates = t[rows], t[0] + np.cumsum(running)[rows]
    factors = [time_factor(times, recording.q[rows], recording.qd[rows]) for times in candidates]
    if factors[0] is None or factors[1] is None:
        return DistinctRows(rows, candidates[0], False)
    stalled = factors[0] - 1 > MIN_STALL and abs(factors[1] - 1) < STALL_RATIO * (factors[0] - 1)
    return DistinctRows(rows, candidates[int(stalled)], bool(stalled))


def time_factor(t: NDArray[np.float64], q: NDArray[np.float64], qd: NDArray[np.float64]) -> float | None:
    """Returns the ratio of recorded to true time from the integral of qd, or None if it is not identifiable.

    At least `MIN_JOINTS` joints must move, and the ratios of most of these joints must agree within 10 %.

    Args:
        t: Recorded times (m,) [s].
        q, qd: Positions (m, n) [rad, m] and velocities (m, n) [rad/s, m/s].
    """
    # Differences over several rows reduce the effects of jitter and repeated rows.
    integrals = np.diff(
        np.vstack([q[:1] * 0, np.cumsum((qd[1:] + qd[:-1]) / 2 * np.diff(t)[:, None], axis=0)])[::BLOCK], axis=0
    )
    dq = np.diff(q[::BLOCK], axis=0)
    moving = np.sqrt(np.mean(qd**2, axis=0)) > REST_SPEED[1]
    squares = np.sum(dq**2, axis=0) * np.sum(integrals**2, axis=0)
    correlated = np.sum(dq * integrals, axis=0) > 0.6 * np.sqrt(squares)
    used = moving & correlated & (squares > 0)
    if np.sum(used) < MIN_JOINTS:
        return None
    factors = np.sqrt(np.sum(integrals[:, used] ** 2, axis=0) / np.sum(dq[:, used] ** 2, axis=0))
    factor = float(np.median(factors))
    return factor if np.mean(np.abs(factors / factor - 1) < 0.1) > 0.5 else None


def repeated_block(block: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Returns a mask (m,) of the rows of a block (m, n) that repeat the previous row in all columns."""
    same = SAME_VALUE * np.sqrt(np.mean(block**2, axis=0))
    return np.concatenate([[False], np.all(np.abs(np.diff(block, axis=0)) <= same, axis=1)])


def increasing_times(recording: Recording) -> NDArray[np.float64]:
    """Returns the times t (m,) of a motion.

    Raises:
        RecordingError: There are no times, or they do not increase.
    """
    if recording.t is None:
        raise RecordingError(
            f"{recording.source or 'recording'}: the recording has no times. Add t [s], the time of each row."
        )
    decreasing = np.flatnonzero(np.diff(recording.t) <= 0)
    if len(decreasing):
        row = int(decreasing[0]) + 1
        raise RecordingError(
            f"{recording.where(row)}: t = {recording.t[row]:g} s is not greater than {recording.t[row - 1]:g} s in the "
            "previous row. Sort the rows by time."
        )
    return recording.t


def _intervals(
    dq: NDArray[np.float64], qd: NDArray[np.float64], mean: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Estimates the intervals between rows, see `true_time`.

    Args:
        dq: Position increments (k - 1, j) of j joints [rad, m].
        qd: Mean velocities (k - 1, j) of the two rows of each interval [rad/s, m/s].
        mean: Mean interval [s].

    Returns:
        Intervals (k - 1,) [s], and noise variances (j,) of the position increments [rad^2, m^2].
    """
    tiny = np.finfo(float).tiny
    noise = np.var(dq - qd * mean, axis=0) + tiny
    spread = (0.5 * mean) ** 2
    for _ in range(_ITERATIONS):
        precision = np.sum(qd**2 / noise, axis=1) + 1 / spread
        intervals = (np.sum(dq * qd / noise, axis=1) + mean / spread) / precision
        # Expectation maximisation: the uncertainty of an interval contributes to both variances.
        noise = np.mean((dq - qd * intervals[:, None]) ** 2 + qd**2 / precision[:, None], axis=0) + tiny
        spread = float(np.mean((intervals - mean) ** 2 + 1 / precision))
    return np.maximum(intervals, MIN_INTERVAL * mean), noise


def _residual_variance(
    dq: NDArray[np.float64], qd: NDArray[np.float64], intervals: NDArray[np.float64], noise: NDArray[np.float64]
) -> float:
    """Returns the median over the intervals of sum_j (dq_j - qd_j dt)^2 / noise_j."""
    return float(np.median(np.sum((dq - qd * intervals[:, None]) ** 2 / noise, axis=1)))
