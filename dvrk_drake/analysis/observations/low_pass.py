"""Zero-phase filters, differentiation, resampling, correlation, and the minimum of a sampled curve."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

#: Order of the Butterworth low-pass filter, as for the published errors of a real MTM and PSM (Wang et al., RA-L 2019).
#: The filter runs forwards and backwards, which halves the amplitude at the cut-off frequency.
ORDER = 6
#: Largest number of values that are filtered or interpolated together, but at least one column. It limits the memory
#: for a long motion, and the values (8 MB) stay in the cache of the processor.
MAX_VALUES = 1_000_000


def low_pass(x: NDArray[np.float64], rate: float, cut_off: ArrayLike, order: int = ORDER) -> NDArray[np.float64]:
    """Applies a zero-phase Butterworth low-pass filter along axis 0.

    Args:
        x: Samples (m,) or (m, n) at a constant rate.
        rate: Sampling rate [Hz].
        cut_off: Frequency at which the amplitude is halved [Hz], a scalar or one value (n,) per column. If it is at
            least half the sampling rate, the column is not changed.
        order: Order of the filter in each direction, even.

    Raises:
        ValueError: There are too few rows for the reflection at the ends.
    """
    from scipy.signal import butter, sosfiltfilt  # takes 0.3 s

    columns = np.asarray(x, dtype=np.float64).reshape(len(x), -1)
    filtered = columns.copy()
    cut_offs = np.broadcast_to(cut_off, columns.shape[1])
    for value in np.unique(cut_offs[cut_offs < 0.5 * rate]):
        if len(x) <= (edge := 3 * (order + 1)):
            raise ValueError(f"the filter requires more than {edge} rows, got {len(x)}")
        sos, selected = butter(order, value, fs=rate, output="sos"), np.flatnonzero(cut_offs == value)
        for block in np.array_split(selected, min(-(-len(x) * len(selected) // MAX_VALUES), len(selected))):
            filtered[:, block] = sosfiltfilt(sos, columns[:, block].T, padlen=edge).T
    return filtered.reshape(x.shape)


def correlation(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns the cross-correlation (2 m - 1,) of a and b (m,): sum_t a(t + lag) b(t) for lags 1 - m .. m - 1."""
    from scipy.signal import correlate

    return np.asarray(correlate(a, b, method="fft"))


def central_difference(x: NDArray[np.float64], rate: float) -> NDArray[np.float64]:
    """Computes the time derivative of x (m, ...) along axis 0, with one-sided differences at both ends."""
    return np.asarray(np.gradient(x, 1 / rate, axis=0), dtype=float)


def resample(t: NDArray[np.float64], x: NDArray[np.float64], times: NDArray[np.float64]) -> NDArray[np.float64]:
    """Interpolates x (m, ...) from increasing times t (m,) to new `times` (k,).

    The interpolation is piecewise cubic without overshoot (PCHIP). Outside t, the first or last value is used.
    """
    from scipy.interpolate import PchipInterpolator

    times = np.clip(times, t[0], t[-1])
    result = np.empty((len(times), *x.shape[1:]))
    start = 0
    for part in np.array_split(times, max(1, -(-result.size // MAX_VALUES))):
        # The slope at a time depends on the times before and after it.
        first = max(int(np.searchsorted(t, np.min(part), side="right")) - 3, 0)
        last = int(np.searchsorted(t, np.max(part))) + 3
        result[start : start + len(part)] = PchipInterpolator(t[first:last], x[first:last], axis=0)(part)
        start += len(part)
    return result


def minimiser(x: NDArray[np.number], values: NDArray[np.float64]) -> float:
    """Returns the minimiser of a curve with given values at equidistant x, from parabolic interpolation."""
    i = int(np.clip(np.argmin(values), 1, len(values) - 2))
    before, minimum, after = values[i - 1 : i + 2]
    curvature = before - 2 * minimum + after
    offset = 0.5 * (before - after) / curvature if curvature > 0 else 0.0
    return float(x[i] + np.clip(offset, -1, 1) * (x[1] - x[0]))
