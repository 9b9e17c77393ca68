"""Names causes of the effort error of a joint: shares of the squared error by cause, and structure in the residual."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.analysis.estimation.motion_columns import DIRECTION_WIDTH
from dvrk_drake.analysis.observations.signals import MOTION_FREQUENCY
from dvrk_drake.recordings.recording import GAP, MIN_GAP

#: Number of frequencies of the sine and cosine functions in the position-dependent error: those of the cable effects in
#: an arm file (`CABLES`).
_HARMONICS = 2
#: Smallest share of the squared error, beyond the mean error, for which a structure is named. An effect with a smaller
#: share reduces the RMS error by less than 15 %.
MIN_SHARE = 0.25
#: Number of rows that count as one independent value in a motion: half a second at a typical rate of 200 Hz, because
#: efforts at neighbouring rows are correlated.
_ROWS_PER_VALUE = 100
#: Speed below which the direction of a motion is uncertain, as a share of the RMS speed, as in `ErrorShares`.
_SLOW = 0.1


class ErrorShares(NamedTuple):
    """Shares of the squared effort error of one actuator, by cause. The sum of all shares is 1.

    Each share is what its cause explains in addition to the previous causes.

    Attributes:
        bias: Share due to the mean error.
        friction_like: Additional share that viscous and Coulomb friction in the actuator explain.
        position_dependent: Additional share that sine and cosine functions of the actuator's position explain. The
            functions have half a period and one period over the range of the position.
        acceleration_dependent: Additional share that is linear in the accelerations of all actuators (inertia).
        posture_dependent: Additional share that is linear in the sines and cosines of the positions of all other
            actuators (gravity, cables across joints). It may contain slow errors with other causes.
        not_repeating: Share of the rest that differs between periods of the motion: half the mean square of its
            difference between periods. No function of position, velocity and acceleration explains it. None if the
            motion does not repeat.
        fast: Share of the rest above `MOTION_FREQUENCY`, without the part that does not repeat: transients at reversals
            of the velocity, vibration, errors of the delay.
        other: Remaining share: slow and, in a periodic motion, the same in each period.
    """

    bias: float
    friction_like: float
    position_dependent: float
    acceleration_dependent: float
    posture_dependent: float
    not_repeating: float | None
    fast: float
    other: float


#: Labels of the fields of `ErrorShares` in tables and figures.
SHARE_LABELS = (
    *("bias", "friction-like", "position-dependent", "acceleration-dependent"),
    *("posture-dependent", "not repeating", "fast", "other"),
)


def error_shares(
    error: NDArray[np.float64],
    actuator: int,
    q: NDArray[np.float64],
    v: NDArray[np.float64],
    vd: NDArray[np.float64],
    t: NDArray[np.float64],
    period: float | None,
) -> ErrorShares:
    """Returns the shares of the squared effort error of one actuator by cause.

    Args:
        error: Measured minus predicted efforts (r,) [N m, N].
        actuator: Index of the actuator.
        q: Positions (r, n) of all actuators [rad, m].
        v: Velocities (r,) of the actuator [rad/s, m/s].
        vd: Accelerations (r, n) of all actuators [rad/s^2, m/s^2].
        t: Times (r,) at a nearly constant rate [s].
        period: Period of the motion [s], or None if the motion does not repeat.
    """
    own, others = q[:, actuator], np.delete(q, actuator, axis=1)
    width = DIRECTION_WIDTH * float(np.sqrt(np.mean(v**2))) or 1.0
    travel = (own - own.min()) / (float(np.ptp(own)) or 1.0)
    kinds = [
        [np.ones_like(own)],
        [v, np.tanh(v / width)],
        [f(np.pi * k * travel) for k in range(1, _HARMONICS + 1) for f in (np.sin, np.cos)],
        list(vd.T),
        [*np.sin(others).T, *np.cos(others).T],
    ]
    shares, rest = _explained_shares(error, kinds)
    bias, friction, position, acceleration, posture = shares
    total, slow = float(np.mean(error**2)) or 1.0, _slow_part(rest, t)
    repeating, sizes = [], []
    for part in (rest - slow, slow):
        size = float(np.mean(part**2))
        sizes.append(size)
        repeating.append(max(0.0, size - _mean_square_between_periods(part, t, period)))
    fast, other = repeating
    not_repeating = None if period is None else (sum(sizes) - fast - other) / total
    return ErrorShares(bias, friction, position, acceleration, posture, not_repeating, fast / total, other / total)


def _slow_part(x: NDArray[np.float64], t: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns the part of a signal (r,) below `MOTION_FREQUENCY`. It is orthogonal to the rest of the signal."""
    frequency = np.fft.rfftfreq(len(x), float(t[-1] - t[0]) / (len(t) - 1))
    return np.fft.irfft(np.where(frequency < MOTION_FREQUENCY, np.fft.rfft(x), 0.0), len(x))


