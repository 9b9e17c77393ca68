"""Expiry of commands by the age of the measurement that they answer, on the arm's clock and on a wall clock."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable

#: Number of measurements at 2 kHz within the longest expiry, 1 s.
_MAX_MEASUREMENTS = 2000


class WallClock:
    """Wall-clock times of measurements. The wall clock continues while the process and the arm's clock are stopped.

    Copies of a guard share it, since it records external events.
    """

    def __init__(self, clock: Callable[[], int]) -> None:
        """Creates it with `clock`, a monotonic time [us]."""
        self.now = clock
        self._times: OrderedDict[int, int] = OrderedDict()

    def note(self, measured_utime: int, age: int) -> None:
        """Records a measurement of `measured_utime` on the arm's clock, where its age is `age` [us]."""
        self._times.setdefault(measured_utime, self.now() - age)
        if len(self._times) > _MAX_MEASUREMENTS:
            self._times.popitem(last=False)

    def time_of(self, measured_utime: int, age: int) -> int:
        """Returns the time of a measurement [us]. If it was not recorded: `age` by the arm's clock before now [us]."""
        time = self._times.get(measured_utime)
        return self.now() - age if time is None else time

    def forget(self) -> None:
        """Discards all measurements, after the arm's clock went back."""
        self._times.clear()


class CommandExpiry:
    """Age at which a command expires, counted from the measurement that it answers.

    The age is the larger one of two: by the arm's clock, and by the wall clock if there is one. So a command also
    expires if the arm's clock is late or was stopped. Copies of a guard share it.
    """

    def __init__(self, expiry: int, wall_clock: Callable[[], int] | None) -> None:
        """Creates it with the age limit `expiry` [us] and a monotonic `wall_clock` [us], or None."""
        self.expiry = expiry
        self.wall = None if wall_clock is None else WallClock(wall_clock)

    def wall_time(self, measured_utime: int, age: int) -> int:
        """Returns the wall-clock time of a measurement, 0 without a wall clock; see `WallClock.time_of`."""
        return 0 if self.wall is None else self.wall.time_of(measured_utime, age)

    def fault(self, age: int, wall_utime: int) -> str:
        """Returns the reason why a command has expired. Empty: it has not.

        Args:
            age: Age of the measurement that it answers, by the arm's clock [us].
            wall_utime: Wall-clock time of that measurement [us]; see `wall_time`.
        """
        clock = "the arm's clock"
        if self.wall is not None and (by_wall := self.wall.now() - wall_utime) > age:
            age, clock = by_wall, "the wall clock"
        if age <= self.expiry:
            return ""
        return f"the last command expired: {1e-3 * age:.1f} ms old by {clock}, {1e-3 * self.expiry:g} ms are allowed"
