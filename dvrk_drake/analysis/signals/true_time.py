"""Estimates the true times of a motion's rows from displacements and velocities.

Recorded velocities are used only if they agree with the derivatives of the recorded positions in gain and lag.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.analysis.signals.low_pass import central_difference, low_pass, resample
from dvrk_drake.errors import RecordingError
from dvrk_drake.recordings.recording import Recording

#: Velocities are compared below this frequency [Hz]. Motions are slower, and most timing jitter is faster.
CUT_OFF = 10.0
#: Largest deviation of the gain from 1, and largest lag [s], of velocities that agree.
GAIN_TOLERANCE, LAG_TOLERANCE = 0.03, 0.004
#: Least RMS speed for a comparison [rad/s, m/s].
MIN_SPEED = 1e-3
#: Omitted at each end because of filter transients [s], at most a tenth of the motion.
ENDS = 0.5
_FIT_ITERATIONS = 5


class VelocityAgreement(NamedTuple):
    """Fit of qd(t) = gain * dq/dt(t - lag) by least squares below `CUT_OFF`; (n,) each.

    Attributes:
        gain: Gain, 1 if both agree; nan if the joint rests.
        lag: Delay of qd [s].
        mismatch: RMS residual of the fit, as a share of the RMS of qd.
        agrees: True if the gain is within `GAIN_TOLERANCE` of 1 and the lag is within `LAG_TOLERANCE`.
    """

    gain: NDArray[np.float64]
    lag: NDArray[np.float64]
    mismatch: NDArray[np.float64]
    agrees: NDArray[np.bool_]


def velocity_agreement(q: NDArray[np.float64], qd: NDArray[np.float64], rate: float) -> VelocityAgreement:
    """Compares qd with the time derivative of q.

    Args:
        q: (m, n) positions at a constant rate. Jitter of the times averages out below `CUT_OFF`.
        qd: (m, n) velocities at the same rate.
        rate: Sampling rate [Hz].
    """
    v, qd = (low_pass(x, rate, min(CUT_OFF, 0.2 * rate), order=4) for x in (central_difference(q, rate), qd))
    ends = min(int(ENDS * rate), len(q) // 10)
    fits = np.array([_fit(v[:, j], qd[:, j], slice(ends, len(q) - ends)) for j in range(q.shape[1])])
    gain, samples, mismatch = fits.T
    lag = samples / rate
    return VelocityAgreement(gain, lag, mismatch, (np.abs(gain - 1) < GAIN_TOLERANCE) & (np.abs(lag) < LAG_TOLERANCE))


def _fit(v: NDArray[np.float64], qd: NDArray[np.float64], inner: slice) -> tuple[float, float, float]:
    """Returns gain, lag [samples] and mismatch by Gauss-Newton iterations, starting without lag."""
    size = float(np.sqrt(np.mean(qd[inner] ** 2)))
    if float(np.sqrt(np.mean(v[inner] ** 2))) < MIN_SPEED:
        return np.nan, np.nan, np.nan
    if size < MIN_SPEED:
        return 0.0, 0.0, 1.0
    index = np.arange(len(v), dtype=float)
    gain, lag = 1.0, 0.0
    for _ in range(_FIT_ITERATIONS):
        shifted = np.interp(index - lag, index, v)
        columns = np.column_stack([shifted, -np.gradient(shifted)])
        (gain, slope), *_ = np.linalg.lstsq(columns[inner], qd[inner], rcond=None)
        if gain == 0.0:
            break
        lag += float(np.clip(slope / gain, -3, 3))
    left = (qd - gain * np.interp(index - lag, index, v))[inner]
    return float(gain), lag, float(np.sqrt(np.mean(left**2))) / size


#: Largest difference of equal values, as a share of the channel's RMS. Conversions of coordinates cause rounding.
SAME_VALUE = 1e-9
#: Fewest rows, and fewest joints with consistent qd and dq/dt, for reconstructing times.
MIN_ROWS, MIN_JOINTS = 100, 2
#: Least ratio of the residual variances of recorded and reconstructed times for replacing the recorded times.
WORSE = 3.0
#: Below this frequency the reconstructed times follow the recorded times [Hz].
DRIFT = 0.3
#: Shortest interval between two distinct rows, as a share of the mean interval.
MIN_LENGTH = 0.02
_ITERATIONS = 8


class TrueTime(NamedTuple):
    """True times of the rows of a motion.

    Attributes:
        rows: (k,) rows that do not repeat the row before.
        t: (k,) their times [s], increasing. These are the recorded times unless they jitter.
        jitter: Standard deviation of the difference between true and recorded intervals, as a share of the mean
            interval; 0 if the recorded times are kept.
        reconstructed: True if t is reconstructed from q and qd.
    """

    rows: NDArray[np.int_]
    t: NDArray[np.float64]
    jitter: float
    reconstructed: bool


def true_time(recording: Recording) -> TrueTime:
    """Returns the times of the distinct rows, reconstructed from q and qd if the recorded times jitter.

    The interval dt_i between two rows maximises the posterior of dq_ij = qd_ij dt_i + noise_j over the joints j whose
    qd agrees with dq/dt (`velocity_agreement`), with the mean interval as the prior:

        dt_i = (sum_j dq_ij qd_ij / s_j^2 + dt_0 / s^2) / (sum_j qd_ij^2 / s_j^2 + 1 / s^2)

    Here qd_ij is the mean of both rows. The deviations s_j of the noise and s of the intervals are estimated together
    with the intervals. The sum of the intervals is scaled to the recorded duration.

    Raises:
        RecordingError: The recording has no times, or they do not increase.
    """
    t = increasing_times(recording)
    rows = np.flatnonzero(~repeated_rows(recording))
    own = t[rows]
    if recording.qd is None or len(rows) < MIN_ROWS:
        return TrueTime(rows, own, 0.0, False)
    q, qd, mean = recording.q[rows], recording.qd[rows], float(np.mean(np.diff(own)))
    made = own
    # Jitter first hides the agreement of some joints. It is evaluated again with the times from the other joints.
    for _ in range(2):
        even = np.linspace(own[0], own[-1], len(own))
        agrees = velocity_agreement(resample(made, q, even), resample(made, qd, even), 1 / mean).agrees
        if np.sum(agrees) < MIN_JOINTS:
            return TrueTime(rows, own, 0.0, False)
        dq, mean_qd = np.diff(q[:, agrees], axis=0), ((qd[1:] + qd[:-1]) / 2)[:, agrees]
        intervals, noise = _intervals(dq, mean_qd, mean)
        intervals *= (own[-1] - own[0]) / np.sum(intervals)
        made = _without_drift(own, own[0] + np.concatenate([[0.0], np.cumsum(intervals)]), mean)
    if _left(dq, mean_qd, np.diff(own), noise) < WORSE * _left(dq, mean_qd, intervals, noise):
        return TrueTime(rows, own, 0.0, False)
    return TrueTime(rows, made, float(np.std(np.diff(made) - np.diff(own))) / mean, True)


def _without_drift(own: NDArray[np.float64], made: NDArray[np.float64], mean: float) -> NDArray[np.float64]:
    """Removes the slow drift of the reconstructed times. An error of 1 % in qd causes a drift of milliseconds."""
    lead = made - own
    intervals = np.diff(own + lead - low_pass(lead, 1 / mean, DRIFT))
    return own[0] + np.concatenate([[0.0], np.cumsum(np.maximum(intervals, MIN_LENGTH * mean))])


def repeated_rows(recording: Recording) -> NDArray[np.bool_]:
    """Returns a mask (m,) of moving rows in which q, qd and tau repeat the row before, because of too fast polling."""
    blocks = [block for block in (recording.q, recording.qd, recording.tau) if block is not None]
    repeats = np.all([repeated_block(block) for block in blocks], axis=0)
    moves = np.any(np.abs(recording.qd) > 0, axis=1) if recording.qd is not None else np.ones(len(recording), bool)
    return np.asarray(repeats & moves, dtype=bool)


def repeated_block(block: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Returns a mask (m,) of the rows of a block (m, n) that repeat the row before in all columns."""
    same = SAME_VALUE * np.sqrt(np.mean(block**2, axis=0))
    return np.concatenate([[False], np.all(np.abs(np.diff(block, axis=0)) <= same, axis=1)])


