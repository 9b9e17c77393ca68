"""Waiting for a condition instead of for a time."""

import time

#: Ends a test that would wait forever [s]; no test depends on its value, however busy the computer is.
TIMEOUT = 300.0


def wait_until(condition, what, process=None):
    """Waits until the condition holds.

    Args:
        condition: called every millisecond.
        what: shall come true, for the message when it does not.
        process: has to bring it about; when it ends before, so does the test. A subprocess.Popen, or one with its poll.
    """
    end = time.monotonic() + TIMEOUT
    while not condition():
        ended = process is not None and process.poll() is not None
        assert not ended or condition(), f"{what}: the process ended before"
        assert time.monotonic() < end, f"{what}: not within {TIMEOUT:g} s"
        time.sleep(1e-3)
