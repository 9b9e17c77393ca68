"""Estimates the delay of the efforts relative to the motion, and the Coulomb friction of the actuators."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.analysis.estimation.motion_columns import DIRECTION_WIDTH
from dvrk_drake.analysis.estimation.motion_effects import MIN_ERRORS, MIN_GAIN
from dvrk_drake.analysis.observations.motion_grid import MotionSignals, ends_of
from dvrk_drake.analysis.observations.signals import low_pass, minimiser
from dvrk_drake.analysis.observations.true_time import MAX_ROWS

#: Cut-off of the low-pass filter for accelerations, efforts and regressor columns [Hz]. It is above the cut-offs of the
#: efforts of the public motions (5.65 and 16.96 Hz). Half or twice the value changes only notes on delays of the public
#: recordings.
CUT_OFF = 20.0
#: Largest tested delay [s]. Half or twice the value changes only notes on delays of the public recordings.
MAX_LAG = 0.04
#: Number of segments of the motion from which the standard error of the delay is estimated. Half or twice the value
#: changes only notes on delays of the public recordings.
NUM_SEGMENTS = 5
#: Assumed number of independent measurements of an effort, for the standard error of the Coulomb friction and the
#: log-likelihood of `ChannelFit`. More measurements do not average out model errors. It is that of one period (6.48 s)
#: of the public motion `psm_one` below its cut-off frequency (16.96 Hz).
NUM_INDEPENDENT = 220


class EffortLag(NamedTuple):
    """Delay of tau relative to the motion, and Coulomb friction. All arrays have shape (n,).

    Attributes:
        lag: Delay with the smallest residual variance [s], between -`MAX_LAG` and `MAX_LAG`. nan if the actuator does
            not move or its effort is always 0.
        standard_error: Standard error of the delay, from `NUM_SEGMENTS` segments of the motion [s].
        gain: Ratio of the residual variances without and with the delay [1].
        determined: True if the delay is significant, see `MIN_GAIN` and `MIN_ERRORS`.
        coulomb: Coulomb friction [N m, N], negative if the effort has the wrong sign.
        coulomb_error: Standard error of the Coulomb friction, see `_coulomb` [N m, N].
    """

    lag: NDArray[np.float64]
    standard_error: NDArray[np.float64]
    gain: NDArray[np.float64]
    determined: NDArray[np.bool_]
    coulomb: NDArray[np.float64]
    coulomb_error: NDArray[np.float64]


def effort_lag(signals: MotionSignals, moving: NDArray[np.bool_]) -> EffortLag:
    """Estimates the delay of each effort by fits with delays between -`MAX_LAG` and `MAX_LAG`.

    The regressors are the actuator's Coulomb and viscous friction, the accelerations, the sines and cosines of the
    positions, and an offset. The accelerations and positions of all moving actuators are used. Presliding friction has
    a similar effect to a delay, so the two are not identifiable separately from one motion.

    Args:
        signals: Signals in actuator coordinates.
        moving: Mask (n,) of the actuators that move.
    """
    rate = signals.rate
    start = max(int(ends_of(len(signals.t) / rate) * rate), int(MAX_LAG * rate))
    inner = slice(start, len(signals.t) - start, -(-len(signals.t) // MAX_ROWS))
    tau = low_pass(signals.tau, rate, CUT_OFF)
    angles = signals.q[:, moving]
    columns_of_all = (signals.vd[:, moving], np.sin(angles), np.cos(angles), np.ones((len(angles), 1)))
    shared = np.hstack([low_pass(columns, rate, CUT_OFF)[inner] for columns in columns_of_all])
    result = np.full((tau.shape[1], 5), np.nan)
    for j in np.flatnonzero(moving & np.any(tau != 0, axis=0)):
        v = signals.v[:, j]
        coulomb = np.tanh(v / (DIRECTION_WIDTH * np.sqrt(np.mean(v**2))))
        columns = np.hstack([low_pass(np.column_stack([coulomb, v]), rate, CUT_OFF)[inner], shared])
        Q, _ = np.linalg.qr(columns / (np.sqrt(np.mean(columns**2, axis=0)) + np.finfo(float).tiny))
        result[j] = *_fit(tau[:, j], Q, inner, rate), *_coulomb(columns, tau[inner, j])
    lag, error, gain, size, size_error = result.T
    with np.errstate(invalid="ignore"):
        determined = (gain > MIN_GAIN) & (np.abs(lag) > MIN_ERRORS * error)
    return EffortLag(lag, error, gain, determined, size, size_error)


def _coulomb(columns: NDArray[np.float64], tau: NDArray[np.float64]) -> tuple[float, float]:
    """Returns the coefficient of the first column (Coulomb friction) and the standard error of the coefficient.

    The standard error is that of `NUM_INDEPENDENT` measurements with the residuals of the fit. It does not decrease
    with the length or the repetitions of a motion, because the residuals are mainly errors of the simple model.
    """
    first, others = columns[:, 0], columns[:, 1:]
    own = first - others @ np.linalg.lstsq(others, first, rcond=None)[0]
    coefficient = float(own @ tau / (own @ own))
    residual = tau - columns @ np.linalg.lstsq(columns, tau, rcond=None)[0]
    return coefficient, float(np.linalg.norm(residual) / np.linalg.norm(own)) / np.sqrt(NUM_INDEPENDENT)


def _fit(tau: NDArray[np.float64], Q: NDArray[np.float64], inner: slice, rate: float) -> tuple[float, float, float]:
    """Returns the delay [s], its standard error [s] and its gain, for regressors with the orthonormal basis Q."""
    last = int(MAX_LAG * rate)
    shifts = np.arange(-last, last + 1)
    shifted = np.column_stack([tau[inner.start + s : inner.stop + s : inner.step] for s in shifts])
    squares = (shifted - Q @ (Q.T @ shifted)) ** 2
    totals = np.sum(squares, axis=0)
    lags = [minimiser(shifts, np.sum(segment, axis=0)) for segment in np.array_split(squares, NUM_SEGMENTS)]
    error = float(np.std(lags, ddof=1)) / np.sqrt(NUM_SEGMENTS)
    return minimiser(shifts, totals) / rate, error / rate, float(totals[len(shifts) // 2] / np.min(totals))
