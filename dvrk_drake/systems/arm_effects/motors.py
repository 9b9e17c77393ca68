"""The motors of a simulated arm: from the commanded effort to what they give, and what is measured of it."""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray
from pydrake.systems.framework import BasicVector, Context, LeafSystem

from dvrk_drake.models.arm import Arm
from dvrk_drake.models.effects_schema import ArmEffects, EffortEffect, per_actuator


class Motors:
    """What the motors make of the efforts that are commanded of the joints.

    On the actuators [N m, N]: the command, clamped to the joints' limits, as efforts of the actuators J^-T tau, in
    whole steps of `effort.command_resolution`, and no more than `saturation`.

    Attributes:
        constants: (3, n) limits of the joints, steps of the command, most of each motor: for `motor_effort_into`.
        to_motors: (n, n) J^-T.
    """

    def __init__(self, arm: Arm, effects: ArmEffects, effort_limits: NDArray[np.float64]) -> None:
        """Of `arm`; `effort_limits` (n,) are those of the joints."""
        names = arm.joint_names
        steps = per_actuator(effects.effort.command_resolution if effects.effort else {}, names, 0.0)
        self.constants = np.array([effort_limits, steps, per_actuator(effects.saturation, names, np.inf)])
        self.to_motors = np.ascontiguousarray(np.linalg.inv(arm.transmission.matrix).T)

    def effort(self, command: NDArray[np.float64]) -> NDArray[np.float64]:
        """(n,) of the actuators, for a command (n,) on the joints."""
        effort = np.empty(len(self.to_motors))
        motor_effort_into(np.ascontiguousarray(command), self.constants, self.to_motors, effort)
        return effort


@numba.njit("float64(float64, float64)", cache=True)
def in_steps(value, step):
    """`value` to the next whole number of steps; exact where the step is 0."""
    return step * np.rint(value / step) if step > 0.0 else value


@numba.njit("void(float64[::1], float64[:, ::1], float64[:, ::1], float64[::1])", cache=True)
def motor_effort_into(command, constants, to_motors, effort):
    """`Motors.effort`, for compiled code."""
    limits, steps, most = constants
    effort[:] = 0.0
    for k in range(len(command)):
        tau = min(max(command[k], -limits[k]), limits[k])
        for i in range(len(effort)):
            effort[i] += to_motors[i, k] * tau
    for i in range(len(effort)):
        effort[i] = min(max(in_steps(effort[i], steps[i]), -most[i]), most[i])


class EffortSensor(LeafSystem):
    """Efforts of the motors as a computer reads them from the currents.

    .. pydrake_system::

        name: EffortSensor
        input_ports:
        - effort_commanded (optional)
        output_ports:
        - effort_measured

    - `effort_commanded` (n): on the joints, when it was measured [N m, N]. Unconnected: zero.
    - `effort_measured` (n): on the joints: what the motors make of it, with Gaussian noise that is new in every time
      step, and then in whole steps of `measured_resolution`, both of the actuators.

    The generator counts (Philox, Salmon et al., SC 2011): the numbers of a time step follow from seed and index alone,
    whoever asks, in whatever order. So a seed gives the same noise bit for bit, and what nobody reads costs nothing.
    Drake's RandomSource has no seed that Python can set (1.51 to 1.58).
    """

    def __init__(self, arm: Arm, motors: Motors, effort: EffortEffect | None, time_step: float, seed: int) -> None:
        """Of `arm`, with new noise every `time_step` [s]; `seed` >= 0. Without an `effort` it is exact."""
        super().__init__()
        effort = effort or EffortEffect()
        names, n = arm.joint_names, arm.num_joints
        self._deviations = per_actuator(effort.noise, names, 0.0)
        self._steps = per_actuator(effort.measured_resolution, names, 0.0)
        self._motors, self._transmission = motors, arm.transmission
        self._time_step, self._seed = time_step, seed
        self.DeclareVectorInputPort(name="effort_commanded", size=n)
        needs = {self.all_input_ports_ticket(), self.time_ticket()}
        self.DeclareVectorOutputPort(name="effort_measured", size=n, calc=self._calc, prerequisites_of_calc=needs)

    def _calc(self, context: Context, output: BasicVector) -> None:
        port = self.get_input_port()
        effort = self._motors.effort(port.Eval(context) if port.HasValue(context) else np.zeros(len(self._steps)))
        if np.any(self._deviations):
            # Half a step of grace: sums of time steps are not exact.
            tick = int(context.get_time() / self._time_step + 0.5)
            bits = np.random.Philox(key=self._seed, counter=[0, 0, tick, 0])
            effort = effort + self._deviations * np.random.Generator(bits).standard_normal(len(effort))
        counted = np.array([in_steps(value, step) for value, step in zip(effort, self._steps, strict=True)])
        output.SetFromVector(self._transmission.pull_back_effort(counted))
