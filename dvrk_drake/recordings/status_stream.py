"""What the status messages of one arm say as measurements: which can be used, and how many of the others there were."""

from __future__ import annotations

import math
from collections import Counter

from dvrk_drake.errors import RecordingError
from dvrk_drake.lcmtypes import lcmt_dvrk_status
from dvrk_drake.models.lcm_messages import decode

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
