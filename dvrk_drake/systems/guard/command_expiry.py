"""Expiry of commands. A command expires when the measurement from which it was computed is too old."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable

#: Largest number of recorded times: measurements at 2 kHz during the longest allowed expiry of 1 s.
_MAX_MEASUREMENTS = 2000


class WallClock:
    """Record of the wall-clock times of measurements.

    The wall clock continues while the process or the arm's clock is stopped. All copies of a guard share one record,
    because the recorded times do not depend on the state of a copy.
    """

    def __init__(self, clock: Callable[[], int]) -> None:
        """Creates an empty record.

        Args:
            clock: Function that returns a monotonic time [us].
        """
        self.now = clock
        self._times: OrderedDict[int, int] = OrderedDict()

    def note(self, measured_utime: int, age: int) -> None:
        """Records the wall-clock time of a measurement, unless the time of this measurement is already recorded.

        Args:
            measured_utime: Time of the measurement on the arm's clock [us].
            age: Age of the measurement by the arm's clock [us].
        """
        self._times.setdefault(measured_utime, self.now() - age)
        if len(self._times) > _MAX_MEASUREMENTS:
            self._times.popitem(last=False)

    def time_of(self, measured_utime: int, age: int) -> int:
        """Returns the wall-clock time of a measurement [us].

        Args:
            measured_utime: Time of the measurement on the arm's clock [us].
            age: Age of the measurement by the arm's clock [us], used if the measurement was not recorded.
        """
        time = self._times.get(measured_utime)
        return self.now() - age if time is None else time

    def forget(self) -> None:
        """Discards all recorded times. The guard calls this method after the arm's clock went back."""
        self._times.clear()


class CommandExpiry:
    """Age limit of commands. The age of a command is the age of the measurement from which it was computed.

    The age is determined by the arm's clock and, if there is a wall clock, also by the wall clock. The larger of these
    ages counts. A command therefore also expires while the arm's clock is late or stopped. All copies of a guard share
    one object of this class.
    """

    def __init__(self, expiry: int, wall_clock: Callable[[], int] | None) -> None:
        """Creates the age limit.

        Args:
            expiry: Age at which a command expires [us].
            wall_clock: Function that returns a monotonic time [us]. None: only the arm's clock is used.
        """
        self.expiry = expiry
        self.wall = None if wall_clock is None else WallClock(wall_clock)

    def wall_time(self, measured_utime: int, age: int) -> int:
        """Returns the wall-clock time of a measurement [us], or 0 without a wall clock; see `WallClock.time_of`."""
        return 0 if self.wall is None else self.wall.time_of(measured_utime, age)

    def fault(self, age: int, wall_utime: int) -> str:
        """Returns the reason why a command has expired, or "" if it has not expired.

        Args:
            age: Age of the measurement from which the command was computed, by the arm's clock [us].
            wall_utime: Wall-clock time of that measurement [us]; see `wall_time`.
        """
        larger = self.age(age, wall_utime)
        if larger <= self.expiry:
            return ""
        clock = "the wall clock" if larger > age else "the arm's clock"
        allowed = f"{1e-3 * self.expiry:g} ms are allowed"
        return f"the last command expired: it is {1e-3 * larger:.1f} ms old by {clock}; {allowed}"

    def age(self, age: int, wall_utime: int) -> int:
        """Returns the age of a command by the clock that gives the larger age [us]; see `fault` for the arguments."""
        return age if self.wall is None else max(age, self.wall.now() - wall_utime)
