"""Controller of one arm. It computes one command for each status message."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder

from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.lcmtypes import lcmt_dvrk_command, lcmt_dvrk_status
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.arm_schema import Gains
from dvrk_drake.systems.effort_ramp import EffortRamp
from dvrk_drake.systems.friction_compensator import FrictionCompensator
from dvrk_drake.systems.gravity_pid_controller import GravityPidController, Mode
from dvrk_drake.systems.hardware_arm_station import HardwareArmStation
from dvrk_drake.systems.lcm.arm_link import ArmLink
from dvrk_drake.systems.lcm.dvrk_driver import DvrkDriver


class _Exchange(ArmLink):
    """Link in which the caller of an `ArmController` places each status, and finds the command that answers it."""

    def __init__(self, arm: Arm) -> None:
        super().__init__(arm)
        self.status: lcmt_dvrk_status | None = None
        self.command = lcmt_dvrk_command()
        self.time = 0.0

    def now(self) -> float:
        return self.time

    def close(self) -> None:
        pass

    def poll(self) -> lcmt_dvrk_status | None:
        return self.status

    def send(self, command: lcmt_dvrk_command) -> None:
        self.command = command

    def _handle(self, seconds: float) -> bool:
        return False

    def _publish(self, data: bytes) -> None:
        pass


class ArmController:
    """Controller of one arm. It computes a command message from each status message, in one of the modes of `Mode`.

    The controller is a Diagram of HardwareArmStation, GravityPidController, an optional FrictionCompensator and
    EffortRamp. Each status advances the Diagram by one period, so the command is available immediately.
    While the arm does not apply the commanded efforts, the controller commands the measured efforts. When the arm
    begins to apply the commanded efforts, mode "hold" stores the measured pose as the pose to hold. In every mode, the
    commanded efforts then change linearly from the measured efforts to the efforts of the mode.

    Attributes:
        arm: Controlled arm.
        sender_id: Identifier of this controller in its command messages.
        acting: True if the last status shows that the arm applies the efforts of this controller.
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
        self.arm, self._mode, self._period = arm, mode, period
        self._link = _Exchange(arm)
        station = builder.AddSystem(HardwareArmStation(arm, driver=DvrkDriver(status_period=period), link=self._link))
        self._controller = builder.AddSystem(GravityPidController(model, period=period, gains=gains, mode="gravity"))
        self._ramp = builder.AddSystem(EffortRamp(arm.num_joints, period=period))
        name, desired_effort = arm.name.lower(), self._controller.GetOutputPort("effort")
        state = station.GetOutputPort(f"{name}.state_estimated")
        builder.Connect(state, self._controller.GetInputPort("state_estimated"))
        if friction is not None:
            builder.AddSystem(friction)
            builder.Connect(state, friction.GetInputPort("state_estimated"))
            builder.Connect(desired_effort, friction.GetInputPort("effort_wanted"))
            desired_effort = friction.GetOutputPort("effort")
        builder.Connect(desired_effort, self._ramp.GetInputPort("effort_wanted"))
        for port, measured in (("effort_measured", "effort_measured"), ("enabled", "in_control")):
            builder.Connect(station.GetOutputPort(f"{name}.{measured}"), self._ramp.GetInputPort(port))
        builder.Connect(self._ramp.GetOutputPort("effort"), station.GetInputPort(f"{name}.effort_commanded"))
        self._simulator = Simulator(builder.Build())
        context = self._simulator.get_mutable_context()
        self._ramp_context = self._ramp.GetMyContextFromRoot(context)
        self._controller_context = self._controller.GetMyMutableContextFromRoot(context)
        self._num_answers, self.sender_id, self.acting = 0, station.sender_id, False

    @property
    def ramped(self) -> bool:
        """True if the ramp to the desired efforts is complete."""
        return self.acting and self._ramp.GetShare(self._ramp_context) >= 1

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
        acts = status.guard_state == lcmt_dvrk_status.STATE_EFFORT and status.command_sender_id == self.sender_id
        if acts != self.acting:
            self.acting = acts
            # The change of the mode from "gravity" to "hold" stores the pose to hold and resets the integrator.
            self._controller.SetMode(self._controller_context, self._mode if acts else "gravity")
        if desired_state is not None:
            self._controller.GetInputPort("desired_state").FixValue(self._controller_context, desired_state)
        self._link.status, self._link.time = status, time
        # At the start of this step, the station reads the status. At its end, the station sends the command.
        self._num_answers += 1
        self._simulator.AdvanceTo(self._num_answers * self._period)
        return self._link.command
