"""Processes that collect poses of an arm over UDP, for tests."""

import sys
import time

from own_network import start

from dvrk_drake.lcmtypes import lcmt_dvrk_status as Status


def dvrk_drake(*arguments):
    return start(sys.executable, "-m", "dvrk_drake.cli", *map(str, arguments))


def until(condition, seconds, process):
    """Waits; False if the arm took over instead, as it does when a machine busy with other tests is late."""
    deadline = time.monotonic() + seconds
    while not condition():
        if process.poll() is not None:
            said = process.stdout.read()
            assert process.returncode == 2 and " took over and holds" in said, said
            return False
        assert time.monotonic() < deadline
        time.sleep(0.01)
    return True


def collect_until(condition, command):
    """A collecting process in which the condition has come true; the same command goes on where one ended."""
    for _ in range(6):
        process = dvrk_drake(*command)
        if until(condition, 60, process):
            return process
    raise AssertionError("the arm took over six times")


def holds(status):
    return status.guard_state == Status.STATE_HOLD
