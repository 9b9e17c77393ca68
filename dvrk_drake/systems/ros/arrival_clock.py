"""Time and rate of measurements whose time stamps come from the clock of another computer."""

from __future__ import annotations

import time
from collections import deque

import numpy as np

#: Number of measurements whose rate is determined.
_WINDOW = 100
#: Time after which the difference of the clocks is determined anew [us], because the clocks drift.
_RENEWAL = 10_000_000


class ArrivalClock:
    """Clock of an arm [us]. It converts time stamps of another computer, and determines the rate of measurements.

    The clock is the time of day at its creation plus the monotonic time since then. It also advances while this process
    is suspended, and it does not jump.

    The smallest observed time from a stamp to its arrival is the difference of the two clocks plus the shortest delay
    of the network. A measurement is as old as its time from stamp to arrival exceeds this minimum. A constant delay is
    therefore not detected.
    """

    def __init__(self, largest_change: float = 0.1) -> None:
        """Starts the clock.

        Args:
            largest_change: Largest change of the difference of the clocks [s] that is not a jump of a clock.
        """
        self._largest_change = round(1e6 * largest_change)
        self._start = time.time_ns() - time.monotonic_ns()
        self._stamps: deque[int] = deque(maxlen=_WINDOW)
        self._offset = self._next_offset = self._renewal = 0
        self._last = 0

    def now(self) -> int:
        """Returns the present time [us]."""
        return (self._start + time.monotonic_ns()) // 1000

    def convert(self, stamp: int, arrival: int) -> tuple[int, str]:
        """Returns the time of a measurement [us] on this clock, and a description of a jump or "".

        The times of different measurements increase.

        Args:
            stamp: Time stamp of the measurement [ns].
            arrival: Time of arrival on the monotonic clock [ns].
        """
        stamp, arrival = stamp // 1000, (self._start + arrival) // 1000
        difference, jump = arrival - stamp, ""
        if not self._stamps:
            self._restart(difference, arrival)
        elif stamp == self._stamps[-1]:
            return self._last, ""
        elif stamp < self._stamps[-1] or difference < self._offset - self._largest_change:
            change = 1e-6 * (stamp - self._stamps[-1])
            jump = f"the time stamp changed by {change:.3f} s since the previous message"
            self._stamps.clear()
            self._restart(difference, arrival)
        self._stamps.append(stamp)
        self._offset, self._next_offset = min(self._offset, difference), min(self._next_offset, difference)
        if arrival > self._renewal:
            self._offset, self._next_offset = self._next_offset, difference
            self._renewal = arrival + _RENEWAL
        self._last = max(stamp + self._offset, self._last + 1)
        return self._last, jump

    @property
    def rate(self) -> float | None:
        """Inverse of the median interval of the last 100 measurements [Hz], or None before 100 measurements."""
        if len(self._stamps) < _WINDOW:
            return None
        return 1e6 / float(np.median(np.diff(self._stamps)))

    def _restart(self, difference: int, arrival: int) -> None:
        self._offset = self._next_offset = difference
        self._renewal = arrival + _RENEWAL
