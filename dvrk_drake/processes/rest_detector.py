"""Says when an arm rests, by its positions alone: estimated velocities are noisy."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


class RestDetector:
    """An arm rests when all its joints have stayed near one pose for a while."""

    def __init__(self, tolerance: NDArray[np.float64], duration: float) -> None:
        """Within `tolerance` (n,) [rad, m] of one pose for `duration` [s]."""
        self._tolerance, self._duration = tolerance, duration
        self._since = 0.0
        self._q: NDArray[np.float64] | None = None

    def rests(self, time: float, q: NDArray[np.float64]) -> bool:
        """Whether it rests at `time` [s] with q (n,) measured; to be asked at every measurement."""
        if self._q is None or not np.all(np.abs(q - self._q) <= self._tolerance):  # also true of NaN
            self._q, self._since = q, time
        return time - self._since >= self._duration
