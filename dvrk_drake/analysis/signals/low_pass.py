"""Filtering without delay, and derivatives of what is left."""

from __future__ import annotations

from functools import lru_cache

import numba
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import PchipInterpolator
from scipy.signal import butter, sosfilt_zi

#: Order of the Butterworth low-pass; run forwards and backwards, so that it halves the amplitude at the cut-off.
ORDER = 6


def low_pass(x: NDArray[np.float64], rate: float, cut_off: ArrayLike, order: int = ORDER) -> NDArray[np.float64]:
    """Zero-phase Butterworth low-pass along axis 0: forwards, then backwards.

    Args:
        x: (m,) or (m, n) at a constant rate.
        rate: samples a second [Hz].
        cut_off: where the amplitude is halved [Hz]; one, or (n,) one a column. At half the rate or above, a column
            stays as it is.
        order: of the filter that runs each way.
    """
    columns = np.asarray(x, dtype=np.float64).reshape(len(x), -1)
    values, column_groups = np.unique(cut_off, return_inverse=True)
    if len(values) == 1:
        return _forwards_and_backwards(columns, values[0] / rate, order).reshape(x.shape)
    filtered = np.empty(columns.shape)
    for group, value in enumerate(values):
        chosen = column_groups == group
        filtered[:, chosen] = _forwards_and_backwards(columns[:, chosen], value / rate, order)
    return filtered


def _forwards_and_backwards(x: NDArray[np.float64], cut_off: float, order: int) -> NDArray[np.float64]:
    """scipy's `sosfiltfilt` of columns (m, k), with the same ends, but all columns at a time.

    `cut_off` as a share of the rate; from 0.5 on, x itself.
    """
    if cut_off >= 0.5:
        return x.copy()
    sos, initial = _sections(order, cut_off)
    edge = 3 * (2 * len(sos) + 1 - min(np.sum(sos[:, 2] == 0), np.sum(sos[:, 5] == 0)))
    if len(x) <= edge:
        raise ValueError(f"the filter needs more than {edge} rows, got {len(x)}")
    y = np.concatenate([2 * x[0] - x[edge:0:-1], x, 2 * x[-1] - x[-2 : -edge - 2 : -1]])
    for backwards in (False, True):
        _filter(sos, initial[:, :, None] * y[-1 if backwards else 0], y, backwards)
    return y[edge:-edge]


@lru_cache(64)
def _sections(order: int, cut_off: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Second-order sections (s, 6) of the Butterworth low-pass, and their state (s, 2) after a long time at 1."""
    sos = butter(order, cut_off, fs=1.0, output="sos")
    return sos, sosfilt_zi(sos)


@numba.njit(cache=True, nogil=True, fastmath={"contract"})
def _filter(sos, state, x, backwards):  # pragma: no cover
    """Runs second-order sections (s, 6) with state (s, 2, k) over the rows of x (m, k), in place."""
    for row in range(len(x)):
        values = x[len(x) - 1 - row if backwards else row]
        for s in range(len(sos)):
            b0, b1, b2, a1, a2 = sos[s, 0], sos[s, 1], sos[s, 2], sos[s, 4], sos[s, 5]
            first, second = state[s, 0], state[s, 1]
            for k in range(len(values)):
                value = values[k]
                y = b0 * value + first[k]
                first[k] = b1 * value - a1 * y + second[k]
                second[k] = b2 * value - a2 * y
                values[k] = y


def central_difference(x: NDArray[np.float64], rate: float) -> NDArray[np.float64]:
    """Derivative of x (m, ...) along axis 0, per second; one-sided at both ends."""
    return np.asarray(np.gradient(x, 1 / rate, axis=0), dtype=float)


def resample(t: NDArray[np.float64], x: NDArray[np.float64], times: NDArray[np.float64]) -> NDArray[np.float64]:
    """x (m, ...), known at increasing times t (m,), at `times` (k,): piecewise cubic, without overshoot (PCHIP)."""
    return np.asarray(PchipInterpolator(t, x, axis=0)(np.clip(times, t[0], t[-1])), dtype=float)
