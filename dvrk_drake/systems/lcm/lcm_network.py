"""Checks that an LCM network can be used, and handles its messages. LCM itself raises no exception."""

from __future__ import annotations

import secrets
import select
import time

import lcm
from pydrake.lcm import DrakeLcm, DrakeLcmParams

from dvrk_drake.errors import DvrkDrakeError

#: Longest time until this process receives its own message on a busy computer [s]. Time between two such messages [s].
#: Several messages are sent, because UDP may lose messages.
_OWN_MESSAGES, _NEXT_MESSAGE = 5.0, 0.2


def usable_lcm_url(url: str = "") -> str:
    """Returns the URL of an LCM network on which this process receives its own messages.

    Args:
        url: URL of the network. If it is empty, the environment variable LCM_DEFAULT_URL or LCM's default is used.

    Raises:
        DvrkDrakeError: LCM does not support the URL, or this process does not receive its own messages.
    """
    # Drake's interface states the default URL. Receiving is deferred, because nothing is received with it.
    name = str(DrakeLcm(DrakeLcmParams(lcm_url=url, defer_initialization=True)).get_lcm_url())
    try:
        own = lcm.LCM(name)
        channel, received = f"DVRK_SELF_TEST_{secrets.token_hex(8)}", []
        own.subscribe(channel, lambda channel, data: received.append(data))
        end = time.monotonic() + _OWN_MESSAGES
        while not received and time.monotonic() < end:
            own.publish(channel, b"")
            handle_message(own, _NEXT_MESSAGE)
    except (RuntimeError, OSError) as error:
        raise DvrkDrakeError(
            f'LCM network "{name}" cannot be used: {error}. Use a URL such as udpm://239.255.76.67:7667'
        ) from error
    if not received:
        raise DvrkDrakeError(
            f'LCM network "{name}" does not deliver messages. Add a route for its multicast address. On one machine: '
            "ip link set lo multicast on; ip route add 239.255.0.0/16 dev lo"
        )
    return name


def handle_message(network: lcm.LCM, seconds: float) -> bool:
    """Handles one message that arrives within `seconds`, and returns whether one arrived.

    A signal of the operating system, such as SIGINT, does not raise an error.
    """
    ready, _, _ = select.select([network.fileno()], [], [], seconds)
    if ready:
        network.handle()
    return bool(ready)


def listen(network: lcm.LCM, seconds: float) -> None:
    """Handles the messages that arrive within `seconds`."""
    end = time.monotonic() + seconds
    while (left := end - time.monotonic()) > 0:
        handle_message(network, left)
