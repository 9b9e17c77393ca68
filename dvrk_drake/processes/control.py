"""A process that controls one arm over LCM: `dvrk-drake run`."""

from __future__ import annotations

import time
from collections.abc import Callable

import lcm
import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import AbstractValue

from dvrk_drake.errors import ControllerError
from dvrk_drake.lcmtypes import lcmt_dvrk_command, lcmt_dvrk_status
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.lcm_messages import (
    MessageKey,
    StatusFilter,
    command_channel,
    decode,
    describe_state,
    status_channel,
)
from dvrk_drake.processes.arm_controller import ArmController
from dvrk_drake.processes.lcm_network import handle_message
from dvrk_drake.processes.live_status import AnswerTimes, LiveStatus, LiveStatusMaker, takeover_reason
from dvrk_drake.systems.lcm.dvrk_command import DvrkCommandSender

#: Without a status for this long there is no arm [s]; at first it may have to be started.
_SILENCE, _FIRST_WAIT = 1.0, 10.0

#: Measurements may not be further apart [us]: a PSM held with its own gains swings at 7 ms, an MTM at 10 ms.
_MAX_PERIOD = 5000

#: Statuses that wait, beyond which new ones are dropped; and how many are handled at once, so that a flood cannot keep
#: a controller from answering.
_QUEUE, _MESSAGES_AT_ONCE = 100, 200

#: How many statuses are looked at before an arm is controlled.
_FIRST_STATUSES = 60

#: How long the arm may take to confirm that it holds by itself [s].
_RELEASE = 1.0

#: The longest time for which a guard may remember a sender that is silent, and a little [s].
_FORGOTTEN = 1.1

#: How long commands may be refused, or watched, without one that acts [s]; the start guard takes a quarter of a second.
_TIMEOUT = 10.0

#: What to do about an arm that has a fault or waits for an operator.
_RESET = "Look at the arm, then start again with --reset"

#: How often `tell` hears the live status [s].
_TELL = 0.2


class ArmLink:
    """Both channels of one arm, for a loop that is driven by its messages: only the newest status counts."""

    def __init__(
        self,
        arm: Arm,
        url: str,
        *,
        key: MessageKey | None = None,
        before: lcmt_dvrk_status | None = None,
        replays: bool = False,
    ) -> None:
        """Of `arm` on the LCM network `url`.

        Args:
            arm: whose statuses count.
            url: of the network.
            key: must have signed statuses, and signs commands; None: neither is signed.
            before: a status of the session that is controlled; None: the first session that is seen.
            replays: also take statuses of any session and time, as of a log that is played again. Never for a
                controller: what it is told of the arm's past would go into what it answers to the present.
        """
        self.arm, self.lost, self._replays, self._key = arm, 0, replays, key
        self._session = 0 if before is None else before.session_id
        self._filter = StatusFilter(arm.name, arm.num_joints, key, session_id=self._session)
        self._lcm = lcm.LCM(url)
        self._last: lcmt_dvrk_status | None = None
        self._is_new = False
        self._subscription = self._lcm.subscribe(status_channel(arm), self._hear)
        self._subscription.set_queue_capacity(_QUEUE)

    def close(self) -> None:
        """Hears no more, and ends LCM's reading thread, which would wake for every message for nothing."""
        self._lcm.unsubscribe(self._subscription)
        # The subscription holds this link and LCM, unseen by the garbage collector.
        del self._subscription, self._lcm

    def now(self) -> float:
        """Time by the computer's monotonic clock [s]."""
        return time.monotonic()

    def next_status(self, seconds: float) -> lcmt_dvrk_status:
        """The newest status of the session that comes within `seconds`.

        Raises:
            ControllerError: none came; the message names what came instead.
        """
        end = time.monotonic() + seconds
        self._is_new = False
        while not self._is_new and (left := end - time.monotonic()) > 0:
            handle_message(self._lcm, left)
        for _ in range(_MESSAGES_AT_ONCE):
            if not handle_message(self._lcm, 0.0):
                break
        self._filter.settle(self.now())
        if not self._is_new or self._last is None:
            raise ControllerError(
                f"no status of {self.arm.name} for {seconds:g} s on {status_channel(self.arm)}{self._instead()}"
            )
        return self._last

    def send(self, command: lcmt_dvrk_command) -> None:
        """Publishes a command."""
        data = command.encode()
        self._lcm.publish(command_channel(self.arm), data if self._key is None else self._key.sign(data))

    def _hear(self, channel: str, data: bytes) -> None:
        if self._replays:
            status = decode(lcmt_dvrk_status, data)
            if status is None or (status.arm_name, status.num_joints) != (self.arm.name, self.arm.num_joints):
                return
        elif (status := self._filter.take(data, self.now(), settle=False)) is None:
            return
        elif self._last is not None:
            self.lost += status.sequence - self._last.sequence - 1
        self._last, self._is_new = status, True

    def _instead(self) -> str:
        """Returns which statuses came and were ignored since the last one, in words, or ""."""
        ignored = self._filter.ignored.most_common()
        if not ignored:
            return ""
        advice = {
            StatusFilter.OTHER_SESSION: f"; {self.arm.name} was restarted: look at it, then start again",
            StatusFilter.NOT_AUTHENTIC: "; both sides need the same key (--key)",
        }
        return f"; ignored: {', '.join(f'{n} {reason}' for reason, n in ignored)}{advice.get(ignored[0][0], '')}"


