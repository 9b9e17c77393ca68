"""Commands to an arm: command of a sender, and System that receives commands and checks them with a guard."""

from __future__ import annotations

import secrets

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import AbstractValue
from pydrake.systems.framework import BasicVector, Context, DiscreteValues, LeafSystem, State

from dvrk_drake.lcmtypes import lcmt_dvrk_command, lcmt_dvrk_status
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.lcm_messages import MessageKey
from dvrk_drake.systems.guard.command_guard import CommandGuard
from dvrk_drake.systems.guard.command_inbox import CommandInbox
from dvrk_drake.systems.guard.command_stream import is_finite
from dvrk_drake.systems.lcm.dvrk_status import ArmClock


def draw_id() -> int:
    """Returns a random sender_id or session_id, which is not 0 and practically unique."""
    return 1 + secrets.randbelow(2**62)


def make_command(
    status: lcmt_dvrk_status,
    sender_id: int,
    utime: int,
    mode: int,
    effort: NDArray[np.float64] | None = None,
    desired_state: NDArray[np.float64] | None = None,
    *,
    reset_fault: bool = False,
) -> lcmt_dvrk_command:
    """Returns the command that answers a status.

    The mode is HOLD if the values of the mode are missing or not finite, or with `reset_fault`. The command contains
    the session, time and sequence of the status. The arm refuses a second command for the same status, so it holds if
    the sender receives no new statuses.

    Args:
        status: Last received status.
        sender_id: Identifier of the sender.
        utime: Present time of the sender's clock [us].
        mode: lcmt_dvrk_command.OFF, HOLD, POSITION or EFFORT.
        effort: Commanded efforts (n,) [N m, N] for EFFORT.
        desired_state: Commanded q, then v (2n,) [rad, m, rad/s, m/s] for POSITION.
        reset_fault: Whether to request the reset of a fault, or the resume after a watchdog hold.
    """
    n, command = status.num_joints, lcmt_dvrk_command()
    command.utime, command.sequence, command.sender_id = utime, status.sequence, sender_id
    command.session_id, command.status_utime = status.session_id, status.utime
    command.arm_name, command.num_joints = status.arm_name, n
    efforts, q, v = [0.0] * n, [0.0] * n, [0.0] * n
    command.control_mode, command.reset_fault = lcmt_dvrk_command.HOLD, reset_fault
    values = {lcmt_dvrk_command.EFFORT: effort, lcmt_dvrk_command.POSITION: desired_state}.get(mode)
    numbers = None if values is None else values.tolist()
    if mode == lcmt_dvrk_command.OFF and not reset_fault:
        command.control_mode = mode
    elif numbers is not None and is_finite(numbers) and not reset_fault:
        command.control_mode = mode
        if mode == lcmt_dvrk_command.EFFORT:
            efforts = numbers
        else:
            q, v = numbers[:n], numbers[n:]
    command.effort, command.position, command.velocity = efforts, q, v
    return command


#: Shortest time [s] in which an effort grows from zero to its limit, outside the state EFFORT. The gains of the
#: position controller are stable up to a delay of 8 ms, so the crossover frequency is below pi/2 / 8 ms = 196 rad/s. An
#: effort with this frequency and the amplitude of the limit changes by the limit within 5 ms. With a longer time, large
#: motions would be unstable.
_RISE_TIME = 0.004


