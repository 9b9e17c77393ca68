"""Names structure in the effort error of a joint: offset, harmonics of its position, friction, hysteresis and load."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

#: Smallest share of the squared error, beyond the mean error, for which a structure is named. An effect with a smaller
#: share reduces the RMS error by less than 15 %.
MIN_SHARE = 0.25
#: Number of rows that count as one independent value in a motion: half a second at a typical rate of 200 Hz, because
#: efforts at neighbouring rows are correlated.
_ROWS_PER_VALUE = 100
#: Speed below which the direction of a motion is uncertain, as a share of the RMS speed, as in `ErrorShares`.
_SLOW = 0.1


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
        X = np.column_stack([np.ones_like(error), *own])
        rest = error - X @ np.linalg.lstsq(X, error, rcond=None)[0]
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
    total = float(np.mean(error**2)) or 1.0
    remaining, shares = total, {}
    columns: list[NDArray[np.float64]] = []
    for name, own in (
        ("bias", [np.ones_like(q)]),
        ("first harmonic", [np.sin(q), np.cos(q)]),
        ("second harmonic", [np.sin(2 * q), np.cos(2 * q)]),
        ("load", [effort]),
    ):
        columns += own
        X = np.column_stack(columns)
        rest = float(np.mean((error - X @ np.linalg.lstsq(X, error, rcond=None)[0]) ** 2))
        shares[name] = (remaining - rest) / total
        remaining = rest
    return shares | {"other": remaining / total}
