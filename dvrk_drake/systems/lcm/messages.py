"""Messages of an arm over LCM: network, command of a sender, fields of a status, and inbox of a command guard."""

from __future__ import annotations

import secrets
import select
import struct
import time
from collections.abc import Callable

import lcm
import numpy as np
from numpy.typing import NDArray
from pydrake.lcm import DrakeLcm, DrakeLcmParams

from dvrk_drake.errors import DvrkDrakeError
from dvrk_drake.lcmtypes import lcmt_dvrk_command, lcmt_dvrk_status
from dvrk_drake.models.lcm_messages import MAC_SIZE, MessageKey, decode
from dvrk_drake.systems.guard.command_guard import CommandGuard
from dvrk_drake.systems.guard.limits import is_finite

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


def draw_id() -> int:
    """Returns a random sender_id or session_id, which is not 0 and practically unique."""
    return 1 + secrets.randbelow(2**62)


def make_command(
    status: lcmt_dvrk_status,
    sender_id: int,
    utime: int,
    mode: int,
    effort: NDArray[np.float64] | None = None,
    desired_state: NDArray[np.float64] | None = None,
    *,
    reset_fault: bool = False,
) -> lcmt_dvrk_command:
    """Returns the command that answers a status.

    The mode is HOLD if the values of the mode are missing or not finite, or with `reset_fault`. The command contains
    the session, time and sequence of the status. The arm refuses a second command for the same status, so it holds if
    the sender receives no new statuses.

    Args:
        status: Last received status.
        sender_id: Identifier of the sender.
        utime: Present time of the sender's clock [us].
        mode: lcmt_dvrk_command.OFF, HOLD, POSITION or EFFORT.
        effort: Commanded efforts (n,) [N m, N] for EFFORT.
        desired_state: Commanded q, then v (2n,) [rad, m, rad/s, m/s] for POSITION.
        reset_fault: Whether to request the reset of a fault, or the resume after a watchdog hold.
    """
    n, command = status.num_joints, lcmt_dvrk_command()
    command.utime, command.sequence, command.sender_id = utime, status.sequence, sender_id
    command.session_id, command.status_utime = status.session_id, status.utime
    command.arm_name, command.num_joints = status.arm_name, n
    efforts, q, v = [0.0] * n, [0.0] * n, [0.0] * n
    command.control_mode, command.reset_fault = lcmt_dvrk_command.HOLD, reset_fault
    values = {lcmt_dvrk_command.EFFORT: effort, lcmt_dvrk_command.POSITION: desired_state}.get(mode)
    numbers = None if values is None else values.tolist()
    if mode == lcmt_dvrk_command.OFF and not reset_fault:
        command.control_mode = mode
    elif numbers is not None and is_finite(numbers) and not reset_fault:
        command.control_mode = mode
        if mode == lcmt_dvrk_command.EFFORT:
            efforts = numbers
        else:
            q, v = numbers[:n], numbers[n:]
    command.effort, command.position, command.velocity = efforts, q, v
    return command


def fill_in_guard(status: lcmt_dvrk_status, guard: CommandGuard) -> None:
    """Sets the fields of `status` that describe the state of a guard. A bridge can call this function as well."""
    status.session_id = guard.session_id
    status.guard_state, status.accepted_modes = guard.state, guard.accepted_modes
    status.fault_code, status.fault_text = guard.fault_code, guard.fault_text or guard.blocked_reason
    status.weaker_settings = guard.weaker_settings
    status.command_sender_id = guard.sender_id
    status.command_sequence, status.command_utime = guard.last_command.sequence, guard.last_command.utime
    counts = guard.counts
    status.num_accepted, status.num_lost, status.num_refused = counts.accepted, counts.lost, counts.refused
    status.num_expired, status.refusal_code = counts.expired, guard.refusal_code
    status.num_ignored, status.ignored_code = counts.ignored, guard.ignored_code
    status.position_commanded = guard.output.position.tolist()
    status.joint_flags = guard.output.joint_flags.tolist()


#: Largest number of commands of the sender in control that are kept between two steps. The same number of commands is
#: kept for all other senders together.
_CAPACITY = 16
#: Byte ranges of sequence, sender_id and session_id in an encoded command, and offset of arm_name [bytes].
_SEQUENCE, _SENDER, _SESSION, _NAME = slice(16, 24), slice(24, 32), slice(32, 40), 48

