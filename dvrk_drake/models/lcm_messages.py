"""Channels, authentication and decoding of the LCM messages of an arm.

A status is a message lcmt_dvrk_status, which the arm's process sends. A command is a message lcmt_dvrk_command, which a
controller sends. An estimated force is a message lcmt_dvrk_force, which a controller or a bridge sends.
"""

from __future__ import annotations

import hashlib
import math
import os
import secrets
import stat
import struct
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from dvrk_drake.errors import KeyFileError
from dvrk_drake.lcmtypes import lcmt_dvrk_command, lcmt_dvrk_force, lcmt_dvrk_status
from dvrk_drake.models.files import open_input

if TYPE_CHECKING:
    from dvrk_drake.models.arm import Arm

#: Version of all message types. The first 8 bytes of a message, its fingerprint, depend on all fields of its type. A
#: changed field therefore makes a new version. Receivers ignore messages of other versions (docs/files.md).
MESSAGE_VERSION = "1.0"
#: Minimum and maximum length of a key, and length of a new key [bytes]. The maximum is that of BLAKE2b.
_MIN_LENGTH, _MAX_LENGTH, _NEW_LENGTH = 16, 64, 32
#: Length of a message authentication code [bytes].
MAC_SIZE = 16
#: Byte that precedes the authentication code of a message. It contains the size of the code, or 0 if the message has no
#: code.
_NO_MAC, _MAC_FOLLOWS = b"\0", bytes([MAC_SIZE])


class MessageKey:
    """Key that signs and verifies encoded messages: keyed BLAKE2b with a digest of 16 bytes.

    The last two fields of a message are `mac_size` and `mac`. The authentication code `mac` covers all bytes before
    these fields: fingerprint of the message type, session, sequence, time and content.
    """

    def __init__(self, key: bytes) -> None:
        """Creates a key from 16 to 64 bytes.

        Raises:
            KeyFileError: The key is too short or too long.
        """
        if not _MIN_LENGTH <= len(key) <= _MAX_LENGTH:
            raise KeyFileError(f"the key has {len(key)} bytes; allowed: {_MIN_LENGTH} to {_MAX_LENGTH}")
        self._hash = hashlib.blake2b(key=key, digest_size=MAC_SIZE)

    @classmethod
    def load(cls, path: str | Path) -> MessageKey:
        """Loads the key whose bytes are the content of the file at `path`.

        Raises:
            KeyFileError: The file does not exist, is accessible to other users, or is too short or too long.
        """
        with open_input(path, KeyFileError) as file:
            mode = stat.S_IMODE(os.fstat(file.fileno()).st_mode)
            if mode & (stat.S_IRWXG | stat.S_IRWXO):
                raise KeyFileError(
                    f"{path}: other users have access to this key (mode {mode:04o}). Run: chmod 600 {path}"
                )
            key = file.read(_MAX_LENGTH + 1) or b""
        try:
            return cls(key)
        except KeyFileError as error:
            size = f"more than {_MAX_LENGTH}" if len(key) > _MAX_LENGTH else str(len(key))
            raise KeyFileError(
                f"{path}: the key has {size} bytes; allowed: {_MIN_LENGTH} to {_MAX_LENGTH}. "
                "Create a key with: dvrk-drake keygen --output FILE"
            ) from error

    def sign(self, data: bytes) -> bytes:
        """Returns the unsigned encoded message `data` with its authentication code appended."""
        content = data[: -len(_NO_MAC)]
        return content + _MAC_FOLLOWS + self._mac(content)

    def verify(self, data: bytes) -> bool:
        """Returns whether `data` ends with the authentication code of the bytes before it."""
        content, size, mac = data[: -MAC_SIZE - 1], data[-MAC_SIZE - 1 : -MAC_SIZE], data[-MAC_SIZE:]
        return size == _MAC_FOLLOWS and secrets.compare_digest(self._mac(content), mac)

    def _mac(self, content: bytes) -> bytes:
        state = self._hash.copy()
        state.update(content)
        return state.digest()


def create_key_file(path: str | Path) -> None:
    """Writes a random key of 32 bytes to a new file that only its owner can read and write.

    Raises:
        KeyFileError: The file exists or cannot be written.
    """
    try:
        descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600)
    except FileExistsError as error:
        raise KeyFileError(f"{path} already exists, and a key is never overwritten. Choose another file.") from error
    except (OSError, ValueError) as error:
        raise KeyFileError(f"{path} cannot be written: {getattr(error, 'strerror', None) or error}") from error
    with open(descriptor, "wb") as file:
        file.write(secrets.token_bytes(_NEW_LENGTH))


