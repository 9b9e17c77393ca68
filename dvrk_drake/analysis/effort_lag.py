"""Whether efforts are late behind the motion that they cause: the delay that explains them best."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.analysis.low_pass import low_pass
from dvrk_drake.analysis.motion_signals import MotionSignals

#: Of the low-pass that efforts and what explains them get [Hz].
CUT_OFF = 20.0
#: Delays that are tried [s], and their step.
LONGEST_LAG, LAG_STEP = 0.04, 0.0025
#: Left out at each end, where filters swing in [s].
ENDS = 0.5
#: Coulomb friction is smoothed over this share of the RMS speed.
SMOOTHING = 0.1
#: Presliding: friction builds up over these shares of the standard deviation of q.
PRESLIDING = 0.003, 0.01, 0.03, 0.08, 0.2
#: Parts of the motion whose delays give the standard error.
PARTS = 5
#: A delay is told only if it takes the variance that is left down by this factor, and exceeds so many standard errors.
LEAST_GAIN, LEAST_ERRORS = 1.12, 5.0


class EffortLag(NamedTuple):
    """How late tau is behind the motion; (n,) each.

    Attributes:
        lag: that leaves least of tau unexplained [s]; nan where the joint or its effort rests.
        standard_error: of it, from `PARTS` parts of the motion [s].
        gain: variance left without a delay over that with it [1].
        determined: whether the lag is one: large gain, many standard errors, and not at the end of what is tried.
    """

    lag: NDArray[np.float64]
    standard_error: NDArray[np.float64]
    gain: NDArray[np.float64]
    determined: NDArray[np.bool_]


def effort_lag(signals: MotionSignals, moving: NDArray[np.bool_]) -> EffortLag:
    """Fits each effort, delayed by up to 40 ms either way, by what its joint does; the least residual tells the delay.

    Explained by: all accelerations, own speed, own Coulomb friction, own presliding friction, sine and cosine of all
    positions. Friction that builds up over some way looks late; without its terms it would be taken for a delay.

    Args:
        signals: of the actuators: friction is theirs.
        moving: (n,) which of them move.
    """
    rate = signals.rate
    start = max(int(ENDS * rate), int(LONGEST_LAG * rate))
    inner = slice(start, len(signals.t) - start)
    tau = low_pass(signals.tau, rate, CUT_OFF)
    friction = _presliding(signals.q)
    angles = signals.q[:, moving]
    shared = np.hstack([signals.vd[:, moving], np.sin(angles), np.cos(angles), np.ones((len(angles), 1))])
    result = np.full((tau.shape[1], 3), np.nan)
    for j in np.flatnonzero(moving & np.any(tau != 0, axis=0)):
        v = signals.v[:, j]
        coulomb = np.tanh(v / (SMOOTHING * np.sqrt(np.mean(v**2))))
        columns = low_pass(np.column_stack([shared, v, coulomb, friction[:, j]]), rate, CUT_OFF)[inner]
        Q, _ = np.linalg.qr(columns / (np.sqrt(np.mean(columns**2, axis=0)) + np.finfo(float).tiny))
        result[j] = _fit(tau[:, j], Q, inner, rate)
    lag, error, gain = result.T
    with np.errstate(invalid="ignore"):
        determined = (gain > LEAST_GAIN) & (np.abs(lag) > LEAST_ERRORS * error)
        determined &= np.abs(lag) < LONGEST_LAG - LAG_STEP
    return EffortLag(lag, error, gain, determined)


def _presliding(q: NDArray[np.float64]) -> NDArray[np.float64]:
    """(m, n, widths) states of elasto-plastic elements, -1..1: z follows q and slips at its width."""
    width = np.std(q, axis=0)[:, None] * np.array(PRESLIDING) + np.finfo(float).tiny
    states = np.empty((*q.shape, len(PRESLIDING)))
    z = np.zeros_like(width)
    for row, step in enumerate(np.diff(q, axis=0, prepend=q[:1])):
        z = np.minimum(np.maximum(z + step[:, None], -width), width)
        states[row] = z
    return np.asarray(states / width)


def _fit(tau: NDArray[np.float64], Q: NDArray[np.float64], inner: slice, rate: float) -> tuple[float, float, float]:
    """Lag [s], its standard error [s] and its gain, for what spans the columns of Q."""
    step = max(round(LAG_STEP * rate), 1)
    shifts = np.arange(-(inner.start // step), inner.start // step + 1) * step
    shifts = shifts[np.abs(shifts) <= LONGEST_LAG * rate]
    shifted = np.column_stack([tau[inner.start + s : inner.stop + s] for s in shifts])
    squares = (shifted - Q @ (Q.T @ shifted)) ** 2
    left = np.sum(squares, axis=0)
    parts = [_least(shifts, np.sum(part, axis=0)) for part in np.array_split(squares, PARTS)]
    error = float(np.std(parts, ddof=1)) / np.sqrt(PARTS)
    return _least(shifts, left) / rate, error / rate, float(left[len(shifts) // 2] / np.min(left))


def _least(at: NDArray[np.int_], values: NDArray[np.float64]) -> float:
    """Where a sampled curve is least, between its samples by a parabola."""
    i = int(np.clip(np.argmin(values), 1, len(values) - 2))
    before, here, after = values[i - 1 : i + 2]
    curvature = before - 2 * here + after
    offset = 0.5 * (before - after) / curvature if curvature > 0 else 0.0
    return float(at[i] + np.clip(offset, -1, 1) * (at[1] - at[0]))
