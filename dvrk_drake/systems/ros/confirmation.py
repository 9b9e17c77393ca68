"""Repeats a message until the arm has received it, also after a loss of the network."""

from __future__ import annotations

import time
from collections.abc import Callable

#: Time between two attempts without confirmation [s].
_INTERVAL = 0.25


def repeat_until_confirmed(attempt: Callable[[float], bool], is_over: Callable[[], bool]) -> bool:
    """Repeats an attempt to send a message until two attempts in succession are confirmed. Returns whether they are.

    One confirmation is not sufficient. A subscription that DDS discovers again after a loss of the network does not
    receive the messages that were published before, but confirms them.

    Args:
        attempt: Function that publishes the message, and waits for its confirmation at most the given time [s]. It
            returns whether the arm is connected and has confirmed the message.
        is_over: Function that returns whether to stop. It is called after each attempt without confirmation.
    """
    missing = 2
    while missing:
        begin = time.monotonic()
        if attempt(_INTERVAL):
            missing -= 1
            continue
        missing = 2
        if is_over():
            return False
        time.sleep(max(0.0, begin + _INTERVAL - time.monotonic()))
    return True
