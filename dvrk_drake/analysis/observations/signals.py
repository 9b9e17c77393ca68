"""Zero-phase filters, differentiation, resampling, correlation, noise, and the minimum of a sampled curve."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import median_filter

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


#: Duration of the segments for averaged periodograms [s]. The frequency resolution [Hz] is the reciprocal of this
#: duration. Half or twice the value changes only cut-offs and notes on narrow-band noise of the public recordings.
SEGMENT_DURATION = 2.56
#: Largest frequency of the motion of an arm [Hz], and smallest cut-off frequency. In three public motions (`mtm_one`,
#: `psm_one`, `psm1_2`), at most 1.3 % of the power of the velocity is above it, except for one of 17 joints.
MOTION_FREQUENCY = 2.0
#: Smallest ratio of the peak noise in a narrow band to the median noise below and above the band. Half the value
#: changes no note on the public recordings, twice the value removes one.
PEAK = 4.0
#: Noise at the edges of a narrow band as a share of the peak noise, and largest width of a narrow band [octaves]. Half
#: or twice these values changes only notes on narrow-band noise of the public recordings.
EDGE, MAX_OCTAVES = 0.15, 2.0
#: Smallest reported RMS of a narrow band, as a share of the RMS of signal and noise. Half the value adds two notes on
#: the public recordings, twice the value removes three.
MIN_SHARE = 0.03


class Spectra(NamedTuple):
    """Power spectral densities of n joints.

    Attributes:
        frequency: Frequencies (k,) [Hz].
        signal: Power spectral densities (k, n) of the signal without noise.
        noise: Power spectral densities (k, n) of the noise.
    """

    frequency: NDArray[np.float64]
    signal: NDArray[np.float64]
    noise: NDArray[np.float64]


class Band(NamedTuple):
    """Noise in a narrow band.

    Attributes:
        lower: Lower frequency [Hz].
        upper: Upper frequency [Hz].
        share: RMS of the noise in the band divided by the RMS of signal and noise [1].
    """

    lower: float
    upper: float
    share: float


def spectra(x: NDArray[np.float64], rate: float, period: float | None) -> Spectra:
    """Computes the spectra of signal and noise.

    With a period T, the noise is (x(t) - x(t + T)) / sqrt(2). Without a period, white noise is assumed. Its density is
    then the median density of x above a quarter of the sampling rate. The spectrum of the signal is the spectrum of x
    minus the spectrum of the noise.

    Args:
        x: Samples (m, n) at a constant rate.
        rate: Sampling rate [Hz].
        period: Period of the motion [s], or None if the motion does not repeat.
    """
    from scipy.signal import welch  # takes 0.3 s

    length = min(int(SEGMENT_DURATION * rate), len(x) // 4)
    frequency, power = welch(x, rate, nperseg=length, axis=0)
    if period is None:
        noise = np.tile(np.median(power[frequency > rate / 4], axis=0), (len(frequency), 1))
    else:
        shift = round(period * rate)
        _, noise = welch(x[shift:] - x[:-shift], rate, nperseg=min(length, len(x) - shift), nfft=length, axis=0)
        noise = noise / 2
    return Spectra(frequency, np.maximum(power - noise, 0), noise)


def cut_offs(densities: Spectra) -> NDArray[np.float64]:
    """Returns the lowest frequency (n,) at which the noise exceeds the signal [Hz], at least `MOTION_FREQUENCY`.

    Both spectra are smoothed over five frequencies. If the signal exceeds the noise at all frequencies, the result is
    half the sampling rate.
    """
    kernel = np.ones(5) / 5
    result = []
    for signal, noise in zip(densities.signal.T, densities.noise.T, strict=True):
        noisy = np.convolve(signal, kernel, "same") < np.convolve(noise, kernel, "same")
        noisy &= densities.frequency >= MOTION_FREQUENCY
        result.append(densities.frequency[np.argmax(noisy)] if np.any(noisy) else densities.frequency[-1])
    return np.array(result)


def narrow_band(densities: Spectra, joint: int) -> Band | None:
    """Returns the strongest narrow band of one joint's noise, or None if no band is significant."""
    noise = median_filter(densities.noise[:, joint], 3)
    noise[0] = noise[1]
    peak = int(np.argmax(noise))
    inside = noise > EDGE * noise[peak]
    lower, upper = peak, peak
    while lower > 0 and inside[lower - 1]:
        lower -= 1
    while upper < len(noise) - 1 and inside[upper + 1]:
        upper += 1
    below, above = noise[:lower], noise[upper + 1 :]
    if lower < 2 or len(above) < 2 or noise[peak] < PEAK * max(np.median(below), np.median(above)):
        return None
    f, step = densities.frequency, densities.frequency[1]
    total = np.sum(densities.signal[:, joint] + densities.noise[:, joint])
    share = float(np.sqrt(np.sum(densities.noise[lower : upper + 1, joint]) / total))
    if share < MIN_SHARE or f[upper] > f[lower] * 2**MAX_OCTAVES:
        return None
    return Band(float(f[lower] - step / 2), float(f[upper] + step / 2), share)
