"""Reads LCM logs, including damaged logs, and extracts the statuses (lcmt_dvrk_status) of one arm.

The format is described at https://lcm-proj.github.io/lcm/content/log-file-format.html. A log is a sequence of events.
Each event is big-endian and consists of a magic number, the event number, a time, two lengths, channel and data.
`EventLog` of the `lcm` package is not used. It crashes on a damaged length (segmentation fault in lcm 1.5.3), and
writes the last events only when the log is closed.
"""

from __future__ import annotations

import math
import mmap
import struct
from array import array
from collections import Counter, deque
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from dvrk_drake.errors import RecordingError
from dvrk_drake.lcmtypes import lcmt_dvrk_status
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.files import open_input
from dvrk_drake.models.lcm_messages import MESSAGE_VERSION, STATUS_PREFIX, decode, status_channel
from dvrk_drake.recordings.joint_states import MAX_LATE
from dvrk_drake.recordings.reader_options import FileOptions, sha256_of
from dvrk_drake.recordings.recording import Recording

_MAGIC = bytes.fromhex("EDA1DA01")
_HEADER = struct.Struct(">4sqqII")
_MAX_CHANNEL = 1000


class LcmEvent(NamedTuple):
    """One message of a log: event number, time of arrival [us since 1970], channel and data."""

    number: int
    utime: int
    channel: str
    data: bytes


def read_events(path: Path, notes: list[str]) -> Iterator[LcmEvent]:
    """Iterates over the events of a log in order, and skips damaged events.

    Args:
        path: Path of the log.
        notes: List to which descriptions of damage are appended.

    Raises:
        RecordingError: The file cannot be read.
    """
    with open_input(path, RecordingError) as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
        position = 0
        while position < len(content):
            event, end = _event(content, position)
            if event:
                yield event
            else:
                while (end := content.find(_MAGIC, end + 1)) >= 0 and not _event(content, end)[0]:
                    pass
                if end >= 0:
                    notes.append(f"{end - position} damaged bytes skipped, from byte {position}")
                else:
                    end = len(content)
                    notes.append(f"incomplete message skipped at the end of the log ({end - position} bytes)")
            position = end


def is_lcm_log(path: Path) -> bool:
    """Returns whether the file begins like an LCM log; False for a folder."""
    if path.is_dir():
        return False
    with path.open("rb") as file:
        return file.read(len(_MAGIC)) == _MAGIC


def event_bytes(event: LcmEvent) -> bytes:
    """Returns the encoding of an event in a log. A log is a sequence of encoded events, numbered from 0."""
    channel = event.channel.encode()
    return _HEADER.pack(_MAGIC, event.number, event.utime, len(channel), len(event.data)) + channel + event.data


def _event(content: mmap.mmap, start: int) -> tuple[LcmEvent | None, int]:
    """Returns the event that begins at `start`, and its end.

    The result is (None, `start`) if there is no event, or if neither an event nor the end of the file follows.
    """
    channel = start + _HEADER.size
    if channel > len(content):
        return None, start
    magic, number, utime, channel_length, data_length = _HEADER.unpack_from(content, start)
    data = channel + channel_length
    end = data + data_length
    if magic != _MAGIC or not 0 < channel_length <= _MAX_CHANNEL or end > len(content):
        return None, start
    if not _MAGIC.startswith(content[end : end + len(_MAGIC)]):
        return None, start
    # Channels that are not UTF-8 are not used, but must not raise an error.
    return LcmEvent(number, utime, content[channel:data].decode("utf-8", "replace"), content[data:end]), end


_UNREADABLE = f"not an lcmt_dvrk_status of version {MESSAGE_VERSION}"
_FOREIGN = "of another arm or number of joints"
_LATE = f"more than {MAX_LATE:g} s before an earlier one"
_REPEATED = "with the time of another one"
_NOT_FINITE = "with a measurement that is not finite"
_OFF = "with the motors off"


