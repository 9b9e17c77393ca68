"""Shows an operator the state of an arm over LCM or ROS 2, stops the arm, and resets a fault."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.errors import ControllerError
from dvrk_drake.lcmtypes import lcmt_dvrk_command, lcmt_dvrk_status
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.lcm_messages import describe_refusal, describe_state
from dvrk_drake.processes.control import FIRST_WAIT, SILENCE
from dvrk_drake.systems.lcm.arm_link import ArmLink
from dvrk_drake.systems.lcm.messages import draw_id, make_command
from dvrk_drake.systems.ros.discovery import END_OTHER_PROCESS, shown

if TYPE_CHECKING:
    from dvrk_drake.systems.ros.crtk_client import CrtkObserver, JointMeasurement

#: Longest time for which a guard ignores new senders after the last command of a sender, plus a margin [s].
_SENDER_RESERVED = 1.1
#: States in which commands of a controller act, or are checked before they act.
_CONTROLLED = (lcmt_dvrk_status.STATE_STARTING, lcmt_dvrk_status.STATE_POSITION, lcmt_dvrk_status.STATE_EFFORT)
_EMERGENCY = "Press the emergency stop button"
#: Time after which an arm that does not stop is reported [s]. A guard examines each message within 1 ms, so this time
#: allows for lost messages and a busy computer.
_STOP = 1.0
#: Time for switching the power off [s]. It includes the time for which another sender is reserved.
_POWER_OFF = _SENDER_RESERVED + _STOP


#: Bits of `joint_flags` and what they mean.
_FLAGS = {
    lcmt_dvrk_status.FLAG_EFFORT_CLAMPED: "effort limit",
    lcmt_dvrk_status.FLAG_RATE_LIMITED: "rate limit",
    lcmt_dvrk_status.FLAG_POSITION_LIMIT: "soft wall",
    lcmt_dvrk_status.FLAG_COUPLED_LIMIT: "coupled limit",
    lcmt_dvrk_status.FLAG_SPEED_LIMIT: "speed limit",
    lcmt_dvrk_status.FLAG_IMPLAUSIBLE: "position not plausible",
}


@dataclass(frozen=True)
class ArmObservation:
    """State of an arm with n joints during a short time, for its operator.

    Attributes:
        state: State of the guard over LCM, or operating state over ROS 2.
        why: Reason why the arm is in its state.
        next_step: What the operator can do next, or "" if nothing is to be done.
        is_fault: Whether the arm has a fault.
        notes: Sentences on the messages: their rate and age, and what is not known.
        q: Mean positions (n,) [rad, m]. NaN if a measurement is not valid.
        v: Mean velocities (n,) [rad/s, m/s].
        effort: Mean efforts of the motors (n,) [N m, N].
        count: Number of averaged measurements.
        flags: Active limits of each joint (n), "" if there are none.

    Example:
        >>> import dvrk_drake as dvrk
        >>> connection = dvrk.connect(dvrk.load_arm("mtml"))
        >>> connection.measure().why  # doctest: +SKIP
        'no controller sends commands'
    """

    state: str
    why: str
    next_step: str
    is_fault: bool
    notes: Sequence[str]
    q: NDArray[np.float64]
    v: NDArray[np.float64]
    effort: NDArray[np.float64]
    count: int
    flags: Sequence[str]


def observe(link: ArmLink, seconds: float, options: str) -> ArmObservation:
    """Receives the statuses of an arm for some time.

    Args:
        link: Channels of the arm.
        seconds: Duration [s].
        options: Options of a command line for this arm, for the next step.

    Raises:
        ControllerError: No status arrives.
    """
    statuses, lost, start = [link.next_status(FIRST_WAIT)], link.lost, link.now()
    while (duration := link.now() - start) < seconds:
        statuses.append(link.next_status(SILENCE))
    first, last = statuses[0], statuses[-1]
    q, v, effort = np.mean([[s.position, s.velocity, s.effort_measured] for s in statuses], axis=0)
    rate = (len(statuses) - 1) / max(duration, seconds)
    commands = (last.num_accepted - first.num_accepted) / max(duration, seconds)
    why, next_step = _explain(link.arm, first, last, commands, options)
    notes = [
        f"Statuses: {rate:.0f} per second, {link.lost - lost} lost.",
        f"Commands since the start of the arm: {last.num_accepted} accepted, {last.num_lost} lost, {last.num_refused} "
        f"refused, {last.num_ignored} ignored, {last.num_expired} expired.",
    ]
    if last.weaker_settings:
        notes.append(f"Guard settings weaker than the defaults: {last.weaker_settings}.")
    is_fault = last.fault_code != lcmt_dvrk_status.FAULT_NONE
    flags = [", ".join(text for bit, text in _FLAGS.items() if flag & bit) for flag in last.joint_flags]
    state = describe_state(last.guard_state)
    return ArmObservation(state, why, next_step, is_fault, notes, q, v, effort, len(statuses), flags)


def _explain(
    arm: Arm, first: lcmt_dvrk_status, last: lcmt_dvrk_status, commands: float, options: str
) -> tuple[str, str]:
    """Returns why the arm is in its state, and what the operator can do next. `commands` is their rate [Hz]."""
    reset = f"look at the arm, remove the cause, then: dvrk-drake control {options} --reset"
    if last.utime == first.utime and first.utime:
        why = f"no new measurement arrives ({last.fault_text or 'no fault'})"
        return why, f"check the process of the arm and its connection. Then {reset}"
    if last.fault_code != lcmt_dvrk_status.FAULT_NONE:
        return f"fault: {last.fault_text}", reset
    if last.guard_state == lcmt_dvrk_status.STATE_OFF:
        return "the motors have no power", "switch the power on, as the manual of the arm describes"
    if last.fault_text:
        return f"the guard holds the arm until an operator resumes: {last.fault_text}", reset
    if last.gravity_compensation:
        why = "the arm adds its own gravity compensation, so controllers of this package do not start"
        return why, "switch off gravity_compensation in the arm's driver"
    if not np.all(np.isfinite([*last.position, *last.velocity, *last.effort_measured])):
        return "a measured position, velocity or effort is not finite", "check the sensors of the arm"
    if last.num_refused > first.num_refused:
        return f"commands are refused: {describe_refusal(last.refusal_code)}", "correct or end the controller"
    if last.num_ignored > first.num_ignored:
        return f"messages are ignored: {describe_refusal(last.ignored_code)}", "give the arm's key to the controller"
    if commands:
        return f"sender {last.command_sender_id} sends {commands:.0f} commands per second", ""
    return idle_reason(arm, last.position, "no controller sends commands", options)


def idle_reason(arm: Arm, q: Sequence[float], why: str, options: str) -> tuple[str, str]:
    """Returns why an arm at `q` (n,) does not move without commands, and what the operator can do next.

    Args:
        arm: Arm with n joints.
        q: Measured positions (n,) [rad, m].
        why: Reason if the arm is inside its limits.
        options: Options of a command line for this arm.
    """
    if violations := "; ".join(arm.limit_violations(q)):
        why = f"the arm is outside its limits, so controllers do not start: {violations}"
        return why, "move the arm inside its limits, or check its encoder offsets"
    return why, f"dvrk-drake control {options}"


def stop_arm(link: ArmLink, *, power_off: bool = False) -> lcmt_dvrk_status:
    """Commands HOLD until no controller moves the arm, then, on request, switches the motor power off.

    The guard obeys HOLD of every sender. If commands of a controller acted, they do not act again until an operator
    resumes. An arm in a fault or without motor power gets no command, because HOLD would switch the power on.

    Args:
        link: Channels of the arm.
        power_off: True to switch the motor power off. An arm without brakes falls.

    Returns:
        Status after the stop.

    Raises:
        ControllerError: No status arrives, the arm does not stop, or its power cannot be switched off.
    """
    sender, name, status = _Sender(link), link.arm.name, link.next_status(FIRST_WAIT)
    end = link.now() + _STOP
    while status.guard_state in _CONTROLLED:
        if link.now() > end:
            raise ControllerError(f"{name} does not stop: {_refusal(status)}. {_EMERGENCY}")
        status = sender.send(status)
    if not power_off or status.guard_state == lcmt_dvrk_status.STATE_OFF:
        return status
    if status.guard_state == lcmt_dvrk_status.STATE_FAULT:
        raise ControllerError(f"{name} has a fault, in which its guard does not switch the power off. {_EMERGENCY}")
    if not status.accepted_modes >> lcmt_dvrk_command.OFF & 1:
        raise ControllerError(f"{name} holds its pose, but its driver does not accept OFF (modes). {_EMERGENCY}")
    end = link.now() + _POWER_OFF
    while status.guard_state != lcmt_dvrk_status.STATE_OFF:
        if link.now() > end:
            raise ControllerError(f"the power of {name} stays on: {_refusal(status)}. {_EMERGENCY}")
        # OFF is accepted only after HOLD of the same sender.
        status = sender.send(status, lcmt_dvrk_command.OFF if sender.accepted(status) else lcmt_dvrk_command.HOLD)
    return status


def reset_fault(link: ArmLink, report: Callable[[str], None]) -> None:
    """Clears the latched fault of the arm, or resumes after a watchdog hold. Afterwards, the arm is in HOLD.

    Args:
        link: Channels of the arm.
        report: Function that is called with a description of the fault, or of the reason of the watchdog hold.

    Raises:
        ControllerError: No status arrives, or the fault remains because its cause persists.
    """
    status, name = link.next_status(FIRST_WAIT), link.arm.name
    if status.fault_code == lcmt_dvrk_status.FAULT_NONE and not status.fault_text:
        return
    fault = status.fault_text
    if status.fault_code == lcmt_dvrk_status.FAULT_NONE:
        report(f"the guard of {name} held the arm, and the operator resumes now: {fault}")
    else:
        report(f"{name} has a fault, which is reset now: {fault}")
    sender = _Sender(link)
    # The guard requires a change of the flag from false to true.
    for reset in [False, False, *[True] * 20]:
        status = sender.send(status, reset_fault=reset)
    # The guard ignores a new sender for up to a second after the last command of this sender.
    end = link.now() + _SENDER_RESERVED
    while link.now() < end:
        status = link.next_status(SILENCE)
    if status.fault_code != lcmt_dvrk_status.FAULT_NONE:
        raise ControllerError(f"{name} still has a fault after the reset: {status.fault_text or fault}")
    if status.fault_text:
        raise ControllerError(f"{name} does not resume: {status.fault_text}")


class _Sender:
    """Sender of HOLD and OFF commands."""

    def __init__(self, link: ArmLink) -> None:
        self._link, self._sender_id = link, draw_id()
        self._last: lcmt_dvrk_command | None = None

    def send(
        self, status: lcmt_dvrk_status, mode: int = lcmt_dvrk_command.HOLD, *, reset_fault: bool = False
    ) -> lcmt_dvrk_status:
        """Sends the command for a status, and returns the next status."""
        utime = round(1e6 * self._link.now())
        self._last = make_command(status, self._sender_id, utime, mode, reset_fault=reset_fault)
        self._link.send(self._last)
        return self._link.next_status(SILENCE)

    def accepted(self, status: lcmt_dvrk_status) -> bool:
        """Returns whether the last command that the arm accepted is the last one of this sender."""
        last = self._last
        return last is not None and (status.command_sequence, status.command_utime) == (last.sequence, last.utime)


def _refusal(status: lcmt_dvrk_status) -> str:
    state = describe_state(status.guard_state)
    if status.num_refused and status.refusal_code:
        return f"its state is {state}; last refused command: {describe_refusal(status.refusal_code)}"
    if status.num_ignored and status.ignored_code:
        return f"its state is {state}; last ignored message: {describe_refusal(status.ignored_code)}"
    return f"its state is {state}"


#: Longest time until the first measurement [s]. A dVRK also publishes invalid measurements.
_FIRST = 2.0
#: Longest time until the arm has switched its power off [s].
_POWER_OFF_ROS = 2.0


def observe_dvrk(observer: CrtkObserver, seconds: float, options: str) -> ArmObservation:
    """Receives the messages of an arm for some time.

    Args:
        observer: Observer of the arm.
        seconds: Duration [s].
        options: Options of a command line for this arm, for the next step.
    """
    domain, arm = observer.domain, observer.arm
    received: list[JointMeasurement] = []
    num_before, start = observer.num_received, time.monotonic()

    def receive() -> bool:
        if observer.receive() and observer.measurement is not None:
            received.append(observer.measurement)
        return bool(received)

    domain.wait_until(receive, _FIRST)
    end = time.monotonic() + seconds
    while received and (left := end - time.monotonic()) > 0:
        domain.wait(left)
        receive()
    intervals = np.diff([measurement.stamp for measurement in received])
    # The median, because a busy computer may miss messages.
    rate = 1e9 / float(np.median(intervals)) if intervals.any() else 0.0
    why, next_step = _explain_dvrk(observer, received, rate, options)
    state = observer.operating_state
    words = ["operating state unknown"] if state is None else [shown(state.state), "moves by itself" * state.is_busy]
    nothing = np.full(arm.num_joints, np.nan)
    q, v, effort = np.mean([(m.q, m.v, m.effort) for m in received] or [(nothing,) * 3], axis=0)
    return ArmObservation(
        state=", ".join(filter(None, words)),
        why=why,
        next_step=next_step,
        is_fault=state is not None and state.state == "FAULT",
        notes=_notes(observer, (observer.num_received - num_before) / (time.monotonic() - start)),
        q=q,
        v=v,
        effort=effort,
        count=len(received),
        flags=[""] * arm.num_joints,
    )


def _notes(observer: CrtkObserver, rate: float) -> list[str]:
    """Returns what the topics state, and what is known only to a guard. `rate` is that of measured_js [Hz]."""
    gravity, topics = observer.gravity_compensation, ", ".join(observer.other_publishers())
    text = "unknown" if gravity is None else f"on, up to {gravity:.3g} N m or N" if gravity else "off"
    notes = [
        f"Gravity compensation of the dVRK: {text}.",
        f"Topics with which a process can move it: {topics or 'none'}.",
    ]
    if observer.measurement is not None:
        age = 1e-6 * (time.monotonic_ns() - observer.measurement.arrival)
        notes.insert(0, f"measured_js: {rate:.0f} per second, the last one {age:.0f} ms ago.")
    return [*notes, "Unknown over ROS 2: state of a guard, rate of commands, refused commands and active limits."]


def _explain_dvrk(
    observer: CrtkObserver, received: Sequence[JointMeasurement], rate: float, options: str
) -> tuple[str, str]:
    """Returns why the arm is in its state, and what the operator can do next."""
    from dvrk_drake.systems.ros.crtk_bridge import MIN_RATE, RATE_TOLERANCE

    restart = "check the dVRK's console and the network"
    if not received:
        return f"no message arrives on {observer.namespace}/measured_js", restart
    if observer.operating_state is None:
        return f"no message arrives on {observer.namespace}/operating_state. Is it a dVRK?", restart
    state, last, others = observer.operating_state, received[-1], observer.other_publishers()
    if state.state != "ENABLED":
        if state.state == "PAUSED":
            return "it executes no commands", "resume the arm at its console"
        remove = "remove the cause of the fault, then " if state.state == "FAULT" else ""
        return "the motors have no power", f"{remove}enable and home the arm at its console"
    if not state.is_homed:
        homes = "wait until the arm is homed" if state.is_busy else "home the arm at its console"
        return "the arm is not homed", homes
    if last.problem or not np.isfinite(last.effort).all():
        return last.problem or "a measured effort is not finite", "check the sensors of the arm and its console"
    if len(received) > 1 and last.stamp == received[0].stamp:
        return f"{observer.namespace}/measured_js repeats the same measurement", restart
    if twice := [topic for topic in others if topic.endswith(("/measured_js", "/operating_state"))]:
        return f"several processes publish {', '.join(twice)}", "end all but the console of the dVRK"
    if others:
        return "another process can move the arm (topics below)", ""
    why = "no process can move the arm"
    if rate < (1 - RATE_TOLERANCE) * MIN_RATE:
        why += f"; {rate:.0f} measurements per second suffice only for collect poses"
        return why, f"publish at {MIN_RATE:.0f} Hz or more, e.g. with another period of the dVRK's console"
    return idle_reason(observer.arm, last.q.tolist(), why, options)


def stop_dvrk(observer: CrtkObserver, *, power_off: bool = False) -> str:
    """Publishes `hold` until the arm confirms it, then, on request, switches the motor power off.

    A process that publishes commands is not ended, so it can move the arm again. A bridge obeys `hold`.

    Args:
        observer: Observer of the arm.
        power_off: True to switch the motor power off. An arm without brakes falls.

    Returns:
        State of the arm after the stop.

    Raises:
        ControllerError: The arm does not confirm `hold`, or its power stays on.
        DvrkDrakeError: DDS cannot send a message.
    """
    name = observer.namespace
    if not observer.hold_until_confirmed(FIRST_WAIT):
        raise ControllerError(f"{name}: the arm did not confirm hold. Press the emergency stop button")
    if power_off and not observer.switch_power_off(_POWER_OFF_ROS):
        raise ControllerError(f"{name} holds its pose, but its power stays on. Press the emergency stop button")
    observer.receive_state()
    state = observer.operating_state
    text = "it has confirmed hold" + (f", operating state {shown(state.state)}" if state is not None else "")
    if others := ", ".join(observer.other_publishers()):
        text += (
            f". Another process publishes {others}, and moves the arm again unless it is a bridge. {END_OTHER_PROCESS}"
        )
    return text
