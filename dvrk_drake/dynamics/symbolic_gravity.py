"""Derives the gravity torque and its regressor symbolically from an arm's MultibodyPlant.

Reference: Rutfield et al., "Gravity Compensation Control of da Vinci Robot" (2015), sections III.B to III.D and III.H.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import cache

import sympy

from dvrk_drake.dynamics.gravity_parameters import GravityParameters, gravity_parameters
from dvrk_drake.dynamics.symbolic_plant import SymbolicPlant
from dvrk_drake.models.arm import Arm

#: Magnitude of gravity [m/s^2].
GRAVITY = sympy.Symbol("g", positive=True)


@dataclass(frozen=True, eq=False)
class SymbolicGravity(GravityParameters):
    """Symbolic torque tau = Y(q) beta that compensates gravity at the n independent joints.

    Attributes:
        q: Joint positions as symbols q1, ..., qn [rad, m].
        regressor: Y (n, b) as a function of q and `GRAVITY`.
        potential: Row (1, b). `potential @ beta` is the part of the potential energy that depends on q [J].
    """

    q: tuple[sympy.Symbol, ...]
    regressor: sympy.ImmutableDenseMatrix
    potential: sympy.ImmutableDenseMatrix


@cache
def derive_gravity(arm: Arm, frames: str = "dh", serial: bool = False) -> SymbolicGravity:
    """Derives the gravity torque of `arm` from its symbolic plant.

    The potential energy P is linear in the mass and the first moments of each link. P is derived as a function of the
    independent joint positions q, per unit of each parameter in `base.columns`. The regressor is the derivative of P
    with respect to q.

    Args:
        arm, frames, serial: Arguments of `gravity_parameters`.

    Raises:
        ArmError: See `gravity_parameters`.
    """
    parameters = gravity_parameters(arm, frames, serial)
    plant = SymbolicPlant(arm, frames)
    chosen = [parameters.standard_parameters[column] for column in parameters.base.columns]
    # `potential_energy` returns short forms, so the opposite rotations in a linkage cancel before differentiation.
    energies = [plant.potential_energy(p.label, p.axis) for p in chosen]
    rows = [[plant.shortest(sympy.diff(energy, q)) for energy in energies] for q in plant.q]
    return SymbolicGravity(
        **{part.name: getattr(parameters, part.name) for part in fields(parameters)},
        q=plant.q,
        regressor=sympy.ImmutableDenseMatrix(GRAVITY * sympy.Matrix(rows)),
        potential=sympy.ImmutableDenseMatrix([[GRAVITY * energy for energy in energies]]),
    )
