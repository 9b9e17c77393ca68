"""Periodic work by the wall clock, and real-time scheduling where the system permits it."""

from __future__ import annotations

import ctypes
import gc
import os
import time
from collections.abc import Callable

#: Priority of SCHED_FIFO: above everything that is not real-time, below the kernel's own threads at 99.
_PRIORITY = 50

#: So far behind, a loop does not catch up any more but goes on from now [s].
_MAX_DELAY = 0.1


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
            if now > self._next + _MAX_DELAY:
                self._next = now
        self._next += self._period


def make_realtime() -> list[str]:
    """Schedules this process as real-time (SCHED_FIFO, priority 50), keeps its memory and the machine's cores awake.

    Threads that are started later inherit the priority, as LCM's do. A core that sleeps takes longer to wake than an
    answer to compute: the request of https://docs.kernel.org/power/pm_qos_interface.html keeps them from it until this
    process ends.

    Returns:
        What could not be had and why, a warning each.
    """
    warnings = []
    for step, what in (
        (_schedule, f"no real-time scheduling: give the user an rtprio limit of {_PRIORITY}, or CAP_SYS_NICE"),
        (_lock_memory, "memory may be paged out: give the user an unlimited memlock limit, or CAP_IPC_LOCK"),
        (_keep_cores_awake, "cores may sleep between messages: let the user write /dev/cpu_dma_latency"),
    ):
        try:
            step()
        except (OSError, AttributeError) as error:
            warnings.append(f"{what} ({getattr(error, 'strerror', None) or error})")
    return warnings


def _schedule() -> None:
    os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(_PRIORITY))


def _lock_memory() -> None:
    current, future = 1, 2  # MCL_CURRENT, MCL_FUTURE
    if ctypes.CDLL(None, use_errno=True).mlockall(current | future):
        raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))


def _keep_cores_awake() -> None:
    # Never closed: the request lasts as long as the file is open.
    os.write(os.open("/dev/cpu_dma_latency", os.O_WRONLY), (0).to_bytes(4, "little"))


def settle_memory() -> None:
    """Takes what was made so far out of the garbage collector's sight, so that its passes are short."""
    gc.collect()
    gc.freeze()
