"""Checks a dVRK arm that moves on its own: whether the motion must stop."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.dynamics.identified_model import ControlModel
from dvrk_drake.errors import CollectionError
from dvrk_drake.systems.ros.arrival_clock import ArrivalClock
from dvrk_drake.systems.ros.discovery import END_OTHER_PROCESS

if TYPE_CHECKING:
    from dvrk_drake.models.arm import Arm
    from dvrk_drake.systems.ros.crtk_client import CrtkClient

#: Time without a message on measured_js after which the motion must stop [s]. The arm has then stopped already, because
#: goals wait for new measurements.
SILENCE = 1.0
#: Largest plausible change of a position between two messages: a fraction of the range of the joint, and ranges per
#: second of the time between the messages.
JUMP, _JUMP_SPEED = 0.02, 2.0
#: Time for which the effort may exceed its limit [s]. A shorter peak is friction or noise.
OVERLOAD = 0.05


class CrtkMonitor:
    """Receives the messages of an arm and checks them.

    Attributes:
        q: Measured positions (n,) [rad, m] in the last message.
        effort: Measured efforts (n,) [N m, N] in the last message.
        num_received: Number of messages on measured_js.
    """

    def __init__(self, client: CrtkClient, model: ControlModel, max_effort: float) -> None:
        """Creates a monitor.

        Args:
            client: Client of the arm.
            model: Model of the arm.
            max_effort: Largest absolute difference between the measured effort and the gravity effort of the model, as
                a fraction of the effort limit of the joint.
        """
        self._client, self._arm, self._model, self._max_effort = client, client.arm, model, max_effort
        self.q = self.effort = np.zeros(client.arm.num_joints)
        self.num_received = self._stamp = 0
        self._span = self._arm.position_upper - self._arm.position_lower
        # The first message may be late, if this computer is busy.
        self._clock = ArrivalClock(SILENCE)
        self._overload_since: float | None = None
        self._num_changes = -1

    def update(self, now: float, *, with_effort: bool) -> None:
        """Receives messages and checks the arm.

        Args:
            now: Present time of the monotonic clock [s].
            with_effort: Whether to check the efforts.

        Raises:
            CollectionError: The motion must stop.
        """
        try:
            self._update(now, with_effort=with_effort)
        except CollectionError as error:
            raise CollectionError(f"{self._arm.name} stopped: {error}") from None

    def _update(self, now: float, *, with_effort: bool) -> None:
        client = self._client
        topic, is_new = f"{client.namespace}/measured_js", client.receive()
        if reason := client.not_ready_reason:
            raise CollectionError(reason)
        if client.domain.num_changes != self._num_changes:
            self._num_changes = client.domain.num_changes
            if others := ", ".join(client.other_publishers()):
                raise CollectionError(f"another process publishes {others}. {END_OTHER_PROCESS}")
        measurement = client.measurement
        if measurement is None or now - 1e-9 * measurement.arrival > SILENCE:
            raise CollectionError(f"no message on {topic} for {SILENCE:g} s")
        if not is_new:
            return
        if measurement.problem:
            raise CollectionError(measurement.problem)
        if jump := self._clock.convert(measurement.stamp, measurement.arrival)[1]:
            raise CollectionError(f"{topic}: {jump}")
        if unheard := client.unheard_commands(("move_jp", "hold")):
            raise CollectionError(f"no process subscribes to {', '.join(unheard)}")
        if self._stamp:
            self._check_jump(measurement.q - self.q, 1e-9 * (measurement.stamp - self._stamp))
        self.q, self.effort = measurement.q, measurement.effort
        self.num_received, self._stamp = client.num_received, measurement.stamp
        if with_effort:
            self._check_effort(now)

    def _check_jump(self, change: NDArray[np.float64], interval: float) -> None:
        ratio = np.abs(change) / (self._span * (JUMP + _JUMP_SPEED * interval))
        j = int(np.argmax(ratio))
        if ratio[j] > 1:
            raise CollectionError(
                f"{self._arm.joint_names[j]} jumped by {change[j]:.3g} {unit(self._arm, j)} between two messages. "
                "Check the encoder of the joint"
            )

    def _check_effort(self, now: float) -> None:
        excess = np.abs(self.effort - self._model.gravity_effort(self.q)) / self._arm.effort_limits
        j = int(np.argmax(excess))
        if excess[j] <= self._max_effort:
            self._overload_since = None
            return
        if self._overload_since is None:
            self._overload_since = now
        if now - self._overload_since >= OVERLOAD:
            newton = "N" if self._arm.prismatic[j] else "N m"
            raise CollectionError(
                f"the effort {self.effort[j]:.3g} {newton} of {self._arm.joint_names[j]} differs from the gravity "
                f"effort of the model by {excess[j]:.2f} of the effort limit; allowed: {self._max_effort:g} "
                "(--max-effort). Check for an obstacle"
            )


def unit(arm: Arm, joint: int) -> str:
    """Returns the unit of the position of a joint, "rad" or "m"."""
    return "m" if arm.prismatic[joint] else "rad"