def increasing_times(recording: Recording) -> NDArray[np.float64]:
    """Returns the times t (m,) of a motion.

    Raises:
        RecordingError: There are no times, or they do not increase.
    """
    if recording.t is None:
        raise RecordingError(f"{recording.source or 'recording'}: the recording has no times. Add a column t [s].")
    back = np.flatnonzero(np.diff(recording.t) <= 0)
    if len(back):
        row = int(back[0]) + 1
        raise RecordingError(
            f"{recording.where(row)}: t = {recording.t[row]:g} s does not increase, after {recording.t[row - 1]:g} s "
            "in the previous row. Sort the rows by time."
        )
    return recording.t


def _intervals(
    dq: NDArray[np.float64], qd: NDArray[np.float64], mean: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Returns intervals (k - 1,) [s] and the noise variance of each joint for dq and qd (k - 1, joints)."""
    tiny = np.finfo(float).tiny
    noise = np.var(dq - qd * mean, axis=0) + tiny
    spread = (0.5 * mean) ** 2
    for _ in range(_ITERATIONS):
        precision = np.sum(qd**2 / noise, axis=1) + 1 / spread
        intervals = (np.sum(dq * qd / noise, axis=1) + mean / spread) / precision
        # Expectation maximisation: the uncertainty of an interval contributes to both variances.
        noise = np.mean((dq - qd * intervals[:, None]) ** 2 + qd**2 / precision[:, None], axis=0) + tiny
        spread = float(np.mean((intervals - mean) ** 2 + 1 / precision))
    return np.maximum(intervals, MIN_LENGTH * mean), noise


def _left(
    dq: NDArray[np.float64], qd: NDArray[np.float64], intervals: NDArray[np.float64], noise: NDArray[np.float64]
) -> float:
    """Returns the median over rows of the squared residual of dq - qd dt in units of the noise, robust to spikes."""
    return float(np.median(np.sum((dq - qd * intervals[:, None]) ** 2 / noise, axis=1)))
