"""The controller's end of the command channel."""

from __future__ import annotations

import secrets

import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.systems.framework import Context, LeafSystem

from dvrk_drake.lcmtypes import lcmt_dvrk_command, lcmt_dvrk_status
from dvrk_drake.models.arm import Arm
from dvrk_drake.systems.guard.command_stream import is_finite

_MODES = (lcmt_dvrk_command.OFF, lcmt_dvrk_command.HOLD, lcmt_dvrk_command.POSITION, lcmt_dvrk_command.EFFORT)


def draw_id() -> int:
    """A random sender_id or session_id: never 0, and two of them never alike."""
    return 1 + secrets.randbelow(2**62)


class DvrkCommandSender(LeafSystem):
    """Makes the command that answers a status, for an LcmPublisherSystem.

    .. pydrake_system::

        name: DvrkCommandSender
        input_ports:
        - lcmt_dvrk_status
        - effort (optional)
        - desired_state (optional)
        - control_mode (optional)
        - reset_fault (optional)
        output_ports:
        - lcmt_dvrk_command

    Ports, for n joints in the arm's order [rad, rad/s, N m; m, m/s, N on a prismatic joint]:

    - `lcmt_dvrk_status`: the status that is answered: its session, time and sequence go into the command. A command
      that is sent again without a new status is refused by the arm as sent twice, so a controller that hears nothing
      ends in a hold.
    - `effort` (n) and `desired_state` (2n: q, then v): what is asked for.
    - `control_mode` (1): lcmt_dvrk_command.HOLD, POSITION, EFFORT or OFF; anything else is HOLD. Unconnected: EFFORT if
      `effort` is connected, else POSITION if `desired_state` is, else HOLD.
    - `reset_fault` (1): not zero: asks to clear a fault, or to resume after the watchdog took over; the mode is then
      HOLD.
    - `lcmt_dvrk_command`: the message. It is HOLD whenever what is asked for is not connected or not finite.
    """

    def __init__(self, arm: Arm, sender_id: int | None = None) -> None:
        """Of a controller of `arm`; its `sender_id` is drawn if not given."""
        super().__init__()
        n = arm.num_joints
        self._arm_name, self._num_joints = arm.name, n
        self._sender_id = sender_id or draw_id()
        self._status = self.DeclareAbstractInputPort("lcmt_dvrk_status", AbstractValue.Make(lcmt_dvrk_status()))
        self._effort = self.DeclareVectorInputPort("effort", n)
        self._desired = self.DeclareVectorInputPort("desired_state", 2 * n)
        self._control_mode = self.DeclareVectorInputPort("control_mode", 1)
        self._reset = self.DeclareVectorInputPort("reset_fault", 1)
        self.DeclareAbstractOutputPort(
            "lcmt_dvrk_command", lambda: AbstractValue.Make(lcmt_dvrk_command()), self._calc_command
        )

    @property
    def sender_id(self) -> int:
        """By which the arm tells this sender from others."""
        return self._sender_id

    def _calc_command(self, context: Context, output: AbstractValue) -> None:
        n = self._num_joints
        status = self._status.Eval(context)
        command = lcmt_dvrk_command()
        command.utime, command.sequence = round(1e6 * context.get_time()), status.sequence
        command.sender_id, command.session_id = self._sender_id, status.session_id
        command.status_utime, command.arm_name = status.utime, self._arm_name
        command.num_joints = n
        effort = self._effort.Eval(context) if self._effort.HasValue(context) else np.full(n, np.nan)
        desired = self._desired.Eval(context) if self._desired.HasValue(context) else np.full(2 * n, np.nan)
        asked = {lcmt_dvrk_command.EFFORT: effort, lcmt_dvrk_command.POSITION: desired}
        mode = self._mode(context)
        command.reset_fault = self._reset.HasValue(context) and bool(self._reset.Eval(context)[0])
        if command.reset_fault or (mode in asked and not is_finite(asked[mode].tolist())):
            mode = lcmt_dvrk_command.HOLD
        command.control_mode = mode
        zero = np.zeros(n)
        command.effort = (effort if mode == lcmt_dvrk_command.EFFORT else zero).tolist()
        q_v = desired if mode == lcmt_dvrk_command.POSITION else np.zeros(2 * n)
        command.position, command.velocity = q_v[:n].tolist(), q_v[n:].tolist()
        output.set_value(command)

    def _mode(self, context: Context) -> int:
        if self._control_mode.HasValue(context):
            mode = self._control_mode.Eval(context)[0]
            return int(mode) if mode in _MODES else lcmt_dvrk_command.HOLD
        if self._effort.HasValue(context):
            return lcmt_dvrk_command.EFFORT
        return lcmt_dvrk_command.POSITION if self._desired.HasValue(context) else lcmt_dvrk_command.HOLD
