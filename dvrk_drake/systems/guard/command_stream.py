"""Checks of a command that do not depend on the state of the arm: content, place in the sender's stream, and age."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from dvrk_drake.lcmtypes import lcmt_dvrk_command, lcmt_dvrk_status
from dvrk_drake.systems.guard.limits import Part, Vector, is_finite

#: Refusal reasons for messages that do not belong to the session or to the sender in control. The guard counts these
#: messages as ignored, not as refused.
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

#: Refusal reasons for commands that do not continue the sender's stream, such as copies and replays. Such commands
#: do not end the state STARTING.
OUT_OF_STREAM = frozenset(
    {
        lcmt_dvrk_status.REFUSAL_STALE,
        lcmt_dvrk_status.REFUSAL_OUT_OF_ORDER,
        lcmt_dvrk_status.REFUSAL_SEQUENCE_JUMP,
        lcmt_dvrk_status.REFUSAL_CLOCK_JUMP,
    }
)


def foreign_refusal(command: lcmt_dvrk_command | None, arm_name: str, num_joints: int, session_id: int) -> int:
    """Checks that a command is addressed to this arm and session.

    Args:
        command: Received command, or None if the message was unreadable.
        arm_name: Name of the arm.
        num_joints: Number of joints of the arm.
        session_id: Identifier of the arm's session.

    Returns:
        Reason of the refusal, lcmt_dvrk_status.REFUSAL_*, or REFUSAL_NONE.
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
    """Returns lcmt_dvrk_status.REFUSAL_* for a command with invalid numbers or flags, otherwise REFUSAL_NONE."""
    if not is_finite([*command.position, *command.velocity, *command.effort]):
        return lcmt_dvrk_status.REFUSAL_NOT_FINITE
    if command.reset_fault and command.control_mode != lcmt_dvrk_command.HOLD:
        return lcmt_dvrk_status.REFUSAL_BAD_RESET
    return lcmt_dvrk_status.REFUSAL_NONE


@dataclass
class GuardCounts(Part):
    """Counts of commands since the guard was created.

    Attributes:
        accepted: Number of accepted commands.
        lost: Number of commands that are missing in the sequence of accepted commands.
        refused: Number of refused commands.
        ignored: Number of ignored messages.
        expired: Number of commands in force that expired.
    """

    accepted: int = 0
    lost: int = 0
    refused: int = 0
    ignored: int = 0
    expired: int = 0


@dataclass
class CommandInForce(Part):
    """Command that is in force or is monitored during the start check.

    The numbers are copied, so that later changes of the message have no effect.

    Attributes:
        command: Message of the command.
        position: Commanded positions (n,) [rad, m].
        velocity: Commanded velocities (n,) [rad/s, m/s].
        effort: Commanded efforts (n,) [N m, N].
        status_utime: Time of the measurement from which the command was computed [us].
        wall_utime: Wall-clock time of that measurement [us]; 0 without a wall clock.
        accepted_since: Time at which the start check of this stream began [us].
    """

    command: lcmt_dvrk_command = field(default_factory=lcmt_dvrk_command)
    position: Vector = field(default_factory=lambda: np.zeros(0))
    velocity: Vector = field(default_factory=lambda: np.zeros(0))
    effort: Vector = field(default_factory=lambda: np.zeros(0))
    status_utime: int = 0
    wall_utime: int = 0
    accepted_since: int = 0

    def replace(self, command: lcmt_dvrk_command) -> None:
        """Replaces the command by the next command of the same stream."""
        self.command, self.status_utime = command, command.status_utime
        self.position, self.velocity, self.effort = (
            np.array(numbers, float) for numbers in (command.position, command.velocity, command.effort)
        )


