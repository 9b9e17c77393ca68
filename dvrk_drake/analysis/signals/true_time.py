"""The true times of a motion's rows, from how far the joints moved between them and how fast they were.

Recorded velocities count where they are the derivatives of the recorded positions: gain and lag of each channel tell.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.analysis.signals.low_pass import central_difference, low_pass, resample
from dvrk_drake.errors import RecordingError
from dvrk_drake.recordings.recording import Recording

#: Both are compared below this frequency [Hz]; an arm moves below it, and jitter is mostly above.
CUT_OFF = 10.0
#: A channel agrees if its gain is this close to 1, and its lag below this [s].
GAIN_TOLERANCE, LAG_TOLERANCE = 0.03, 0.004
#: Below this RMS speed nothing can be said [rad/s, m/s].
MIN_SPEED = 1e-3
#: Left out at each end, where filters swing in [s]; at most a tenth of the motion.
ENDS = 0.5
_FIT_ITERATIONS = 5


class VelocityAgreement(NamedTuple):
    """qd(t) = gain * dq/dt(t - lag), fitted by least squares below `CUT_OFF`; (n,) each.

    Attributes:
        gain: 1 if both agree; nan where the joint rests.
        lag: by which qd is late [s].
        mismatch: RMS of what the fit leaves, as a share of the RMS of qd.
        agrees: gain within `GAIN_TOLERANCE` of 1 and lag within `LAG_TOLERANCE`.
    """

    gain: NDArray[np.float64]
    lag: NDArray[np.float64]
    mismatch: NDArray[np.float64]
    agrees: NDArray[np.bool_]


def velocity_agreement(q: NDArray[np.float64], qd: NDArray[np.float64], rate: float) -> VelocityAgreement:
    """Compares qd with the derivative of q in time.

    Args:
        q, qd: (m, n) positions and velocities at a constant rate; jitter of the times averages out below `CUT_OFF`.
        rate: samples a second [Hz].
    """
    v, qd = (low_pass(x, rate, min(CUT_OFF, 0.2 * rate), order=4) for x in (central_difference(q, rate), qd))
    ends = min(int(ENDS * rate), len(q) // 10)
    fits = np.array([_fit(v[:, j], qd[:, j], slice(ends, len(q) - ends)) for j in range(q.shape[1])])
    gain, samples, mismatch = fits.T
    lag = samples / rate
    return VelocityAgreement(gain, lag, mismatch, (np.abs(gain - 1) < GAIN_TOLERANCE) & (np.abs(lag) < LAG_TOLERANCE))


def _fit(v: NDArray[np.float64], qd: NDArray[np.float64], inner: slice) -> tuple[float, float, float]:
    """Gain, lag [samples] and mismatch: Gauss-Newton from no lag."""
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


#: Two values closer than this share of their channel's RMS are the same: coordinates may have been converted.
SAME_VALUE = 1e-9
#: Fewest rows, and fewest joints whose qd agrees with dq/dt, that tell a time.
MIN_ROWS, MIN_JOINTS = 100, 2
#: The recorded times are kept unless they leave this many times the variance that made ones leave.
WORSE = 3.0
#: Slower than this the recorded times are right [Hz].
DRIFT = 0.3
#: Shortest interval between two different rows, as a share of the mean.
MIN_LENGTH = 0.02
_ITERATIONS = 8


class TrueTime(NamedTuple):
    """When the rows of a motion were measured.

    Attributes:
        rows: (k,) rows that do not repeat the one before.
        t: (k,) their times [s], increasing; the recorded ones unless they jitter.
        jitter: standard deviation of the difference between true and recorded intervals, as a share of the mean one; 0
            where the recorded times are kept.
        reconstructed: whether t is made from q and qd.
    """

    rows: NDArray[np.int_]
    t: NDArray[np.float64]
    jitter: float
    reconstructed: bool


def true_time(recording: Recording) -> TrueTime:
    """The times of the rows that say something new, made from q and qd where the recorded ones jitter against those.

    The interval dt_i between two rows maximises the posterior of dq_ij = qd_ij dt_i + noise_j over the joints j whose
    qd agrees with dq/dt (`velocity_agreement`), with the mean interval as the prior:

        dt_i = (sum_j dq_ij qd_ij / s_j^2 + dt_0 / s^2) / (sum_j qd_ij^2 / s_j^2 + 1 / s^2)

    qd_ij is the mean of both rows; the deviations s_j of the noise and s of the intervals are estimated with it. Their
    sum is scaled to the recorded duration.

    Raises:
        RecordingError: no times, or they do not increase.
    """
    t = increasing_times(recording)
    rows = np.flatnonzero(~repeated_rows(recording))
    own = t[rows]
    if recording.qd is None or len(rows) < MIN_ROWS:
        return TrueTime(rows, own, 0.0, False)
    q, qd, mean = recording.q[rows], recording.qd[rows], float(np.mean(np.diff(own)))
    made = own
    # Jitter spoils the agreement of some joints at first: it is judged again on the times that the others make.
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
    """The made times that keep to the recorded ones on the whole: an error of qd of a percent makes a drift of ms."""
    lead = made - own
    intervals = np.diff(own + lead - low_pass(lead, 1 / mean, DRIFT))
    return own[0] + np.concatenate([[0.0], np.cumsum(np.maximum(intervals, MIN_LENGTH * mean))])


def repeated_rows(recording: Recording) -> NDArray[np.bool_]:
    """(m,) True where q, qd and tau all repeat the row before although the arm moves: it was polled too fast."""
    blocks = [block for block in (recording.q, recording.qd, recording.tau) if block is not None]
    repeats = np.all([repeated_block(block) for block in blocks], axis=0)
    moves = np.any(np.abs(recording.qd) > 0, axis=1) if recording.qd is not None else np.ones(len(recording), bool)
    return np.asarray(repeats & moves, dtype=bool)


def repeated_block(block: NDArray[np.float64]) -> NDArray[np.bool_]:
    """(m,) True where all columns of a block (m, n) repeat the row before."""
    same = SAME_VALUE * np.sqrt(np.mean(block**2, axis=0))
    return np.concatenate([[False], np.all(np.abs(np.diff(block, axis=0)) <= same, axis=1)])


def increasing_times(recording: Recording) -> NDArray[np.float64]:
    """t (m,) of a motion.

    Raises:
        RecordingError: there is none, or it does not increase.
    """
    if recording.t is None:
        raise RecordingError(f"{recording.source or 'recording'}: has no times; a motion needs a column t [s]")
    back = np.flatnonzero(np.diff(recording.t) <= 0)
    if len(back):
        row = int(back[0]) + 1
        raise RecordingError(
            f"{recording.where(row)}: t = {recording.t[row]:g} s does not increase, after {recording.t[row - 1]:g} s "
            "in the row before; rows must follow in time"
        )
    return recording.t


def _intervals(
    dq: NDArray[np.float64], qd: NDArray[np.float64], mean: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Intervals (k - 1,) [s] and the variance of each joint's noise; dq and qd (k - 1, joints)."""
    tiny = np.finfo(float).tiny
    noise = np.var(dq - qd * mean, axis=0) + tiny
    spread = (0.5 * mean) ** 2
    for _ in range(_ITERATIONS):
        precision = np.sum(qd**2 / noise, axis=1) + 1 / spread
        intervals = (np.sum(dq * qd / noise, axis=1) + mean / spread) / precision
        # Expectation and maximisation: what is uncertain of an interval belongs to both variances.
        noise = np.mean((dq - qd * intervals[:, None]) ** 2 + qd**2 / precision[:, None], axis=0) + tiny
        spread = float(np.mean((intervals - mean) ** 2 + 1 / precision))
    return np.maximum(intervals, MIN_LENGTH * mean), noise


def _left(
    dq: NDArray[np.float64], qd: NDArray[np.float64], intervals: NDArray[np.float64], noise: NDArray[np.float64]
) -> float:
    """What the intervals leave of dq - qd dt, in variances of its noise; the median row, which no spike moves."""
    return float(np.median(np.sum((dq - qd * intervals[:, None]) ** 2 / noise, axis=1)))
