"""Shows an operator the state of a dVRK arm on ROS 2, and stops the arm."""

from __future__ import annotations

import time
from collections.abc import Sequence

import numpy as np

from dvrk_drake.errors import ControllerError
from dvrk_drake.processes.arm_operator import ArmObservation, idle_reason
from dvrk_drake.processes.control import FIRST_WAIT
from dvrk_drake.systems.ros.crtk_bridge import MIN_RATE, RATE_TOLERANCE
from dvrk_drake.systems.ros.crtk_client import CrtkObserver, JointMeasurement, shown
from dvrk_drake.systems.ros.discovery import END_OTHER_PROCESS

#: Longest time until the first measurement [s]. A dVRK also publishes invalid measurements.
_FIRST = 2.0
#: Longest time until the arm has switched its power off [s].
_POWER_OFF = 2.0


def observe_dvrk(observer: CrtkObserver, seconds: float, options: str) -> ArmObservation:
    """Receives the messages of an arm for some time.

    Args:
        observer: Observer of the arm.
        seconds: Duration [s].
        options: Options of a command line for this arm, for the next step.
    """
    domain, arm, received = observer.domain, observer.arm, list[JointMeasurement]()
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
    why, next_step = _explain(observer, received, rate, options)
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


def _explain(
    observer: CrtkObserver, received: Sequence[JointMeasurement], rate: float, options: str
) -> tuple[str, str]:
    """Returns why the arm is in its state, and what the operator can do next."""
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
    if power_off and not observer.switch_power_off(_POWER_OFF):
        raise ControllerError(f"{name} holds its pose, but its power stays on. Press the emergency stop button")
    observer.receive_state()
    state = observer.operating_state
    text = "it has confirmed hold" + (f", operating state {shown(state.state)}" if state is not None else "")
    if others := ", ".join(observer.other_publishers()):
        text += (
            f". Another process publishes {others}, and moves the arm again unless it is a bridge. {END_OTHER_PROCESS}"
        )
    return text
