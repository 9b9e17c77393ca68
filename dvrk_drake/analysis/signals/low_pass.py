"""Zero-phase filters, differentiation, resampling and correlation.

The filters are compiled here, because importing scipy.signal is slow compared with an identification. Tests compare the
results with scipy.signal.
"""

from __future__ import annotations

from functools import lru_cache

import numba
import numpy as np
from numpy.typing import ArrayLike, NDArray

#: Order of the Butterworth low-pass filter. The filter runs forwards and backwards, which halves the amplitude at the
#: cut-off frequency.
ORDER = 6
#: Largest number of columns that are filtered together. It limits the memory for a long motion.
MAX_COLUMNS = 16


def low_pass(x: NDArray[np.float64], rate: float, cut_off: ArrayLike, order: int = ORDER) -> NDArray[np.float64]:
    """Applies a zero-phase Butterworth low-pass filter along axis 0, forwards and backwards like scipy's `sosfiltfilt`.

    Args:
        x: Samples (m,) or (m, n) at a constant rate.
        rate: Sampling rate [Hz].
        cut_off: Frequency at which the amplitude is halved [Hz], a scalar or one value (n,) per column. If it is at
            least half the sampling rate, the column is not changed.
        order: Order of the filter in each direction, even.
    """
    columns = np.asarray(x, dtype=np.float64).reshape(len(x), -1)
    filtered = np.empty(columns.shape)
    cut_offs = np.broadcast_to(cut_off, columns.shape[1])
    for value in np.unique(cut_offs):
        selected = np.flatnonzero(cut_offs == value)
        for block in np.array_split(selected, -(-len(selected) // MAX_COLUMNS)):
            filtered[:, block] = _forwards_and_backwards(columns[:, block], value / rate, order)
    return filtered.reshape(x.shape)


def _forwards_and_backwards(x: NDArray[np.float64], cut_off: float, order: int) -> NDArray[np.float64]:
    """Filters columns (m, k) after point reflection at both ends. `cut_off` is a share of the sampling rate."""
    if cut_off >= 0.5:
        return x
    sos = butterworth(order, cut_off)
    edge = 3 * (order + 1)
    if len(x) <= edge:
        raise ValueError(f"the filter requires more than {edge} rows, got {len(x)}")
    y = np.concatenate([2 * x[0] - x[edge:0:-1], x, 2 * x[-1] - x[-2 : -edge - 2 : -1]])
    # Steady state (s, 2, 1) of each section, at which a constant input of 1 gives a constant output of 1.
    steady_state = np.stack([1 - sos[:, 0], sos[:, 2] - sos[:, 5]], axis=1)[:, :, None]
    for _ in ("forwards", "backwards"):
        _filter(sos, steady_state * y[0], y)
        y = y[::-1].copy()
    return y[edge:-edge]


@lru_cache(64)
def butterworth(order: int, cut_off: float) -> NDArray[np.float64]:
    """Returns second-order sections (s, 6) [b0 b1 b2 1 a1 a2] of a Butterworth filter from the bilinear transform.

    Args:
        order: Order of the filter, even.
        cut_off: Cut-off frequency as a share of the sampling rate, below 0.5.
    """
    w = np.tan(np.pi * cut_off)
    damping = 2 * np.sin(np.pi * np.arange(1, order, 2) / (2 * order))
    scale = 1 / (1 + damping * w + w**2)
    b, a = w**2 * scale, np.ones_like(scale)
    return np.column_stack([b, 2 * b, b, a, 2 * (w**2 - 1) * scale, (1 - damping * w + w**2) * scale])


@numba.njit(cache=True, nogil=True, fastmath={"contract"})
def _filter(sos, state, x):  # pragma: no cover - compiled
    """Filters x (m, k) along axis 0 by second-order sections (s, 6) with state (s, 2, k). Changes x and the state."""
    for row in range(len(x)):
        for s in range(len(sos)):
            b0, b1, b2, a1, a2 = sos[s, 0], sos[s, 1], sos[s, 2], sos[s, 4], sos[s, 5]
            for k in range(x.shape[1]):
                value = x[row, k]
                y = b0 * value + state[s, 0, k]
                state[s, 0, k] = b1 * value - a1 * y + state[s, 1, k]
                state[s, 1, k] = b2 * value - a2 * y
                x[row, k] = y


def correlation(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns the cross-correlation (2 m - 1,) of a and b (m,): sum_t a(t + lag) b(t) for lags 1 - m .. m - 1."""
    count = len(a)
    size = 1 << (2 * count - 1).bit_length()
    circular = np.fft.irfft(np.fft.rfft(a, size) * np.conj(np.fft.rfft(b, size)), size)
    return np.concatenate([circular[size - count + 1 :], circular[:count]])


def central_difference(x: NDArray[np.float64], rate: float) -> NDArray[np.float64]:
    """Computes the time derivative of x (m, ...) along axis 0, with one-sided differences at both ends."""
    return np.asarray(np.gradient(x, 1 / rate, axis=0), dtype=float)


def resample(t: NDArray[np.float64], x: NDArray[np.float64], times: NDArray[np.float64]) -> NDArray[np.float64]:
    """Interpolates x (m, ...) from increasing times t (m,) to new `times` (k,).

    The interpolation is piecewise cubic without overshoot (PCHIP). Outside t, the first or last value is used.
    """
    from scipy.interpolate import PchipInterpolator

    return np.asarray(PchipInterpolator(t, x, axis=0)(np.clip(times, t[0], t[-1])), dtype=float)