Message = TypeVar("Message", lcmt_dvrk_command, lcmt_dvrk_force, lcmt_dvrk_status)

STATUS_PREFIX = "DVRK_STATUS_"

#: Maximum rate of statuses [Hz], and maximum number of statuses that may arrive at once after a pause of the arm's
#: process.
_MAX_RATE, _MAX_AHEAD = 2000, 100

_STATE_NAMES = {
    value: name.removeprefix("STATE_").lower()
    for name, value in vars(lcmt_dvrk_status).items()
    if name.startswith("STATE_")
}

_REFUSALS = {
    lcmt_dvrk_status.REFUSAL_NONE: "none",
    lcmt_dvrk_status.REFUSAL_UNREADABLE: f"not an lcmt_dvrk_command of version {MESSAGE_VERSION}",
    lcmt_dvrk_status.REFUSAL_WRONG_ARM: "command for another arm",
    lcmt_dvrk_status.REFUSAL_WRONG_SIZE: "wrong number of joints",
    lcmt_dvrk_status.REFUSAL_NOT_FINITE: "numbers that are not finite",
    lcmt_dvrk_status.REFUSAL_BAD_MODE: "mode not accepted in the present state",
    lcmt_dvrk_status.REFUSAL_NO_SENDER: "no sender_id",
    lcmt_dvrk_status.REFUSAL_WRONG_SESSION: "session from before a restart of the arm",
    lcmt_dvrk_status.REFUSAL_STALE: "based on a measurement that is too old",
    lcmt_dvrk_status.REFUSAL_OUT_OF_ORDER: "command sent twice or out of order",
    lcmt_dvrk_status.REFUSAL_CLOCK_JUMP: "jump of the sender's clock",
    lcmt_dvrk_status.REFUSAL_FAULT: "guard in a fault",
    lcmt_dvrk_status.REFUSAL_BAD_RESET: "reset of a fault in a mode other than HOLD",
    lcmt_dvrk_status.REFUSAL_START_FAR: "start too far from the present efforts or pose",
    lcmt_dvrk_status.REFUSAL_START_OUTSIDE: "start while the arm is beyond a position limit",
    lcmt_dvrk_status.REFUSAL_OTHER_SENDER: "sent by a second sender",
    lcmt_dvrk_status.REFUSAL_SUDDEN_OFF: "OFF without HOLD before",
    lcmt_dvrk_status.REFUSAL_RESUME: "command before the operator has resumed",
    lcmt_dvrk_status.REFUSAL_START_GRAVITY: "start while the measured effort differs from the gravity effort",
    lcmt_dvrk_status.REFUSAL_NOT_AUTHENTIC: "not signed with the arm's key (--key)",
    lcmt_dvrk_status.REFUSAL_SEQUENCE_JUMP: "jump of the sequence number",
    lcmt_dvrk_status.REFUSAL_FLOOD: "too many messages at once",
}


def command_channel(arm: Arm) -> str:
    """Returns the command channel of an arm, DVRK_COMMAND_<ARM>."""
    return f"DVRK_COMMAND_{arm.name.upper()}"


def status_channel(arm: Arm) -> str:
    """Returns the status channel of an arm, DVRK_STATUS_<ARM>."""
    return STATUS_PREFIX + arm.name.upper()


def force_channel(arm: Arm) -> str:
    """Returns the channel of the estimated external force on an arm, DVRK_FORCE_<ARM>."""
    return f"DVRK_FORCE_{arm.name.upper()}"


def decode(message_type: type[Message], data: bytes) -> Message | None:
    """Returns the message of the given type in `data`, or None if `data` is not such a message.

    Decoders generated by lcm-gen raise various errors for invalid data: ValueError, struct.error, MemoryError.
    """
    try:
        return message_type.decode(data)
    except Exception:
        return None


def describe_state(guard_state: int, fault_text: str = "") -> str:
    """Returns a description of a guard state."""
    return _STATE_NAMES.get(guard_state, f"state {guard_state}") + (f": {fault_text}" if fault_text else "")


def describe_refusal(refusal_code: int) -> str:
    """Returns the reason why a command was refused."""
    return _REFUSALS.get(refusal_code, f"refusal {refusal_code}")


