"""Periodic execution by the wall clock, and real-time scheduling if the system permits it."""

from __future__ import annotations

import ctypes
import gc
import os
import time
from collections.abc import Callable

#: Priority of SCHED_FIFO. It is higher than the priority of all processes that are not real-time, and lower than that
#: of the kernel's own threads (99).
_PRIORITY = 50

#: Longest delay [s] for which a loop catches up. After a longer delay, the loop continues from the current time.
_MAX_DELAY = 0.1

#: Share of the time for which a late loop rests. Linux reserves 5 % of each core for processes without real-time
#: priority (sched_rt_runtime_us). From a loop that leaves them less, it takes 50 ms at once in each second, and the
#: guard of the arm then holds. Measured beside busy processes: with 4 % these gaps remain, with 6 % there is none.
_REST = 0.08


class Pace:
    """Periodic ticks of the monotonic clock, which is not affected by changes of the system time.

    After a late tick, the next ticks follow immediately until the loop is on time. A loop that is more than 0.1 s late
    continues from the current time. With real-time priority, a loop that is never on time rests for 8 % of the
    time, in short pieces.

    Attributes:
        count: Number of ticks.
        late: Number of ticks that began more than a period late.
        lost: Time that was not caught up, because the loop was more than 0.1 s late [s].
    """

    def __init__(
        self,
        period: float,
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
        rest: Callable[[float], None] | None = None,
    ) -> None:
        """Starts the ticks. The first tick is at the current time.

        Args:
            period: Period of the ticks [s].
            clock: Function that returns a monotonic time [s].
            sleep: Function that waits for a time [s]. It may work meanwhile, e.g. receive messages.
            rest: Function with which a late loop waits for a time [s] without any work. None: `time.sleep` if this
                thread has real-time priority, otherwise no rest.
        """
        self._period, self._clock, self._sleep = period, clock, sleep
        self._rest = time.sleep if rest is None and _is_realtime() else rest
        self._next = self._begun = clock()
        self.count = self.late = 0
        self.lost = 0.0

    def wait(self) -> None:
        """Waits until the next tick."""
        self.count += 1
        now = self._clock()
        rest = min(_REST * (now - self._begun), self._period) if self._rest else 0.0
        if now + rest < self._next:
            self._sleep(self._next - now)
        elif self._rest:
            self._rest(rest)
        if now > self._next + self._period:
            self.late += 1
            if now > self._next + _MAX_DELAY:
                self.lost += now - self._next
                self._next = now
        self._next += self._period
        self._begun = self._clock()

    def describe(self) -> str:
        """Returns the share of late ticks, and the time by which a simulation was slower than real time."""
        share = 100 * self.late / max(self.count, 1)
        return (
            f"{self.late} of {self.count} steps ({share:.1f} %) started more than one period late, and the simulation "
            f"was {self.lost:.1f} s slower than real time"
        )


def make_realtime() -> list[str]:
    """Requests locked memory, no sleep states of the cores, and real-time scheduling (SCHED_FIFO, priority 50).

    Scheduling is the last, since the system needs 0.3 s to lock 600 MB, and would meanwhile withhold a core from the
    loops that already run with the same priority. So collect garbage before (`settle_memory`).

    Threads that are started later, such as those of LCM, inherit the priority. A core in a sleep state needs more time
    to wake up than a controller needs to compute a command. The request to /dev/cpu_dma_latency
    (https://docs.kernel.org/power/pm_qos_interface.html) prevents sleep states until this process ends.

    Returns:
        One warning for each request that was refused, with the reason.
    """
    warnings = []
    for step, what in (
        (_lock_memory, "memory may be paged out. Give the user an unlimited memlock limit, or CAP_IPC_LOCK"),
        (_keep_cores_awake, "cores may sleep between messages. Allow the user to write /dev/cpu_dma_latency"),
        (_schedule, f"no real-time scheduling. Give the user an rtprio limit of {_PRIORITY}, or CAP_SYS_NICE"),
    ):
        try:
            step()
        except (OSError, AttributeError) as error:
            warnings.append(f"{what} ({getattr(error, 'strerror', None) or error})")
    return warnings


def _is_realtime() -> bool:
    try:
        return os.sched_getscheduler(0) in (os.SCHED_FIFO, os.SCHED_RR)
    except AttributeError:  # macOS
        return False


def _schedule() -> None:
    os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(_PRIORITY))


def _lock_memory() -> None:
    current, future = 1, 2  # MCL_CURRENT, MCL_FUTURE
    if ctypes.CDLL(None, use_errno=True).mlockall(current | future):
        raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))


def _keep_cores_awake() -> None:
    # The file stays open, because closing it would end the request.
    os.write(os.open("/dev/cpu_dma_latency", os.O_WRONLY), (0).to_bytes(4, "little"))


def settle_memory() -> None:
    """Excludes existing objects from garbage collection, which shortens each collection."""
    gc.collect()
    gc.freeze()
