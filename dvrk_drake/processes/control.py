"""Process that controls one arm over LCM, started by `dvrk-drake control`."""

from __future__ import annotations

import contextlib
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.errors import ControllerError
from dvrk_drake.lcmtypes import lcmt_dvrk_command, lcmt_dvrk_status
from dvrk_drake.models.lcm_messages import describe_state
from dvrk_drake.processes.arm_controller import ArmController, GoalController
from dvrk_drake.processes.live_status import AnswerTimes, LiveStatus, LiveStatusMaker, takeover_reason
from dvrk_drake.systems.lcm.arm_link import ArmLink

#: Time without a status after which an arm is considered absent [s]. Longest time until the first status [s].
SILENCE, FIRST_WAIT = 1.0, 10.0

#: Longest period of the measurements [us]. With the gains of the arm files, a PSM oscillates if this period is 7 ms,
#: and an MTM oscillates if it is 10 ms.
_MAX_PERIOD = 5000

#: Number of statuses that are inspected before an arm is controlled.
_FIRST_STATUSES = 60

#: Longest time until the arm confirms HOLD [s].
_RELEASE = 1.0

#: Longest time without applied commands [s]. The start check of the guard takes 0.25 s.
_TIMEOUT = 10.0

#: Advice for an arm that has a fault or waits for an operator.
_RESET = "Look at the arm, then start again, over LCM with --reset"

#: Period in which `report` is called with the live status [s].
_REPORT_PERIOD = 0.2


def first_status(link: ArmLink) -> tuple[lcmt_dvrk_status, float]:
    """Waits for the first status and checks that the arm may be controlled.

    Returns:
        First status, and the period of the statuses [s].

    Raises:
        ControllerError: No status arrives, or the arm has a fault, waits for an operator, measures values that are not
            finite, is outside its limits, does not accept efforts, or measures too infrequently.
    """
    status, name = link.next_status(FIRST_WAIT), link.arm.name
    _check(status, name)
    if not np.all(np.isfinite([*status.position, *status.velocity, *status.effort_measured])):
        raise ControllerError(f"{name}: a measured position, velocity or effort is not finite. Check its sensors first")
    if violations := link.arm.limit_violations(status.position):
        raise ControllerError(f"{name} is outside its limits: {'; '.join(violations)}. Move it inside first")
    if not status.accepted_modes >> lcmt_dvrk_command.EFFORT & 1:
        raise ControllerError(f"{name} does not accept efforts now; its state is {describe_state(status.guard_state)}")
    utimes = [status.utime]
    for _ in range(_FIRST_STATUSES):
        later = link.next_status(SILENCE)
        _check(later, name)
        utimes.append(later.utime)
    if not (later.sequence > status.sequence and later.utime > status.utime):
        raise ControllerError(
            f"{name}: utime or sequence of its status does not increase. Restart its driver or bridge"
        )
    # The smallest interval is the period, because a busy computer may miss statuses. Several statuses of one
    # measurement have the same utime.
    gaps = np.diff(np.unique(utimes))
    if min(gaps) > _MAX_PERIOD:
        raise ControllerError(
            f"{name} is measured at {1e6 / min(gaps):.0f} Hz; control needs at least {1e6 / _MAX_PERIOD:.0f} Hz "
            "(1 kHz is recommended)"
        )
    return status, 1e-6 * (later.utime - status.utime) / (later.sequence - status.sequence)


def _check(status: lcmt_dvrk_status, name: str, late: Callable[[], str] = lambda: "") -> None:
    """Raises a ControllerError if the arm has a fault, waits for an operator, or adds its own gravity compensation.

    Args:
        status: Status of the arm.
        name: Name of the arm.
        late: Function that returns a description of late commands, or "" if no command is late. Late commands may be
            the reason of a watchdog hold.
    """
    if status.fault_code != lcmt_dvrk_status.FAULT_NONE:
        raise ControllerError(f"{name} has a fault: {status.fault_text}. {_RESET}")
    if status.fault_text:
        reason = "; ".join(filter(None, [status.fault_text, late()]))
        raise ControllerError(f"the guard of {name} holds the arm: {reason}. {_RESET}")
    if status.gravity_compensation:
        raise ControllerError(
            f"{name} adds its own gravity compensation. Together with this controller, it would throw the arm upward. "
            "Switch it off in the arm's driver (gravity_compensation in its status)"
        )


#: Function that is called with a status and its time of arrival [s]. It returns the desired state (2n,), or None to
#: hold the latched pose.
StatusHandler = Callable[[lcmt_dvrk_status, float], NDArray[np.float64] | None]


def control(
    link: ArmLink,
    controller: ArmController | GoalController,
    stopped: Callable[[], bool],
    report: Callable[[LiveStatus], None],
    on_status: StatusHandler = lambda status, time: None,
) -> None:
    """Sends a command for every status until `stopped` returns true or an error occurs, then commands HOLD.

    Args:
        link: Channels of the arm.
        controller: Controller that computes the commands.
        stopped: Function that returns whether to stop. It is called once per status.
        report: Function that is called with the live status a few times per second.
        on_status: Function that returns the desired state; see `StatusHandler`. It is called once per status.

    Raises:
        ControllerError: The arm stops sending statuses, is restarted, has a fault, is held by its guard, adds its own
            gravity compensation, or applies no commands.
    """
    start = link.now()
    first = link.next_status(SILENCE)
    live, next_report, acted, before = LiveStatusMaker(controller.sender_id, first), _REPORT_PERIOD, 0.0, first
    answers = AnswerTimes()
    try:
        while not stopped():
            status = link.next_status(SILENCE)
            now = link.now() - start
            answers.add(now)
            _check(status, link.arm.name, answers.lateness)
            link.send(controller.answer(status, now, on_status(status, now)))
            live.answer(status, now)
            if controller.acting:
                acted, before = now, status
            elif now > acted + _TIMEOUT:
                reason = takeover_reason(status, before, answers)
                raise ControllerError(f"{link.arm.name} applied no command for {_TIMEOUT:g} s: {reason}")
            if now >= next_report:
                report(live.make(status, now, link.lost))
                next_report = now + _REPORT_PERIOD
    except BaseException:
        # The last efforts would act until they expire. The first error is the one that matters.
        with contextlib.suppress(Exception):
            _release(link, controller, start)
        raise
    _release(link, controller, start)


def _release(link: ArmLink, controller: ArmController | GoalController, start: float) -> None:
    """Commands HOLD until a status shows that the controller is not in control."""
    if link.release():
        return
    end = link.now() + _RELEASE
    while link.now() < end:
        status = link.next_status(SILENCE)
        if status.command_sender_id != controller.sender_id:
            _check(status, link.arm.name)
            return
        command = controller.answer(status, link.now() - start)
        command.control_mode = lcmt_dvrk_command.HOLD
        link.send(command)
    raise ControllerError(f"{link.arm.name} did not confirm HOLD. It will hold when the last command expires")
