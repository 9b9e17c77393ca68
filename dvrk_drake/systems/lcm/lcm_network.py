"""Opens an LCM network and handles its messages. Unlike LCM, it raises an exception for an unusable network."""

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


def open_lcm(url: str = "") -> DrakeLcm:
    """Opens an LCM network.

    Args:
        url: URL of the network. If it is empty, the environment variable LCM_DEFAULT_URL or LCM's default is used.

    Returns:
        LCM interface of the network.

    Raises:
        DvrkDrakeError: LCM does not support the URL, or this process does not receive its own messages.
    """
    # Receiving is deferred, because an interface that only publishes needs no thread that wakes up for every message.
    network = DrakeLcm(DrakeLcmParams(lcm_url=url, defer_initialization=True))
    name = network.get_lcm_url()
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
    return network


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
