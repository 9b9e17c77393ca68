"""Processes that collect poses of an arm over UDP, for tests."""

import time

from arm_processes import dvrk_drake

from dvrk_drake.lcmtypes import lcmt_dvrk_status as Status


def until(condition, seconds, process):
    """Waits; False if the arm took over instead, as it does when a machine busy with other tests is late."""
    deadline = time.monotonic() + seconds
    while not condition():
        if not process.is_running():
            assert process.wait(0) == 2 and " took over and holds" in process.said(), process.said()
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