def first_status(link: ArmLink) -> tuple[lcmt_dvrk_status, float]:
    """The first status of an arm that may be controlled, and the period in which statuses come [s].

    Raises:
        ControllerError: no arm, a fault, an arm that waits for an operator, a state that is not known, a pose outside
            the limits, an arm that takes no efforts, or is measured too seldom.
    """
    status, name = link.next_status(_FIRST_WAIT), link.arm.name
    _check(status, name)
    if not np.all(np.isfinite([*status.position, *status.velocity, *status.effort_measured])):
        raise ControllerError(f"{name} does not know its state: a position, velocity or effort is not finite")
    if violations := link.arm.limit_violations(status.position):
        raise ControllerError(f"{name} stands outside its limits: {'; '.join(violations)}. Move it inside first")
    if not status.accepted_modes >> lcmt_dvrk_command.EFFORT & 1:
        raise ControllerError(f"{name} does not accept efforts now; its state is {describe_state(status.guard_state)}")
    utimes = [status.utime]
    for _ in range(_FIRST_STATUSES):
        later = link.next_status(_SILENCE)
        _check(later, name)
        utimes.append(later.utime)
    if not (later.sequence > status.sequence and later.utime > status.utime):
        raise ControllerError(f"{name} tells nothing new: its utime or sequence does not increase")
    # The least one: on a busy computer some are missed. Several statuses of one measurement have one utime.
    gaps = np.diff(np.unique(utimes))
    if min(gaps) > _MAX_PERIOD:
        raise ControllerError(
            f"{name} is measured at {1e6 / min(gaps):.0f} Hz; control needs {1e6 / _MAX_PERIOD:.0f} Hz, better 1 kHz"
        )
    return status, 1e-6 * (later.utime - status.utime) / (later.sequence - status.sequence)


