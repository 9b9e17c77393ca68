"""Gravity torque and its regressor, derived symbolically from the arm's own MultibodyPlant (paper, III.B-D, H)."""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import cache

import numpy as np
import sympy

from dvrk_drake.dynamics.gravity_parameters import GravityParameters, gravity_parameters
from dvrk_drake.dynamics.symbolic_plant import SymbolicPlant
from dvrk_drake.models.arm import Arm

GRAVITY = sympy.Symbol("g", positive=True)


@dataclass(frozen=True, eq=False)
class SymbolicGravity(GravityParameters):
    """tau = Y(q) beta: the torque on the n independent joints that holds the arm against gravity.

    Attributes:
        q: the n joint positions as sympy symbols q1..qn [rad, m].
        regressor: sympy (n, b) in q and the symbol g = |gravity| [m/s^2]; d potential / dq.
        potential: sympy (1, b); potential beta is the part of the potential energy that depends on q [J].
    """

    q: tuple[sympy.Symbol, ...]
    regressor: sympy.ImmutableDenseMatrix
    potential: sympy.ImmutableDenseMatrix

    @property
    def gravity_magnitude(self) -> float:
        """|gravity| [m/s^2]: the number for the symbol g."""
        return float(np.linalg.norm(self.arm.gravity))


@cache
def derive_gravity(arm: Arm, frames: str = "dh", serial: bool = False) -> SymbolicGravity:
    """Derives the gravity torque of `arm` from its plant.

    `MultibodyPlant.ToSymbolic()` gives the pose of every link, and so the potential energy P per unit of its mass m and
    of its first moment m c, in which P is linear; only those that stand for base parameters are written out. tau = G'
    dP/dq_tree falls out by making the tree a function of the independent joints first: the regressor's columns are the
    derivatives.

    Args:
        arm, frames, serial: as in `gravity_parameters`.

    Raises:
        ArmError: as of `gravity_parameters`.
    """
    parameters = gravity_parameters(arm, frames, serial)
    plant = SymbolicPlant(arm, frames)
    chosen = [parameters.standard_parameters[column] for column in parameters.base.columns]
    # Shortened before they are differentiated: a linkage turns its links back and forth, which all drops out here.
    energies, ring = [plant.potential_energy(p.label, p.axis) for p in chosen], plant.ring
    columns = [[ring.to_sympy(ring.shortest(ring.derivative(e, q))) for e in energies] for q in plant.q]
    return SymbolicGravity(
        **{part.name: getattr(parameters, part.name) for part in fields(parameters)},
        q=plant.q,
        regressor=sympy.ImmutableDenseMatrix(GRAVITY * sympy.Matrix(columns)),
        potential=sympy.ImmutableDenseMatrix([[GRAVITY * ring.to_sympy(energy) for energy in energies]]),
    )
