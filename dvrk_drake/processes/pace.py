"""Periodic work by the wall clock, and real-time scheduling where the system permits it."""

from __future__ import annotations

import gc
import os
import time
from collections.abc import Callable

#: Priority of SCHED_FIFO: above everything that is not real-time, below the kernel's own threads at 99.
_PRIORITY = 50

#: So far behind, a loop does not catch up any more but goes on from now [s].
_FARTHEST_BEHIND = 0.1


class Pace:
    """Ticks of one period by the monotonic clock, which no setting of the time changes.

    A tick that comes late is followed by the next ones at once, until the loop has caught up; behind by more than 0.1 s
    it goes on from now.

    Attributes:
        late: ticks that began more than a period late.
    """

    def __init__(
        self,
        period: float,
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        """Of ticks every `period` [s], the first one now; `clock` and `sleep` are for tests."""
        self._period, self._clock, self._sleep = period, clock, sleep
        self._next = clock()
        self.late = 0

    def wait(self) -> None:
        """Until the next tick."""
        now = self._clock()
        if now < self._next:
            self._sleep(self._next - now)
        elif now > self._next + self._period:
            self.late += 1
            if now > self._next + _FARTHEST_BEHIND:
                self._next = now
        self._next += self._period


def make_realtime() -> str:
    """Schedules this process as real-time (SCHED_FIFO, priority 50).

    Returns:
        "", or a warning that says why it could not.
    """
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(_PRIORITY))
    except (OSError, AttributeError) as error:
        reason = getattr(error, "strerror", None) or error
        return f"no real-time scheduling ({reason}): give the user an rtprio limit of {_PRIORITY}, or CAP_SYS_NICE"
    return ""


def settle_memory() -> None:
    """Takes what was made so far out of the garbage collector's sight, so that its passes are short."""
    gc.collect()
    gc.freeze()