@dataclass
class CommandStream(Part):
    """Stream of the commands of one sender. All times are in us. Times of arrival refer to the arm's clock.

    A sender is in control while its commands are accepted. Commands of a second sender are ignored until `expiry` has
    elapsed since the last accepted command of the first sender. Refused commands of the first sender do not extend this
    time. Otherwise, a process that repeats one command could prevent an operator from resuming.

    The sequence and time of a command are compared with the sequence and time of the last accepted command, unless that
    command arrived more than `expiry` ago. Refused commands are not used for this comparison. A forged sequence or time
    in a refused command therefore does not end the control of the authentic sender. After a jump of a sender's clock or
    sequence, the commands of this sender are accepted again when `expiry` has elapsed since the last accepted command.

    Attributes:
        expiry: Time since the last accepted command, after which another sender is accepted. After this time, a new
            command is also no longer compared with the last accepted command.
        clock_tolerance: Allowed difference between the times that elapse on the sender's clock and on the arm's clock
            from one accepted command to the next.
        sequence_jump: Largest difference in sequence between two accepted commands.
        sender_id: Identifier of the sender, or 0 if there is no sender yet.
        lost: Number of commands missing in the sequence of accepted commands.
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
        """Returns whether the command comes from another sender while a sender is in control."""
        return command.sender_id != self.sender_id != 0 and utime - self._arrival <= self.expiry

    def refusal(self, command: lcmt_dvrk_command, utime: int) -> int:
        """Returns REFUSAL_* for a command that does not continue the sender's stream, otherwise REFUSAL_NONE."""
        if self.is_other_sender(command, utime):
            return lcmt_dvrk_status.REFUSAL_OTHER_SENDER
        # A command is compared only with a recent command, which then has the same sender.
        if self._last is not None and utime - self._arrival <= self.expiry:
            step = command.sequence - self._last.sequence
            if step <= 0:
                return lcmt_dvrk_status.REFUSAL_OUT_OF_ORDER
            if step > self.sequence_jump:
                return lcmt_dvrk_status.REFUSAL_SEQUENCE_JUMP
            advance = command.utime - self._last.utime
            if advance <= 0 or abs(advance - (utime - self._arrival)) > self.clock_tolerance:
                return lcmt_dvrk_status.REFUSAL_CLOCK_JUMP
        same_sender = command.sender_id == self.sender_id
        if command.control_mode == lcmt_dvrk_command.OFF and not (same_sender and self._can_turn_off):
            return lcmt_dvrk_status.REFUSAL_SUDDEN_OFF
        return lcmt_dvrk_status.REFUSAL_NONE

    def accept(self, command: lcmt_dvrk_command, utime: int) -> bool:
        """Accepts a command. Returns True if the command requests a reset: reset_fault changed from false to true."""
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
        """Discards the sender and its last command, because the arm's clock went back or there is a new sender."""
        self.sender_id, self._last = 0, None
        self._can_reset = self._can_turn_off = False


#: Largest number of recorded times: measurements at 2 kHz during the longest allowed expiry of 1 s.
_MAX_MEASUREMENTS = 2000


class WallClock:
    """Record of the wall-clock times of measurements.

    The wall clock continues while the process or the arm's clock is stopped. All copies of a guard share one record,
    because the recorded times do not depend on the state of a copy.
    """

    def __init__(self, clock: Callable[[], int]) -> None:
        """Creates an empty record.

        Args:
            clock: Function that returns a monotonic time [us].
        """
        self.now = clock
        self._times: OrderedDict[int, int] = OrderedDict()

    def note(self, measured_utime: int, age: int) -> None:
        """Records the wall-clock time of a measurement, unless the time of this measurement is already recorded.

        Args:
            measured_utime: Time of the measurement on the arm's clock [us].
            age: Age of the measurement by the arm's clock [us].
        """
        self._times.setdefault(measured_utime, self.now() - age)
        if len(self._times) > _MAX_MEASUREMENTS:
            self._times.popitem(last=False)

    def time_of(self, measured_utime: int, age: int) -> int:
        """Returns the wall-clock time of a measurement [us].

        Args:
            measured_utime: Time of the measurement on the arm's clock [us].
            age: Age of the measurement by the arm's clock [us], used if the measurement was not recorded.
        """
        time = self._times.get(measured_utime)
        return self.now() - age if time is None else time

    def forget(self) -> None:
        """Discards all recorded times. The guard calls this method after the arm's clock went back."""
        self._times.clear()


class CommandExpiry:
    """Age limit of commands. The age of a command is the age of the measurement from which it was computed.

    The age is determined by the arm's clock and, if there is a wall clock, also by the wall clock. The larger of these
    ages counts. A command therefore also expires while the arm's clock is late or stopped. All copies of a guard share
    one object of this class.
    """

    def __init__(self, expiry: int, wall_clock: Callable[[], int] | None) -> None:
        """Creates the age limit.

        Args:
            expiry: Age at which a command expires [us].
            wall_clock: Function that returns a monotonic time [us]. None: only the arm's clock is used.
        """
        self.expiry = expiry
        self.wall = None if wall_clock is None else WallClock(wall_clock)

    def wall_time(self, measured_utime: int, age: int) -> int:
        """Returns the wall-clock time of a measurement [us], or 0 without a wall clock; see `WallClock.time_of`."""
        return 0 if self.wall is None else self.wall.time_of(measured_utime, age)

    def fault(self, age: int, wall_utime: int) -> str:
        """Returns the reason why a command has expired, or "" if it has not expired.

        Args:
            age: Age of the measurement from which the command was computed, by the arm's clock [us].
            wall_utime: Wall-clock time of that measurement [us]; see `wall_time`.
        """
        larger = self.age(age, wall_utime)
        if larger <= self.expiry:
            return ""
        clock = "the wall clock" if larger > age else "the arm's clock"
        allowed = f"{1e-3 * self.expiry:g} ms are allowed"
        return f"the last command expired: it is {1e-3 * larger:.1f} ms old by {clock}; {allowed}"

    def age(self, age: int, wall_utime: int) -> int:
        """Returns the age of a command by the clock that gives the larger age [us]; see `fault` for the arguments."""
        return age if self.wall is None else max(age, self.wall.now() - wall_utime)
