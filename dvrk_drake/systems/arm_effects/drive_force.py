"""Efforts that are computed outside of Drake's solver (motors, cables, springs, disturbance), and the effort sensor."""

from __future__ import annotations

from collections.abc import Callable

import numba
import numpy as np
from numpy.typing import NDArray
from pydrake.systems.framework import BasicVector, Context, LeafSystem

from dvrk_drake.dynamics.actuator_effects import ActuatorEffect, effect_fault
from dvrk_drake.dynamics.compiled import entry_point
from dvrk_drake.dynamics.holding_torque import HoldingArrays, holding_torque_into
from dvrk_drake.errors import StationError
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.effects_schema import POSITION_KINDS, ArmEffects, EffortEffect, per_actuator
from dvrk_drake.systems.arm_effects.dry_friction import PlantEffects
from dvrk_drake.systems.ideal_drive import PlantJoints


class Motors:
    """Conversion of commanded joint efforts to motor efforts.

    The command is clamped to the effort limits of the joints and converted to actuator efforts J^-T tau [N m, N]. The
    actuator efforts are rounded to multiples of `effort.command_resolution` and limited to `saturation`; see
    `ArmEffects`.

    Attributes:
        constants: Array (3, n). Its rows are the effort limits of the joints, the resolutions of the commands, and the
            saturation efforts.
        to_motors: Matrix J^-T (n, n) from joint efforts to actuator efforts.
    """

    def __init__(self, arm: Arm, effects: ArmEffects, effort_limits: NDArray[np.float64]) -> None:
        """Creates the motors of `arm` with the `effort_limits` (n,) [N m, N] of the joints."""
        names = arm.joint_names
        steps = per_actuator(effects.effort.command_resolution if effects.effort else {}, names, 0.0)
        self.constants = np.array([effort_limits, steps, per_actuator(effects.saturation, names, np.inf)])
        self.to_motors = np.ascontiguousarray(np.linalg.inv(arm.transmission.matrix).T)

    def effort(self, command: NDArray[np.float64]) -> NDArray[np.float64]:
        """Returns the actuator efforts (n,) for commanded joint efforts (n,)."""
        effort = np.empty(len(self.to_motors))
        motor_effort_into(np.ascontiguousarray(command), self.constants, self.to_motors, effort)
        return effort


@numba.njit("float64(float64, float64)", cache=True)
def round_to_step(value, step):
    """Rounds `value` to the nearest multiple of `step`. A step of 0 means no rounding."""
    return step * np.rint(value / step) if step > 0.0 else value


@numba.njit("void(float64[::1], float64[:, ::1], float64[:, ::1], float64[::1])", cache=True)
def motor_effort_into(command, constants, to_motors, effort):
    """Computes `Motors.effort` in compiled code."""
    limits, steps, saturation = constants
    effort[:] = 0.0
    for k in range(len(command)):
        tau = min(max(command[k], -limits[k]), limits[k])
        for i in range(len(effort)):
            effort[i] += to_motors[i, k] * tau
    for i in range(len(effort)):
        effort[i] = min(max(round_to_step(effort[i], steps[i]), -saturation[i]), saturation[i])


class EffortSensor(LeafSystem):
    """Simulated sensor of the motor efforts. A dVRK computes these efforts from the motor currents.

    .. pydrake_system::

        name: EffortSensor
        input_ports:
        - effort_commanded (optional)
        output_ports:
        - effort_measured

    - `effort_commanded` (n): commanded joint efforts at the time of the measurement [N m, N]. Unconnected: zero.
    - `effort_measured` (n): measured joint efforts [N m, N]. Gaussian noise is added to the motor efforts, which are
      then rounded to multiples of `measured_resolution`. The noise changes every time step.

    The noise comes from a counter-based generator (Philox, Salmon et al., SC 2011). The noise of a time step depends
    only on the seed and the index of the step. A seed therefore gives identical noise for any order of evaluations.
    Drake's RandomSource is not used, because Python cannot set its seed (Drake 1.51 to 1.58).
    """

    def __init__(self, arm: Arm, motors: Motors, effort: EffortEffect | None, time_step: float, seed: int) -> None:
        """Creates the sensor.

        Args:
            arm: Arm with n joints.
            motors: Motors of the arm.
            effort: Noise and resolution. None: the measurement is exact.
            time_step: Sampling period of the noise [s].
            seed: Seed of the noise, at least 0.
        """
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
            # Half a step is added before truncation, because sums of time steps are not exact.
            tick = int(context.get_time() / self._time_step + 0.5)
            bits = np.random.Philox(key=self._seed, counter=[0, 0, tick, 0])
            effort = effort + self._deviations * np.random.Generator(bits).standard_normal(len(effort))
        counted = np.array([round_to_step(value, step) for value, step in zip(effort, self._steps, strict=True)])
        output.SetFromVector(self._transmission.pull_back_effort(counted))


