"""Control loop of one arm, and its live status, displayed by `dvrk-drake control` and `collect`."""

from __future__ import annotations

import contextlib
import shutil
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import TextIO

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.errors import ControllerError
from dvrk_drake.lcmtypes import lcmt_dvrk_command, lcmt_dvrk_status
from dvrk_drake.models.lcm_messages import describe_refusal, describe_state
from dvrk_drake.processes.arm_controller import ArmController, GoalController
from dvrk_drake.systems.lcm.arm_link import ArmLink


class LiveLine:
    """Status line in a terminal that is updated at most four times per second."""

    def __init__(self, stream: TextIO, period: float = 0.25, clock: Callable[[], float] = time.monotonic) -> None:
        """Creates a status line.

        Args:
            stream: Stream to write to. If it is not a terminal, nothing is written.
            period: Minimum time between two updates [s].
            clock: Function that returns a monotonic time [s].
        """
        self._stream, self._period, self._clock = stream, period, clock
        self._next = clock()

    def show(self, text: Callable[[], str]) -> None:
        """Updates the line with the result of `text` if the period has elapsed."""
        now = self._clock()
        if not self._stream.isatty() or now < self._next:
            return
        self._next = now + self._period
        columns = shutil.get_terminal_size().columns
        self._write(text()[: columns - 1])

    def clear(self) -> None:
        """Clears the line for subsequent output."""
        if self._stream.isatty():
            self._write("")

    def report(self, text: str) -> None:
        """Prints a line of text to the standard output, above the status line."""
        self.clear()
        print(text, flush=True)

    def _write(self, text: str) -> None:
        # Escape sequence: clear the line to the right of the cursor.
        self._stream.write(f"\r\x1b[K{text}")
        self._stream.flush()


#: Time window in which commands are counted [s]. Interval between commands above which the controller is too slow [s].
_WINDOW, _LATE = 1.0, 0.02
#: Reasons for which the guard refuses commands if the sender or the arm is too slow.
_REFUSED_IF_LATE = (
    lcmt_dvrk_status.REFUSAL_STALE,
    lcmt_dvrk_status.REFUSAL_OUT_OF_ORDER,
    lcmt_dvrk_status.REFUSAL_SEQUENCE_JUMP,
    lcmt_dvrk_status.REFUSAL_CLOCK_JUMP,
)
#: Reasons for which the guard refuses all commands until the last accepted command expires.
_EXPIRED_IF_REFUSED = (lcmt_dvrk_status.REFUSAL_SEQUENCE_JUMP, lcmt_dvrk_status.REFUSAL_CLOCK_JUMP)


@dataclass(frozen=True)
class LiveStatus:
    """Status of a control loop for display.

    Attributes:
        state: State of the guard.
        pace: Rate of the commands, their round-trip time, and the number of lost statuses.
        problem: Reasons why commands were refused, ignored or expired since the previous live status, and settings of
            the guard that are weaker than their defaults; or "" if there are none.
    """

    state: str
    pace: str
    problem: str

    def __str__(self) -> str:
        return "; ".join(filter(None, [self.state, self.pace, self.problem]))


class LiveStatusMaker:
    """Computes live statuses from the arm's statuses and the times of the controller's commands."""

    def __init__(self, sender_id: int, first: lcmt_dvrk_status) -> None:
        """Starts the counts for a sender at the `first` status of the arm. A restarted arm requires a new object."""
        self._sender_id, self._before, self._last_time = sender_id, first, 0.0
        self._answered = 0
        self._trips: deque[float] = deque(maxlen=1000)

    def answer(self, status: lcmt_dvrk_status, time: float) -> None:
        """Counts a command that was sent for `status` at `time` [s] of the sender's clock."""
        self._answered += 1
        if status.command_sender_id == self._sender_id:
            self._trips.append(time - 1e-6 * status.command_utime)

    def make(self, status: lcmt_dvrk_status, time: float, lost: int) -> LiveStatus:
        """Returns the live status for the time since the previous live status.

        Args:
            status: Last status of the arm.
            time: Time of the sender's clock [s].
            lost: Number of statuses that were not received.
        """
        rate = self._answered / (time - self._last_time)
        trip = f"round trip {1e3 * float(np.median(self._trips)):.2f} ms" if self._trips else "no command accepted yet"
        problem = []
        if status.num_refused > self._before.num_refused:
            problem.append(f"refused: {describe_refusal(status.refusal_code)}")
        if status.num_ignored > self._before.num_ignored:
            problem.append(f"the arm ignores messages: {describe_refusal(status.ignored_code)}")
        if status.num_expired > self._before.num_expired:
            problem.append("the guard holds the arm because the last command expired")
        if status.weaker_settings:
            problem.append(f"guard settings weaker than the defaults: {status.weaker_settings}")
        self._before, self._last_time, self._answered = status, time, 0
        pace = f"{rate:.0f} Hz, {trip}, {lost} statuses lost"
        return LiveStatus(describe_state(status.guard_state), pace, ", ".join(problem))


class AnswerTimes:
    """Times of a controller's commands in the last second, to determine the rate and longest interval of commands."""

    def __init__(self) -> None:
        self._times: deque[float] = deque()

    def add(self, time: float) -> None:
        """Adds a command at `time` [s] of the controller's clock."""
        self._times.append(time)
        while time - self._times[0] > _WINDOW and len(self._times) > 2:
            self._times.popleft()

    def lateness(self) -> str:
        """Returns a message with the rate and longest interval of the commands if they are too infrequent, or ""."""
        intervals = np.diff(np.array(self._times))
        if not len(intervals) or intervals.max() <= _LATE:
            return ""
        return (
            f"this computer or the arm's computer is too slow: {1 / intervals.mean():.0f} commands per second, longest "
            f"interval {1e3 * intervals.max():.0f} ms. End other programs, or use --realtime"
        )


def takeover_reason(status: lcmt_dvrk_status, before: lcmt_dvrk_status, answers: AnswerTimes) -> str:
    """Returns the reason why an arm no longer applies the commands of the controller.

    Args:
        status: Status in which the arm does not apply the commands.
        before: Last status in which the arm applied the commands, or the first status. Earlier refusals are not
            considered.
        answers: Times of the controller's commands.
    """
    expired, refused = status.num_expired > before.num_expired, status.num_refused > before.num_refused
    late = answers.lateness()
    if late and (expired or not refused or status.refusal_code in _REFUSED_IF_LATE):
        return late
    if expired and not (refused and status.refusal_code in _EXPIRED_IF_REFUSED):
        return "commands arrived too late (use --realtime)"
    if refused:
        return f"last refused command: {describe_refusal(status.refusal_code)}"
    if status.num_ignored > before.num_ignored:
        return f"the arm ignores messages: {describe_refusal(status.ignored_code)}"
    return f"its state is {describe_state(status.guard_state)}"


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
