"""Repeats a message until the arm has received it, also after a loss of the network."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from dvrk_drake.systems.ros.topic import Publisher

#: Time between two repetitions [s].
_INTERVAL = 0.25


def repeat_until_received(
    publisher: Publisher[Any], message: Any, is_present: Callable[[], object], is_over: Callable[[], bool]
) -> bool:
    """Waits until a published message is confirmed. Returns whether it is confirmed.

    The message is published again while it is not confirmed. A subscription that DDS discovers again after a loss of
    the network does not receive the messages that were published before, but confirms them. After a repetition, two
    messages in succession must therefore be confirmed.

    Args:
        publisher: Publisher of the message.
        message: Message that was published last.
        is_present: Function that returns whether DDS has a connection to the arm. Without subscriptions, DDS regards
            each message as confirmed.
        is_over: Function that returns whether to stop waiting. It is called after each attempt without confirmation.

    Raises:
        DvrkDrakeError: DDS cannot send the message.
    """
    missing = 1
    while True:
        begin = time.monotonic()
        if publisher.wait_until_received(_INTERVAL) and is_present():
            missing -= 1
            if not missing:
                return True
        else:
            missing = 2
            if is_over():
                return False
            time.sleep(max(0.0, begin + _INTERVAL - time.monotonic()))
        publisher.publish(message)
