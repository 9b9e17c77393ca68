"""Time and rate of measurements whose time stamps come from the clock of another computer."""

from __future__ import annotations

import time
from collections import deque

import numpy as np

#: Number of measurements whose rate is determined.
_WINDOW = 100
#: Largest drift of the clocks, as a fraction of the time: each clock is corrected by at most 500 ppm, the limit of NTP.
_DRIFT = 1e-3


class ArrivalClock:
    """Clock of an arm [us]. It converts time stamps of another computer, and determines the rate of measurements.

    The clock is the time of day at its creation plus the monotonic time since then. It also advances while this process
    is suspended, and it does not jump.

    The shortest observed time from a stamp to its arrival is the difference of the two clocks plus the shortest delay
    of the network. The age of a measurement is its time from stamp to arrival minus this reference. The reference
    increases by at most 1 ms per second, because the clocks drift. So a delay that is constant from the first
    measurement on, or that increases more slowly, is not detected.
    """

    def __init__(self, largest_change: float = 0.1) -> None:
        """Starts the clock.

        Args:
            largest_change: Largest change of the difference of the clocks [s] that is not a jump of a clock.
        """
        self._largest_change = round(1e6 * largest_change)
        self._start = time.time_ns() - time.monotonic_ns()
        self._stamps: deque[int] = deque(maxlen=_WINDOW)
        self._offset, self._offset_time = 0.0, 0
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
        reference = self._offset + _DRIFT * (arrival - self._offset_time)
        if not self._stamps:
            reference = difference
        elif stamp == self._stamps[-1]:
            return self._last, ""
        elif stamp < self._stamps[-1] or difference < self._offset - self._largest_change:
            change = 1e-6 * (stamp - self._stamps[-1])
            jump = f"the time stamp changed by {change:.3f} s since the previous message"
            self._stamps.clear()
            reference = difference
        self._stamps.append(stamp)
        self._offset, self._offset_time = min(reference, difference), arrival
        self._last = max(stamp + round(self._offset), self._last + 1)
        return self._last, jump

    @property
    def rate(self) -> float | None:
        """Inverse of the median interval of the last 100 measurements [Hz], or None before 100 measurements."""
        if len(self._stamps) < _WINDOW:
            return None
        return 1e6 / float(np.median(np.diff(self._stamps)))
