"""Controller of one arm. It computes one command for each status message."""

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
    """Controller of one arm. It computes a command message from each status message, in one of the modes of `Mode`.

    The controller is a Diagram of DvrkStatusReceiver, GravityPidController, an optional FrictionCompensator, EffortRamp
    and DvrkCommandSender. Each status causes a forced update of the Diagram, so the command is available immediately.
    While the arm does not apply the commanded efforts, the controller commands the measured efforts. When the arm
    begins to apply the commanded efforts, mode "hold" stores the measured pose as the pose to hold. In every mode, the
    commanded efforts then change linearly from the measured efforts to the efforts of the mode.

    Attributes:
        arm: Controlled arm.
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
        """Creates the controller.

        Args:
            arm: Arm to control.
            model: Model of the arm with its actual base orientation.
            mode: Mode of the controller.
            period: Period of the status messages [s].
            friction: Friction compensator for mode "gravity". It is added to the Diagram. None: friction is not
                compensated.
            gains: Gains for the modes "hold" and "damped". None: the gains of `arm` are used.
        """
        builder = DiagramBuilder()
        self.arm, self._mode = arm, mode
        receiver = builder.AddSystem(DvrkStatusReceiver(arm))
        self._controller = builder.AddSystem(GravityPidController(model, period=period, gains=gains, mode="gravity"))
        self._ramp = builder.AddSystem(EffortRamp(arm.num_joints, period=period))
        self._sender = builder.AddSystem(DvrkCommandSender(arm))
        builder.Connect(receiver.GetOutputPort("state_estimated"), self._controller.GetInputPort("state_estimated"))
        builder.Connect(receiver.GetOutputPort("effort_measured"), self._ramp.GetInputPort("effort_measured"))
        desired_effort = self._controller.GetOutputPort("effort")
        if friction is not None:
            builder.AddSystem(friction)
            builder.Connect(receiver.GetOutputPort("state_estimated"), friction.GetInputPort("state_estimated"))
            builder.Connect(desired_effort, friction.GetInputPort("effort_wanted"))
            desired_effort = friction.GetOutputPort("effort")
        builder.Connect(desired_effort, self._ramp.GetInputPort("effort_wanted"))
        builder.Connect(self._ramp.GetOutputPort("effort"), self._sender.GetInputPort("effort"))
        status = builder.ExportInput(receiver.GetInputPort("lcmt_dvrk_status"), "lcmt_dvrk_status")
        builder.ConnectInput(status, self._sender.GetInputPort("lcmt_dvrk_status"))
        self._diagram = builder.Build()
        self._context = self._diagram.CreateDefaultContext()
        # The port is fixed only once. FixValue would deep-copy each message, which is slower than the rest of a step.
        port = self._diagram.GetInputPort("lcmt_dvrk_status")
        self._status = port.FixValue(self._context, AbstractValue.Make(lcmt_dvrk_status()))
        self._ramp_context = self._ramp.GetMyMutableContextFromRoot(self._context)
        self._sender_context = self._sender.GetMyContextFromRoot(self._context)
        self._new_state = self._diagram.AllocateDiscreteVariables()
        self._set_acting(False)

    @property
    def sender_id(self) -> int:
        """Identifier of this controller in its command messages."""
        return self._sender.sender_id

    @property
    def acting(self) -> bool:
        """True if the last status shows that the arm applies the efforts of this controller."""
        return self._acting

    @property
    def ramped(self) -> bool:
        """True if the ramp to the desired efforts is complete."""
        return self._acting and self._ramp.GetShare(self._ramp_context) >= 1

    def answer(
        self, status: lcmt_dvrk_status, time: float, desired_state: NDArray[np.float64] | None = None
    ) -> lcmt_dvrk_command:
        """Computes the command for a status.

        Args:
            status: Received status.
            time: Time of arrival on the controller's clock [s].
            desired_state: Desired state (2n,) in mode "hold": q_d, then v_d. None: the stored pose is held; see
                `ArmController`.

        Returns:
            Command for the arm.
        """
        context = self._context
        context.SetTime(time)
        self._status.GetMutableData().set_value(status)
        acts = status.guard_state == lcmt_dvrk_status.STATE_EFFORT and status.command_sender_id == self.sender_id
        if acts != self._acting:
            self._set_acting(acts)
        if desired_state is not None:
            controller_context = self._controller.GetMyMutableContextFromRoot(context)
            self._controller.GetInputPort("desired_state").FixValue(controller_context, desired_state)
        self._diagram.CalcForcedDiscreteVariableUpdate(context, self._new_state)
        context.SetDiscreteState(self._new_state)
        return self._sender.get_output_port().Eval(self._sender_context)

    def _set_acting(self, acting: bool) -> None:
        """Stores whether the efforts act on the arm. If they act, restarts the ramp and stores the pose to hold."""
        self._acting = acting
        self._ramp.GetInputPort("enabled").FixValue(self._ramp_context, np.array([float(acting)]))
        # The change of the mode from "gravity" to "hold" stores the pose to hold and resets the integrator.
        controller_context = self._controller.GetMyMutableContextFromRoot(self._context)
        self._controller.SetMode(controller_context, self._mode if acting else "gravity")
