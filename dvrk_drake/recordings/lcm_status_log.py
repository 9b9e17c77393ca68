"""Status messages of one arm as measurements: as they come, and as an LCM log has them."""

from __future__ import annotations

import math
from array import array
from collections import Counter
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.errors import RecordingError
from dvrk_drake.lcmtypes import lcmt_dvrk_status
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.lcm_messages import STATUS_PREFIX, decode, status_channel
from dvrk_drake.recordings.lcm_log_reader import LcmLogReader

_UNREADABLE = "no lcmt_dvrk_status, or one of another version"
_FOREIGN = "of another arm or number of joints"
_LATE = "not later than the one before"
_NOT_FINITE = "with a measurement that is not finite"
_OFF = "with the motors off, whose efforts hold nothing"


class StatusStream:
    """Takes the messages of a status channel one by one.

    Attributes:
        arm_name: whose statuses count.
        num_joints: how many joints they must have.
        last: the newest status of the arm, whether it can be used or not, or None.
        num_lost: statuses that are missing in the sequence.
        num_taken: statuses that were used.
        first_utime: of the first status that was used [us], the zero of a recording's t.
    """

    def __init__(self, arm_name: str, num_joints: int) -> None:
        """Of that arm."""
        self.arm_name, self.num_joints = arm_name, num_joints
        self.last: lcmt_dvrk_status | None = None
        self.num_lost, self.num_taken, self.first_utime = 0, 0, 0
        self._sessions: list[int] = []
        self._left_out: Counter[str] = Counter()

    def take(self, data: bytes) -> lcmt_dvrk_status | None:
        """The status in a message, or None if it cannot be used as a measurement.

        Raises:
            RecordingError: two arms of this name send at the same time.
        """
        status = decode(lcmt_dvrk_status, data)
        reason = _UNREADABLE if status is None else self._examine(status)
        if status is None or reason:
            self._left_out[reason] += 1
            return None
        if not self.num_taken:
            self.first_utime = status.utime
        self.num_taken += 1
        return status

    def time(self, status: lcmt_dvrk_status) -> float:
        """Of a status that was used, since the first that was [s]."""
        return 1e-6 * (status.utime - self.first_utime)

    def notes(self) -> list[str]:
        """What was left out and lost, a line each."""
        notes = [f"messages left out, {reason}: {count}" for reason, count in self._left_out.items()]
        if self.num_lost:
            notes.append(f"messages lost on the way, missing in the sequence: {self.num_lost}")
        if len(self._sessions) > 1:
            notes.append(f"restarts of {self.arm_name} in between: {len(self._sessions) - 1}")
        return notes

    def _examine(self, status: lcmt_dvrk_status) -> str:
        """Why a status cannot be used, or ""; the sequence is followed through those that cannot."""
        if status.arm_name != self.arm_name or status.num_joints != self.num_joints:
            return _FOREIGN
        continues = self._follow_session(status.session_id)
        if self.last is not None and status.utime <= self.last.utime:
            return _LATE
        if continues and self.last is not None:
            self.num_lost += max(0, status.sequence - self.last.sequence - 1)
        self.last = status
        if not all(map(math.isfinite, measurements(status))):
            return _NOT_FINITE
        return _OFF if status.guard_state == lcmt_dvrk_status.STATE_OFF else ""

    def _follow_session(self, session_id: int) -> bool:
        """Whether this is the session of the message before; a session that comes back was never ended."""
        if self._sessions and self._sessions[-1] == session_id:
            return True
        if session_id in self._sessions:
            raise RecordingError(
                f"two arms called {self.arm_name} send at the same time (sessions "
                f"{' and '.join(map(str, self._sessions))}): end one, or give them networks of their own"
            )
        self._sessions.append(session_id)
        return False


def measurements(status: lcmt_dvrk_status) -> tuple[float, ...]:
    """q, v, tau in one tuple (3n,), as measured."""
    return (*status.position, *status.velocity, *status.effort_measured)


#: Most channels that a message lists.
_LISTED = 8


class StatusLog(NamedTuple):
    """The measurements of one arm, in joint coordinates; SI.

    Attributes:
        t: (m,) the arm's own clock since the first row [s].
        q, qd, tau: (m, n) measured positions, velocities and efforts.
        events: (m,) number of each row's event in the log.
        notes: what is damaged, missing or left out, a line each.
        sha256: of the log's bytes.
    """

    t: NDArray[np.float64]
    q: NDArray[np.float64]
    qd: NDArray[np.float64]
    tau: NDArray[np.float64]
    events: NDArray[np.int_]
    notes: tuple[str, ...]
    sha256: str


def read_status_log(path: str | Path, arm: Arm | None = None) -> StatusLog:
    """Reads an LCM log as lcm-logger or `dvrk-drake record` writes it; other channels in it do not matter.

    Left out and noted are messages that cannot be read or are not of the arm, that are not later than the one before,
    whose numbers are not finite, or that were sent with the motors off.

    Args:
        path: the log.
        arm: whose statuses; None if the log has only one arm's.

    Raises:
        RecordingError: no LCM log, none or (without `arm`) several arms' statuses, or none that can be used.
    """
    log = LcmLogReader(path)
    channel = status_channel(arm) if arm else _only_status_channel(log)
    stream = StatusStream(arm.name, arm.num_joints) if arm else None
    rows, times, events = array("d"), array("d"), array("q")
    channels: Counter[str] = Counter()
    for event in log:
        channels[event.channel] += 1
        if event.channel != channel:
            continue
        if stream is None and (first := decode(lcmt_dvrk_status, event.data)):
            stream = StatusStream(first.arm_name, first.num_joints)
        try:
            status = stream.take(event.data) if stream else None
        except RecordingError as error:
            raise RecordingError(f"{path}: event {event.number}: {error}") from error
        if status is not None and stream is not None:
            rows.extend(measurements(status))
            times.append(stream.time(status))
            events.append(event.number)
    notes = [*log.notes, *(stream.notes() if stream else [])]
    if not events:
        raise RecordingError(f"{path}: {_why_nothing(channel, arm, channels, notes)}")
    q, qd, tau = np.array(rows).reshape(len(events), 3, -1).transpose(1, 0, 2)
    return StatusLog(np.array(times), q, qd, tau, np.array(events), tuple(notes), log.sha256())


def _only_status_channel(log: LcmLogReader) -> str:
    channels = sorted({event.channel for event in log if event.channel.startswith(STATUS_PREFIX)})
    if len(channels) > 1:
        raise RecordingError(f"{log.path}: has statuses of several arms, {', '.join(channels)}: name one")
    return channels[0] if channels else STATUS_PREFIX


def _why_nothing(channel: str, arm: Arm | None, channels: Counter[str], notes: list[str]) -> str:
    if count := channels[channel]:
        reasons = "; ".join(notes) or "no lcmt_dvrk_status, or one of another version"
        return f"none of its {count} messages on channel {channel} can be used: {reasons}"
    listed = [f"{name} ({number})" for name, number in channels.most_common(_LISTED)]
    more = [f"{len(channels) - _LISTED} more"] if len(channels) > _LISTED else []
    has = ", ".join([*listed, *more]) or "nothing that can be read"
    return f"has no status of {arm.name if arm else 'any arm'} (channel {channel}); it has {has}"
