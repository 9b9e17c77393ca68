"""What a fit leaves, made white: errors that stay for a while count as few, fast ones as many."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class Whitening:
    """x[t] - sum_k coefficients[k - 1] x[t - k step], channel by channel.

    The step is half a period of the low-pass that the rows are behind: at that spacing their whole band is there, and
    nothing else is.

    Attributes:
        coefficients: (n, order) of each channel; zeros leave it as it is.
        step: rows between the values that are combined.
    """

    coefficients: NDArray[np.float64]
    step: int

    @classmethod
    def none(cls, channels: int) -> Whitening:
        """That of white rows."""
        return cls(np.zeros((channels, 0)), 1)

    @classmethod
    def of(cls, residual: NDArray[np.float64], order: int, rate: float, cut_off: float) -> Whitening:
        """The autoregression of residuals (r, n) that lie behind a low-pass at `cut_off` [Hz], rows at `rate` [Hz]."""
        step = max(1, round(rate / (2 * cut_off)))
        coefficients = []
        for x in residual.T:
            past = np.column_stack([x[(order - k) * step : len(x) - k * step] for k in range(1, order + 1)])
            coefficients.append(np.linalg.lstsq(past, x[order * step :], rcond=None)[0])
        return cls(np.array(coefficients), step)

    @property
    def lost(self) -> int:
        """Rows at the start that have no past."""
        return self.coefficients.shape[1] * self.step

    def __call__(self, x: NDArray[np.float64], channel: int) -> NDArray[np.float64]:
        """Rows (r - lost, ...) of one channel's rows x (r, ...)."""
        y = x[self.lost :].copy()
        for k, a in enumerate(self.coefficients[channel], start=1):
            y -= a * x[self.lost - k * self.step : len(x) - k * self.step]
        return y
