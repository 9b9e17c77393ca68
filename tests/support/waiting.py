"""Waits for a condition instead of a fixed time."""

import time

#: Time limit of a test that would wait forever [s]; no test depends on its value, however busy the computer is.
TIMEOUT = 300.0


def wait_until(condition, what, process=None):
    """Waits until the condition holds.

    Args:
        condition: Function that is called every millisecond.
        what: Expected condition, for the message.
        process: Process that is expected to fulfil the condition; the test fails if it ends earlier. A
            subprocess.Popen, or an object with its poll.
    """
    end = time.monotonic() + TIMEOUT
    while not condition():
        ended = process is not None and process.poll() is not None
        assert not ended or condition(), f"{what}: the process ended before"
        assert time.monotonic() < end, f"{what}: not within {TIMEOUT:g} s"
        time.sleep(1e-3)
