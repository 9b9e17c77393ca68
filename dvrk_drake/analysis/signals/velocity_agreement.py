"""Whether the recorded velocities are the derivatives of the recorded positions: gain and lag of each channel."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.signal import butter, sosfiltfilt

#: Both are compared below this frequency [Hz]; an arm moves below it, and jitter is mostly above.
CUT_OFF = 10.0
#: A channel agrees if its gain is this close to 1, and its lag below this [s].
GAIN_TOLERANCE, LAG_TOLERANCE = 0.03, 0.004
#: Below this RMS speed nothing can be said [rad/s, m/s].
LEAST_SPEED = 1e-3
#: Left out at each end, where filters swing in [s]; at most a tenth of the motion.
ENDS = 0.5
_ITERATIONS = 5


class VelocityAgreement(NamedTuple):
    """qd(t) = gain * dq/dt(t - lag), fitted by least squares below `CUT_OFF`; (n,) each.

    Attributes:
        gain: 1 if both agree; nan where the joint rests.
        lag: by which qd is late [s].
        mismatch: RMS of what the fit leaves, as a share of the RMS of qd.
        agrees: gain within `GAIN_TOLERANCE` of 1 and lag within `LAG_TOLERANCE`.
    """

    gain: NDArray[np.float64]
    lag: NDArray[np.float64]
    mismatch: NDArray[np.float64]
    agrees: NDArray[np.bool_]


def velocity_agreement(q: NDArray[np.float64], qd: NDArray[np.float64], rate: float) -> VelocityAgreement:
    """Compares qd with the derivative of q in time.

    Args:
        q, qd: (m, n) positions and velocities at a constant rate; jitter of the times averages out below `CUT_OFF`.
        rate: samples a second [Hz].
    """
    sections = butter(4, min(CUT_OFF, 0.2 * rate), fs=rate, output="sos")
    v, qd = (sosfiltfilt(sections, x, axis=0) for x in (np.gradient(q, 1 / rate, axis=0), qd))
    ends = min(int(ENDS * rate), len(q) // 10)
    fits = np.array([_fit(v[:, j], qd[:, j], slice(ends, len(q) - ends)) for j in range(q.shape[1])])
    gain, samples, mismatch = fits.T
    lag = samples / rate
    return VelocityAgreement(gain, lag, mismatch, (np.abs(gain - 1) < GAIN_TOLERANCE) & (np.abs(lag) < LAG_TOLERANCE))


def _fit(v: NDArray[np.float64], qd: NDArray[np.float64], inner: slice) -> tuple[float, float, float]:
    """Gain, lag [samples] and mismatch: Gauss-Newton from no lag."""
    size = float(np.sqrt(np.mean(qd[inner] ** 2)))
    if float(np.sqrt(np.mean(v[inner] ** 2))) < LEAST_SPEED:
        return np.nan, np.nan, np.nan
    if size < LEAST_SPEED:
        return 0.0, 0.0, 1.0
    index = np.arange(len(v), dtype=float)
    gain, lag = 1.0, 0.0
    for _ in range(_ITERATIONS):
        shifted = np.interp(index - lag, index, v)
        columns = np.column_stack([shifted, -np.gradient(shifted)])
        (gain, slope), *_ = np.linalg.lstsq(columns[inner], qd[inner], rcond=None)
        if gain == 0.0:
            break
        lag += float(np.clip(slope / gain, -3, 3))
    left = (qd - gain * np.interp(index - lag, index, v))[inner]
    return float(gain), lag, float(np.sqrt(np.mean(left**2))) / size
