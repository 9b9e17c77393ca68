"""All efforts on the plant of a real arm that no solver needs to know: motors, cables, springs, a hand."""

from __future__ import annotations

from collections.abc import Callable

import numba
import numpy as np
from pydrake.systems.framework import BasicVector, Context, LeafSystem

from dvrk_drake.dynamics.actuator_effects import ActuatorEffect, effect_fault
from dvrk_drake.dynamics.codegen import entry_point
from dvrk_drake.dynamics.static_model import compile_effect_torque
from dvrk_drake.errors import StationError
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.effects_schema import POSITION_KINDS, ArmEffects
from dvrk_drake.systems.arm_effects.dry_friction import PlantEffects
from dvrk_drake.systems.arm_effects.motors import Motors, motor_effort_into


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
        kinds = tuple(ActuatorEffect(law.coordinate, law.kind, law.scale) for law in laws)
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