class DvrkCommandReceiver(LeafSystem):
    """Receives commands for one arm, checks them with a guard, and outputs the resulting efforts and targets.

    Until a command acts, the arm holds the measured pose, as with Drake's command receivers. The arm also holds a pose
    during a watchdog hold and after a fault.

    .. pydrake_system::

        name: DvrkCommandReceiver
        input_ports:
        - lcmt_dvrk_command (optional)
        - state_estimated
        - effort_measured
        - position_control_effort
        - gravity_effort (optional)
        output_ports:
        - control_mode
        - desired_state
        - effort
        - guard

    Ports, for n joints in the arm's order [rad, rad/s, N m; m, m/s, N on a prismatic joint]:

    - `lcmt_dvrk_command`: command, e.g. from an LcmSubscriberSystem. A repeated message is processed only once. Drake
      keeps only the newest message of a channel, without the encoded bytes that are needed to verify the authentication
      code. A process that moves an arm must therefore pass every message to `Receive` instead.
    - `state_estimated` (2n): measured q, then v. `effort_measured` (n): applied motor efforts.
    - `position_control_effort` (n): present effort of the position controller in the arm's driver.
    - `gravity_effort` (n): gravity compensation of the arm's driver. If connected, it is added to commanded efforts and
      subtracted from `effort_measured`.
    - `control_mode` (1): mode in force, lcmt_dvrk_command.OFF, HOLD, POSITION or EFFORT.
    - `desired_state` (2n): target of the position controller. While efforts act, it is the measured pose with zero
      velocity.
    - `effort` (n): motor efforts to apply, inside the effort limits. In OFF, they are zero. In EFFORT, they are the
      output of the guard plus `gravity_effort`. In all other modes, they are `position_control_effort`. Where this
      effort is not finite, the gravity effort of the model is used instead. Outside the state EFFORT, an effort
      changes by at most its limit within 4 ms.
    - `guard`: the CommandGuard, read-only.

    The guard is an abstract state that is updated once per period of the clock. Drake updates abstract states before it
    steps a discrete plant at the same time. A command therefore acts in the next step of the plant.
    """

    def __init__(
        self,
        arm: Arm,
        guard: CommandGuard,
        clock: ArmClock | None = None,
        key: MessageKey | None = None,
    ) -> None:
        """Creates the receiver of `arm` with its `guard`.

        Args:
            arm: Arm that defines the number of joints and their effort limits.
            guard: Guard in its initial state. Each context has its own copy of the guard.
            clock: Clock of the arm, with the period of the guard. None: `ArmClock()` is used.
            key: Key that must have signed the messages for `Receive`. None: authentication codes are not verified.
        """
        super().__init__()
        n = arm.num_joints
        self._allows_reset = False
        self._num_joints, self._clock = n, clock or ArmClock()
        self._effort_limits = arm.effort_limits
        self._command = self.DeclareAbstractInputPort("lcmt_dvrk_command", AbstractValue.Make(lcmt_dvrk_command()))
        self._state = self.DeclareVectorInputPort("state_estimated", 2 * n)
        self._effort = self.DeclareVectorInputPort("effort_measured", n)
        self._position_control = self.DeclareVectorInputPort("position_control_effort", n)
        self._gravity = self.DeclareVectorInputPort("gravity_effort", n)
        self._guard = self.DeclareAbstractState(AbstractValue.Make(guard))
        self._last_command_id = self.DeclareAbstractState(AbstractValue.Make((0, 0, 0)))
        # Effort of the previous step. Not finite before the first step, whose effort is not limited in rate.
        self._last_effort = self.DeclareDiscreteState(np.full(n, np.nan))
        own = {self.abstract_state_ticket(self._guard)}
        self.DeclareVectorOutputPort("control_mode", 1, self._calc_control_mode, own)
        self.DeclareVectorOutputPort("desired_state", 2 * n, self._calc_desired_state, own)
        efforts = {self.input_port_ticket(port.get_index()) for port in (self._position_control, self._gravity)}
        last = self.discrete_state_ticket(self._last_effort)
        self._applied = self.DeclareVectorOutputPort("effort", n, self._calc_effort, own | efforts | {last})
        self.DeclareAbstractOutputPort("guard", lambda: AbstractValue.Make(guard), self._calc_guard, own)
        self.DeclareInitializationUnrestrictedUpdateEvent(self._update)
        self.DeclarePeriodicUnrestrictedUpdateEvent(self._clock.period, 0.0, self._update)
        self.DeclarePeriodicDiscreteUpdateEvent(self._clock.period, 0.0, self._store_effort)
        self._inbox = CommandInbox(guard, key)

    def Receive(self, data: bytes) -> None:
        """Adds a received message to the inbox that the next update reads."""
        self._inbox.put(data)

    def AllowReset(self) -> None:
        """Allows the reset of a fault in the next update; see `CommandGuard.allow_reset`."""
        self._allows_reset = True

    def GetGuard(self, context: Context) -> CommandGuard:
        """Returns the guard of this context, read-only."""
        return context.get_abstract_state(int(self._guard)).get_value()

    def _update(self, context: Context, state: State) -> None:
        guard = state.get_mutable_abstract_state(int(self._guard)).get_mutable_value()
        utime = self._clock.utime(context)
        if self._allows_reset:
            self._allows_reset = False
            guard.allow_reset()
        self._inbox.deliver(guard, utime)
        if self._command.HasValue(context):
            command = self._command.Eval(context)
            command_id = (command.sender_id, command.sequence, command.utime)
            if command_id != context.get_abstract_state(int(self._last_command_id)).get_value():
                state.get_mutable_abstract_state(int(self._last_command_id)).set_value(command_id)
                guard.receive(command, utime)
        q_v = self._state.Eval(context)
        effort = self._effort.Eval(context)
        if self._gravity.HasValue(context):
            effort = effort - self._gravity.Eval(context)
        guard.step(utime, utime, q_v[: self._num_joints], q_v[self._num_joints :], effort)

    def _store_effort(self, context: Context, values: DiscreteValues) -> None:
        # Drake calls this method after `_update`, and together with the step of a discrete plant that uses the effort.
        values.set_value(self._applied.Eval(context))

    def _calc_control_mode(self, context: Context, output: BasicVector) -> None:
        output.SetAtIndex(0, self.GetGuard(context).output.control_mode)

    def _calc_desired_state(self, context: Context, output: BasicVector) -> None:
        guarded = self.GetGuard(context).output
        output.SetFromVector(np.concatenate([guarded.position, guarded.velocity]))

    def _calc_effort(self, context: Context, output: BasicVector) -> None:
        guard = self.GetGuard(context)
        guarded = guard.output
        if guarded.control_mode == lcmt_dvrk_command.OFF:
            output.SetZero()
            return
        if guarded.control_mode == lcmt_dvrk_command.EFFORT:
            effort = guarded.effort + (self._gravity.Eval(context) if self._gravity.HasValue(context) else 0.0)
        else:
            effort = self._position_control.Eval(context)
            # The effort of the position controller is not finite while measurements are missing for a few periods.
            effort = np.where(np.isfinite(effort), effort, guard.gravity_effort)
        last = context.get_discrete_state(self._last_effort).value()
        # In EFFORT, the guard limits the rate, except that of the soft walls and of the speed limit.
        if guard.state != lcmt_dvrk_status.STATE_EFFORT and is_finite(last.tolist()):
            step = self._effort_limits * self._clock.period / _RISE_TIME
            effort = np.clip(effort, last - step, last + step)
        output.SetFromVector(np.clip(effort, -self._effort_limits, self._effort_limits))

    def _calc_guard(self, context: Context, output: AbstractValue) -> None:
        output.set_value(self.GetGuard(context))
