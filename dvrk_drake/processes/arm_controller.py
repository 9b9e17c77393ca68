"""The controller that answers an arm's status messages, one command each, without a clock of its own."""

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
    """Gravity compensation or a pose hold of one arm, from status to command.

    A Diagram of DvrkStatusReceiver, GravityPidController, FrictionCompensator if wanted, EffortRamp and
    DvrkCommandSender, stepped by forced updates: one status in, one command out, nothing in between waits for a period.
    Whenever efforts do not act yet, or not any more, it commands the measured efforts; when they begin to act it ramps
    to its own, and latches the pose to hold.

    Attributes:
        arm: which it controls.
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
        """Of `arm`, carried by `model`.

        Args:
            arm: named in the messages.
            model: of that arm, mounted as it is.
            mode: of the controller.
            period: in which statuses come [s].
            friction: takes friction off the hand in mode "gravity"; becomes part of this controller.
            gains: to hold or to brake with; the arm's own by default.
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
        # Fixed once: FixValue would deep-copy each message, which costs more than all the rest of an answer.
        port = self._diagram.GetInputPort("lcmt_dvrk_status")
        self._status = port.FixValue(self._context, AbstractValue.Make(lcmt_dvrk_status()))
        self._ramp_context = self._ramp.GetMyMutableContextFromRoot(self._context)
        self._sender_context = self._sender.GetMyContextFromRoot(self._context)
        self._new_state = self._diagram.AllocateDiscreteVariables()
        self._act(False)

    @property
    def sender_id(self) -> int:
        """By which the arm tells this controller from others."""
        return self._sender.sender_id

    @property
    def acting(self) -> bool:
        """Whether, at the last status, this controller's efforts acted."""
        return self._acting

    @property
    def ramped(self) -> bool:
        """Whether they have become the wanted ones in full."""
        return self._acting and self._ramp.GetShare(self._ramp_context) >= 1

    def answer(
        self, status: lcmt_dvrk_status, time: float, desired_state: NDArray[np.float64] | None = None
    ) -> lcmt_dvrk_command:
        """The command that answers `status` at `time` [s] of the controller's own clock.

        `desired_state` (2n: q_d, then v_d) is what "hold" regulates to; without it, always, the latched pose.
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
        """Whether efforts act from now on: then the ramp begins, and the pose to hold is latched anew."""
        self._acting = acting
        self._ramp.GetInputPort("enabled").FixValue(self._ramp_context, np.array([float(acting)]))
        # At the change to "hold" the pose is latched anew and the integrator is empty.
        controller_context = self._controller.GetMyMutableContextFromRoot(self._context)
        self._controller.SetMode(controller_context, self._mode if acting else "gravity")
