"""Checks of a command that do not depend on the state of the arm: its content and its position in the stream."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from dvrk_drake.lcmtypes import lcmt_dvrk_command, lcmt_dvrk_status
from dvrk_drake.models.arm_schema import IMPLAUSIBLE
from dvrk_drake.systems.guard.limits import Vector

#: Refusals of messages that do not belong to the session or to the sender in control. They are counted separately.
FOREIGN = frozenset(
    {
        lcmt_dvrk_status.REFUSAL_UNREADABLE,
        lcmt_dvrk_status.REFUSAL_WRONG_ARM,
        lcmt_dvrk_status.REFUSAL_WRONG_SIZE,
        lcmt_dvrk_status.REFUSAL_NO_SENDER,
        lcmt_dvrk_status.REFUSAL_WRONG_SESSION,
        lcmt_dvrk_status.REFUSAL_NOT_AUTHENTIC,
        lcmt_dvrk_status.REFUSAL_OTHER_SENDER,
        lcmt_dvrk_status.REFUSAL_FLOOD,
    }
)

#: Refusals of commands that do not continue their sender's stream, such as copies and replays. They do not interrupt
#: it.
OUT_OF_STREAM = frozenset(
    {
        lcmt_dvrk_status.REFUSAL_STALE,
        lcmt_dvrk_status.REFUSAL_OUT_OF_ORDER,
        lcmt_dvrk_status.REFUSAL_SEQUENCE_JUMP,
        lcmt_dvrk_status.REFUSAL_CLOCK_JUMP,
    }
)


def is_finite(numbers: list[float]) -> bool:
    """Returns whether all numbers are finite and the sum of their magnitudes is below 1e6.

    The argument is a list, because numpy takes longer for a few numbers and warns of an overflow.
    """
    return sum(map(abs, numbers)) < IMPLAUSIBLE


def foreign_refusal(command: lcmt_dvrk_command | None, arm_name: str, num_joints: int, session_id: int) -> int:
    """Returns lcmt_dvrk_status.REFUSAL_* of a command that does not address this arm and session, else REFUSAL_NONE.

    Args:
        command: Received command. None: it was not readable.
        arm_name: Name of the arm that it must address.
        num_joints: Number of joints of that arm.
        session_id: Session of that arm.
    """
    if command is None:
        return lcmt_dvrk_status.REFUSAL_UNREADABLE
    if command.arm_name != arm_name:
        return lcmt_dvrk_status.REFUSAL_WRONG_ARM
    vectors = (command.position, command.velocity, command.effort)
    if command.num_joints != num_joints or any(len(vector) != num_joints for vector in vectors):
        return lcmt_dvrk_status.REFUSAL_WRONG_SIZE
    if command.sender_id == 0:
        return lcmt_dvrk_status.REFUSAL_NO_SENDER
    if command.session_id != session_id:
        return lcmt_dvrk_status.REFUSAL_WRONG_SESSION
    return lcmt_dvrk_status.REFUSAL_NONE


def content_refusal(command: lcmt_dvrk_command) -> int:
    """Returns lcmt_dvrk_status.REFUSAL_* of a command with invalid numbers or flags, else REFUSAL_NONE."""
    if not is_finite([*command.position, *command.velocity, *command.effort]):
        return lcmt_dvrk_status.REFUSAL_NOT_FINITE
    if command.reset_fault and command.control_mode != lcmt_dvrk_command.HOLD:
        return lcmt_dvrk_status.REFUSAL_BAD_RESET
    return lcmt_dvrk_status.REFUSAL_NONE


@dataclass
class GuardCounts:
    """Counts of commands since the guard was created: accepted, missing, refused, ignored, and expired in force."""

    accepted: int = 0
    lost: int = 0
    refused: int = 0
    ignored: int = 0
    expired: int = 0


@dataclass
class CommandInForce:
    """Command in force or being monitored.

    The numbers are copied, so that later changes of the message have no effect.

    Attributes:
        command: The command.
        position: Commanded positions (n,); the other numbers accordingly.
        status_utime: Time of the measurement that it answers [us].
        wall_utime: Time of that measurement on the guard's wall clock, if there is one [us].
        good_since: Time since which its stream has been good [us].
    """

    command: lcmt_dvrk_command = field(default_factory=lcmt_dvrk_command)
    position: Vector = field(default_factory=lambda: np.zeros(0))
    velocity: Vector = field(default_factory=lambda: np.zeros(0))
    effort: Vector = field(default_factory=lambda: np.zeros(0))
    status_utime: int = 0
    wall_utime: int = 0
    good_since: int = 0

    def replace(self, command: lcmt_dvrk_command) -> None:
        """Replaces the command by the next one of the same stream."""
        self.command, self.status_utime = command, command.status_utime
        self.position, self.velocity, self.effort = (
            np.array(numbers, float) for numbers in (command.position, command.velocity, command.effort)
        )


@dataclass
class CommandStream:
    """Stream of the commands of one sender. All times are in us; arrivals are on the arm's clock.

    A sender stays in control while its commands are accepted. A second sender is refused until no command of the first
    one has been accepted for `expiry`. A refused command does not extend the control. Otherwise a process that repeats
    one command could prevent an operator from resuming.

    Sequence and time of a command are compared with those of the last accepted command, unless that is older than
    `expiry`. A refused command changes neither. So a spoofed sequence or time does not end the control of the genuine
    sender. A sender whose own clock or sequence jumped restarts when its last accepted command has expired.

    Attributes:
        expiry: Time after which another sender may replace a silent one. After the same time, sequence and time of the
            last accepted command are no longer compared.
        clock_tolerance: Allowed difference of the advance of the sender's and the arm's clock between two accepted
            commands.
        sequence_jump: Largest difference in sequence between two accepted commands.
        sender_id: Identifier of the sender. 0: none yet.
        lost: Number of commands missing between accepted ones.
    """

    expiry: int
    clock_tolerance: int
    sequence_jump: int
    sender_id: int = 0
    lost: int = 0
    _last: lcmt_dvrk_command | None = None
    _arrival: int = 0
    _can_reset: bool = False
    _can_turn_off: bool = False

    def is_other_sender(self, command: lcmt_dvrk_command, utime: int) -> bool:
        """Returns whether the command comes from another sender than the one in control."""
        return command.sender_id != self.sender_id != 0 and utime - self._arrival <= self.expiry

    def refusal(self, command: lcmt_dvrk_command, utime: int) -> int:
        """Returns REFUSAL_* of a command that does not continue its sender's stream, or REFUSAL_NONE."""
        if self.is_other_sender(command, utime):
            return lcmt_dvrk_status.REFUSAL_OTHER_SENDER
        # The sender is the one in control; its last accepted command must be recent.
        if self._last is not None and utime - self._arrival <= self.expiry:
            step = command.sequence - self._last.sequence
            if step <= 0:
                return lcmt_dvrk_status.REFUSAL_OUT_OF_ORDER
            if step > self.sequence_jump:
                return lcmt_dvrk_status.REFUSAL_SEQUENCE_JUMP
            if self._jumped(command.utime - self._last.utime, utime - self._arrival):
                return lcmt_dvrk_status.REFUSAL_CLOCK_JUMP
        same_sender = command.sender_id == self.sender_id
        if command.control_mode == lcmt_dvrk_command.OFF and not (same_sender and self._can_turn_off):
            return lcmt_dvrk_status.REFUSAL_SUDDEN_OFF
        return lcmt_dvrk_status.REFUSAL_NONE

    def accept(self, command: lcmt_dvrk_command, utime: int) -> bool:
        """Accepts this command. Returns True if it requests a reset: reset_fault changed from false to true."""
        if command.sender_id != self.sender_id:
            self.forget()
            self.sender_id = command.sender_id
        if self._last is not None and utime - self._arrival <= self.expiry:
            self.lost += command.sequence - self._last.sequence - 1
        self._last, self._arrival = command, utime
        resets = command.reset_fault and self._can_reset
        self._can_reset = not command.reset_fault
        self._can_turn_off = command.control_mode in (lcmt_dvrk_command.HOLD, lcmt_dvrk_command.OFF)
        return resets

    def forget(self) -> None:
        """Discards the sender and its last command, for an arm clock that is not reliable."""
        self.sender_id, self._last = 0, None
        self._can_reset = self._can_turn_off = False

    def _jumped(self, advance: int, waited: int) -> bool:
        return advance <= 0 or abs(advance - waited) > self.clock_tolerance
