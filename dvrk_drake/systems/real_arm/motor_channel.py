"""From the effort that is commanded to what the motors give."""

from __future__ import annotations

from collections.abc import Callable

import numba
import numpy as np
from numpy.typing import NDArray
from pydrake.systems.framework import BasicVector, Context, LeafSystem

from dvrk_drake.models.arm import Arm
from dvrk_drake.models.effects_schema import ArmEffects, per_actuator
from dvrk_drake.systems.gravity_pid_step import entry_point


class MotorChannel(LeafSystem):
    """What the motors make of the efforts that are commanded of the joints.

    .. pydrake_system::

        name: MotorChannel
        input_ports:
        - effort_commanded (optional)
        output_ports:
        - motor_effort

    - `effort_commanded` (n): on the joints [N m, N]. Unconnected: zero.
    - `motor_effort` (n): on the actuators [N m, N]: the command, clamped to the joints' limits, as efforts of the
      actuators J^-T tau, in whole steps of `effort.command_resolution`, and no more than `saturation`.
    """

    def __init__(self, arm: Arm, effects: ArmEffects, effort_limits: NDArray[np.float64]) -> None:
        """Of `arm`; `effort_limits` (n,) are those of the joints."""
        super().__init__()
        n, names = arm.num_joints, arm.joint_names
        steps = per_actuator(effects.effort.command_resolution if effects.effort else {}, names, 0.0)
        most = per_actuator(effects.saturation, names, np.inf)
        self._constants = np.array([effort_limits, steps, most])
        self._to_motors = np.ascontiguousarray(np.linalg.inv(arm.transmission.matrix).T)
        self.DeclareVectorInputPort(name="effort_commanded", size=n)
        self.DeclareVectorOutputPort(
            name="motor_effort", size=n, calc=self._make_calc(), prerequisites_of_calc={self.all_input_ports_ticket()}
        )

    def _make_calc(self) -> Callable[[Context, BasicVector], None]:
        """The handler of the port, with all that it needs at hand: see GravityPidController."""
        eval_vector_input, effort_into = self.EvalVectorInput, entry_point(_motor_effort_into)
        to_motors, constants = self._to_motors, self._constants
        nothing = np.zeros(len(to_motors))

        def calc(context: Context, output: BasicVector) -> None:
            command = eval_vector_input(context, 0)
            effort = nothing if command is None else command.get_value()
            effort_into(effort, to_motors, constants, output.get_mutable_value())

        return calc


@numba.njit("float64(float64, float64)", cache=True)
def in_steps(value, step):
    """`value` to the next whole number of steps; exact where the step is 0."""
    return step * np.rint(value / step) if step > 0.0 else value


@numba.njit("void(float64[::1], float64[:, ::1], float64[:, ::1], float64[::1])", cache=True)
def _motor_effort_into(command, to_motors, constants, effort):
    """`constants` (3, n): limits of the joints, steps, and most of each motor."""
    limits, steps, most = constants
    effort[:] = 0.0
    for k in range(len(command)):
        tau = min(max(command[k], -limits[k]), limits[k])
        for i in range(len(effort)):
            effort[i] += to_motors[i, k] * tau
    for i in range(len(effort)):
        effort[i] = min(max(in_steps(effort[i], steps[i]), -most[i]), most[i])
