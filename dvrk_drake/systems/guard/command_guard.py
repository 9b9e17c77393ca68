"""The watchdog between whoever commands an arm and its motors: no Drake, no LCM, for simulated and real arms."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from dvrk_drake.errors import StationError
from dvrk_drake.lcmtypes import lcmt_dvrk_command, lcmt_dvrk_status
from dvrk_drake.models.lcm_messages import describe_refusal
from dvrk_drake.systems.guard.command_expiry import CommandExpiry
from dvrk_drake.systems.guard.command_stream import (
    FOREIGN,
    OUT_OF_STREAM,
    CommandInForce,
    CommandStream,
    GuardCounts,
    content_refusal,
    foreign_refusal,
)
from dvrk_drake.systems.guard.follower import Follower, GuardOutput
from dvrk_drake.systems.guard.limits import GuardLimits, Vector
from dvrk_drake.systems.guard.measurement import Measurement
from dvrk_drake.systems.guard.monitors import OscillationMonitor, PeriodMonitor
from dvrk_drake.systems.guard.plausibility import ArmModel, Plausibility
from dvrk_drake.systems.guard.settings import GuardSettings

if TYPE_CHECKING:
    from dvrk_drake.models.arm import Arm

#: No longer time between two steps is made up for in rate limits [s].
_MAX_STEP = 0.01

#: After a longer time without a measurement, the next one is not compared with it [s]: somebody may have moved the arm.
_MAX_GAP = 0.1

#: States in which a position controller leads the arm to a target.
_REGULATED = (lcmt_dvrk_status.STATE_HOLD, lcmt_dvrk_status.STATE_STARTING, lcmt_dvrk_status.STATE_POSITION)

_ACTIVE = {
    lcmt_dvrk_command.POSITION: lcmt_dvrk_status.STATE_POSITION,
    lcmt_dvrk_command.EFFORT: lcmt_dvrk_status.STATE_EFFORT,
}


class CommandGuard:
    """Takes commands as they arrive and says, once a period, what the arm shall do.

    Call `receive` with every command and `step` once a period (1 ms), both with the arm's clock in microseconds, the
    one that its status messages carry. `step` returns what to do; whoever calls it does that and nothing else.

    **States** (lcmt_dvrk_status.STATE_*) and what the arm does in them:

    - OFF: motors without power. Leaves for HOLD on a HOLD command only.
    - HOLD: the arm regulates to a latched pose. The first state. Nobody need command.
    - STARTING: as HOLD, while a sender's POSITION or EFFORT commands are watched.
    - POSITION, EFFORT: the last command acts, inside the limits of GuardLimits.
    - FAULT: as HOLD. After a fault of a measurement, efforts hold the joints with a valid position, and the others have
      the gravity effort of their last valid pose. As OFF where the motors had no power.

    ::

        HOLD --OFF after a HOLD--> OFF --HOLD--> HOLD       any --HOLD--> HOLD, but from FAULT
        HOLD --POSITION, EFFORT--> STARTING --good for start_time--> POSITION, EFFORT
        STARTING --refused, expired, bad measurement, stepped too seldom--> HOLD
        POSITION, EFFORT --HOLD--> HOLD; --expired, bad measurement, stepped too seldom--> HOLD until a resume
        POSITION, EFFORT --the other mode--> STARTING
        any --fault--> FAULT --HOLD with reset_fault, changed from false to true--> HOLD

    **Expiry**: a command is obeyed until `expiry` after the measurement that it answers (its `status_utime`), whenever
    it came; who answers one measurement again and again gains no time. Then the arm holds. See `CommandExpiry`.

    **Measurements** are checked: numbers, age, and plausibility (`Plausibility`). One that is not finite or too old
    ends commands; while the arm holds, some in a row are tolerated, and more are a fault. One that is
    not compared with an earlier one (the first one, and after a gap, OFF or a reset) must not be far beyond a limit.

    **Period**: a guard that is not stepped for `longest_period`, or with a median period above `slow_period`, accepts
    no POSITION and EFFORT: what it limits would come too late.

    **Resume**: when a command in force ended for one of these reasons, the watchdog took over. The guard then refuses
    POSITION and EFFORT until an operator resumes, in the way in which a fault is reset; `hold_reason` is why. It is no
    fault: the arm holds, and OFF is allowed. A HOLD command before the silence, and STARTING that ends, need no resume.
    `GuardSettings.resume_automatically` switches this off; the next sender is then watched as the first was.

    **What is refused** (`lcmt_dvrk_status.REFUSAL_*` has the list): commands that are not finite, expired when they
    come, out of order or sent twice, after a jump of the sender's sequence or clock, in a mode that is not accepted
    now. They do not act and do not keep an older command alive, so a stream of bad commands ends in HOLD.

    **What is ignored**: messages that are unreadable, not authentic, of another arm, size or session, or of a second
    sender while the first one still sends. They are counted separately and change nothing: the first sender stays in
    command. Without a key, a sender is only as good as its sender_id, which anybody on the network can copy.

    **OFF** drops an arm without brakes, so it must be in `modes`, and no single message does it: the arm must hold, and
    the sender's last command must have been HOLD. A fault refuses it: the cause is unknown, so the arm stays held until
    an operator resets the fault. In an emergency, press the stop button.

    **Start guard**: before commands act they must have come without a gap of `expiry` and without a refusal for
    `start_time`, all near the present: efforts near the measured ones, positions near the measured ones, also where the
    feed-forward velocity leads; for efforts the pose must not be beyond a limit by half the margin, the present effort
    not beyond what commands may use, and near the model's gravity effort. A sender that starts with something else is
    refused, so a restarted or confused controller moves nothing.

    **Faults** are latched: measurements that are not plausible, not finite or too old, a pose beyond a limit (by half
    the margin) while efforts act, a joint that does not follow or is pushed away, efforts that oscillate, the arm's
    clock going backwards or standing still, an output that is not finite, and what a driver reports. The reset must be
    meant: the flag must change from false to true in a HOLD command, and a cause that lasts faults again.

    **Without a bump**: HOLD keeps the target that was regulated to, after POSITION only while the arm is near it, and
    else latches the measured pose; POSITION starts from the held pose; EFFORT starts from the measured effort, and the
    soft wall, for whoever starts inside it, comes on in `start_time`; each at its limited rate.

    **Clocks**: the sender's and the arm's are never compared, only how far each went between two commands; so they need
    not be synchronised. Commands after a jump of the sender's clock are refused until what is in force has expired; a
    jump of the arm's clock forward expires it.
    """

    def __init__(
        self,
        arm: Arm,
        session_id: int,
        model: ArmModel,
        settings: GuardSettings | None = None,
        modes: tuple[int, ...] | None = None,
        wall_clock: Callable[[], int] | None = None,
    ):
        """A guard in HOLD.

        Args:
            arm: whose limits are kept.
            session_id: not 0; drawn anew whenever the arm starts.
            model: of the arm, mounted as it is, e.g. `ControlModel(IdentifiedModel.from_arm(arm))`; an identified model
                detects more.
            settings: the defaults of GuardSettings if None.
            modes: which of POSITION, EFFORT and OFF are accepted; POSITION and EFFORT if None.
            wall_clock: monotonic time of the computer [us], by which commands expire as well; None: by the arm's clock
                only, as for an arm in a simulated Diagram. Copies of the guard share it.

        Raises:
            StationError: no session, unknown modes, or settings or an arm's gains that guard nothing.
        """
        if unknown := set(modes or ()) - {*_ACTIVE, lcmt_dvrk_command.OFF, lcmt_dvrk_command.HOLD}:
            raise StationError(f"modes must be of POSITION, EFFORT and OFF; got {sorted(unknown)}")
        if session_id == 0:
            raise StationError("session_id must not be 0, which a command has that was never filled in")
        self.settings = settings or GuardSettings()
        self.settings.check()
        self.limits = GuardLimits(arm, self.settings)
        self.arm_name, self.num_joints, self.session_id = arm.name, arm.num_joints, session_id
        self.state = lcmt_dvrk_status.STATE_HOLD
        self.fault_code, self.fault_text = lcmt_dvrk_status.FAULT_NONE, ""
        #: Why the watchdog took over, until an operator resumes; or "".
        self.hold_reason = ""
        self.refusal_code = self.ignored_code = lcmt_dvrk_status.REFUSAL_NONE
        self.counts = GuardCounts()
        self._modes = tuple(_ACTIVE) if modes is None else modes
        self._expiry = CommandExpiry(round(1e6 * self.settings.expiry), wall_clock)
        self._stepped = 0
        self._stream = CommandStream(
            self._expiry.expiry, round(1e6 * self.settings.clock_tolerance), self.settings.sequence_jump
        )
        self._force = CommandInForce()
        self._powered = True
        #: What is wrong with the last measurement, in words; or "".
        self._problem = ""
        self._measured = Measurement(arm.num_joints, round(1e6 * self.settings.measurement_age))
        self._plausibility = Plausibility(arm, model, self.settings.plausibility, self.limits.speed)
        self._period, self._oscillation = PeriodMonitor(self.settings), OscillationMonitor(self.settings, arm)
        self._follower = Follower(self.limits)
        self._acted = False
        self.output = self._output(0.0)
        self._commanded = self.output.effort

    def __deepcopy__(self, memo: object) -> CommandGuard:
        # A Drake context copies its state before every update, so this must be quick. No array is changed in place.
        other = object.__new__(CommandGuard)
        other.__dict__.update(self.__dict__)
        for name in (
            "counts",
            "_stream",
            "_force",
            "_follower",
            "_measured",
            "_plausibility",
            "_period",
            "_oscillation",
        ):
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
        modes = {lcmt_dvrk_command.HOLD, *self._modes}
        if self.state == lcmt_dvrk_status.STATE_OFF or self.waits_for:
            modes -= set(_ACTIVE)
        if self.state not in (lcmt_dvrk_status.STATE_OFF, lcmt_dvrk_status.STATE_HOLD):
            modes -= {lcmt_dvrk_command.OFF}
        return sum(1 << mode for mode in modes)

    @property
    def sender_id(self) -> int:
        """Whose commands are in force or being watched; 0: nobody's."""
        return self._stream.sender_id if self._is_watched_or_in_force() else 0

    @property
    def last_sender_id(self) -> int:
        """Whose commands were accepted last; 0: nobody's."""
        return self._stream.sender_id

    @property
    def last_command(self) -> lcmt_dvrk_command:
        """The last accepted command."""
        return self._force.command

    @property
    def waits_for(self) -> str:
        """Why no POSITION and EFFORT is accepted while there is no fault, in words; "" if they are.

        Either `hold_reason`, until an operator resumes, or a guard that is stepped too seldom.
        """
        return self.hold_reason or self._period.fault

    @property
    def gravity_effort(self) -> Vector:
        """(n,) gravity effort of the model at the last good measurement [N m, N]."""
        return self._plausibility.gravity

    def receive(self, command: lcmt_dvrk_command | None, utime: int) -> int:
        """Takes one command, or None for a message that was none, that arrived at `utime` [us].

        Returns:
            lcmt_dvrk_status.REFUSAL_NONE, or why it was refused.
        """
        self._expire(utime)
        code = foreign_refusal(command, self.arm_name, self.num_joints, self.session_id)
        if command is not None and code == lcmt_dvrk_status.REFUSAL_NONE:
            code = self._refusal_now(command, utime)
            if code == lcmt_dvrk_status.REFUSAL_NONE:
                self._accept(command, utime)
                return code
        if code in FOREIGN:
            self.ignore(code)
            return code
        self.counts.refused += 1
        self.refusal_code = code
        if code not in OUT_OF_STREAM and self.state == lcmt_dvrk_status.STATE_STARTING:
            self._take_over(f"a command was refused while its mode began: {describe_refusal(code)}")
        return code

    def ignore(self, code: int, count: int = 1) -> None:
        """Counts messages that were not given to `receive` because they do not belong to the session.

        Args:
            code: lcmt_dvrk_status.REFUSAL_*, why the last one was ignored.
            count: how many there were.
        """
        self.counts.ignored += count
        self.ignored_code = code

    def step(self, utime: int, measured_utime: int, q: ArrayLike, v: ArrayLike, effort: ArrayLike) -> GuardOutput:
        """What to do from `utime` [us] on.

        Args:
            utime: the arm's clock now [us].
            measured_utime: the arm's clock when q, v and effort were measured [us]; too old is a fault.
            q: measured positions (n,) [rad, m].
            v: velocities (n,) [rad/s, m/s].
            effort: what the motors applied (n,) [N m, N].
        """
        dt, problem = self._measured.advance(utime)
        if dt < 0:
            self._stream.forget()
        if (wall := self._expiry.wall) is not None:
            if dt < 0:
                wall.forget()
            wall.note(measured_utime, utime - measured_utime)
        if problem:
            self.report_fault(problem, lcmt_dvrk_status.FAULT_CLOCK)
        self._measure(measured_utime, q, v, effort)
        self._expire(utime)
        self._watch_period(dt)
        if self.state == lcmt_dvrk_status.STATE_EFFORT and (excess := self.limits.beyond(self._q())):
            self.report_fault(excess, lcmt_dvrk_status.FAULT_POSITION_LIMIT)
        if self.state in _REGULATED and (away := self._follower.astray(self._q())):
            self.report_fault(away, lcmt_dvrk_status.FAULT_FOLLOWING)
        self.output = self._output(min(max(dt, 0.0), _MAX_STEP))
        if not self.output.is_finite():
            self.report_fault("the guard's output is not finite", lcmt_dvrk_status.FAULT_NOT_FINITE)
            self._follower.latch(self._q(), np.zeros(self.num_joints))
            self.output = self._follower.hold(0.0)
        elif self.state == lcmt_dvrk_status.STATE_EFFORT:
            joint = self._oscillation.add(self.output.effort, min(max(dt, 0.0), _MAX_STEP))
            if joint is not None:
                text = f"{self.limits.names[joint]}: the commanded effort oscillates"
                self.report_fault(text, lcmt_dvrk_status.FAULT_OSCILLATION)
                self.output = self._output(0.0)
        self._commanded = self.output.effort.copy()
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

    def _measure(self, measured_utime: int, q: ArrayLike, v: ArrayLike, effort: ArrayLike) -> None:
        """Takes a measurement and checks it; what is wrong with it ends in HOLD or FAULT."""
        measured, plausibility = self._measured, self._plausibility
        first = measured.q is None
        begins = plausibility.begins or measured.time_since(measured_utime) >= _MAX_GAP
        implausible_pose = self.limits.implausible_pose if begins else None
        self._problem = problem = measured.take(measured_utime, q, v, effort, implausible_pose)
        if problem:
            if first or measured.bad > self.settings.plausibility.bad_samples:
                # An arm that was never measured has no pose that it could be held at.
                self.report_fault(problem, lcmt_dvrk_status.FAULT_MEASUREMENT, has_power=not first)
                plausibility.reject_all()
            elif self._is_watched_or_in_force():
                self._take_over(problem)
            return
        if first:
            self._follower.latch(self._q(), np.zeros(self.num_joints))  # it stands so far
        elif measured.dt == 0:
            return  # the same measurement again
        if begins:
            plausibility.forget()
        commanded = self._commanded if self.state == lcmt_dvrk_status.STATE_EFFORT else None
        fault = plausibility.check(measured.dt, self._q(), measured.v, measured.effort, commanded)
        if fault:
            self.report_fault(fault, lcmt_dvrk_status.FAULT_IMPLAUSIBLE)
        if not self._powered:
            plausibility.forget()  # somebody may move the arm, in any way

    def _watch_period(self, dt: float) -> None:
        if self._expiry.wall is not None:
            now = self._expiry.wall.now()
            dt, self._stepped = 1e-6 * (now - self._stepped) if self._stepped else 0.0, now
        if self._period.add(dt) and self._is_watched_or_in_force():
            self._take_over(self._period.fault)

    def _is_watched_or_in_force(self) -> bool:
        return self.state in (lcmt_dvrk_status.STATE_STARTING, *_ACTIVE.values())

    def _q(self) -> Vector:
        """The measured pose (n,), or where it was last wanted."""
        return self._follower.target if self._measured.q is None else self._measured.q

    def _expire(self, utime: int) -> None:
        if not self._is_watched_or_in_force():
            return
        if reason := self._expiry.fault(utime - self._force.status_utime, self._force.wall_utime):
            self.counts.expired += self.state != lcmt_dvrk_status.STATE_STARTING
            self._take_over(reason)

    def _take_over(self, reason: str) -> None:
        """Goes to HOLD, until an operator resumes if commands acted; has no effect in OFF and in FAULT.

        Args:
            reason: in words; the first one stays until the resume.
        """
        if self.state in (lcmt_dvrk_status.STATE_OFF, lcmt_dvrk_status.STATE_FAULT):
            return
        acted, self._acted = self._acted, False
        self._hold()
        if acted and not self.settings.resume_automatically:
            self.hold_reason = self.hold_reason or reason

    def _refusal_now(self, command: lcmt_dvrk_command, utime: int) -> int:
        """REFUSAL_* of a command of this session, given who sent what before and what the arm is doing."""
        if self._stream.is_other_sender(command, utime):
            return lcmt_dvrk_status.REFUSAL_OTHER_SENDER
        if self._measured.utime is None or not 0 <= utime - command.status_utime <= self._expiry.expiry:
            return lcmt_dvrk_status.REFUSAL_STALE
        # The stream first: what does not continue it interrupts nothing.
        if (code := self._stream.refusal(command, utime)) != lcmt_dvrk_status.REFUSAL_NONE:
            return code
        if (code := content_refusal(command)) != lcmt_dvrk_status.REFUSAL_NONE:
            return code
        if command.control_mode == lcmt_dvrk_command.OFF and lcmt_dvrk_command.OFF not in self._modes:
            return lcmt_dvrk_status.REFUSAL_BAD_MODE
        if self.state == lcmt_dvrk_status.STATE_FAULT and command.control_mode != lcmt_dvrk_command.HOLD:
            return lcmt_dvrk_status.REFUSAL_FAULT
        if self.hold_reason and command.control_mode in _ACTIVE:
            return lcmt_dvrk_status.REFUSAL_RESUME
        if self.state == _ACTIVE.get(command.control_mode):
            return lcmt_dvrk_status.REFUSAL_NONE
        if command.control_mode < 0 or not self.accepted_modes >> command.control_mode & 1:
            return lcmt_dvrk_status.REFUSAL_BAD_MODE
        if command.control_mode == lcmt_dvrk_command.HOLD and self._measured.bad and not self._powered:
            return lcmt_dvrk_status.REFUSAL_STALE  # nobody knows where it would be held
        if command.control_mode in _ACTIVE:
            return self.limits.refusal_to_start(command, self._q(), self._measured.effort, self._plausibility.gravity)
        return lcmt_dvrk_status.REFUSAL_NONE

    def _accept(self, command: lcmt_dvrk_command, utime: int) -> None:
        self.counts.accepted += 1
        resets = self._stream.accept(command, utime)
        self.counts.lost = self._stream.lost
        mode, force = command.control_mode, self._force
        goes_on = self.state == lcmt_dvrk_status.STATE_STARTING and mode == force.command.control_mode
        force.take(command)
        force.wall_utime = self._expiry.wall_time(command.status_utime, utime - command.status_utime)
        self._acted &= mode in _ACTIVE
        if mode == lcmt_dvrk_command.OFF:
            self.state, self._powered = lcmt_dvrk_status.STATE_OFF, False
        elif mode == lcmt_dvrk_command.HOLD:
            # A pose that is not measured now, or that no arm has, is not where a reset may hold the arm.
            problem = self._problem or self.limits.implausible_pose(self._q())
            if resets and problem and self.state == lcmt_dvrk_status.STATE_FAULT:
                self.fault_text = problem
            elif resets and not problem:
                self.fault_code, self.fault_text = lcmt_dvrk_status.FAULT_NONE, ""
                self.hold_reason = ""
                if self._plausibility.invalid.any() or not self._follower.is_near(self._q()):
                    self._follower.latch(self._q(), self._measured.v)
                self._plausibility.restart()
            if self.fault_code == lcmt_dvrk_status.FAULT_NONE:
                self._hold()
        elif self.state == _ACTIVE[mode]:
            return
        elif not goes_on:
            self._hold()
            self.state, force.good_since = lcmt_dvrk_status.STATE_STARTING, utime
        elif utime - force.good_since >= 1e6 * self.settings.start_time:
            self._act(mode)

    def _act(self, mode: int) -> None:
        self.state, self._acted = _ACTIVE[mode], True
        if mode == lcmt_dvrk_command.POSITION:
            self._follower.begin_position()
        else:
            self._oscillation.restart()
            self._follower.begin_effort(self._measured.effort, self._q())

    def _hold(self) -> None:
        """To HOLD, at the pose that is held already or else at the measured one."""
        q = self._q()
        regulated = (
            self.state in (lcmt_dvrk_status.STATE_HOLD, lcmt_dvrk_status.STATE_STARTING, lcmt_dvrk_status.STATE_FAULT)
            and self._powered
        )
        if not (regulated or (self.state == lcmt_dvrk_status.STATE_POSITION and self._follower.is_near(q))):
            self._follower.latch(q, self._measured.v)
        self.state, self._powered = lcmt_dvrk_status.STATE_HOLD, True

    def _output(self, dt: float) -> GuardOutput:
        follower, force = self._follower, self._force
        q = self._q()
        if not self._powered:
            return follower.off(q)
        if self.state == lcmt_dvrk_status.STATE_FAULT and self._plausibility.invalid.any():
            valid = ~self._plausibility.invalid
            gravity = self._plausibility.model.gravity_effort(np.where(valid, q, self._plausibility.last_valid))
            v = np.zeros(self.num_joints) if self._measured.bad else self._measured.v
            return follower.hold_valid_joints(q, v, valid, gravity)
        if self.state == lcmt_dvrk_status.STATE_POSITION:
            return follower.follow_position(force.position, force.velocity, dt)
        if self.state == lcmt_dvrk_status.STATE_EFFORT and self._measured.utime is not None:
            share = 1e-6 * (self._measured.utime - force.good_since) / self.settings.start_time - 1.0
            return follower.follow_effort(force.effort, q, self._measured.v, dt, min(max(share, 0.0), 1.0))
        return follower.hold(dt)
