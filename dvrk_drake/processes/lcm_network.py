"""Opens an LCM network, or says why it cannot be used: LCM itself only writes to stderr and goes on without."""

from __future__ import annotations

import secrets
import select
import time

import lcm
from pydrake.lcm import DrakeLcm, DrakeLcmParams

from dvrk_drake.errors import DvrkDrakeError

#: How long messages to oneself may take, on a busy machine, and the time between them: UDP may lose one [s].
_OWN_MESSAGES, _NEXT_MESSAGE = 5.0, 0.2


def open_lcm(url: str = "") -> DrakeLcm:
    """The network at `url`; empty: the environment's LCM_DEFAULT_URL, or LCM's own default.

    Raises:
        DvrkDrakeError: LCM does not know such a network, or no message to oneself comes back.
    """
    # Deferred: a network that only publishes needs no thread that wakes for every message.
    network = DrakeLcm(DrakeLcmParams(lcm_url=url, defer_initialization=True))
    name = network.get_lcm_url()
    try:
        own = lcm.LCM(name)
        channel, heard = f"DVRK_SELF_TEST_{secrets.token_hex(8)}", []
        own.subscribe(channel, lambda channel, data: heard.append(data))
        end = time.monotonic() + _OWN_MESSAGES
        while not heard and time.monotonic() < end:
            own.publish(channel, b"")
            handle_message(own, _NEXT_MESSAGE)
    except (RuntimeError, OSError) as error:
        raise DvrkDrakeError(f'LCM network "{name}" cannot be used: {error}; e.g. udpm://239.255.76.67:7667') from error
    if not heard:
        raise DvrkDrakeError(
            f'LCM network "{name}" carries no message: is there a route for its multicast address? On one machine: '
            "ip link set lo multicast on; ip route add 239.255.0.0/16 dev lo"
        )
    return network


def handle_message(network: lcm.LCM, seconds: float) -> bool:
    """Handles one message if it comes within that time; lcm's own handle_timeout fails when a signal comes."""
    ready, _, _ = select.select([network.fileno()], [], [], seconds)
    if ready:
        network.handle()
    return bool(ready)


def listen(network: lcm.LCM, seconds: float) -> None:
    """Handles what comes within that time, so that a tick begins with little left to do."""
    end = time.monotonic() + seconds
    while (left := end - time.monotonic()) > 0:
        handle_message(network, left)