_UNREADABLE = lcmt_dvrk_status.REFUSAL_UNREADABLE


def _sequence(data: bytes) -> int:
    return int.from_bytes(data[_SEQUENCE], signed=True)


class CommandInbox:
    """Buffer for encoded commands that arrived since the last step of the guard.

    `put` checks the length, type, arm and session of a message without decoding the message. If there is a key, `put`
    also checks the authentication code. A message that fails a check is counted and dropped. Only a limited number of
    the other messages is kept. `deliver` decodes the kept messages and passes them to the guard.

    Commands of the sender in control (see `CommandStream`) are kept in a separate list, so a flood from other senders
    does not displace these commands. If this list is full, the command with the lowest sequence is dropped. A flood of
    copies of earlier commands therefore does not displace new commands. Of other senders, HOLD is kept before other
    commands.
    """

    def __init__(self, guard: CommandGuard, key: MessageKey | None = None, capacity: int = _CAPACITY) -> None:
        """Creates an empty inbox for one guard.

        Args:
            guard: Guard whose arm and session the commands must address. `deliver` also accepts copies of this guard.
            key: Key that must have signed the commands. None: authentication codes are not verified.
            capacity: Largest number of kept commands of the sender in control. The same number of commands is kept for
                all other senders together.
        """
        name = guard.arm_name.encode() + b"\0"
        self._fingerprint = lcmt_dvrk_command()._get_packed_fingerprint()
        self._session = struct.pack(">q", guard.session_id)
        self._name = struct.pack(">I", len(name)) + name
        self._mode = _NAME + len(self._name)  # offset of control_mode [bytes]
        bare = self._mode + struct.calcsize(f">bbi{3 * guard.num_joints}db")
        self._lengths = (bare, bare + MAC_SIZE)
        self._verify: Callable[[bytes], bool] | None = key.verify if key else None
        self._capacity = capacity
        self._sender = b""
        self._own: list[bytes] = []
        self._others: list[bytes] = []
        self._ignored, self._code = 0, lcmt_dvrk_status.REFUSAL_NONE

    def put(self, data: bytes) -> None:
        """Stores the bytes of a message of the command channel."""
        code = self._refusal(data)
        if code == lcmt_dvrk_status.REFUSAL_NONE:
            messages = self._own if data[_SENDER] == self._sender else self._others
            messages.append(data)
            if len(messages) <= self._capacity:
                return
            if messages is self._own:
                messages.remove(min(messages, key=_sequence))
            else:
                others = (k for k, each in enumerate(messages) if each[self._mode] != lcmt_dvrk_command.HOLD)
                messages.pop(max(others, default=-1))
            code = lcmt_dvrk_status.REFUSAL_FLOOD
        self._ignored += 1
        self._code = code

    def deliver(self, guard: CommandGuard, utime: int) -> None:
        """Passes the kept messages and the number of dropped messages to the guard.

        Args:
            guard: Guard that receives the messages.
            utime: Time of arrival on the arm's clock [us].
        """
        if self._ignored:
            guard.ignore(self._code, self._ignored)
            self._ignored = 0
        # Commands of the sender in control come first. The order between senders does not matter.
        for messages in (self._own, self._others):
            for data in messages:
                guard.receive(decode(lcmt_dvrk_command, data), utime)
            messages.clear()
        self._sender = struct.pack(">q", guard.last_sender_id)

    def _refusal(self, data: bytes) -> int:
        """Returns lcmt_dvrk_status.REFUSAL_* for the bytes of a message."""
        if data[:8] != self._fingerprint:
            return _UNREADABLE
        if data[_SESSION] != self._session:
            return lcmt_dvrk_status.REFUSAL_WRONG_SESSION
        if not data.startswith(self._name, _NAME):
            return lcmt_dvrk_status.REFUSAL_WRONG_ARM
        if len(data) not in self._lengths:
            return lcmt_dvrk_status.REFUSAL_WRONG_SIZE
        if self._verify is not None and not self._verify(data):
            return lcmt_dvrk_status.REFUSAL_NOT_AUTHENTIC
        return lcmt_dvrk_status.REFUSAL_NONE
