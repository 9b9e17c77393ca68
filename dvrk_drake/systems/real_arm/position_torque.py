"""Cables and springs of an arm's drive as torques on its joints."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numba
import numpy as np
from pydrake.systems.framework import BasicVector, Context, LeafSystem

from dvrk_drake.dynamics.actuator_effects import EFFECT_KINDS, effect_step
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.effects_schema import DriveEffect
from dvrk_drake.systems.gravity_pid_step import entry_point
from dvrk_drake.systems.real_arm.dry_friction import coordinate_row


class PositionTorque(LeafSystem):
    """Torques that depend on where a coordinate of the drive is: each is the slope of a potential.

    .. pydrake_system::

        name: PositionTorque
        input_ports:
        - state
        output_ports:
        - effort

    - `state` (2n): q, then v of the arm's joints, exact [rad, rad/s; m, m/s on a prismatic joint].
    - `effort` (n): what acts on the joints [N m, N]: an effect is what motors need to hold against it, so this is minus
      their sum, `ActuatorEffect.step` of each, pulled back to the joints.
    """

    def __init__(self, arm: Arm, effects: Sequence[DriveEffect]) -> None:
        """Of position effects along coordinates of `arm`'s drive.

        Raises:
            StationError: a coordinate that the arm's drive has not.
        """
        super().__init__()
        n = arm.num_joints
        self._rows = np.array([coordinate_row(arm, effect.coordinate) for effect in effects]).reshape(-1, n)
        self._codes = np.array([EFFECT_KINDS[effect.kind].code for effect in effects], dtype=int)
        self._constants = np.array([[effect.scale, effect.coefficient] for effect in effects])
        self.DeclareVectorInputPort(name="state", size=2 * n)
        self.DeclareVectorOutputPort(
            name="effort", size=n, calc=self._make_calc(), prerequisites_of_calc={self.all_input_ports_ticket()}
        )

    def _make_calc(self) -> Callable[[Context, BasicVector], None]:
        eval_vector_input, step = self.EvalVectorInput, entry_point(_torque_into)
        rows, codes, constants = self._rows, self._codes, self._constants

        def calc(context: Context, output: BasicVector) -> None:
            step(eval_vector_input(context, 0).get_value(), rows, codes, constants, output.get_mutable_value())

        return calc


@numba.njit("void(float64[::1], float64[:, ::1], int64[::1], float64[:, ::1], float64[::1])", cache=True)
def _torque_into(state, rows, codes, constants, effort):
    """`constants` (effects, 2): scale and coefficient."""
    effort[:] = 0.0
    for i in range(len(codes)):
        x = 0.0
        for k in range(len(effort)):
            x += rows[i, k] * state[k]
        _, shape = effect_step(codes[i], 0.0, 0.0, x, 0.0, constants[i, 0])
        for k in range(len(effort)):
            effort[k] -= rows[i, k] * constants[i, 1] * shape
