"""What is measured of the motors' efforts: noise and steps of a converter."""

from __future__ import annotations

import numpy as np
from pydrake.systems.framework import BasicVector, Context, LeafSystem

from dvrk_drake.models.arm import Arm
from dvrk_drake.models.effects_schema import EffortEffect, per_actuator
from dvrk_drake.systems.arm_effects.motors import Motors, in_steps


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