def reset_fault(link: ArmLink, tell: Callable[[str], None]) -> None:
    """Asks the arm to clear its latched fault, or to resume after its watchdog took over, and leaves it in its hold.

    Args:
        link: to the arm.
        tell: hears what the fault was, or why the watchdog took over, before it is cleared.

    Raises:
        ControllerError: no arm, or one whose fault or hold stays, because its cause lasts.
    """
    status, name = link.next_status(_FIRST_WAIT), link.arm.name
    if status.fault_code == lcmt_dvrk_status.FAULT_NONE and not status.fault_text:
        return
    fault = status.fault_text
    if status.fault_code == lcmt_dvrk_status.FAULT_NONE:
        tell(f"{name} took over and waits for an operator, who resumes now: {fault}")
    else:
        tell(f"{name} has a fault, which is reset now: {fault}")
    sender = DvrkCommandSender(link.arm)
    context = sender.CreateDefaultContext()
    start = link.now()
    # The flag must be seen to change: false, then true.
    for reset in [0.0, 0.0, *[1.0] * 20]:
        context.SetTime(link.now() - start)
        sender.GetInputPort("reset_fault").FixValue(context, np.array([reset]))
        sender.GetInputPort("lcmt_dvrk_status").FixValue(context, AbstractValue.Make(status))
        link.send(sender.get_output_port().Eval(context))
        status = link.next_status(_SILENCE)
    # A sender that comes while this one still has its place would be ignored: a guard may keep it for a second.
    end = link.now() + _FORGOTTEN
    while link.now() < end:
        status = link.next_status(_SILENCE)
    if status.fault_code != lcmt_dvrk_status.FAULT_NONE:
        raise ControllerError(f"{name} has a fault that stays: {status.fault_text or fault}")
    if status.fault_text:
        raise ControllerError(f"{name} does not resume: {status.fault_text}")


def _check(status: lcmt_dvrk_status, name: str, late: Callable[[], str] = lambda: "") -> None:
    """Refuses an arm that has a fault, waits for an operator, or adds its own gravity compensation.

    `late` says whether answers came too seldom, which may be why the arm took over.
    """
    if status.fault_code != lcmt_dvrk_status.FAULT_NONE:
        raise ControllerError(f"{name} has a fault: {status.fault_text}. {_RESET}")
    if status.fault_text:
        why = "; ".join(filter(None, [status.fault_text, late()]))
        raise ControllerError(f"{name} took over and holds: {why}. {_RESET}")
    if status.gravity_compensation:
        raise ControllerError(
            f"{name} adds gravity compensation of its own, and two of them throw the arm upward: switch it off there "
            "(gravity_compensation in its status)"
        )


#: Hears a status and the time [s], and says the desired state (2n), or None for the controller's own.
Lead = Callable[[lcmt_dvrk_status, float], NDArray[np.float64] | None]


def control(
    link: ArmLink,
    controller: ArmController,
    stopped: Callable[[], bool],
    tell: Callable[[LiveStatus], None],
    lead: Lead = lambda status, time: None,
) -> None:
    """Answers every status until `stopped`, then leaves the arm to its own hold.

    Args:
        link: to the arm.
        controller: makes the commands.
        stopped: asked once a status.
        tell: hears how it goes a few times a second.
        lead: where to, asked once a status.

    Raises:
        ControllerError: the arm fell silent, as one that was restarted, faulted, took over, or lets no command act.
    """
    start = link.now()
    first = link.next_status(_SILENCE)
    live, tell_at, acted, before = LiveStatusMaker(controller.sender_id, first), _TELL, 0.0, first
    answers = AnswerTimes()
    while not stopped():
        status = link.next_status(_SILENCE)
        now = link.now() - start
        answers.add(now)
        _check(status, link.arm.name, answers.lateness)
        link.send(controller.answer(status, now, lead(status, now)))
        live.answer(status, now)
        if controller.acting:
            acted, before = now, status
        elif now > acted + _TIMEOUT:
            why = takeover_reason(status, before, answers)
            raise ControllerError(f"{link.arm.name} lets no command act for {_TIMEOUT:g} s; {why}")
        if now >= tell_at:
            tell(live.make(status, now, link.lost))
            tell_at = now + _TELL
    _release(link, controller, start)


def _release(link: ArmLink, controller: ArmController, start: float) -> None:
    """Asks the arm to hold until it says that it does."""
    end = link.now() + _RELEASE
    while link.now() < end:
        status = link.next_status(_SILENCE)
        _check(status, link.arm.name)
        if status.guard_state in (lcmt_dvrk_status.STATE_HOLD, lcmt_dvrk_status.STATE_OFF):
            return
        command = controller.answer(status, link.now() - start)
        command.control_mode = lcmt_dvrk_command.HOLD
        link.send(command)
    raise ControllerError(f"{link.arm.name} did not confirm that it holds; without commands it does after its expiry")