def _mean_square_between_periods(x: NDArray[np.float64], t: NDArray[np.float64], period: float | None) -> float:
    """Returns half the mean square of the difference of a signal (r,) between periods. Returns 0 without a period."""
    if period is None:
        return 0.0
    # Times in a gap have no measurement.
    after = np.clip(np.searchsorted(t, t + period), 1, len(t) - 1)
    first = (t + period <= t[-1]) & (t[after] - t[after - 1] < max(MIN_GAP, GAP * float(np.median(np.diff(t)))))
    return float(np.mean((np.interp(t[first] + period, t, x) - x[first]) ** 2)) / 2


def _without(error: NDArray[np.float64], columns: Sequence[NDArray[np.float64]]) -> NDArray[np.float64]:
    """Returns the part of an error (r,) that columns (r,) do not explain."""
    X = np.column_stack(columns)
    return np.asarray(error - X @ np.linalg.lstsq(X, error, rcond=None)[0])


def _explained_shares(
    error: NDArray[np.float64], kinds: Sequence[Sequence[NDArray[np.float64]]]
) -> tuple[list[float], NDArray[np.float64]]:
    """Returns the share of the squared error that each kind explains beyond the previous kinds, and the rest (r,)."""
    rests = [error, *(_without(error, [x for kind in kinds[: k + 1] for x in kind]) for k in range(len(kinds)))]
    squares = np.array([np.mean(rest**2) for rest in rests])
    return (-np.diff(squares) / (squares[0] or 1.0)).tolist(), rests[-1]


def residual_structure(
    error: NDArray[np.float64],
    q: NDArray[np.float64],
    effort: NDArray[np.float64],
    v: NDArray[np.float64] | None = None,
) -> list[tuple[str, float]]:
    """Returns the structures that explain the error of one joint, the largest share first.

    Each structure is fitted alone, together with an offset. Its share is reduced by the share that as many random
    columns would explain.

    Args:
        error: Measured minus predicted effort (r,) [N m, N].
        q: Position (r,) of the joint [rad, m].
        effort: Predicted effort (r,) [N m, N].
        v: Velocity (r,) of the joint in a motion [rad/s, m/s]. None: static poses.

    Returns:
        Name of each structure, and its share of the squared error beyond the mean error (0 to 1), at least `MIN_SHARE`.
    """
    span = float(np.ptp(q)) or 1.0
    # Harmonics of a revolute joint are those of its angle, of a joint with a short range those of half a period.
    scale = 1.0 if span > np.pi / 2 else np.pi / span
    columns = {
        f"{which} harmonic of its position": [np.sin(k * scale * q), np.cos(k * scale * q)]
        for k, which in ((1, "first"), (2, "second"))
    }
    columns["load (the effort itself)"] = [effort]
    if v is not None:
        width = _SLOW * float(np.sqrt(np.mean(v**2))) or 1.0
        columns["friction (velocity)"] = [v, np.tanh(v / width)]
        columns["hysteresis (direction of the last motion)"] = [_last_direction(v, width)]
        columns["friction that grows with the load"] = [np.abs(effort) * np.tanh(v / width)]
    count = len(error) if v is None else max(len(error) // _ROWS_PER_VALUE, 4)
    varying = error - error.mean()
    total = float(varying @ varying)
    found = []
    for name, own in columns.items():
        rest = _without(error, [np.ones_like(error), *own])
        free = count - 1 - len(own)
        if total > 0 and free > 0:
            share = 1.0 - float(rest @ rest) / total * (count - 1) / free
            found.append((name, share))
    return sorted((one for one in found if one[1] >= MIN_SHARE), key=lambda one: -one[1])


def _last_direction(v: NDArray[np.float64], slow: float) -> NDArray[np.float64]:
    """Returns the sign (r,) of the last velocity whose magnitude exceeds `slow`, 0 before the first motion."""
    moving = np.abs(v) > slow
    last = np.maximum.accumulate(np.where(moving, np.arange(len(v)), -1))
    return np.where(last >= 0, np.sign(v[last]), 0.0)


def pose_error_shares(
    error: NDArray[np.float64], q: NDArray[np.float64], effort: NDArray[np.float64]
) -> dict[str, float]:
    """Returns the shares of the squared error of one joint at static poses, by cause. They sum to 1.

    The causes are fitted in this order: offset, first and second harmonic of the position, predicted effort (load).
    Each share is the additional reduction of the squared error.

    Args:
        error: Measured minus predicted effort (r,) [N m, N].
        q: Position (r,) of the joint [rad, m].
        effort: Predicted effort (r,) [N m, N].
    """
    kinds = {
        "bias": [np.ones_like(q)],
        "first harmonic": [np.sin(q), np.cos(q)],
        "second harmonic": [np.sin(2 * q), np.cos(2 * q)],
        "load": [effort],
    }
    shares, rest = _explained_shares(error, list(kinds.values()))
    return dict(zip(kinds, shares, strict=True)) | {"other": float(np.mean(rest**2) / (np.mean(error**2) or 1.0))}