class StatusStream:
    """Processes the messages of a status channel one by one.

    Attributes:
        arm_name: Name of the arm whose statuses are used.
        num_joints: Number of joints that the statuses must have.
        last: Latest status of the arm, including unusable statuses; None before the first status.
        num_lost: Number of statuses missing in the sequence.
        num_late: Number of statuses that arrived after a later one, by up to `MAX_LATE`.
        num_used: Number of used statuses.
        first_utime: Time of the first used status [us], at which t of the recording is 0.
    """

    def __init__(self, arm_name: str, num_joints: int) -> None:
        """Creates a stream for the named arm."""
        self.arm_name, self.num_joints = arm_name, num_joints
        self.last: lcmt_dvrk_status | None = None
        self.num_lost, self.num_late, self.num_used, self.first_utime = 0, 0, 0, 0
        self._recent: deque[int] = deque()
        self._sessions: list[int] = []
        self._omitted: Counter[str] = Counter()

    def accept(self, data: bytes) -> lcmt_dvrk_status | None:
        """Returns the status in a message, or None if it cannot be used as a measurement.

        Raises:
            RecordingError: Two processes send statuses of the arm at the same time.
        """
        status = decode(lcmt_dvrk_status, data)
        reason = _UNREADABLE if status is None else self._examine(status)
        if status is None or reason:
            self._omitted[reason] += 1
            return None
        if not self.num_used:
            self.first_utime = status.utime
        self.num_used += 1
        return status

    def time(self, status: lcmt_dvrk_status) -> float:
        """Returns the time of a used status since the first one [s]."""
        return 1e-6 * (status.utime - self.first_utime)

    def notes(self) -> list[str]:
        """Returns descriptions of omitted and lost statuses, one per line."""
        notes = [f"messages omitted, {reason}: {count}" for reason, count in self._omitted.items()]
        if self.num_lost:
            notes.append(f"messages lost (gaps in the sequence numbers): {self.num_lost}")
        if self.num_late:
            notes.append(f"messages not in order, sorted by their times: {self.num_late}")
        if len(self._sessions) > 1:
            notes.append(f"restarts of {self.arm_name} during the recording: {len(self._sessions) - 1}")
        return notes

    def _examine(self, status: lcmt_dvrk_status) -> str:
        """Returns the reason why a status is not usable, or "" if it is usable. Also counts the lost statuses."""
        if status.arm_name != self.arm_name or status.num_joints != self.num_joints:
            return _FOREIGN
        continues, last = self._follow_session(status.session_id), self.last
        if last is not None and status.utime <= last.utime:
            if last.utime - status.utime > 1e6 * MAX_LATE:
                return _LATE
            if status.utime in self._recent:
                return _REPEATED
            # The gap in the sequence was counted when the later status arrived.
            self.num_lost = max(0, self.num_lost - 1)
            self.num_late += 1
        else:
            if continues and last is not None:
                self.num_lost += max(0, status.sequence - last.sequence - 1)
            self.last = status
            while self._recent and status.utime - self._recent[0] > 1e6 * MAX_LATE:
                self._recent.popleft()
        self._recent.append(status.utime)
        if not all(map(math.isfinite, measurements(status))):
            return _NOT_FINITE
        return _OFF if status.guard_state == lcmt_dvrk_status.STATE_OFF else ""

    def _follow_session(self, session_id: int) -> bool:
        """Returns whether the session is unchanged. Raises RecordingError if an earlier session reappears."""
        if self._sessions and self._sessions[-1] == session_id:
            return True
        if session_id in self._sessions:
            raise RecordingError(
                f"two processes send statuses of {self.arm_name} at the same time (sessions "
                f"{' and '.join(map(str, self._sessions))}). Stop one of them, or use a separate network for each."
            )
        self._sessions.append(session_id)
        return False


def measurements(status: lcmt_dvrk_status) -> tuple[float, ...]:
    """Returns the measured positions, velocities and efforts in one tuple (3n,)."""
    return (*status.position, *status.velocity, *status.effort_measured)


#: Maximum number of channels listed in a message.
_LISTED = 8


def read_status_log(path: Path, options: FileOptions) -> Recording:
    """Reads an LCM log written by lcm-logger or `dvrk-drake record`. Messages of other channels are ignored.

    A message is omitted and counted in `notes` if it cannot be read, is of another arm, has the time of another one,
    contains a number that is not finite, or was sent while the motors were off. Messages that are late by up to
    `MAX_LATE` are sorted and counted.

    Args:
        path: Path of the log.
        options: Arm whose statuses are read; None if the log has statuses of only one arm.

    Raises:
        RecordingError: The file is not an LCM log or has no usable status, the arm has locked joints, or the arm
            is None and the log has statuses of several arms.
    """
    arm = options.arm
    if arm is not None and arm.locked_joints:
        raise RecordingError(f"{path}: an LCM log contains all joints of {arm.name}, so --locked is not accepted")
    channel, stream = (status_channel(arm), StatusStream(arm.name, arm.num_joints)) if arm else _only_stream(path)
    rows, times, events, damage = array("d"), array("d"), array("q"), list[str]()
    channels: Counter[str] = Counter()
    for event in read_events(path, damage):
        channels[event.channel] += 1
        if event.channel != channel:
            continue
        try:
            status = stream.accept(event.data)
        except RecordingError as error:
            raise RecordingError(f"{path}: event {event.number}: {error}") from error
        if status is not None:
            rows.extend(measurements(status))
            times.append(stream.time(status))
            events.append(event.number)
    notes = [*damage, *stream.notes()]
    if not events:
        raise RecordingError(f"{path}: {_no_usable_status(channel, arm, channels, notes)}")
    order = np.argsort(times, kind="stable")
    q, qd, tau = np.array(rows).reshape(len(events), 3, -1).transpose(1, 0, 2)[:, order]
    t, numbers, sha256 = np.array(times)[order], np.array(events)[order], sha256_of(path)
    return Recording(
        *(q, tau, qd, t - t[0], "joint", str(path), numbers, sha256, tuple(notes), "event"),
        times_from="messages",
        file_coordinates="joint",
        arm_name=arm.name if arm else "",
    )


def _only_stream(path: Path) -> tuple[str, StatusStream]:
    """Returns the only channel with statuses, and the stream of the arm of its first readable status."""
    first: dict[str, lcmt_dvrk_status | None] = {}
    for event in read_events(path, []):
        if event.channel.startswith(STATUS_PREFIX) and not first.get(event.channel):
            first[event.channel] = decode(lcmt_dvrk_status, event.data)
    if len(first) > 1:
        raise RecordingError(
            f"{path} has statuses of several arms ({', '.join(sorted(first))}). Select one with --arm (arm= in Python)."
        )
    channel, status = next(iter(first.items()), (STATUS_PREFIX, None))
    return channel, StatusStream(status.arm_name, status.num_joints) if status else StatusStream("", 0)


def _no_usable_status(channel: str, arm: Arm | None, channels: Counter[str], notes: list[str]) -> str:
    if count := channels[channel]:
        reasons = "; ".join(notes) or _UNREADABLE
        return f"none of the {count} messages on channel {channel} is usable: {reasons}"
    listed = [f"{name} ({number})" for name, number in channels.most_common(_LISTED)]
    more = [f"{len(channels) - _LISTED} more"] if len(channels) > _LISTED else []
    has = ", ".join([*listed, *more]) or "none"
    return f"no status of {arm.name if arm else 'any arm'} (channel {channel}). Channels in the log: {has}."
