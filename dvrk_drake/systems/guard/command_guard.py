"""Command guard: checks the commands to an arm and the arm's measurements. It does not depend on Drake."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from dvrk_drake.errors import StationError
from dvrk_drake.lcmtypes import lcmt_dvrk_command, lcmt_dvrk_status
from dvrk_drake.models.lcm_messages import describe_refusal
from dvrk_drake.systems.guard.command_stream import (
    FOREIGN,
    OUT_OF_STREAM,
    CommandExpiry,
    CommandInForce,
    CommandStream,
    GuardCounts,
    content_refusal,
    foreign_refusal,
)
from dvrk_drake.systems.guard.limits import ArmModel, Follower, GuardLimits, GuardOutput, Part, Vector
from dvrk_drake.systems.guard.measurement import AgeMonitor, Measurement, OscillationMonitor, PeriodMonitor
from dvrk_drake.systems.guard.plausibility import Plausibility
from dvrk_drake.systems.guard.settings import GuardSettings
from dvrk_drake.systems.guard.states import TRANSITIONS, Event, State
from dvrk_drake.systems.guard.unsafe_arm import unsafe_difference

if TYPE_CHECKING:
    from dvrk_drake.models.arm import Arm

#: Largest time step that the rate limits use [s]. They also use this value if the time between two steps is longer.
_MAX_STEP = 0.01

#: Longest gap between two measurements that are compared with each other [s]. During a longer gap, the arm may have
#: been moved.
_MAX_GAP = 0.1

#: Number of faults within a time [us] after which only a person at the arm's process allows a reset. A controller that
#: answers each fault with a reset would otherwise have EFFORT again after `start_time`.
_MAX_FAULTS, _FAULT_TIME = 3, 10_000_000

_PERSON = (
    f". {_MAX_FAULTS} faults within {_FAULT_TIME / 1e6:g} s: look at the arm, and press Enter in the terminal of its "
    "process, or restart this process"
)

#: Faults after which the guard regulates the arm with the reduced gains of the safe state. The loop of the arm's own
#: position controller may be the cause of these faults, e.g. if the measurements are late.
_SAFE_STATE_FAULTS = (
    lcmt_dvrk_status.FAULT_POSITION_LIMIT,
    lcmt_dvrk_status.FAULT_FOLLOWING,
    lcmt_dvrk_status.FAULT_IMPLAUSIBLE,
    lcmt_dvrk_status.FAULT_OSCILLATION,
)

#: State in which the commands of each mode act, and event that begins it.
_ACTIVE = {
    lcmt_dvrk_command.POSITION: (State.POSITION, Event.ACT_POSITION),
    lcmt_dvrk_command.EFFORT: (State.EFFORT, Event.ACT_EFFORT),
}


class CommandGuard(Part):
    """Guard between the sender of commands and the motors of an arm.

    Call `receive` with every command and `step` once per period (1 ms). Both methods require the time of the arm's
    clock [us]. The status messages use the same clock. `step` returns the output for this period. The caller must apply
    this output unchanged.

    **States** (lcmt_dvrk_status.STATE_*) and the behaviour of the arm in each of them:

    - OFF: The motors have no power. Of all commands, only HOLD ends this state.
    - HOLD: The arm's position controller regulates to a latched pose. HOLD is the initial state and needs no commands.
    - STARTING: The arm behaves as in HOLD. The POSITION or EFFORT commands of a sender are monitored but do not act
      yet.
    - POSITION, EFFORT: The last accepted command, called the command in force, acts inside the limits of `GuardLimits`.
    - FAULT: After a fault of the measurements or of the motion, the guard regulates the joints with a valid position.
      It uses reduced gains and efforts (`Follower.hold_valid_joints`), because a delay of the measurements may be the
      cause. All other joints get the gravity effort at their last valid position. After other faults, the arm behaves
      as in HOLD. If the motors had no power before the fault, the arm behaves as in OFF.

    Transitions are written as "state --command or event--> next state". `states.TRANSITIONS` is the complete table::

        HOLD --OFF after a HOLD--> OFF --HOLD--> HOLD       any --HOLD--> HOLD, except from FAULT
        HOLD --POSITION, EFFORT--> STARTING --accepted for start_time--> POSITION, EFFORT
        STARTING --refused, expired, invalid measurement, period too long--> HOLD
        POSITION, EFFORT --HOLD--> HOLD; --expired, invalid measurement, period too long--> HOLD until a resume
        POSITION, EFFORT --the other mode--> STARTING
        any --fault--> FAULT --HOLD with reset_fault, changed from false to true--> HOLD

    **Expiry**: A command contains the time of the measurement from which it was computed (`status_utime`). The command
    expires when this measurement is older than the setting `expiry`. The time of arrival does not matter. A second
    command with the same `status_utime` therefore does not expire later. When the command in force expires, the guard
    holds the arm. See `CommandExpiry`. The guard also holds the arm if the commands are too old when they arrive, since
    this delay can make a control loop unstable. See `AgeMonitor`.

    **Measurements**: The guard checks that each measurement is finite, recent and plausible (`Plausibility`). A
    measurement that is not finite or too old ends STARTING, POSITION and EFFORT. While the arm holds, up to
    `bad_samples` such measurements in a row are tolerated. A longer sequence of such measurements is a fault. The first
    measurement is not compared with an earlier one. The same applies to the first measurement after a gap in the
    measurements, after OFF and after a reset. The pose of such a measurement must not be far outside the limits.

    An effort that is not finite has the same consequences. However, the positions remain valid and the arm is
    regulated, because regulation does not need the measured efforts.

    **Period**: The guard refuses POSITION and EFFORT commands if `step` was not called for `longest_period`, or if the
    median time between two calls exceeds `slow_period`. In these cases, the limits would act too late.

    **Watchdog hold**: If an expired command, an invalid measurement or a long period ends POSITION or EFFORT, the guard
    holds the arm. The same applies to a HOLD command of another sender, and this command also ends STARTING. This is
    called a watchdog hold. The guard then refuses POSITION and EFFORT until an operator resumes. The command for a
    resume is the same as for the reset of a fault. `hold_reason` states the reason of the hold. A watchdog hold is not
    a fault, and OFF is allowed. No resume is needed if the sender commanded HOLD before it stopped sending, or if no
    POSITION or EFFORT command has acted yet. With `GuardSettings.resume_automatically`, no resume is needed in any
    case. New commands act only after STARTING.

    **Refused commands**: A command is refused if a number is not finite, or if the command has expired on arrival, is
    out of order or is a duplicate. It is also refused after a jump of the sender's sequence or clock, and if its mode
    is not accepted in the present state. `lcmt_dvrk_status.REFUSAL_*` lists all reasons. A refused command does not
    act, and the expiry of the command in force does not change. If all new commands are refused, the command in force
    therefore expires and the state changes to HOLD.

    **Ignored messages**: A message is ignored if it is unreadable or not authentic, or if it states another arm, number
    of joints or session. A session is one run of the arm's process. Messages of a second sender are ignored while
    commands of the first sender are accepted, except HOLD in STARTING, POSITION and EFFORT. Ignored messages have no
    effect. They are not included in the number of refused commands. Without a key, only the sender_id identifies a
    sender, and any process on the network can copy this number.

    **OFF**: An arm without brakes falls when its motors are off. OFF must be listed in `modes`. A single message is not
    sufficient, because the state must be HOLD and the sender's last command must have been HOLD. In FAULT, the guard
    refuses OFF and holds the arm until an operator resets the fault. In an emergency, press the stop button.

    **Start check**: Commands act only if, for the time `start_time`, no accepted command expires and no command is
    refused because of its content or mode. During this time, all commands must be close to the present state:

    - Commanded efforts must be near the measured efforts.
    - Commanded positions must be near the measured positions. The same applies to the commanded position plus Kd/Kp
      times the commanded velocity.
    - For EFFORT, the measured pose must not exceed a position limit by more than half of the setting `margin`. The
      measured effort must be near the gravity effort of the model, and may exceed the limit of commanded efforts by at
      most the setting `start_effort`.

    A controller whose state does not match the arm's state, e.g. after a restart, therefore does not move the arm.

    **Faults**: A fault is latched. The causes of a fault are:

    - measurements that are not plausible, not finite or too old,
    - a pose that exceeds a position limit by more than half of the setting `margin` while efforts act,
    - a joint that does not follow its target or is pushed away from the target,
    - efforts that oscillate: commanded, between the command and the limits, or of the arm's own position controller,
    - an arm clock that goes backwards or stands still,
    - an output that is not finite,
    - a fault that the driver reports.

    A fault is reset by a HOLD command in which `reset_fault` changes from false to true. If the cause persists, the
    fault occurs again. After three faults within 10 s, a person at the arm's process must first allow the reset; see
    `allow_reset`. Faults that the driver reports are not counted.

    **Bumpless transfer**: After STARTING, HOLD keeps the target of the position controller. After POSITION or FAULT,
    HOLD keeps this target only if the arm is near the target. Otherwise, HOLD latches the measured pose as the target.
    POSITION starts at the target of HOLD, and EFFORT at the measured effort. If the arm is inside a soft wall (see
    `GuardLimits`) when EFFORT starts, the effort of the wall increases over `start_time`. Commanded targets and efforts
    are limited in rate.

    **Clocks**: The sender's clock and the arm's clock need not be synchronised. The guard compares only the times that
    elapse on these clocks between two commands. After a jump of the sender's clock, commands are refused until the
    command in force has expired. After a forward jump of the arm's clock by more than `expiry`, the command in force
    expires.
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
        """Creates a guard in HOLD.

        Args:
            arm: Arm whose limits are enforced.
            session_id: Random identifier of the session, not 0. Each run of the arm's process requires a new
                identifier.
            model: Model of the arm with its actual base orientation, e.g.
                `ControlModel(IdentifiedModel.from_arm(arm))`. With an identified model, the guard detects more faults.
            settings: Settings of the guard. None: the defaults of `GuardSettings` are used.
            modes: Accepted modes among POSITION, EFFORT and OFF. None: POSITION and EFFORT are accepted.
            wall_clock: Function that returns the computer's monotonic time [us]. If it is given, commands also expire
                by this clock. If it is None, e.g. for an arm in a simulated Diagram, commands expire only by the arm's
                clock. Copies of the guard share this function.

        Raises:
            StationError: The session is 0, a mode is unknown, a setting is out of range, or the arm differs dangerously
                from the arm of this package with the same name (`unsafe_difference`).
        """
        if unknown := set(modes or ()) - {*_ACTIVE, lcmt_dvrk_command.OFF, lcmt_dvrk_command.HOLD}:
            raise StationError(f"modes must be POSITION, EFFORT or OFF; got {sorted(unknown)}")
        if session_id == 0:
            raise StationError("session_id must not be 0, because 0 is the default value in a command")
        if difference := unsafe_difference(arm):
            raise StationError(f"{arm.source}: {difference}")
        self.settings = settings or GuardSettings()
        self.settings.check()
        #: Settings that protect the arm less than their defaults, for the status.
        self.weaker_settings = self.settings.weaker_than_default()
        self.limits = GuardLimits(arm, self.settings)
        arm.refuse_locked_joints("a command guard")
        self.arm_name, self.num_joints, self.session_id = arm.name, arm.num_joints, session_id
        self._state = State.HOLD
        self.fault_code, self.fault_text = lcmt_dvrk_status.FAULT_NONE, ""
        #: Reason of the watchdog hold until an operator resumes. Empty if there is no watchdog hold.
        self.hold_reason = ""
        self._driver_reason = ""
        self.refusal_code = self.ignored_code = lcmt_dvrk_status.REFUSAL_NONE
        self.counts = GuardCounts()
        self._modes = tuple(_ACTIVE) if modes is None else modes
        self._expiry = CommandExpiry(round(1e6 * self.settings.expiry), wall_clock)
        self._last_wall_step = 0
        self._stream = CommandStream(
            self._expiry.expiry, round(1e6 * self.settings.clock_tolerance), self.settings.sequence_jump
        )
        self._in_force = CommandInForce()
        #: Times of the last faults [us], except those that the driver reported.
        self._fault_times: tuple[int, ...] = ()
        #: Reason why the last measurement is invalid. Empty if it is valid.
        self._problem = ""
        self._measured = Measurement(arm.joint_names, round(1e6 * self.settings.measurement_age))
        self._plausibility = Plausibility(arm, model, self.settings.plausibility, self.limits.speed)
        self._period = PeriodMonitor(self.settings)
        self._oscillation = OscillationMonitor(
            self.settings,
            arm,
            "the commanded effort oscillates",
            "the joint moves to and fro between the command and a soft wall or the speed limit",
        )
        self._regulation = OscillationMonitor(
            self.settings, arm, "the measured effort oscillates while the arm's own position controller acts"
        )
        self._ages = AgeMonitor(self.settings)
        self._follower = Follower(self.limits, self.limits.safe_gains(arm, model))
        self.output = self._output(0.0)
        self._commanded = self.output.effort
        self._find_parts()

    @property
    def state(self) -> int:
        """State of the guard, lcmt_dvrk_status.STATE_*."""
        return self._state.code

    @property
    def accepted_modes(self) -> int:
        """Bit mask of the modes that are accepted in the present state, with bit 1 << mode for each mode."""
        modes = {lcmt_dvrk_command.HOLD}
        if self._state in TRANSITIONS[Event.OFF]:
            modes.add(lcmt_dvrk_command.OFF)
        if self._state in TRANSITIONS[Event.START] and not self.blocked_reason:
            modes.update(_ACTIVE)
        return sum(1 << mode for mode in modes if mode in (lcmt_dvrk_command.HOLD, *self._modes))

    @property
    def sender_id(self) -> int:
        """Identifier of the sender whose commands act or are monitored, or 0 if there is no such sender."""
        return self._stream.sender_id if self._state.has_stream else 0

    @property
    def last_sender_id(self) -> int:
        """Identifier of the sender of the last accepted command, or 0 if there is no such command."""
        return self._stream.sender_id

    @property
    def last_command(self) -> lcmt_dvrk_command:
        """Last accepted command."""
        return self._in_force.command

    @property
    def blocked_reason(self) -> str:
        """Reason why POSITION and EFFORT are refused although there is no fault, or "" if they are accepted.

        The reason is `hold_reason` until an operator resumes. Otherwise, it is the reason that the driver passed to
        `block`, or that a period of the guard was too long.
        """
        return self.hold_reason or self._driver_reason or self._period.fault

    @property
    def gravity_effort(self) -> Vector:
        """Gravity effort (n,) of the model at the last valid measurement [N m, N]."""
        return self._plausibility.gravity

    def receive(self, command: lcmt_dvrk_command | None, utime: int) -> int:
        """Checks one command and stores an accepted command.

        Args:
            command: Received command, or None if the message was unreadable.
            utime: Time of arrival on the arm's clock [us].

        Returns:
            Reason of the refusal, lcmt_dvrk_status.REFUSAL_*, or REFUSAL_NONE if the command is accepted.
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
            self._take_over(f"a command was refused during the start check: {describe_refusal(code)}")
        return code

    def ignore(self, code: int, count: int = 1) -> None:
        """Counts ignored messages, including messages that were never passed to `receive`.

        Args:
            code: Reason why the last message was ignored, lcmt_dvrk_status.REFUSAL_*.
            count: Number of ignored messages.
        """
        self.counts.ignored += count
        self.ignored_code = code

    def step(self, utime: int, measured_utime: int, q: ArrayLike, v: ArrayLike, effort: ArrayLike) -> GuardOutput:
        """Checks a measurement and returns the output of the guard for the period that starts at `utime`.

        Args:
            utime: Present time of the arm's clock [us].
            measured_utime: Time of the measurement of q, v and effort on the arm's clock [us].
            q: Measured positions (n,) [rad, m].
            v: Measured velocities (n,) [rad/s, m/s].
            effort: Applied motor efforts (n,) [N m, N].
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
        if self._state is State.EFFORT and (excess := self.limits.position_limit_fault(self._q())):
            self.report_fault(excess, lcmt_dvrk_status.FAULT_POSITION_LIMIT)
        self._watch_regulation()
        self.output = self._output(min(max(dt, 0.0), _MAX_STEP))
        if not self.output.is_finite():
            self.report_fault("the guard's output is not finite", lcmt_dvrk_status.FAULT_NOT_FINITE)
            self._change(Event.BAD_OUTPUT)
            self._follower.latch(self._q(), np.zeros(self.num_joints))
            self.output = self._follower.hold(0.0)
        elif self._state is State.EFFORT:
            self._commanded = self.output.effort.copy()
            text = self._oscillation.add(min(max(dt, 0.0), _MAX_STEP), self._follower.effort, self._commanded)
            if text:
                self.report_fault(text, lcmt_dvrk_status.FAULT_OSCILLATION)
                self.output = self._output(0.0)
        self._commanded = self.output.effort.copy()
        return self.output

    def report_fault(self, text: str, code: int = lcmt_dvrk_status.FAULT_DRIVER, *, has_power: bool = True) -> None:
        """Latches a fault. A driver that reports a fault calls this method before each `step` while the fault lasts.

        Args:
            text: Description of the fault, including measured values. The description of the first fault is kept until
                the reset.
            code: lcmt_dvrk_status.FAULT_*.
            has_power: False if the motors cannot hold the arm. The output is then the same as in OFF. After a reset,
                the arm holds the measured pose, not the pose before the fault.
        """
        if self.state != lcmt_dvrk_status.STATE_FAULT:
            self._change(Event.FAULT)
            # The driver reports a fault before each step until its cause has ended, so a reset cannot end it.
            if code != lcmt_dvrk_status.FAULT_DRIVER:
                now = self._measured.utime or 0
                self._fault_times = (*(time for time in self._fault_times if now - time <= _FAULT_TIME), now)
            self.fault_code, self.fault_text = code, text + (_PERSON if self.needs_person else "")
        if code in _SAFE_STATE_FAULTS:
            self._change(Event.UNSAFE_LOOP)
        if not has_power:
            self._change(Event.POWER_LOSS)

    @property
    def needs_person(self) -> bool:
        """True if resets are refused until a person at the arm's process allows them; see `allow_reset`."""
        return self.state == lcmt_dvrk_status.STATE_FAULT and len(self._fault_times) >= _MAX_FAULTS

    def allow_reset(self) -> None:
        """Allows the reset of a fault after several faults. Call this method only for a person at the arm's process."""
        if self.needs_person:
            self._fault_times = ()
            self.fault_text = self.fault_text.removesuffix(_PERSON)

    def block(self, reason: str) -> None:
        """Refuses POSITION and EFFORT until the driver calls this method with "". The arm holds in the meantime.

        Args:
            reason: Reason why the driver cannot execute commands safely, or "" if it can.
        """
        self._driver_reason = reason
        if reason:
            self._take_over(reason)

    def _measure(self, measured_utime: int, q: ArrayLike, v: ArrayLike, effort: ArrayLike) -> None:
        """Checks and stores a measurement. An invalid measurement leads to HOLD or FAULT."""
        measured, plausibility = self._measured, self._plausibility
        first = measured.q is None
        is_first_in_series = plausibility.is_first or measured.time_since(measured_utime) >= _MAX_GAP
        implausible_pose = self.limits.implausible_pose if is_first_in_series else None
        self._problem = problem = measured.store(measured_utime, q, v, effort, implausible_pose)
        if problem:
            no_pose = measured.q is None
            if no_pose or measured.num_invalid > self.settings.plausibility.bad_samples:
                # Without any measurement there is no pose to hold.
                self.report_fault(problem, lcmt_dvrk_status.FAULT_MEASUREMENT, has_power=not no_pose)
                if not measured.is_pose_valid:
                    self._change(Event.UNSAFE_LOOP)
                    plausibility.reject(measured.invalid_pose)
            else:
                self._take_over(problem)
            if not measured.is_pose_valid:
                return
        q = self._q()
        if first:
            self._follower.latch(q, np.zeros(self.num_joints))  # the arm is assumed to be at rest
        elif measured.dt == 0:
            return  # repeated measurement
        if is_first_in_series:
            plausibility.forget()
        commanded = self._commanded if self._state is State.EFFORT else None
        if fault := plausibility.check(measured.dt, q, measured.v, measured.effort, commanded, measured.invalid_effort):
            self.report_fault(fault, lcmt_dvrk_status.FAULT_IMPLAUSIBLE)
        if not self._state.is_powered:
            plausibility.forget()  # the arm may be moved by hand

    def _watch_period(self, dt: float) -> None:
        if self._expiry.wall is not None:
            now = self._expiry.wall.now()
            dt, self._last_wall_step = 1e-6 * (now - self._last_wall_step) if self._last_wall_step else 0.0, now
        if self._period.add(dt):
            self._take_over(self._period.fault)

    def _watch_regulation(self) -> None:
        """Checks that the arm's own position controller regulates the arm. Late measurements let it oscillate."""
        # After a fault of the driver, another process may move the arm.
        if not self._state.is_regulated or self.fault_code == lcmt_dvrk_status.FAULT_DRIVER:
            return
        if deviation := self._follower.following_fault(self._q()):
            self.report_fault(deviation, lcmt_dvrk_status.FAULT_FOLLOWING)
        if text := self._regulation.add(min(self._measured.dt, _MAX_STEP), self._measured.effort):
            self.report_fault(text, lcmt_dvrk_status.FAULT_OSCILLATION)

    def _change(self, event: Event) -> None:
        """Changes to the next state of the table of transitions, and prepares the output in this state."""
        before, after = self._state, TRANSITIONS[event].get(self._state)
        if after is None:
            return
        follower, q = self._follower, self._q()
        if not (before.keeps_target or (before is State.POSITION and follower.is_near(q))):
            follower.latch(q, self._measured.v)
        self._state = after
        if after is State.POSITION:
            follower.begin_position()
        elif after is State.EFFORT:
            self._oscillation.restart()
            self._regulation.restart()
            follower.begin_effort(self._measured.effort, q)
        elif after is State.SAFE_FAULT:
            acts = self.output.control_mode == lcmt_dvrk_command.EFFORT
            follower.begin_safe_state(self._commanded if acts else self._measured.effort)

    def _q(self) -> Vector:
        """Returns the measured pose (n,), or the target if there is no measurement yet."""
        return self._follower.target if self._measured.q is None else self._measured.q

    def _expire(self, utime: int) -> None:
        in_force = self._in_force
        age = utime - in_force.status_utime
        if self._state.has_stream and (reason := self._expiry.fault(age, in_force.wall_utime)):
            self.counts.expired += self._state in (State.POSITION, State.EFFORT)
            self._take_over(reason)

    def _take_over(self, reason: str, needs_resume: bool = False) -> None:
        """Changes to HOLD if commands are monitored or act. If commands acted, an operator must resume.

        Args:
            reason: Reason of the change. The first reason is kept until the resume.
            needs_resume: True if an operator must also resume if no command has acted.
        """
        needs_resume |= self._state.has_acted
        if needs_resume and not self.settings.resume_automatically:
            self.hold_reason = self.hold_reason or reason
        self._change(Event.WATCHDOG)

    def _refusal_now(self, command: lcmt_dvrk_command, utime: int) -> int:
        """Returns REFUSAL_* for a command of this session, given the earlier commands and the present state."""
        is_stale = self._measured.utime is None or not 0 <= utime - command.status_utime <= self._expiry.expiry
        if self._stream.is_other_sender(command, utime):
            holds = command.control_mode == lcmt_dvrk_command.HOLD and self._state.has_stream and not is_stale
            return lcmt_dvrk_status.REFUSAL_NONE if holds else lcmt_dvrk_status.REFUSAL_OTHER_SENDER
        if is_stale:
            return lcmt_dvrk_status.REFUSAL_STALE
        # The stream is checked before the content. A command that does not continue the stream must not end STARTING.
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
        if command.control_mode in _ACTIVE and self._state is _ACTIVE[command.control_mode][0]:
            return lcmt_dvrk_status.REFUSAL_NONE
        if command.control_mode < 0 or not self.accepted_modes >> command.control_mode & 1:
            return lcmt_dvrk_status.REFUSAL_BAD_MODE
        if command.control_mode == lcmt_dvrk_command.HOLD and self._measured.num_invalid and not self._state.is_powered:
            return lcmt_dvrk_status.REFUSAL_STALE  # the pose to hold is unknown
        if command.control_mode in _ACTIVE:
            return self.limits.refusal_to_start(command, self._q(), self._measured.effort, self._plausibility.gravity)
        return lcmt_dvrk_status.REFUSAL_NONE

    def _accept(self, command: lcmt_dvrk_command, utime: int) -> None:
        self.counts.accepted += 1
        if self._stream.is_other_sender(command, utime):
            # A start check also requires a resume, so that it does not begin again.
            self._take_over(f"sender {command.sender_id} commanded HOLD", needs_resume=True)
            return
        resets = self._stream.accept(command, utime)
        self.counts.lost = self._stream.lost
        mode, in_force = command.control_mode, self._in_force
        continues = self.state == lcmt_dvrk_status.STATE_STARTING and mode == in_force.command.control_mode
        in_force.replace(command)
        in_force.wall_utime = self._expiry.wall_time(command.status_utime, utime - command.status_utime)
        if mode == lcmt_dvrk_command.OFF:
            self._change(Event.OFF)
        elif mode == lcmt_dvrk_command.HOLD:
            if resets and not self.needs_person:
                self._reset()
            self._change(Event.HOLD)
        elif reason := self._ages.add(self._expiry.age(utime - command.status_utime, in_force.wall_utime)):
            self._take_over(reason)
        elif not continues and self._state is not _ACTIVE[mode][0]:
            self._change(Event.START)
            self._ages.restart()
            in_force.accepted_since = utime
        elif continues and utime - in_force.accepted_since >= 1e6 * self.settings.start_time:
            self._change(_ACTIVE[mode][1])

    def _reset(self) -> None:
        """Resets a fault or ends a watchdog hold, unless there is no valid and plausible pose to hold."""
        if problem := self._problem or self.limits.implausible_pose(self._q()):
            if self.state == lcmt_dvrk_status.STATE_FAULT:
                self.fault_text = problem
            return
        self.fault_code, self.fault_text, self.hold_reason = lcmt_dvrk_status.FAULT_NONE, "", ""
        if self._plausibility.invalid.any() or not self._follower.is_near(self._q()):
            self._follower.latch(self._q(), self._measured.v)
        self._plausibility.restart()
        self._change(Event.RESET)

    def _output(self, dt: float) -> GuardOutput:
        follower, in_force, q = self._follower, self._in_force, self._q()
        if not self._state.is_powered:
            return follower.off(q)
        if self._state is State.SAFE_FAULT:
            valid = ~self._plausibility.invalid
            gravity = self._plausibility.model.gravity_effort(np.where(valid, q, self._plausibility.last_valid))
            v = np.where(self._measured.invalid_pose, 0.0, self._measured.v)
            return follower.hold_valid_joints(q, v, valid, gravity, dt)
        if self._state is State.POSITION:
            return follower.follow_position(in_force.position, in_force.velocity, dt)
        if self._state is State.EFFORT and self._measured.utime is not None:
            share = 1e-6 * (self._measured.utime - in_force.accepted_since) / self.settings.start_time - 1.0
            return follower.follow_effort(in_force.effort, q, self._measured.v, dt, min(max(share, 0.0), 1.0))
        return follower.hold(dt)
