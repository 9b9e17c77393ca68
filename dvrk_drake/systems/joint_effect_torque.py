"""Effects in an arm's drive as torques that act on the joints of its simulation."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import ArrayLike
from pydrake.systems.framework import BasicVector, Context, LeafSystem

from dvrk_drake.dynamics.actuator_effects import POSITION_KINDS, ActuatorEffect, effect_fault
from dvrk_drake.dynamics.static_model import compile_effect_torque
from dvrk_drake.errors import StationError
from dvrk_drake.models.arm import Arm
from dvrk_drake.systems.gravity_pid_step import entry_point


class JointEffectTorque(LeafSystem):
    """Plays the effects of position that identification looks for: the same formulas, so what is put in can be found.

    .. pydrake_system::

        name: JointEffectTorque
        input_ports:
        - state_estimated
        output_ports:
        - effort_disturbance

    - `state_estimated` (2n): q, then v of the arm's joints [rad, rad/s; m, m/s on a prismatic joint].
    - `effort_disturbance` (n): what acts on the joints [N m, N], for `ArmStation`'s port of that name. An effect is the
      effort that motors need to hold against it, so this is minus their sum.
    """

    def __init__(self, arm: Arm, effects: Sequence[ActuatorEffect], coefficients: ArrayLike) -> None:
        """Of the `effects` with one coefficient each, in the unit of their kind.

        Raises:
            StationError: an effect that the arm cannot have or that depends on velocity, or not one finite coefficient
                for each effect.
        """
        super().__init__()
        coefficients = np.asarray(coefficients, float)
        if coefficients.shape != (len(effects),) or not np.all(np.isfinite(coefficients)):
            raise StationError(
                f"needs one finite coefficient for each of {len(effects)} effects; got {coefficients.tolist()}"
            )
        for i, effect in enumerate(effects):
            if fault := effect_fault(arm, effect, POSITION_KINDS):
                raise StationError(f"effects[{i}]: {fault}")
        n = arm.num_joints
        self._coefficients = -coefficients
        self._dispatcher = compile_effect_torque(arm, tuple(effects))  # owns the compiled code
        self.DeclareVectorInputPort(name="state_estimated", size=2 * n)
        self.DeclareVectorOutputPort(
            name="effort_disturbance",
            size=n,
            calc=self._make_calc(n),
            prerequisites_of_calc={self.all_input_ports_ticket()},
        )

    def _make_calc(self, n: int) -> Callable[[Context, BasicVector], None]:
        """The handler of the port, with all that it needs at hand: see GravityPidController."""
        eval_vector_input, torque_into = self.EvalVectorInput, entry_point(self._dispatcher)
        coefficients, q = self._coefficients, np.empty(n)

        def calc(context: Context, output: BasicVector) -> None:
            q[:] = eval_vector_input(context, 0).get_value()[:n]
            torque_into(q, coefficients, output.get_mutable_value())

        return calc
