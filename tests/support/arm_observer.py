"""What an arm says over UDP, for tests that wait for something to come true."""

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
    """What an arm says, gathered by a thread that is scheduled as real-time where that is permitted."""

    running: ClassVar[set] = set()

    def __init__(self, name, url=NETWORK_URL):
        self.heard, self.times = [], []
        self.listens, self.ended = threading.Event(), threading.Event()
        self.thread = threading.Thread(target=self.listen, args=(name, url), daemon=True)
        self.thread.start()
        assert self.listens.wait()
        self.running.add(self)

    def end(self):
        """Ends its threads: those of LCM read every message of the network, in real time."""
        self.running.remove(self)
        self.ended.set()
        self.thread.join(TIMEOUT)

    def listen(self, name, url):
        # Scheduling is a thread's own. LCM's reading thread, which is started here, inherits it; processes do not,
        # because the main thread starts them.
        make_realtime()
        network = lcm.LCM(url)
        subscription = network.subscribe(f"DVRK_STATUS_{name.upper()}", self.hear)
        subscription.set_queue_capacity(0)  # no limit
        self.listens.set()
        while not self.ended.is_set():
            network.handle_timeout(100)

    def hear(self, channel, data):
        self.times.append(time.monotonic())
        self.heard.append(Status.decode(data))

    @property
    def last(self):
        return self.heard[-1]

    def until(self, condition, what, since=None, process=None):
        """The index of the first status that meets the condition, of those from now on or since an index.

        `process` is what has to bring it about.
        """
        seen = len(self.heard) if since is None else since

        def met():
            nonlocal seen
            while seen < len(self.heard):
                if condition(self.heard[seen]):
                    return True
                seen += 1
            return False

        try:
            wait_until(met, what, process)
        except AssertionError as error:
            last = self.last if self.heard else Status()
            raise AssertionError(f"{error}; state {last.guard_state}, refusal {last.refusal_code}") from None
        return seen

    def during(self, seconds):
        """The statuses of the next `seconds` of the arm's clock."""
        first, end = len(self.heard), self.last.utime + 1e6 * seconds
        return self.heard[first : 1 + self.until(lambda status: status.utime >= end, f"{seconds} s of the arm's clock")]


def check_clock(statuses):
    """An arm counts its statuses, a millisecond of its clock each; UDP may lose some where a computer is busy."""
    steps = np.diff([status.sequence for status in statuses])
    assert np.all(steps >= 1)
    np.testing.assert_array_equal(np.diff([status.utime for status in statuses]), 1000 * steps)


def holds(status):
    return status.guard_state == Status.STATE_HOLD


def takes_efforts(status):
    return status.guard_state == Status.STATE_EFFORT
