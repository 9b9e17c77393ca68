"""Cables and springs of an arm's drive as torques on its joints."""

from __future__ import annotations

from collections.abc import Sequence

import numba
import numpy as np
from numpy.typing import NDArray
from pydrake.systems.framework import BasicVector, Context, LeafSystem

from dvrk_drake.dynamics.actuator_effects import EFFECT_KINDS, effect_step
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.effects_schema import DriveEffect
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
        self._scales = np.array([effect.scale for effect in effects])
        self._coefficients = np.array([effect.coefficient for effect in effects])
        self.DeclareVectorInputPort(name="state", size=2 * n)
        self.DeclareVectorOutputPort(
            name="effort", size=n, calc=self._calc_effort, prerequisites_of_calc={self.all_input_ports_ticket()}
        )

    def _calc_effort(self, context: Context, output: BasicVector) -> None:
        state = self.EvalVectorInput(context, 0).get_value()
        _torque_into(
            state, self._rows, self._codes, self._scales, self._coefficients, output.get_mutable_value()
        )


@numba.njit(cache=True)
def _torque_into(
    state: NDArray[np.float64],
    rows: NDArray[np.float64],
    codes: NDArray[np.int_],
    scales: NDArray[np.float64],
    coefficients: NDArray[np.float64],
    effort: NDArray[np.float64],
) -> None:
    effort[:] = 0.0
    for i in range(len(codes)):
        x = 0.0
        for k in range(len(effort)):
            x += rows[i, k] * state[k]
        _, shape = effect_step(codes[i], 0.0, 0.0, x, 0.0, scales[i])
        for k in range(len(effort)):
            effort[k] -= rows[i, k] * coefficients[i] * shape
