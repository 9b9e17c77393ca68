"""Monitors of the guard: period of the steps and oscillation of the commanded efforts."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from dvrk_drake.systems.guard.limits import Vector, is_any

if TYPE_CHECKING:
    from dvrk_drake.models.arm import Arm
    from dvrk_drake.systems.guard.settings import GuardSettings

#: Number of periods whose median is checked.
_PERIODS = 100

#: Time constant [s] of the low-pass filter whose output is subtracted from the effort. Changes of the effort below
#: about 1 Hz therefore do not count as oscillations.
_MEAN_TIME = 0.2


class PeriodMonitor:
    """Monitor of the time between two steps of the guard. It checks the last period and the median of 100 periods.

    Attributes:
        fault: Description of the fault in the last periods, or "" if they are valid.
    """

    def __init__(self, settings: GuardSettings) -> None:
        """Creates a monitor without any period."""
        self._slow_period, self._longest_period = settings.slow_period, settings.longest_period
        # One bit per period, set for a slow period. An int is fast to copy, shift and count.
        self._slow = 0
        self.fault = ""

    def add(self, period: float) -> str:
        """Adds one period [s]. Returns the description of a fault, or "" without a fault."""
        self._slow = (self._slow << 1 | (period > self._slow_period)) & ((1 << _PERIODS) - 1)
        self.fault = ""
        if period > self._longest_period:
            self.fault = (
                f"the guard was not stepped for {1e3 * period:.0f} ms; {1e3 * self._longest_period:g} ms are allowed"
            )
        elif self._slow.bit_count() > _PERIODS // 2:
            self.fault = f"the median period of the guard is above the allowed {1e3 * self._slow_period:g} ms"
        return self.fault


class OscillationMonitor:
    """Monitor that counts reversals of the commanded efforts. The count decays exponentially.

    The alternating part of an effort is x = tau - filter(tau), with a first-order low-pass filter. A reversal is a
    change of x from above h to below -h, or from below -h to above h. The threshold h is the fraction `oscillation` of
    the effort limit.
    """

    def __init__(self, settings: GuardSettings, arm: Arm) -> None:
        """Creates a monitor for the joints of `arm`."""
        self._scale, self._time = 1.0 / (settings.oscillation * arm.effort_limits), settings.oscillation_time
        self._allowed = settings.oscillation_reversals
        self._mean: Vector | None = None

    def restart(self) -> None:
        """Resets the counts and filters."""
        self._mean = None

    def add(self, effort: Vector, dt: float) -> int | None:
        """Adds an effort (n,) [N m, N] that is commanded for `dt` [s].

        Returns:
            Index of an oscillating joint, or None if no joint oscillates.
        """
        scaled = self._scale * effort
        if self._mean is None:
            self._mean = scaled
            self._side = self._reversals = np.zeros_like(scaled)
            self._since = 0.0
            return None
        alternating = scaled - self._mean
        self._mean = self._mean + dt / _MEAN_TIME * alternating
        self._since += dt
        large = np.abs(alternating) >= 1.0
        if not is_any(large):
            return None
        side = np.where(large, np.sign(alternating), self._side)
        self._reversals = math.exp(-self._since / self._time) * self._reversals + (side * self._side < 0)
        self._since = 0.0
        self._side = side
        worst = int(self._reversals.argmax())
        return worst if self._reversals[worst] > self._allowed else None
