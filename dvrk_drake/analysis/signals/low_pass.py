"""Filtering without delay, and derivatives of what is left.

scipy.signal and scipy.interpolate are imported where they are used: they take 0.3 s, and poses need neither.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

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
    from scipy.signal import butter, sosfiltfilt

    columns = np.atleast_2d(x.T)
    cut_offs = np.broadcast_to(np.asarray(cut_off, dtype=float), len(columns))
    filtered = np.array(columns, dtype=float)
    for value in np.unique(cut_offs[cut_offs < rate / 2]):
        chosen = cut_offs == value
        filtered[chosen] = sosfiltfilt(butter(order, value, fs=rate, output="sos"), columns[chosen], axis=1)
    return filtered.T.reshape(x.shape)


def central_difference(x: NDArray[np.float64], rate: float) -> NDArray[np.float64]:
    """Derivative of x (m, ...) along axis 0, per second; one-sided at both ends."""
    return np.asarray(np.gradient(x, 1 / rate, axis=0), dtype=float)


def resample(t: NDArray[np.float64], x: NDArray[np.float64], times: NDArray[np.float64]) -> NDArray[np.float64]:
    """x (m, ...), known at increasing times t (m,), at `times` (k,): piecewise cubic, without overshoot (PCHIP)."""
    from scipy.interpolate import PchipInterpolator

    return np.asarray(PchipInterpolator(t, x, axis=0)(np.clip(times, t[0], t[-1])), dtype=float)
