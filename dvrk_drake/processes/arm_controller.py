"""Controller of one arm that computes one command for each status message and has no clock of its own."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import AbstractValue
from pydrake.systems.framework import DiagramBuilder

from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.lcmtypes import lcmt_dvrk_command, lcmt_dvrk_status
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.arm_schema import Gains
from dvrk_drake.systems.effort_ramp import EffortRamp
from dvrk_drake.systems.friction_compensator import FrictionCompensator
from dvrk_drake.systems.gravity_pid_controller import GravityPidController, Mode
from dvrk_drake.systems.lcm.dvrk_command import DvrkCommandSender
from dvrk_drake.systems.lcm.dvrk_status import DvrkStatusReceiver


class ArmController:
    """Gravity compensation or pose hold of one arm, from status message to command message.

    The controller is a Diagram of DvrkStatusReceiver, GravityPidController, an optional FrictionCompensator, EffortRamp
    and DvrkCommandSender. It is stepped by forced updates, so that each status produces one command without waiting for
    a period. While its efforts are not applied, it commands the measured efforts. When they begin to be applied, it
    latches the pose to hold and ramps to its own efforts.

    Attributes:
        arm: Arm that is controlled.
    """

    def __init__(
        self,
        arm: Arm,
        model: IdentifiedModel,
        mode: Mode,
        period: float,
        friction: FrictionCompensator | None = None,
        gains: Gains | None = None,
    ) -> None:
        """Creates the controller of `arm`, whose gravity is computed by `model`.

        Args:
            arm: Arm whose name is in the messages.
            model: Model of that arm in its actual mounting.
            mode: Mode of the controller.
            period: Period of the status messages [s].
            friction: Compensator of friction in mode "gravity". It becomes part of this controller.
            gains: Gains for holding and braking. Defaults to the gains of the arm.
        """
        builder = DiagramBuilder()
        self.arm, self._mode = arm, mode
        receiver = builder.AddSystem(DvrkStatusReceiver(arm))
        self._controller = builder.AddSystem(GravityPidController(model, period=period, gains=gains, mode="gravity"))
        self._ramp = builder.AddSystem(EffortRamp(arm.num_joints, period=period))
        self._sender = builder.AddSystem(DvrkCommandSender(arm))
        builder.Connect(receiver.GetOutputPort("state_estimated"), self._controller.GetInputPort("state_estimated"))
        builder.Connect(receiver.GetOutputPort("effort_measured"), self._ramp.GetInputPort("effort_measured"))
        wanted = self._controller.GetOutputPort("effort")
        if friction is not None:
            builder.AddSystem(friction)
            builder.Connect(receiver.GetOutputPort("state_estimated"), friction.GetInputPort("state_estimated"))
            builder.Connect(wanted, friction.GetInputPort("effort_wanted"))
            wanted = friction.GetOutputPort("effort")
        builder.Connect(wanted, self._ramp.GetInputPort("effort_wanted"))
        builder.Connect(self._ramp.GetOutputPort("effort"), self._sender.GetInputPort("effort"))
        status = builder.ExportInput(receiver.GetInputPort("lcmt_dvrk_status"), "lcmt_dvrk_status")
        builder.ConnectInput(status, self._sender.GetInputPort("lcmt_dvrk_status"))
        self._diagram = builder.Build()
        self._context = self._diagram.CreateDefaultContext()
        # The ports are fixed once: FixValue would deep-copy each message, which takes longer than the rest of a step.
        port = self._diagram.GetInputPort("lcmt_dvrk_status")
        self._status = port.FixValue(self._context, AbstractValue.Make(lcmt_dvrk_status()))
        self._ramp_context = self._ramp.GetMyMutableContextFromRoot(self._context)
        self._sender_context = self._sender.GetMyContextFromRoot(self._context)
        self._new_state = self._diagram.AllocateDiscreteVariables()
        self._act(False)

    @property
    def sender_id(self) -> int:
        """Identifier of this controller in its command messages."""
        return self._sender.sender_id

    @property
    def acting(self) -> bool:
        """True if the efforts of this controller were applied at the last status."""
        return self._acting

    @property
    def ramped(self) -> bool:
        """True if the ramp to the desired efforts is complete."""
        return self._acting and self._ramp.GetShare(self._ramp_context) >= 1

    def answer(
        self, status: lcmt_dvrk_status, time: float, desired_state: NDArray[np.float64] | None = None
    ) -> lcmt_dvrk_command:
        """Computes the command for `status`, received at `time` [s] of the controller's clock.

        In mode "hold" the arm is regulated to `desired_state` (2n: q_d, then v_d), if given. Otherwise it is regulated
        to the latched pose.
        """
        context = self._context
        context.SetTime(time)
        self._status.GetMutableData().set_value(status)
        acts = status.guard_state == lcmt_dvrk_status.STATE_EFFORT and status.command_sender_id == self.sender_id
        if acts != self._acting:
            self._act(acts)
        if desired_state is not None:
            controller_context = self._controller.GetMyMutableContextFromRoot(context)
            self._controller.GetInputPort("desired_state").FixValue(controller_context, desired_state)
        self._diagram.CalcForcedDiscreteVariableUpdate(context, self._new_state)
        context.SetDiscreteState(self._new_state)
        return self._sender.get_output_port().Eval(self._sender_context)

    def _act(self, acting: bool) -> None:
        """Sets whether efforts are applied from now on. If so, restarts the ramp and latches the pose to hold."""
        self._acting = acting
        self._ramp.GetInputPort("enabled").FixValue(self._ramp_context, np.array([float(acting)]))
        # The change to "hold" latches the pose again and resets the integrator.
        controller_context = self._controller.GetMyMutableContextFromRoot(self._context)
        self._controller.SetMode(controller_context, self._mode if acting else "gravity")
