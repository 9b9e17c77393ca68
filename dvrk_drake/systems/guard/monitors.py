"""Monitors of the guard: period of the steps and oscillation of the commanded efforts."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from dvrk_drake.systems.guard.limits import Vector, is_any
from dvrk_drake.systems.guard.part import Part

if TYPE_CHECKING:
    from dvrk_drake.models.arm import Arm
    from dvrk_drake.systems.guard.settings import GuardSettings

#: Number of periods whose median is checked.
_PERIODS = 100

#: Number of commands whose median age is checked.
_AGES = 20

#: Time constant [s] of the low-pass filter whose output is subtracted from the effort. Changes of the effort below
#: about 1 Hz therefore do not count as oscillations.
_MEAN_TIME = 0.2


class _MedianMonitor(Part):
    """Monitor of the median of the last values."""

    def __init__(self, limit: float, count: int) -> None:
        """Creates a monitor without any value, which compares the median of `count` values with `limit`."""
        self._limit, self._count = limit, count
        self.restart()

    def restart(self) -> None:
        """Discards all values."""
        # One bit per value, set for a value above the limit. An int is fast to copy, shift and count.
        self._large = 0

    def _exceeds(self, value: float) -> bool:
        """Adds a value. Returns whether more than half of the last values exceed the limit."""
        self._large = (self._large << 1 | (value > self._limit)) & ((1 << self._count) - 1)
        return self._large.bit_count() > self._count // 2


class PeriodMonitor(_MedianMonitor):
    """Monitor of the time between two steps of the guard. It checks the last period and the median of 100 periods.

    Attributes:
        fault: Description of the fault in the last periods, or "" if they are valid.
    """

    def __init__(self, settings: GuardSettings) -> None:
        """Creates a monitor without any period."""
        super().__init__(settings.slow_period, _PERIODS)
        self._longest_period = settings.longest_period
        self.fault = ""

    def add(self, period: float) -> str:
        """Adds one period [s]. Returns the description of a fault, or "" without a fault."""
        is_slow = self._exceeds(period)
        self.fault = ""
        if period > self._longest_period:
            self.fault = (
                f"the guard was not stepped for {1e3 * period:.0f} ms; {1e3 * self._longest_period:g} ms are allowed"
            )
        elif is_slow:
            self.fault = f"the median period of the guard is above the allowed {1e3 * self._limit:g} ms"
        return self.fault


class AgeMonitor(_MedianMonitor):
    """Monitor of the ages of commands at their arrival, e.g. during a flood of messages. It checks their median.

    A command that answers an old measurement closes a control loop with a delay. The loop may be unstable although the
    command has not expired.
    """

    def __init__(self, settings: GuardSettings) -> None:
        """Creates a monitor without any command."""
        super().__init__(1e6 * settings.command_age, _AGES)

    def add(self, age: int) -> str:
        """Adds the age of a command at its arrival [us]. Returns the description of a fault, or "" without a fault."""
        if not self._exceeds(age):
            return ""
        return (
            f"commands arrive too late: the median age of the last {_AGES} is above the allowed "
            f"{1e-3 * self._limit:g} ms"
        )


class OscillationMonitor(Part):
    """Monitor that counts reversals of the efforts of the joints. The count decays exponentially.

    The alternating part of an effort is x = tau - filter(tau), with a first-order low-pass filter. A reversal is a
    change of x from above h to below -h, or from below -h to above h. The threshold h is the fraction `oscillation` of
    the effort limit. The monitor counts the reversals of each signal, e.g. those of the commands and those of the
    output, which includes soft walls and the speed limit.
    """

    def __init__(self, settings: GuardSettings, arm: Arm, *texts: str) -> None:
        """Creates a monitor for the joints of `arm`, with one description of an oscillation per signal."""
        self._scale, self._time = 1.0 / (settings.oscillation * arm.effort_limits), settings.oscillation_time
        self._allowed, self._names, self._texts = settings.oscillation_reversals, arm.joint_names, texts
        self._mean: Vector | None = None

    def restart(self) -> None:
        """Resets the counts and filters."""
        self._mean = None

    def add(self, dt: float, *efforts: Vector) -> str:
        """Adds the efforts of each signal (n,) [N m, N] that act for `dt` [s].

        Returns:
            Joint and description of its oscillation, or "" if no joint oscillates. If several signals of this joint
            oscillate, the description is that of the first.
        """
        scaled = np.concatenate([self._scale * effort for effort in efforts])
        if self._mean is None:
            self._mean = scaled
            self._side = self._reversals = np.zeros_like(scaled)
            self._since = 0.0
            return ""
        alternating = scaled - self._mean
        self._mean = self._mean + dt / _MEAN_TIME * alternating
        self._since += dt
        large = np.abs(alternating) >= 1.0
        if not is_any(large):
            return ""
        side = np.where(large, np.sign(alternating), self._side)
        self._reversals = math.exp(-self._since / self._time) * self._reversals + (side * self._side < 0)
        self._since = 0.0
        self._side = side
        worst = int(self._reversals.argmax())
        if not self._reversals[worst] > self._allowed:
            return ""
        joint = worst % len(self._names)
        # The cause of an oscillation comes first in the signals. Its count may be behind that of the effect.
        counts = self._reversals[joint :: len(self._names)]
        return f"{self._names[joint]}: {self._texts[int(np.argmax(counts > 0.5 * self._allowed))]}"
