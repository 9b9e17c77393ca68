"""The watchdog between whoever commands an arm and its motors: no Drake, no LCM, for simulated and real arms."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from dvrk_drake.errors import StationError
from dvrk_drake.lcmtypes import lcmt_dvrk_command, lcmt_dvrk_status
from dvrk_drake.systems.guard.command_stream import CommandStream, is_finite, refusal_by_itself
from dvrk_drake.systems.guard.limits import GuardLimits, Vector
from dvrk_drake.systems.guard.output import GuardCounts, GuardOutput
from dvrk_drake.systems.guard.settings import GuardSettings

if TYPE_CHECKING:
    from dvrk_drake.models.arm import Arm

#: No longer time between two steps is made up for in rate limits [s].
_LONGEST_STEP = 0.01

#: By a clock that stands still nothing expires; Drake takes two steps at the time at which it starts.
_MOST_STEPS_AT_ONE_TIME = 10

_PASSIVE = (lcmt_dvrk_command.OFF, lcmt_dvrk_command.HOLD)
_ACTIVE = {
    lcmt_dvrk_command.POSITION: lcmt_dvrk_status.STATE_POSITION,
    lcmt_dvrk_command.EFFORT: lcmt_dvrk_status.STATE_EFFORT,
}


@dataclass
class _Force:
    """The command in force or being watched, when it was accepted, and since when its stream has been good [us].

    The numbers that act are copies, which whoever made the command cannot change any more.
    """

    command: lcmt_dvrk_command = field(default_factory=lcmt_dvrk_command)
    position: Vector = field(default_factory=lambda: np.zeros(0))
    velocity: Vector = field(default_factory=lambda: np.zeros(0))
    effort: Vector = field(default_factory=lambda: np.zeros(0))
    accepted: int = 0
    good_since: int = 0


class CommandGuard:
    """Takes commands as they arrive and says, once a period, what the arm shall do.

    Call `receive` with every command and `step` once a period (1 ms), both with the arm's clock in microseconds, the
    one that its status messages carry. `step` returns what to do; whoever calls it does that and nothing else.

    **States** (lcmt_dvrk_status.STATE_*) and what the arm does in them:

    - OFF: motors without power. Leaves for HOLD on a HOLD command only.
    - HOLD: the arm regulates to a latched pose. The first state. Nobody need command.
    - STARTING: as HOLD, while a sender's POSITION or EFFORT commands are watched.
    - POSITION, EFFORT: the last command acts, inside the limits of GuardLimits.
    - FAULT: as HOLD, or as OFF where the motors were off or the measurement was lost.

    ::

        OFF <--OFF-- any state but FAULT       OFF --HOLD--> HOLD       any --HOLD--> HOLD, but from FAULT
        HOLD --POSITION, EFFORT--> STARTING --good for start_time--> POSITION, EFFORT
        STARTING --refused, none for expiry--> HOLD
        POSITION, EFFORT --HOLD, none for expiry, sender's clock jumped--> HOLD; --the other mode--> STARTING
        any --fault--> FAULT --HOLD with reset_fault, changed from false to true--> HOLD

    **What is refused** (`lcmt_dvrk_status.REFUSAL_*` has the list): what is unreadable, of another arm, size or
    session, not finite, older than `expiry` by the status that it answers, out of order or sent twice, in a mode that
    is not accepted now. It does not act and does not keep an older command alive, so bad commands end in HOLD.

    **Start guard**: before commands act they must have come without a gap of `expiry` and without a refusal for
    `start_time`, all near the present: efforts near the measured ones, positions near the measured ones, also where the
    feed-forward velocity leads; for efforts the pose must not be beyond a limit by half the margin, nor the
    present effort beyond what commands may use. A sender that starts with something else is refused, so a restarted or
    confused controller moves nothing.

    **Faults** are latched: two senders at once, a pose beyond a limit (by half the margin) while efforts
    act, a measurement that is not finite, the arm's clock going backwards or standing still, and what a driver reports.
    The reset must be meant: the flag must change from false to true in a HOLD command, and a cause that lasts faults
    again.

    **Without a bump**: HOLD keeps the target that was regulated to, after POSITION only while the arm is near it, and
    else latches the measured pose; POSITION starts from the held pose; EFFORT starts from the measured effort, and the
    soft wall, for whoever starts inside it, comes on in `start_time`; each at its limited rate.

    **Clocks**: the sender's and the arm's are never compared, only how far each went between two commands; so they need
    not be synchronised, and a jump of either is seen. A jump of the arm's clock forward expires what is in force.
    """

    def __init__(
        self, arm: Arm, session_id: int, settings: GuardSettings | None = None, modes: tuple[int, ...] | None = None
    ):
        """A guard in HOLD.

        Args:
            arm: whose limits are kept.
            session_id: not 0; drawn anew whenever the arm starts.
            settings: the defaults of GuardSettings if None.
            modes: which of POSITION and EFFORT are accepted; both if None.

        Raises:
            StationError: no session, or settings or an arm's gains that guard nothing.
        """
        if session_id == 0:
            raise StationError("session_id must not be 0, which a command has that was never filled in")
        self.settings = settings or GuardSettings()
        self.settings.check()
        self.limits = GuardLimits(arm, self.settings)
        self.arm_name, self.num_joints, self.session_id = arm.name, arm.num_joints, session_id
        self.state = lcmt_dvrk_status.STATE_HOLD
        self.fault_code, self.fault_text = lcmt_dvrk_status.FAULT_NONE, ""
        self.refusal_code = lcmt_dvrk_status.REFUSAL_NONE
        self.counts = GuardCounts()
        self._modes = tuple(_ACTIVE) if modes is None else modes
        self._expiry = round(1e6 * self.settings.expiry)
        self._stream = CommandStream(self._expiry, round(1e6 * self.settings.clock_tolerance))
        self._force = _Force()
        self._utime: int | None = None
        self._steps_at_one_time = 0
        self._powered = True
        self._q: Vector | None = None
        self._v = self._effort = np.zeros(self.num_joints)
        self._target = self._last_effort = np.zeros(self.num_joints)
        # What the walls add at once where efforts begin to act; it is taken back, less and less.
        self._kick = np.zeros(self.num_joints)
        self.output = self._output(0.0)

    def __deepcopy__(self, memo: object) -> CommandGuard:
        # A Drake context copies its state before every update, so this must be quick. No array is changed in place.
        other = object.__new__(CommandGuard)
        other.__dict__.update(self.__dict__)
        for name in ("counts", "_stream", "_force"):
            part = getattr(self, name)
            twin = object.__new__(type(part))
            twin.__dict__.update(part.__dict__)
            setattr(other, name, twin)
        return other

    @property
    def accepted_modes(self) -> int:
        """Bit 1 << mode for each mode that a command may have now."""
        if self.state == lcmt_dvrk_status.STATE_FAULT:
            return 1 << lcmt_dvrk_command.HOLD
        modes = _PASSIVE if self.state == lcmt_dvrk_status.STATE_OFF else (*_PASSIVE, *self._modes)
        return sum(1 << mode for mode in modes)

    @property
    def sender_id(self) -> int:
        """Whose commands are in force or being watched; 0: nobody's."""
        return self._stream.sender_id if self._is_watched_or_in_force() else 0

    @property
    def last_command(self) -> lcmt_dvrk_command:
        """The last accepted command."""
        return self._force.command

    def receive(self, command: lcmt_dvrk_command | None, utime: int) -> int:
        """Takes one command, or None for a message that was none, that arrived at `utime` [us].

        Returns:
            lcmt_dvrk_status.REFUSAL_NONE, or why it was refused.
        """
        self._expire(utime)
        code = refusal_by_itself(command, self.arm_name, self.num_joints, self.session_id)
        if command is not None and code == lcmt_dvrk_status.REFUSAL_NONE:
            code = self._refusal_now(command, utime)
        if command is not None and code == lcmt_dvrk_status.REFUSAL_NONE:
            self._accept(command, utime)
            return code
        self.counts.refused += 1
        self.refusal_code = code
        if (
            command is not None
            and command.sender_id == self.sender_id
            and self.state == lcmt_dvrk_status.STATE_STARTING
        ):
            self._hold()
        return code

    def step(self, utime: int, q: ArrayLike, v: ArrayLike, effort: ArrayLike) -> GuardOutput:
        """What to do from `utime` [us] on, given the measured q, v and effort (n,) [rad, rad/s, N m; m, m/s, N]."""
        dt = 0.0 if self._utime is None else 1e-6 * (utime - self._utime)
        if dt < 0:
            self._stream.forget()
            self._force = _Force(accepted=utime)
            self.report_fault(f"the arm's clock went back by {-dt:.6f} s", lcmt_dvrk_status.FAULT_CLOCK)
        self._steps_at_one_time = 0 if dt else self._steps_at_one_time + 1
        if self._steps_at_one_time > _MOST_STEPS_AT_ONE_TIME:
            self.report_fault("the arm's clock stands still", lcmt_dvrk_status.FAULT_CLOCK)
        self._utime = utime
        self._measure(np.array(q, float), np.array(v, float), np.array(effort, float))
        self._expire(utime)
        if self.state == lcmt_dvrk_status.STATE_EFFORT and (excess := self.limits.beyond(self._measured_q())):
            self.report_fault(excess, lcmt_dvrk_status.FAULT_POSITION_LIMIT)
        self.output = self._output(min(max(dt, 0.0), _LONGEST_STEP))
        return self.output

    def report_fault(self, text: str, code: int = lcmt_dvrk_status.FAULT_DRIVER, *, has_power: bool = True) -> None:
        """Latches a fault, for drivers whose arm reports one: before each `step`, as long as it lasts.

        Args:
            text: what it is, with its numbers; the first one stays until it is reset.
            code: lcmt_dvrk_status.FAULT_*.
            has_power: False if the motors cannot hold the arm. It is as OFF then, and a reset holds it where it is
                found, not where it was.
        """
        if self.state != lcmt_dvrk_status.STATE_FAULT:
            powered = self._powered
            self._hold()
            self.state, self._powered = lcmt_dvrk_status.STATE_FAULT, powered
            self.fault_code, self.fault_text = code, text
        self._powered &= has_power

    def _is_watched_or_in_force(self) -> bool:
        return self.state in (lcmt_dvrk_status.STATE_STARTING, *_ACTIVE.values())

    def _measured_q(self) -> Vector:
        return self._target if self._q is None else self._q

    def _measure(self, q: Vector, v: Vector, effort: Vector) -> None:
        shape = (self.num_joints,)
        if not (q.shape == v.shape == effort.shape == shape and is_finite(q, v, effort)):
            text = f"the measured positions, velocities or efforts are not {self.num_joints} finite numbers each"
            self.report_fault(text, lcmt_dvrk_status.FAULT_MEASUREMENT, has_power=False)
            self._q = None
            return
        if self._q is None:
            self._target = q.copy()
        self._q, self._v, self._effort = q, v, effort

    def _expire(self, utime: int) -> None:
        if self._is_watched_or_in_force() and utime - self._force.accepted > self._expiry:
            self.counts.expired += self.state != lcmt_dvrk_status.STATE_STARTING
            self._hold()

    def _refusal_now(self, command: lcmt_dvrk_command, utime: int) -> int:
        """REFUSAL_* of a command that is good by itself, given who sent what before and what the arm is doing."""
        if self._utime is None or not 0 <= utime - command.status_utime <= self._expiry:
            return lcmt_dvrk_status.REFUSAL_STALE
        before, code = self._stream.sender_id, self._stream.refusal(command, utime)
        if code == lcmt_dvrk_status.REFUSAL_OTHER_SENDER:
            both = f"senders {before} and {command.sender_id} command at the same time"
            self.report_fault(both, lcmt_dvrk_status.FAULT_DUPLICATE_SENDER)
        elif code == lcmt_dvrk_status.REFUSAL_CLOCK_JUMP and self._is_watched_or_in_force():
            self._hold()
        if code != lcmt_dvrk_status.REFUSAL_NONE:
            return code
        if self.state == lcmt_dvrk_status.STATE_FAULT and command.control_mode != lcmt_dvrk_command.HOLD:
            return lcmt_dvrk_status.REFUSAL_FAULT
        if command.control_mode < 0 or not self.accepted_modes >> command.control_mode & 1:
            return lcmt_dvrk_status.REFUSAL_BAD_MODE
        if command.control_mode in _ACTIVE and self.state != _ACTIVE[command.control_mode]:
            return self.limits.refusal_to_start(command, self._measured_q(), self._effort)
        return lcmt_dvrk_status.REFUSAL_NONE

    def _accept(self, command: lcmt_dvrk_command, utime: int) -> None:
        self.counts.accepted += 1
        resets = self._stream.accept(command, utime)
        self.counts.lost = self._stream.lost
        mode, force = command.control_mode, self._force
        goes_on = self.state == lcmt_dvrk_status.STATE_STARTING and mode == force.command.control_mode
        force.command, force.accepted = command, utime
        force.position, force.velocity, force.effort = (
            np.array(numbers, float) for numbers in (command.position, command.velocity, command.effort)
        )
        if mode == lcmt_dvrk_command.OFF:
            self.state, self._powered = lcmt_dvrk_status.STATE_OFF, False
        elif mode == lcmt_dvrk_command.HOLD:
            if resets:
                self.fault_code, self.fault_text = lcmt_dvrk_status.FAULT_NONE, ""
            if self.fault_code == lcmt_dvrk_status.FAULT_NONE:
                self._hold()
        elif self.state == _ACTIVE[mode]:
            return
        elif not goes_on:
            self._hold()
            self.state, force.good_since = lcmt_dvrk_status.STATE_STARTING, utime
        elif utime - force.good_since >= 1e6 * self.settings.start_time:
            limits = self.limits
            self._last_effort = np.clip(self._effort, -limits.command_limits, limits.command_limits)
            restrained, _ = limits.restrain_effort(self._last_effort, self._measured_q(), self._v)
            self._kick = restrained - self._last_effort
            self.state = _ACTIVE[mode]

    def _hold(self) -> None:
        """To HOLD, at the pose that is held already or else at the measured one."""
        q = self._measured_q()
        regulated = (
            self.state in (lcmt_dvrk_status.STATE_HOLD, lcmt_dvrk_status.STATE_STARTING, lcmt_dvrk_status.STATE_FAULT)
            and self._powered
        )
        near = bool(np.all(np.abs(self._target - q) <= self.limits.start_position))
        if not (regulated or (self.state == lcmt_dvrk_status.STATE_POSITION and near)):
            self._target = q.copy()
        self.state, self._powered = lcmt_dvrk_status.STATE_HOLD, True

    def _output(self, dt: float) -> GuardOutput:
        n, limits, force = self.num_joints, self.limits, self._force
        velocity, effort, flags = np.zeros(n), np.zeros(n), np.zeros(n, np.int8)
        q = self._measured_q()
        if not self._powered:
            return GuardOutput(lcmt_dvrk_command.OFF, q.copy(), velocity, effort, flags)
        if self.state == lcmt_dvrk_status.STATE_POSITION:
            self._target, flags = limits.limit_position(force.position, self._target, dt)
            velocity = limits.limit_velocity(force.velocity, self._target, flags)
            return GuardOutput(lcmt_dvrk_command.POSITION, self._target.copy(), velocity, effort, flags)
        if self.state == lcmt_dvrk_status.STATE_EFFORT and self._utime is not None:
            self._last_effort, flags = limits.follow_effort(force.effort, self._last_effort, dt)
            effort, restrained = limits.restrain_effort(self._last_effort, q, self._v)
            acted_for = 1e-6 * (self._utime - force.good_since) - self.settings.start_time
            kick = self._kick * min(max(1.0 - acted_for / self.settings.start_time, 0.0), 1.0)
            effort = np.clip(effort - kick, -limits.effort_limits, limits.effort_limits)
            return GuardOutput(lcmt_dvrk_command.EFFORT, q.copy(), velocity, effort, flags | restrained)
        return GuardOutput(lcmt_dvrk_command.HOLD, self._target.copy(), velocity, effort, flags)
