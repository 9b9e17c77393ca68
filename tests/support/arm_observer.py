"""Observes the statuses of an arm over UDP. Tests use it to wait for a condition."""

import threading
import time
from typing import ClassVar

import lcm
import numpy as np
from waiting import TIMEOUT, wait_until

from dvrk_drake.lcmtypes import lcmt_dvrk_status as Status
from dvrk_drake.processes.pace import make_realtime

NETWORK_URL = "udpm://239.255.76.67:7667?ttl=0"


class Observer:
    """Collects the statuses of an arm in a thread, with real-time scheduling if that is permitted."""

    running: ClassVar[set] = set()

    def __init__(self, name, url=NETWORK_URL):
        self.received, self.times = [], []
        self.listens, self.ended = threading.Event(), threading.Event()
        self.thread = threading.Thread(target=self.listen, args=(name, url), daemon=True)
        self.thread.start()
        assert self.listens.wait(TIMEOUT)
        self.running.add(self)

    def end(self):
        """Ends the thread of the observer. The threads of LCM continue to read every message of the network."""
        self.running.remove(self)
        self.ended.set()
        self.thread.join(TIMEOUT)

    def listen(self, name, url):
        # Scheduling is set per thread. The reading thread of LCM, started here, inherits it. Processes do not inherit
        # it, because the main thread starts them.
        make_realtime()
        network = lcm.LCM(url)
        subscription = network.subscribe(f"DVRK_STATUS_{name.upper()}", self.receive)
        subscription.set_queue_capacity(0)  # no limit
        self.listens.set()
        while not self.ended.is_set():
            network.handle_timeout(100)

    def receive(self, channel, data):
        self.times.append(time.monotonic())
        self.received.append(Status.decode(data))

    @property
    def last(self):
        return self.received[-1]

    def until(self, condition, what, since=None, process=None):
        """Waits for a status that meets the condition, and returns its index.

        Args:
            condition: Function from a status to bool.
            what: Name of the condition, for the message.
            since: Index of the first status to examine; None for statuses received from now on.
            process: Process that must be running until the condition is met, or None.
        """
        seen = len(self.received) if since is None else since

        def met():
            nonlocal seen
            while seen < len(self.received):
                if condition(self.received[seen]):
                    return True
                seen += 1
            return False

        try:
            wait_until(met, what, process)
        except AssertionError as error:
            last = self.last if self.received else Status()
            raise AssertionError(f"{error}; state {last.guard_state}, refusal {last.refusal_code}") from None
        return seen

    def during(self, seconds):
        """Returns the statuses of the next `seconds` of the arm's clock."""
        first, end = len(self.received), self.last.utime + 1e6 * seconds
        return self.received[
            first : 1 + self.until(lambda status: status.utime >= end, f"{seconds} s of the arm's clock")
        ]


def check_clock(statuses):
    """Checks that an arm sends one status every 2 ms of its clock. UDP may lose some if the computer is busy."""
    steps = np.diff([status.sequence for status in statuses])
    assert np.all(steps >= 1)
    np.testing.assert_array_equal(np.diff([status.utime for status in statuses]), 2000 * steps)


def is_holding(status):
    return status.guard_state == Status.STATE_HOLD


def accepts_efforts(status):
    return status.guard_state == Status.STATE_EFFORT
