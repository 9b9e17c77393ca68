"""Links to one arm: its statuses arrive, and commands are sent to it."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod

import lcm
from pydrake.lcm import DrakeLcmInterface

from dvrk_drake.errors import ControllerError
from dvrk_drake.lcmtypes import lcmt_dvrk_command, lcmt_dvrk_force, lcmt_dvrk_status
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.lcm_messages import (
    MessageKey,
    StatusFilter,
    command_channel,
    decode,
    force_channel,
    status_channel,
)
from dvrk_drake.systems.lcm.messages import handle_message

#: Length of the queue of statuses. If the queue is full, further statuses are dropped. Largest number of statuses that
#: are processed at once. It limits the delay that a flood of messages can cause.
_QUEUE, _MESSAGES_AT_ONCE = 100, 200


class ArmLink(ABC):
    """Statuses (lcmt_dvrk_status) from one arm and commands (lcmt_dvrk_command) to it. Only the newest status is used.

    Attributes:
        arm: Arm whose statuses are received.
        lost: Number of statuses that were sent, but not received.
    """

    #: Place where the statuses arrive, for messages.
    where = ""

    def __init__(self, arm: Arm) -> None:
        """Creates a link to `arm`."""
        self.arm, self.lost = arm, 0

    @abstractmethod
    def close(self) -> None:
        """Ends the link."""

    @abstractmethod
    def poll(self) -> lcmt_dvrk_status | None:
        """Returns the newest status that arrived since the last call, or None."""

    @abstractmethod
    def next_status(self, seconds: float) -> lcmt_dvrk_status:
        """Returns the newest status of the session that arrives within `seconds`.

        Raises:
            DvrkDrakeError: No status arrived.
        """

    @abstractmethod
    def send(self, command: lcmt_dvrk_command) -> None:
        """Sends a command."""

    def send_force(self, force: lcmt_dvrk_force) -> None:
        """Publishes an estimated external force for other programs. The arm does not use it.

        Raises:
            ControllerError: This link does not publish forces.
        """
        raise ControllerError(f"{self.arm.name}: the force is published only while a controller acts")

    def now(self) -> float:
        """Returns the time of the computer's monotonic clock [s]."""
        return time.monotonic()

    def utime(self, context_time: float) -> int:
        """Returns the present time of the sender's clock [us]. `context_time` is the time of a Diagram [s]."""
        return round(1e6 * self.now())

    def release(self) -> bool:
        """Commands the arm to hold its pose without an answer to a status. Returns False if it needs an answer."""
        return False


