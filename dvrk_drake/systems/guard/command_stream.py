"""What can be said against a command whatever the arm is doing: by itself, and after its sender's others."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from dvrk_drake.lcmtypes import lcmt_dvrk_command, lcmt_dvrk_status
from dvrk_drake.systems.guard.limits import Vector

#: No joint is there, that fast or that strong [rad, m, rad/s, m/s, N m, N].
ABSURD = 1e6

#: The longest expiry, 1 s, has so many measurements at 2 kHz.
_MOST_MEASUREMENTS = 2000

#: Commands are counted in an int64 of the status; nobody loses as many, but a sequence may jump by more.
_MOST_LOST = 2**63 - 1


def is_finite(*arrays: Any) -> bool:
    """Whether all numbers are finite and none is beyond 1e6."""
    return bool((np.abs(np.concatenate(arrays)) < ABSURD).all())


def refusal_by_itself(command: lcmt_dvrk_command | None, arm_name: str, num_joints: int, session_id: int) -> int:
    """lcmt_dvrk_status.REFUSAL_* of a command that is wrong whatever the arm is doing, else REFUSAL_NONE.

    Args:
        command: as received; None: it was not readable.
        arm_name: of the arm that it must be meant for.
        num_joints: of that arm.
        session_id: of that arm.
    """
    if command is None:
        return lcmt_dvrk_status.REFUSAL_UNREADABLE
    if command.arm_name != arm_name:
        return lcmt_dvrk_status.REFUSAL_WRONG_ARM
    vectors = (command.position, command.velocity, command.effort)
    if command.num_joints != num_joints or any(len(vector) != num_joints for vector in vectors):
        return lcmt_dvrk_status.REFUSAL_WRONG_SIZE
    if not is_finite(*vectors):
        return lcmt_dvrk_status.REFUSAL_NOT_FINITE
    if command.sender_id == 0:
        return lcmt_dvrk_status.REFUSAL_NO_SENDER
    if command.session_id != session_id:
        return lcmt_dvrk_status.REFUSAL_WRONG_SESSION
    if command.reset_fault and command.control_mode != lcmt_dvrk_command.HOLD:
        return lcmt_dvrk_status.REFUSAL_BAD_RESET
    return lcmt_dvrk_status.REFUSAL_NONE


@dataclass
class GuardCounts:
    """Commands since the guard was made: taken, missing, refused; and how often one in force expired."""

    accepted: int = 0
    lost: int = 0
    refused: int = 0
    expired: int = 0


class WallClock:
    """Time of measurements by a clock that goes on while the process and with it the arm's clock stands still.

    Copies of a guard share it: it notes what happened outside of them.
    """

    def __init__(self, clock: Callable[[], int]) -> None:
        """By `clock`, monotonic [us]."""
        self.now = clock
        self._times: OrderedDict[int, int] = OrderedDict()

    def note(self, measured_utime: int, age: int) -> None:
        """Notes a measurement of `measured_utime` on the arm's clock, which is `age` old by it [us]."""
        self._times.setdefault(measured_utime, self.now() - age)
        if len(self._times) > _MOST_MEASUREMENTS:
            self._times.popitem(last=False)

    def time_of(self, measured_utime: int, age: int) -> int:
        """Time of a measurement [us]; for one that was not noted, `age` by the arm's clock before now [us]."""
        time = self._times.get(measured_utime)
        return self.now() - age if time is None else time

    def forget(self) -> None:
        """Forgets all measurements, for when the arm's clock went back."""
        self._times.clear()


@dataclass
class CommandInForce:
    """The command in force or being watched.

    The numbers that act are copies, which whoever made the command cannot change any more.

    Attributes:
        command: itself.
        position: (n,) and so on, its numbers.
        status_utime: of the measurement that it answers [us].
        wall_utime: time of that measurement by the guard's wall clock, if it has one [us].
        good_since: since when its stream has been good [us].
    """

    command: lcmt_dvrk_command = field(default_factory=lcmt_dvrk_command)
    position: Vector = field(default_factory=lambda: np.zeros(0))
    velocity: Vector = field(default_factory=lambda: np.zeros(0))
    effort: Vector = field(default_factory=lambda: np.zeros(0))
    status_utime: int = 0
    wall_utime: int = 0
    good_since: int = 0

    def take(self, command: lcmt_dvrk_command) -> None:
        """Goes on to this command of the same stream."""
        self.command, self.status_utime = command, command.status_utime
        self.position, self.velocity, self.effort = (
            np.array(numbers, float) for numbers in (command.position, command.velocity, command.effort)
        )


@dataclass
class CommandStream:
    """The commands of whoever was heard last. All times in us, arrivals on the arm's clock.

    A sender keeps its place as long as it is heard, with good commands or refused ones; another one that comes in
    within `expiry` of it is the second of two at once.

    Attributes:
        expiry: after which a sender that is silent may be followed by another.
        clock_tolerance: by how much the sender's clock and the arm's may differ from one accepted command to the next.
        sender_id: of who was heard last; 0: nobody yet.
        lost: commands missing between accepted ones.
    """

    expiry: int
    clock_tolerance: int
    sender_id: int = 0
    lost: int = 0
    _heard: int = 0
    _last: lcmt_dvrk_command | None = None
    _arrival: int = 0
    _can_reset: bool = False
    _can_turn_off: bool = False

    def refusal(self, command: lcmt_dvrk_command, utime: int) -> int:
        """Of a command good by itself: REFUSAL_OTHER_SENDER, _OUT_OF_ORDER, _CLOCK_JUMP, _SUDDEN_OFF or _NONE."""
        if command.sender_id != self.sender_id:
            if self.sender_id != 0 and utime - self._heard <= self.expiry:
                return lcmt_dvrk_status.REFUSAL_OTHER_SENDER
            self.forget()
            self.sender_id = command.sender_id
        self._heard = utime
        if self._last is not None and command.sequence <= self._last.sequence:
            return lcmt_dvrk_status.REFUSAL_OUT_OF_ORDER
        if self._last is not None and self._jumped(command.utime - self._last.utime, utime - self._arrival):
            # What follows is compared with the clock as it is now.
            self._last, self._arrival = command, utime
            return lcmt_dvrk_status.REFUSAL_CLOCK_JUMP
        if command.control_mode == lcmt_dvrk_command.OFF and not self._can_turn_off:
            return lcmt_dvrk_status.REFUSAL_SUDDEN_OFF
        return lcmt_dvrk_status.REFUSAL_NONE

    def accept(self, command: lcmt_dvrk_command, utime: int) -> bool:
        """Goes on to this command; True if it asks for a reset: reset_fault changed from false to true."""
        if self._last is not None:
            self.lost = min(self.lost + command.sequence - self._last.sequence - 1, _MOST_LOST)
        self._last, self._arrival = command, utime
        resets = command.reset_fault and self._can_reset
        self._can_reset = not command.reset_fault
        self._can_turn_off = command.control_mode in (lcmt_dvrk_command.HOLD, lcmt_dvrk_command.OFF)
        return resets

    def forget(self) -> None:
        """Forgets who was heard, for when the arm's own clock cannot be trusted."""
        self.sender_id, self._last = 0, None
        self._can_reset = self._can_turn_off = False

    def _jumped(self, advance: int, waited: int) -> bool:
        return advance <= 0 or abs(advance - waited) > self.clock_tolerance
