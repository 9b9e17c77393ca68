"""Expiry of commands: how old the measurement that a command answers may be, by the arm's clock and by a wall clock."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable

#: The longest expiry, 1 s, has so many measurements at 2 kHz.
_MAX_MEASUREMENTS = 2000


class WallClock:
    """Time of measurements by a clock that goes on while the process and with it the arm's clock stands still.

    Copies of a guard share it: it notes what happened outside of them.
    """

    def __init__(self, clock: Callable[[], int]) -> None:
        """By `clock`, monotonic [us]."""
        self.now = clock
        self._times: OrderedDict[int, int] = OrderedDict()

    def note(self, measured_utime: int, age: int) -> None:
        """Notes a measurement of `measured_utime` on the arm's clock, which is `age` old by it [us]."""
        self._times.setdefault(measured_utime, self.now() - age)
        if len(self._times) > _MAX_MEASUREMENTS:
            self._times.popitem(last=False)

    def time_of(self, measured_utime: int, age: int) -> int:
        """Time of a measurement [us]; for one that was not noted, `age` by the arm's clock before now [us]."""
        time = self._times.get(measured_utime)
        return self.now() - age if time is None else time

    def forget(self) -> None:
        """Forgets all measurements, for when the arm's clock went back."""
        self._times.clear()


class CommandExpiry:
    """Age after which a command is obeyed no more, counted from the measurement that it answers.

    It is the larger one of two: by the arm's clock, and by the wall clock if there is one. So a command expires also if
    the arm's clock is late or was stopped. Copies of a guard share it.
    """

    def __init__(self, expiry: int, wall_clock: Callable[[], int] | None) -> None:
        """Expiry after `expiry` [us]; `wall_clock` is monotonic [us], or None."""
        self.expiry = expiry
        self.wall = None if wall_clock is None else WallClock(wall_clock)

    def wall_time(self, measured_utime: int, age: int) -> int:
        """Returns the time of a measurement by the wall clock, 0 without one; see `WallClock.time_of`."""
        return 0 if self.wall is None else self.wall.time_of(measured_utime, age)

    def fault(self, age: int, wall_utime: int) -> str:
        """Returns why a command has expired, in words; "" if it has not.

        Args:
            age: of the measurement that it answers, by the arm's clock [us].
            wall_utime: time of that measurement by the wall clock [us]; see `wall_time`.
        """
        clock = "the arm's clock"
        if self.wall is not None and (by_wall := self.wall.now() - wall_utime) > age:
            age, clock = by_wall, "the wall clock"
        if age <= self.expiry:
            return ""
        return f"the last command expired: {1e-3 * age:.1f} ms old by {clock}, {1e-3 * self.expiry:g} ms are allowed"
