"""Inbox of a command guard for messages from the network. It limits the computing time for a flood of messages."""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING

from dvrk_drake.lcmtypes import lcmt_dvrk_command, lcmt_dvrk_status
from dvrk_drake.models.lcm_messages import MAC_SIZE, MessageKey, decode
from dvrk_drake.systems.guard.command_guard import CommandGuard

if TYPE_CHECKING:
    from collections.abc import Callable

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
