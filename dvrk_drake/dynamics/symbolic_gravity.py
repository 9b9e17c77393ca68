"""Derives link frames, gravity torque and its regressor symbolically from an arm's MultibodyPlant.

Reference: Rutfield et al., "Gravity Compensation Control of da Vinci Robot" (2015), sections III.B to III.D and III.H.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import cache

import numpy as np
import pydrake.symbolic as symbolic
import sympy
from numpy.typing import NDArray
from pydrake.math import RigidTransform
from pydrake.multibody.plant import MultibodyPlant

from dvrk_drake.dynamics.gravity_parameters import GravityParameters, exact_rotation, gravity_parameters, link_frames
from dvrk_drake.dynamics.trigonometric_form import exact_half, shortest_form
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.plant import shared_plant, tree_selector

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


class SymbolicPlant:
    """Symbolic MultibodyPlant of an arm. All positions are functions of the independent joint positions q1, ..., qn.

    Attributes:
        arm: Arm of the plant.
        numeric: Numeric plant of the arm.
        bodies: Label ("1" to "7", "crank", ...) -> moving body B and the pose X_BF of its frame F, see
            `link_frames`.
        q: Joint positions as sympy symbols q1, ..., qn [rad, m].
    """

    def __init__(self, arm: Arm, frames: str = "dh") -> None:
        """Converts the plant of an arm to symbolic form and substitutes the positions of the linkage.

        Args:
            arm: Arm of the plant.
            frames: Prefix of the link frames in the SDF, e.g. "dh".

        Raises:
            ArmError: The SDF has no frames with this prefix.
        """
        self.arm, self._frames = arm, frames
        self.numeric = shared_plant(arm)
        self.bodies = link_frames(arm, frames)
        self._plant = self.numeric.ToSymbolic()
        self._context = self._plant.CreateDefaultContext()
        drake_q = [symbolic.Variable(f"q{i + 1}") for i in range(arm.num_joints)]
        self.q = tuple(sympy.Symbol(f"q{i + 1}", real=True) for i in range(arm.num_joints))
        self._heights: dict[str, list[symbolic.Expression]] = {}
        self._memo: dict = {}
        self._sums = _parallel_sums(self.numeric, arm, self.q)
        q_plant = np.empty(self._plant.num_positions(), dtype=object)
        q_plant[tree_selector(self.numeric, arm)] = _tree_positions(arm, drake_q)
        self._plant.SetPositions(self._context, q_plant)

    def frame_poses(self) -> dict[str, sympy.ImmutableDenseMatrix]:
        """Returns label -> pose X_0F(q) (4, 4) of each link frame in frame 0 [m] (Rutfield et al., 2015)."""
        zero = self.numeric.GetFrameByName(f"{self._frames}_0")
        X_W0 = zero.CalcPoseInWorld(self.numeric.CreateDefaultContext())
        X_0W = _exact_matrix(X_W0.inverse())
        poses = {}
        for label, (body, X_BF) in self.bodies.items():
            X_WB = self._plant.EvalBodyPoseInWorld(self._context, self._plant.get_body(body.index())).GetAsMatrix4()
            X_BF_exact = _exact_matrix(X_BF)
            X_0B = [[_dot(row, column) for column in X_WB.T] for row in X_0W]
            poses[label] = sympy.ImmutableDenseMatrix(
                [[self._from_drake(_dot(column, row)) for column in X_BF_exact.T] for row in X_0B]
            )
        return poses

    def shortest(self, expression: sympy.Expr) -> sympy.Expr:
        """Returns a short form of an expression in q, see `shortest_form`."""
        return shortest_form(expression, self._sums)

    def _from_drake(self, expression: symbolic.Expression) -> sympy.Expr:
        converted = symbolic.to_sympy(expression, memo=self._memo)
        converted = converted.xreplace({s: self.q[int(s.name[1:]) - 1] for s in converted.free_symbols})
        trigonometric = converted.atoms(sympy.sin, sympy.cos)
        exact = {x: x.xreplace({f: exact_half(float(f)) for f in x.atoms(sympy.Float)}) for x in trigonometric}
        return self.shortest(converted.xreplace(exact))

    def potential_energy(self, label: str, axis: str) -> sympy.Expr:
        """Returns the potential energy per unit of a parameter of a link, for gravity of 1 m/s^2.

        The potential energy is linear in mass and first moments. A unit mass at the origin of F contributes
        -g_W . p_WFo, and a unit first moment along an axis of F contributes -g_W . axis. This computation is much
        faster than the symbolic `CalcPotentialEnergy` of an arm with a closed linkage.

        Args:
            label: Label of the link.
            axis: "" for the mass, or "x", "y" or "z" for the first moment along this axis of F.
        """
        if label not in self._heights:
            g_W = exact_rotation(self.arm.gravity / np.linalg.norm(self.arm.gravity))
            X_WB = self._plant.EvalBodyPoseInWorld(
                self._context, self._plant.get_body(self.bodies[label][0].index())
            ).GetAsMatrix4()
            # The row is -g_W' (R_WB, p_WBo). `_dot` omits zeros, so the expressions contain no terms with factor 0.
            self._heights[label] = [_dot(-g_W, X_WB[:3, j]) for j in range(4)]
        column = _exact_matrix(self.bodies[label][1])[:, "xyz".index(axis) if axis else 3]
        return self._from_drake(_dot(column, self._heights[label]))


def _dot(numbers: NDArray[np.float64], expressions: Sequence[symbolic.Expression]) -> symbolic.Expression:
    terms = (float(x) * e for x, e in zip(numbers, expressions, strict=True) if x)
    return sum(terms, symbolic.Expression(0))


def _exact_matrix(X: RigidTransform) -> NDArray[np.float64]:
    """Returns the matrix (4, 4) of a pose, with the rotation of `exact_rotation`."""
    matrix = X.GetAsMatrix4()
    matrix[:3, :3] = exact_rotation(matrix[:3, :3])
    return matrix


def _tree_positions(arm: Arm, q: list[symbolic.Variable]) -> list[symbolic.Expression]:
    G, c = arm.linkage.matrix, arm.linkage.offset
    return [
        sum((G[row, j] * q[j] for j in np.flatnonzero(G[row])), symbolic.Expression(c[row])) for row in range(len(c))
    ]


def _parallel_sums(plant: MultibodyPlant, arm: Arm, q: Sequence[sympy.Symbol]) -> list[tuple[sympy.Expr, sympy.Expr]]:
    """Returns pairs of angles whose sums occur in link poses, from the base to the tip.

    A pair consists of the rotation angle of a body and the angle of a revolute joint on this body. Both angles are
    about the same axis. They are linear combinations of q according to the linkage, so opposite rotations cancel in
    their sum.
    """
    context = plant.CreateDefaultContext()
    rotations: dict[str, tuple[NDArray[np.float64], sympy.Expr]] = {}  # Body -> axis and rotation angle.
    sums = []
    for name, row in zip(arm.tree_joint_names, arm.linkage.matrix, strict=True):
        joint = plant.GetJointByName(name)
        if joint.type_name() != "revolute":
            continue
        axis = joint.frame_on_parent().CalcPoseInWorld(context).rotation() @ joint.revolute_axis()
        angle = sympy.Add(*(exact_half(row[j]) * q[int(j)] for j in np.flatnonzero(row)))
        parent_axis, parent_angle = rotations.get(joint.parent_body().name(), (axis, sympy.Integer(0)))
        if not np.allclose(axis, parent_axis, atol=1e-12):
            parent_angle = sympy.Integer(0)
        if parent_angle != 0 and (parent_angle, angle) not in sums:
            sums.append((parent_angle, angle))
        rotations[joint.child_body().name()] = axis, parent_angle + angle
    return sums
