"""What an arm says over UDP, for tests that wait for something to come true."""

import threading
import time

import lcm

from dvrk_drake.lcmtypes import lcmt_dvrk_status as Status

NETWORK_URL = "udpm://239.255.76.67:7667?ttl=0"


class Observer:
    """What an arm says, with the time of arrival, gathered by a thread."""

    def __init__(self, name, url=NETWORK_URL):
        self.heard = []
        self.lcm = lcm.LCM(url)
        subscription = self.lcm.subscribe(f"DVRK_STATUS_{name.upper()}", self.hear)
        subscription.set_queue_capacity(0)  # no limit: none may be lost here
        threading.Thread(target=self.listen, daemon=True).start()

    def listen(self):
        while True:
            self.lcm.handle()

    def hear(self, channel, data):
        self.heard.append((time.monotonic(), Status.decode(data)))

    @property
    def last(self):
        return self.heard[-1][1]

    def until(self, condition, seconds, what, since=None):
        """The index of the first status that meets the condition, of those from now on or since an index."""
        end = time.monotonic() + seconds
        seen = len(self.heard) if since is None else since
        while time.monotonic() < end:
            for k in range(seen, len(self.heard)):
                if condition(self.heard[k][1]):
                    return k
            seen = len(self.heard)
            time.sleep(1e-3)
        last = self.last if self.heard else Status()
        raise AssertionError(f"{what}: not within {seconds} s; state {last.guard_state}, refusal {last.refusal_code}")