class MessageLink(ArmLink):
    """Link over encoded messages. A subclass passes each received message to `_receive`."""

    def __init__(
        self,
        arm: Arm,
        *,
        key: MessageKey | None = None,
        before: lcmt_dvrk_status | None = None,
        replays: bool = False,
    ) -> None:
        """Creates a link.

        Args:
            arm: Arm whose statuses are received.
            key: Key that must have signed the statuses, and that signs the commands. None: statuses are not verified
                and commands are not signed.
            before: Status of the session that is used. A session is one run of the arm's process. None: the
                session of the first received status is used.
            replays: True to accept statuses of any session and time, for example from a replayed log. Must be False for
                a controller, because old statuses would determine the commands.
        """
        super().__init__(arm)
        self._replays, self._key, self._command_channel = replays, key, command_channel(arm)
        session = 0 if before is None else before.session_id
        self._filter = StatusFilter(arm.name, arm.num_joints, key, session_id=session)
        self._last: lcmt_dvrk_status | None = None
        self._is_new = False

    @abstractmethod
    def _handle(self, seconds: float) -> bool:
        """Handles one message that arrives within `seconds`. Returns whether one arrived."""

    @abstractmethod
    def _publish(self, channel: str, data: bytes) -> None:
        """Sends an encoded message."""

    def poll(self) -> lcmt_dvrk_status | None:
        """Returns the newest status that arrived since the last call, or None."""
        for _ in range(_MESSAGES_AT_ONCE):
            if not self._handle(0.0):
                break
        if not self._is_new:
            return None
        # Without a new status, the limits of the filter grow, so that statuses after a loss of messages are accepted.
        self._filter.settle(self.now())
        self._is_new = False
        return self._last

    def next_status(self, seconds: float) -> lcmt_dvrk_status:
        """Returns the newest status of the session that arrives within `seconds`.

        Raises:
            ControllerError: No status arrived. The error message lists ignored statuses.
        """
        end = time.monotonic() + seconds
        while not self._is_new and (left := end - time.monotonic()) > 0:
            self._handle(left)
        if (status := self.poll()) is None:
            raise ControllerError(
                f"no status of {self.arm.name} for {seconds:g} s on {self.where}{self._ignored_text()}"
            )
        return status

    def send(self, command: lcmt_dvrk_command) -> None:
        """Sends a command."""
        self._publish(self._command_channel, self._signed(command))

    def send_force(self, force: lcmt_dvrk_force) -> None:
        """Sends an estimated external force on the channel DVRK_FORCE_<ARM>."""
        self._publish(force_channel(self.arm), self._signed(force))

    def _signed(self, message: lcmt_dvrk_command | lcmt_dvrk_force) -> bytes:
        data = message.encode()
        return data if self._key is None else self._key.sign(data)

    def _receive(self, data: bytes) -> None:
        if self._replays:
            status = decode(lcmt_dvrk_status, data)
            if status is None or (status.arm_name, status.num_joints) != (self.arm.name, self.arm.num_joints):
                return
        elif (status := self._filter.accept(data, self.now(), settle=False)) is None:
            return
        elif self._last is not None:
            self.lost += status.sequence - self._last.sequence - 1
        self._last, self._is_new = status, True

    def _ignored_text(self) -> str:
        """Returns a description of the statuses that were ignored since the last accepted status, or advice."""
        ignored = self._filter.ignored.most_common()
        if not ignored:
            return ". Check that the process or the bridge of the arm runs on this network"
        advice = {
            StatusFilter.OTHER_SESSION: f"; {self.arm.name} was restarted: look at it, then start again",
            StatusFilter.NOT_AUTHENTIC: "; the arm and this process need the same key (--key)",
        }
        return f"; ignored: {', '.join(f'{n} {reason}' for reason, n in ignored)}{advice.get(ignored[0][0], '')}"


class LcmArmLink(MessageLink):
    """Link to an arm over an LCM network."""

    def __init__(
        self,
        arm: Arm,
        url: str,
        *,
        key: MessageKey | None = None,
        before: lcmt_dvrk_status | None = None,
        replays: bool = False,
    ) -> None:
        """Opens the channels of `arm` on the LCM network `url`; see `MessageLink` for the other arguments."""
        super().__init__(arm, key=key, before=before, replays=replays)
        self.where = status_channel(arm)
        self._lcm = lcm.LCM(url)
        self._subscription = self._lcm.subscribe(self.where, lambda channel, data: self._receive(data))
        self._subscription.set_queue_capacity(_QUEUE)

    def close(self) -> None:
        """Stops receiving and ends LCM's receive thread, which otherwise wakes up for every message."""
        self._lcm.unsubscribe(self._subscription)
        # The subscription refers to this link and to LCM, which the garbage collector does not detect.
        del self._subscription, self._lcm

    def _handle(self, seconds: float) -> bool:
        return handle_message(self._lcm, seconds)

    def _publish(self, channel: str, data: bytes) -> None:
        self._lcm.publish(channel, data)


class DrakeLcmArmLink(MessageLink):
    """Link to an arm over a Drake LCM interface, whose `HandleSubscriptions` the caller calls.

    The sender's clock is the time of the Diagram, so a simulated network may be faster or slower than real time.
    """

    def __init__(self, arm: Arm, network: DrakeLcmInterface, *, key: MessageKey | None = None) -> None:
        """Subscribes to the statuses of `arm`. See `MessageLink` for `key`."""
        super().__init__(arm, key=key)
        self.where, self._network = status_channel(arm), network
        network.Subscribe(self.where, self._receive)

    def close(self) -> None:
        """Does nothing. Drake ends a subscription together with its interface."""

    def utime(self, context_time: float) -> int:
        """Returns the time of the Diagram [us]."""
        return round(1e6 * context_time)

    def _handle(self, seconds: float) -> bool:
        return False

    def _publish(self, channel: str, data: bytes) -> None:
        self._network.Publish(channel, data)
