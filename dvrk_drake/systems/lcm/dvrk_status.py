"""Status messages of an arm: their sender, and the clock of the arm."""

from __future__ import annotations

from dataclasses import dataclass

from pydrake.common.value import AbstractValue
from pydrake.systems.framework import Context, LeafSystem

from dvrk_drake.lcmtypes import lcmt_dvrk_status
from dvrk_drake.models.arm import Arm
from dvrk_drake.systems.guard.command_guard import CommandGuard


@dataclass(frozen=True)
class ArmClock:
    """Clock of an arm. It advances with the time of the context and never jumps.

    Attributes:
        start_utime: Value at time zero of the context [us].
        period: Period in which the arm measures, updates its guard and sends its status [s].
    """

    start_utime: int = 0
    period: float = 1e-3

    def utime(self, context: Context) -> int:
        """Returns the present time [us]."""
        return self.start_utime + round(1e6 * context.get_time())

    def ticks(self, context: Context) -> int:
        """Returns the number of periods that have begun since time zero."""
        return round(context.get_time() / self.period)


class DvrkStatusSender(LeafSystem):
    """Computes the status message of one arm for an LcmPublisherSystem: measurements and the state of the guard.

    .. pydrake_system::

        name: DvrkStatusSender
        input_ports:
        - state_estimated
        - effort_measured
        - effort_commanded
        - guard
        output_ports:
        - lcmt_dvrk_status

    - `state_estimated` (2n): q, then v [rad, rad/s; m, m/s on a prismatic joint].
    - `effort_measured` (n): applied motor efforts [N m, N].
    - `effort_commanded` (n): commanded motor efforts [N m, N].
    - `guard`: the CommandGuard, from DvrkCommandReceiver.
    - `lcmt_dvrk_status`: status message. The sequence is the number of periods since time zero.
    """

    def __init__(
        self,
        arm: Arm,
        guard: CommandGuard,
        clock: ArmClock | None = None,
        *,
        gravity_compensation: bool = False,
    ) -> None:
        """Creates the sender of `arm`.

        Args:
            arm: Arm of the status.
            guard: Guard of the arm, which defines the type of the port.
            clock: Clock that provides the time and the number of periods. None: `ArmClock()` is used.
            gravity_compensation: True if the arm adds its own gravity compensation to commanded efforts.
        """
        super().__init__()
        n = arm.num_joints
        self._num_joints, self._arm_name = n, arm.name
        self._clock = clock or ArmClock()
        self._gravity_compensation = gravity_compensation
        self._state = self.DeclareVectorInputPort("state_estimated", 2 * n)
        self._measured = self.DeclareVectorInputPort("effort_measured", n)
        self._commanded = self.DeclareVectorInputPort("effort_commanded", n)
        self._guard = self.DeclareAbstractInputPort("guard", AbstractValue.Make(guard))
        self.DeclareAbstractOutputPort(
            "lcmt_dvrk_status", lambda: AbstractValue.Make(lcmt_dvrk_status()), self._calc_status
        )

    def _calc_status(self, context: Context, output: AbstractValue) -> None:
        n = self._num_joints
        guard: CommandGuard = self._guard.Eval(context)
        q_v = self._state.Eval(context)
        status = lcmt_dvrk_status()
        status.utime, status.sequence = self._clock.utime(context), self._clock.ticks(context)
        status.arm_name, status.gravity_compensation = self._arm_name, self._gravity_compensation
        status.num_joints = n
        status.position, status.velocity = q_v[:n].tolist(), q_v[n:].tolist()
        status.effort_measured = self._measured.Eval(context).tolist()
        status.effort_commanded = self._commanded.Eval(context).tolist()
        fill_in_guard(status, guard)
        output.set_value(status)


def fill_in_guard(status: lcmt_dvrk_status, guard: CommandGuard) -> None:
    """Sets the fields of `status` that describe the state of a guard. A bridge can call this function as well."""
    status.session_id = guard.session_id
    status.guard_state, status.accepted_modes = guard.state, guard.accepted_modes
    status.fault_code, status.fault_text = guard.fault_code, guard.fault_text or guard.blocked_reason
    status.weaker_settings = guard.weaker_settings
    status.command_sender_id = guard.sender_id
    status.command_sequence, status.command_utime = guard.last_command.sequence, guard.last_command.utime
    counts = guard.counts
    status.num_accepted, status.num_lost, status.num_refused = counts.accepted, counts.lost, counts.refused
    status.num_expired, status.refusal_code = counts.expired, guard.refusal_code
    status.num_ignored, status.ignored_code = counts.ignored, guard.ignored_code
    status.position_commanded = guard.output.position.tolist()
    status.joint_flags = guard.output.joint_flags.tolist()
