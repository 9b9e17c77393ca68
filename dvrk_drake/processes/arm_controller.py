"""Controllers of one arm. They compute one command for each status message."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder, System

from dvrk_drake.analysis.excitation.pose_file import approach_offset
from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.errors import ControllerError
from dvrk_drake.lcmtypes import lcmt_dvrk_command, lcmt_dvrk_status
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.arm_schema import Gains
from dvrk_drake.systems.closed_loop import EffortRamp, add_closed_loop
from dvrk_drake.systems.driver import DvrkDriver
from dvrk_drake.systems.friction_compensator import FrictionCompensator
from dvrk_drake.systems.gravity_pid_controller import GravityPidController, Mode
from dvrk_drake.systems.hardware_arm_station import HardwareArmStation
from dvrk_drake.systems.lcm.arm_link import ArmLink
from dvrk_drake.systems.lcm.messages import draw_id, make_command

#: Proportional effort of the controller at the start of an approach, divided by the effort limit. This effort
#: determines the distance of the approach. Static friction that is at most half of this effort changes its sign during
#: the approach. After a longer approach, the controller's integrator may hold the arm with any part of the friction.
APPROACH = 0.3
#: Speed of an approach with the arm's own controller, as a fraction of the speed of other motions. A fast approach
#: would end with an overshoot, which changes the friction at the pose.
_APPROACH_SPEED = 0.4
#: Time for which the arm must be at rest before such an approach [s].
_APPROACH_REST = 0.2


@dataclass(frozen=True)
class MotionStyle:
    """Differences between the controllers that move an arm along a trajectory.

    Attributes:
        approach_offset: Offset (n,) of the pose at which the approach of a static pose begins [rad, m].
        approach_speed: Speed of the approach, relative to that of other motions.
        approach_rest: Time for which the arm must be at rest before the approach [s]. 0: it does not stop.
        waits: Whether the trajectory waits for an arm that is behind. If not, such an arm is an error. A controller
            that waits commands HOLD if there is no desired state.
        max_step: Largest time step of the trajectory between two statuses [s]. It prevents a jump of the desired state
            after a pause of the computer.
    """

    approach_offset: NDArray[np.float64]
    approach_speed: float
    approach_rest: float
    waits: bool
    max_step: float

    @classmethod
    def of_efforts(cls, arm: Arm) -> MotionStyle:
        """Returns the style of a controller that commands efforts to an arm."""
        return cls(np.asarray(APPROACH * arm.effort_limits / np.asarray(arm.gains.kp)), 1.0, 0.0, False, 0.01)

    @classmethod
    def of_goals(cls, arm: Arm) -> MotionStyle:
        """Returns the style of a controller that commands goals to the arm's own controller."""
        return cls(approach_offset(arm), _APPROACH_SPEED, _APPROACH_REST, True, 0.05)


class GoalController:
    """Controller of an arm whose own controller moves it: it commands each desired state as a position.

    Attributes:
        arm: Controlled arm.
        sender_id: Identifier of this controller in its command messages.
        acting: True if the arm has received a command of this controller.
        style: How this controller moves the arm.
    """

    def __init__(self, arm: Arm, is_busy: Callable[[], bool] = lambda: False) -> None:
        """Creates the controller. `is_busy` returns whether the arm still moves to its goal, as it states itself."""
        self.arm, self.style, self.sender_id, self.acting = arm, MotionStyle.of_goals(arm), draw_id(), False
        self.is_busy = is_busy

    @property
    def ramped(self) -> bool:
        """True if the arm follows the desired state."""
        return self.acting

    def answer(
        self, status: lcmt_dvrk_status, time: float, desired_state: NDArray[np.float64] | None = None
    ) -> lcmt_dvrk_command:
        """Returns the command for a status; see `ArmController.answer`. Without a desired state, it is HOLD."""
        self.acting = status.command_sender_id == self.sender_id
        mode = lcmt_dvrk_command.HOLD if desired_state is None else lcmt_dvrk_command.POSITION
        return make_command(status, self.sender_id, round(1e6 * time), mode, desired_state=desired_state)


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

    def next_status(self, seconds: float) -> lcmt_dvrk_status:
        if self.status is None:
            raise ControllerError(f"{self.arm.name}: there is no status yet")
        return self.status

    def send(self, command: lcmt_dvrk_command) -> None:
        self.command = command


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
        period: Period of the status messages [s].
        style: How this controller moves the arm in mode "hold".
    """

    def __init__(
        self,
        arm: Arm,
        model: IdentifiedModel,
        mode: Mode | System,
        period: float,
        friction: FrictionCompensator | None = None,
        gains: Gains | None = None,
    ) -> None:
        """Creates the controller.

        Args:
            arm: Arm to control.
            model: Model of the arm with its actual base orientation.
            mode: Mode of the controller, or a System that replaces the GravityPidController. It has an input port
                `state_estimated` (2n) and an output port `effort` (n).
            period: Period of the status messages [s].
            friction: Friction compensator for the modes "gravity" and "guide". It is added to the Diagram. None:
                friction is not compensated.
            gains: Gains for all modes except "gravity". None: the gains of `arm` are used.
        """
        builder = DiagramBuilder()
        self.arm, self.period = arm, period
        self._link, self.style = _Exchange(arm), MotionStyle.of_efforts(arm)
        driver = DvrkDriver()
        driver.status_period = period  # measured, and thus not limited to the range of the configuration
        station = HardwareArmStation(arm, driver=driver, link=self._link)
        self._mode = mode if isinstance(mode, str) else None
        self._controller: Any = mode
        if isinstance(mode, str):
            self._controller = GravityPidController(model, period=period, gains=gains, mode="gravity")
        self._ramp = EffortRamp(arm.num_joints, period=period)
        add_closed_loop(builder, station, self._controller, friction=friction, ramp=self._ramp)
        self._simulator = Simulator(builder.Build())
        context = self._simulator.get_mutable_context()
        self._ramp_context = self._ramp.GetMyContextFromRoot(context)
        self._controller_context = self._controller.GetMyMutableContextFromRoot(context)
        self._num_answers, self.sender_id, self.acting = 0, station.sender_id, False

    def is_busy(self) -> bool:
        """Returns False: the arm has no goal of its own."""
        return False

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
            if self._mode is not None:
                self._controller.SetMode(self._controller_context, self._mode if acts else "gravity")
        if desired_state is not None:
            self._controller.GetInputPort("desired_state").FixValue(self._controller_context, desired_state)
        self._link.status, self._link.time = status, time
        # At the start of this step, the station reads the status. At its end, the station sends the command.
        self._num_answers += 1
        self._simulator.AdvanceTo(self._num_answers * self.period)
        return self._link.command
