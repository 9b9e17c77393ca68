"""Waits for a condition instead of a fixed time."""

import threading
import time

#: Time limit for conditions that are never met [s]. It is so long that no test depends on its value.
TIMEOUT = 300.0


def wait_until(condition, what, process=None):
    """Waits until the condition holds.

    Args:
        condition: Function that is called every millisecond.
        what: Expected condition, for the message.
        process: Process that must be running until the condition is met, with a method `poll` as in
            subprocess.Popen; None for no process.
    """
    end = time.monotonic() + TIMEOUT
    while not condition():
        ended = process is not None and process.poll() is not None
        assert not ended or condition(), f"{what}: the process ended before"
        assert time.monotonic() < end, f"{what}: not within {TIMEOUT:g} s"
        time.sleep(1e-3)


def within_time_limit(function, what):
    """Returns the result of a function that may block, e.g. `process.stdout.readline`.

    Args:
        function: Function without arguments. If it does not return in time, its thread remains.
        what: Expected result, for the message.
    """
    results = []
    thread = threading.Thread(target=lambda: results.append(function()), daemon=True)
    thread.start()
    thread.join(TIMEOUT)
    assert results, f"{what}: not within {TIMEOUT:g} s"
    return results[0]