class StatusFilter:
    """Selects the statuses of one session of one arm from the messages of its status channel.

    A session is one run of the arm's process. The filter accepts only the first session that it receives. It ignores a
    status, and counts the reason in `ignored`, if the status is not authentic, belongs to another session, or was not
    sent after the last accepted status. It also ignores a status whose sequence number or time is too far ahead: the
    sequence number may increase by at most 2000 per second plus 100, and the time by at most 1 ms times this number.
    Without this limit, one spoofed status with a large sequence number would make all authentic statuses appear old.

    Attributes:
        last: Last accepted status, or None if no status has been accepted.
        ignored: Mapping from a reason (OTHER_SESSION, JUMP, OLD, NOT_AUTHENTIC, OTHER_VERSION, UNREADABLE) to the
            number of messages ignored since the last accepted status.
    """

    OTHER_SESSION = "of another session"
    JUMP = "with a jump of sequence or time"
    OLD = "not newer than the last one"
    NOT_AUTHENTIC = "not signed with this key"
    UNREADABLE = "unreadable or of another arm"
    OTHER_VERSION = f"not an lcmt_dvrk_status of version {MESSAGE_VERSION}"

    def __init__(
        self,
        arm_name: str,
        num_joints: int,
        key: MessageKey | None = None,
        *,
        session_id: int = 0,
        follow_after: float = math.inf,
    ) -> None:
        """Creates a filter for one arm.

        Args:
            arm_name: Name of the arm.
            num_joints: Number of joints of the arm.
            key: Key with which the statuses must be signed; None to skip verification.
            session_id: Session to accept; 0 for the first received session.
            follow_after: Duration without a status of the session [s] after which another session, or the same session
                after a jump, is accepted. Set it only for recordings, because a controller must not continue with a
                restarted arm.
        """
        self.last: lcmt_dvrk_status | None = None
        self.ignored: Counter[str] = Counter()
        self._arm_name, self._num_joints, self._key, self._follow_after = arm_name, num_joints, key, follow_after
        self._session_id = session_id
        self._fingerprint = lcmt_dvrk_status()._get_packed_fingerprint()
        self._last_arrival = 0.0
        self._reference = (0, 0, 0.0)

    def accept(self, data: bytes, now: float, *, settle: bool = True) -> lcmt_dvrk_status | None:
        """Returns the status in a message, or None if the message is ignored. The arguments are those of `examine`."""
        return None if self.examine(data, now, settle=settle) else self.last

    def examine(self, data: bytes, now: float, *, settle: bool = True) -> str:
        """Stores the status in a message as `last`, or ignores the message.

        Args:
            data: Received message.
            now: Time of arrival on a monotonic clock [s].
            settle: False if the caller calls `settle` after each batch of messages. The messages of a batch arrive at
                the same time, so they are compared with the last status before the batch.

        Returns:
            The reason why the message is ignored, or "" if the status is accepted.
        """
        reason = self._reason(data, now)
        status = None if reason else decode(lcmt_dvrk_status, data)
        if status is None or (status.arm_name, status.num_joints) != (self._arm_name, self._num_joints):
            reason = reason or self.UNREADABLE
            self.ignored[reason] += 1
            return reason
        is_first = self.last is None
        self.last, self._last_arrival, self._session_id = status, now, status.session_id
        self.ignored.clear()
        if settle or is_first:
            self.settle(now)
        return ""

    def settle(self, now: float) -> None:
        """Uses the last status, with arrival time `now` [s], as the reference for later statuses."""
        if self.last is not None:
            self._reference = (self.last.sequence, self.last.utime, now)

    def _reason(self, data: bytes, now: float) -> str:
        """Returns the reason to ignore a message, or "". Only the header and the authentication code are examined."""
        if len(data) < 32 or data[:8] != self._fingerprint:
            return self.OTHER_VERSION
        utime, sequence, session_id = struct.unpack_from(">qqq", data, 8)
        last = self.last
        if last is None:
            if self._session_id not in (0, session_id):
                return self.OTHER_SESSION
        elif now - self._last_arrival <= self._follow_after:
            if session_id != last.session_id:
                return self.OTHER_SESSION
            if sequence <= last.sequence:
                return self.OLD
            from_sequence, from_utime, then = self._reference
            most = _MAX_RATE * (now - then) + _MAX_AHEAD
            if sequence - from_sequence > most or not last.utime <= utime <= from_utime + 1e3 * most:
                return self.JUMP
        if self._key is not None and not self._key.verify(data):
            return self.NOT_AUTHENTIC
        return ""
