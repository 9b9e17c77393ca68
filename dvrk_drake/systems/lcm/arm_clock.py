"""The clock of a simulated arm."""

from __future__ import annotations

from dataclasses import dataclass

from pydrake.systems.framework import Context


@dataclass(frozen=True)
class ArmClock:
    """An arm's clock, which begins with the context's time and never jumps.

    Attributes:
        start_utime: at time zero of the context [us].
        period: in which the arm measures, judges and tells [s].
    """

    start_utime: int = 0
    period: float = 1e-3

    def utime(self, context: Context) -> int:
        """Now [us]."""
        return self.start_utime + round(1e6 * context.get_time())

    def ticks(self, context: Context) -> int:
        """How many periods have begun since time zero."""
        return round(context.get_time() / self.period)
