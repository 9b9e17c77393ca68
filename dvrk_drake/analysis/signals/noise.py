"""Estimates signal and noise spectra of a motion, cut-off frequencies and narrow-band noise."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter

#: Length of the segments for averaged periodograms [s]. Its reciprocal is the resolution [Hz].
PIECE = 2.56
#: Lowest cut-off that is proposed [Hz].
MIN_CUT_OFF = 2.0
#: Least ratio of the noise in a narrow band to the noise on both sides.
PEAK = 4.0
#: Noise at the edges of a band as a share of its peak, and largest width of a band [octaves].
EDGE, WIDEST = 0.15, 2.0
#: Least RMS of a narrow band that is reported, as a share of the signal's RMS.
MIN_SHARE = 0.03


class Spectra(NamedTuple):
    """Power spectral densities over frequency, (k,) and (k, n)."""

    frequency: NDArray[np.float64]
    signal: NDArray[np.float64]
    noise: NDArray[np.float64]


class Band(NamedTuple):
    """Noise between two frequencies [Hz], with the ratio of its RMS to that of the signal [1]."""

    lower: float
    upper: float
    share: float


def spectra(x: NDArray[np.float64], rate: float, period: float | None) -> Spectra:
    """Computes the spectra of the repeating part (signal) and of the rest (noise).

    With a period T, the noise is (x(t) - x(t + T)) / sqrt(2), and the signal is the remaining power of x. Without a
    period, the noise is assumed white: the median density above a quarter of the sampling rate.

    Args:
        x: (m, n) samples at a constant rate.
        rate: Sampling rate [Hz].
        period: Period of the motion [s], or None.
    """
    from scipy.signal import welch  # takes 0.3 s, see `low_pass`

    length = min(int(PIECE * rate), len(x) // 4)
    frequency, power = welch(x, rate, nperseg=length, axis=0)
    if period is None:
        noise = np.tile(np.median(power[frequency > rate / 4], axis=0), (len(frequency), 1))
    else:
        shift = round(period * rate)
        _, noise = welch(x[shift:] - x[:-shift], rate, nperseg=min(length, len(x) - shift), nfft=length, axis=0)
        noise = noise / 2
    return Spectra(frequency, np.maximum(power - noise, 0), noise)


def cut_offs(of: Spectra) -> NDArray[np.float64]:
    """Returns the lowest frequencies (n,) above which the signal is below the noise [Hz], at least `MIN_CUT_OFF`.

    Both spectra are smoothed over five lines. If the signal exceeds the noise at all frequencies, the result is half the
    sampling rate.
    """
    kernel = np.ones(5) / 5
    result = []
    for signal, noise in zip(of.signal.T, of.noise.T, strict=True):
        under = np.convolve(signal, kernel, "same") < np.convolve(noise, kernel, "same")
        under &= of.frequency >= MIN_CUT_OFF
        result.append(of.frequency[np.argmax(under)] if np.any(under) else of.frequency[-1])
    return np.array(result)


def narrow_band(of: Spectra, joint: int) -> Band | None:
    """Returns the strongest narrow band of one joint's noise, or None if no band is significant."""
    noise = median_filter(of.noise[:, joint], 3)
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
    f, step = of.frequency, of.frequency[1]
    total = np.sum(of.signal[:, joint] + of.noise[:, joint])
    share = float(np.sqrt(np.sum(of.noise[lower : upper + 1, joint]) / total))
    if share < MIN_SHARE or f[upper] > f[lower] * 2**WIDEST:
        return None
    return Band(float(f[lower] - step / 2), float(f[upper] + step / 2), share)