class DriveForce(LeafSystem):
    """Computes the sum of motor, cable, spring and disturbance efforts. One system is faster than several systems.

    .. pydrake_system::

        name: DriveForce
        input_ports:
        - effort_commanded (optional)
        - effort_disturbance (optional)
        - plant_state
        output_ports:
        - generalized_force

    - `effort_commanded` (n): commanded joint efforts [N m, N]; see `Motors`. Unconnected: zero.
    - `effort_disturbance` (n): joint efforts that act in addition to the motors [N m, N]. Unconnected: zero.
    - `plant_state`: state of the arm's model instance.
    - `generalized_force`: generalized force (nv) for the plant's port `applied_generalized_force`. The effects of
      cables and springs are defined as the effort that compensates them, so they are subtracted.
    """

    def __init__(self, motors: Motors, parts: PlantEffects, joints: PlantJoints) -> None:
        """Creates the system.

        Args:
            motors: Motors of the arm.
            parts: Effects of the arm in the finalized plant. Only cables and springs are used here.
            joints: Joints of the arm in the plant.

        Raises:
            StationError: An effect is not valid for this arm.
        """
        super().__init__()
        arm, laws = parts.arm, parts.effects.position_dependent
        kinds = tuple(map(ActuatorEffect.of, laws))
        for kind in kinds:
            if fault := effect_fault(arm, kind, POSITION_KINDS):
                raise StationError(f"{arm.name}: effects: cables, springs: {fault}")
        self._motors, self._from_motors = motors, parts.from_motors
        self._joints = np.array([joints.index, joints.velocity_index], dtype=np.int64)
        self._effects = HoldingArrays.of_effects(arm, kinds, np.array([-law.coefficient for law in laws]))
        n, state_size = arm.num_joints, 2 * parts.to_actuators.shape[1]
        for name, size in (("effort_commanded", n), ("effort_disturbance", n), ("plant_state", state_size)):
            self.DeclareVectorInputPort(name=name, size=size)
        self.DeclareVectorOutputPort(
            name="generalized_force",
            size=len(parts.from_motors),
            calc=self._make_calc(n),
            prerequisites_of_calc={self.all_input_ports_ticket()},
        )

    def _make_calc(self, n: int) -> Callable[[Context, BasicVector], None]:
        """Returns the handler of the port. The handler uses local names for speed; see GravityPidController."""
        eval_vector_input, motors_into = self.EvalVectorInput, entry_point(_force_into)
        torque_into, add_at = entry_point(holding_torque_into), entry_point(_add_at)
        constants, to_motors, from_motors = self._motors.constants, self._motors.to_motors, self._from_motors
        joints, effects, has_effects = self._joints, self._effects, len(self._effects.effects) > 0
        force_index = joints[1]
        zero, q, tau, motors = np.zeros(n), np.empty(n), np.empty(n), np.empty(n)

        def calc(context: Context, output: BasicVector) -> None:
            command, disturbance = eval_vector_input(context, 0), eval_vector_input(context, 1)
            force = output.get_mutable_value()
            motors_into(
                zero if command is None else command.get_value(),
                zero if disturbance is None else disturbance.get_value(),
                eval_vector_input(context, 2).get_value(),
                joints,
                constants,
                to_motors,
                from_motors,
                q,
                motors,
                force,
            )
            if has_effects:
                torque_into(q, effects, tau)
                add_at(tau, force_index, force)

        return calc


@numba.njit(
    "void(float64[::1], float64[::1], float64[::1], int64[:, ::1], float64[:, ::1], float64[:, ::1], float64[:, ::1],"
    " float64[::1], float64[::1], float64[::1])",
    cache=True,
)
def _force_into(command, disturbance, state, joints, constants, to_motors, from_motors, q, motors, force):
    """Writes the generalized force of motors and disturbance to `force`.

    The joint positions are written to `q` and the actuator efforts to `motors`. The rows of `joints` are the indices of
    the joints in `state` and in `force`.
    """
    motor_effort_into(command, constants, to_motors, motors)
    for i in range(len(force)):
        force[i] = 0.0
        for k in range(len(motors)):
            force[i] += from_motors[i, k] * motors[k]
    for k in range(len(q)):
        force[joints[1, k]] += disturbance[k]
        q[k] = state[joints[0, k]]


@numba.njit("void(float64[::1], int64[::1], float64[::1])", cache=True)
def _add_at(tau, force_index, force):
    for k in range(len(tau)):
        force[force_index[k]] += tau[k]
