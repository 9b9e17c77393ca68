"""All efforts on the plant of a real arm that no solver needs to know: motors, cables, springs, a hand;
and the sensor of the motors' efforts.
"""

from __future__ import annotations

from collections.abc import Callable

import numba
import numpy as np
from numpy.typing import NDArray
from pydrake.systems.framework import BasicVector, Context, LeafSystem

from dvrk_drake.dynamics.actuator_effects import ActuatorEffect, effect_fault
from dvrk_drake.dynamics.codegen import entry_point
from dvrk_drake.dynamics.static_model import compile_effect_torque
from dvrk_drake.errors import StationError
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.effects_schema import POSITION_KINDS, ArmEffects, EffortEffect, per_actuator
from dvrk_drake.systems.arm_effects.dry_friction import PlantEffects


class Motors:
    """Conversion of commanded joint efforts to the efforts of the motors.

    On the actuators [N m, N]: the command, clamped to the joints' limits, as efforts of the actuators J^-T tau, in
    whole steps of `effort.command_resolution`, and no more than `saturation`.

    Attributes:
        constants: (3, n) limits of the joints, steps of the command, most of each motor: for `motor_effort_into`.
        to_motors: (n, n) J^-T.
    """

    def __init__(self, arm: Arm, effects: ArmEffects, effort_limits: NDArray[np.float64]) -> None:
        """Motors of `arm`, whose joints have `effort_limits` (n,) [N m, N]."""
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
        """Sensor of `arm` with new noise every `time_step` [s]; `seed` >= 0. Without an `effort` it is exact."""
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


class DriveForce(LeafSystem):
    """One system for all of them, as each system that computes in every step costs some microseconds.

    .. pydrake_system::

        name: DriveForce
        input_ports:
        - effort_commanded (optional)
        - effort_disturbance (optional)
        - plant_state
        output_ports:
        - generalized_force

    - `effort_commanded` (n): on the joints [N m, N]; see `Motors`. Unconnected: zero.
    - `effort_disturbance` (n): on the joints too, behind the motors. Unconnected: zero.
    - `plant_state`: of the whole plant.
    - `generalized_force`: for the plant's port `applied_generalized_force`: what the motors give, the disturbance, and
      cables and springs. These are the effort that motors need to hold against them, so minus their sum acts.
    """

    def __init__(self, arm: Arm, motors: Motors, parts: PlantEffects, effects: ArmEffects) -> None:
        """Of `arm`, whose plant is finalized and has the `parts`; of the `effects` cables and springs count.

        Raises:
            StationError: an effect that the arm cannot have.
        """
        super().__init__()
        laws = [*effects.cables, *effects.springs]
        kinds = tuple(map(ActuatorEffect.of, laws))
        for kind in kinds:
            if fault := effect_fault(arm, kind, POSITION_KINDS):
                raise StationError(f"{arm.name}: effects: cables, springs: {fault}")
        self._motors, self._from_motors = motors, parts.from_motors
        self._joints = np.array(parts.joint_index, dtype=np.int64)
        self._torque = compile_effect_torque(arm, kinds) if kinds else None  # owns the compiled code
        self._coefficients = np.array([law.coefficient for law in laws])
        n, nv = arm.num_joints, len(parts.from_motors)
        for name, size in (("effort_commanded", n), ("effort_disturbance", n), ("plant_state", 2 * nv)):
            self.DeclareVectorInputPort(name=name, size=size)
        self.DeclareVectorOutputPort(
            name="generalized_force",
            size=nv,
            calc=self._make_calc(n),
            prerequisites_of_calc={self.all_input_ports_ticket()},
        )

    def _make_calc(self, n: int) -> Callable[[Context, BasicVector], None]:
        """The handler of the port, with all that it needs at hand: see GravityPidController."""
        eval_vector_input, motors_into, subtract_at = self.EvalVectorInput, entry_point(_force_into), entry_point(_take)
        torque_into = None if self._torque is None else entry_point(self._torque)
        constants, to_motors, from_motors = self._motors.constants, self._motors.to_motors, self._from_motors
        joints, coefficients = self._joints, self._coefficients
        nothing, q, tau = np.zeros(n), np.empty(n), np.empty(n)

        def calc(context: Context, output: BasicVector) -> None:
            command, outside = eval_vector_input(context, 0), eval_vector_input(context, 1)
            force = output.get_mutable_value()
            motors_into(
                nothing if command is None else command.get_value(),
                nothing if outside is None else outside.get_value(),
                eval_vector_input(context, 2).get_value(),
                joints,
                constants,
                to_motors,
                from_motors,
                q,
                tau,
                force,
            )
            if torque_into is not None:
                torque_into(q, coefficients, tau)
                subtract_at(tau, joints, force)

        return calc


@numba.njit(
    "void(float64[::1], float64[::1], float64[::1], int64[::1], float64[:, ::1], float64[:, ::1], float64[:, ::1],"
    " float64[::1], float64[::1], float64[::1])",
    cache=True,
)
def _force_into(command, outside, state, joints, constants, to_motors, from_motors, q, motors, force):
    """Motors and what comes from outside; `q` becomes the joints' positions, `motors` the actuators' efforts."""
    motor_effort_into(command, constants, to_motors, motors)
    for i in range(len(force)):
        force[i] = 0.0
        for k in range(len(motors)):
            force[i] += from_motors[i, k] * motors[k]
    for k in range(len(joints)):
        force[joints[k]] += outside[k]
        q[k] = state[joints[k]]


@numba.njit("void(float64[::1], int64[::1], float64[::1])", cache=True)
def _take(tau, joints, force):
    for k in range(len(joints)):
        force[joints[k]] -= tau[k]
