"""Symbolic plant of an arm: its frames and potential energy as functions of the independent joints."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pydrake.symbolic as symbolic
import sympy
from numpy.typing import NDArray
from pydrake.math import RigidTransform
from pydrake.multibody.plant import MultibodyPlant

from dvrk_drake.dynamics.gravity_parameters import exact_rotation, labelled_bodies
from dvrk_drake.dynamics.trigonometric_ring import Polynomial, TrigonometricRing, exact_half
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.plant import shared_plant, tree_selector


class SymbolicPlant:
    """`MultibodyPlant.ToSymbolic()` with the linkage substituted: every position is a function of q1..qn.

    Attributes:
        arm: the arm.
        numeric: the same plant in numbers.
        bodies: label ("1".."7", "crank", ...) -> moving body and the frame F its parameters are written in, X_BF.
        q: the n joint positions as sympy symbols q1..qn [rad, m].
        ring: of polynomials in them.
    """

    def __init__(self, arm: Arm, frames: str = "dh") -> None:
        """Makes the plant symbolic and puts the linkage in.

        Args:
            arm: the arm.
            frames: prefix of the SDF's link frames, "dh" or another that the SDF has.

        Raises:
            ArmError: the SDF has no frames of that prefix.
        """
        self.arm, self._frames = arm, frames
        self.numeric = shared_plant(arm)
        self.bodies = labelled_bodies(self.numeric, frames)
        self._plant = self.numeric.ToSymbolic()
        self._context = self._plant.CreateDefaultContext()
        drake_q = [symbolic.Variable(f"q{i + 1}") for i in range(arm.num_joints)]
        self.q = tuple(sympy.Symbol(f"q{i + 1}", real=True) for i in range(arm.num_joints))
        self._heights: dict[str, list[symbolic.Expression]] = {}
        self.ring = TrigonometricRing(self.q, _parallel_sums(self.numeric, arm, self.q))
        q_plant = np.empty(self._plant.num_positions(), dtype=object)
        q_plant[tree_selector(self.numeric, arm)] = _tree_positions(arm, drake_q)
        self._plant.SetPositions(self._context, q_plant)

    def frame_poses(self) -> dict[str, sympy.ImmutableDenseMatrix]:
        """X_0F(q), the pose of every link frame in frame 0: label -> 4 x 4 (the paper's II.A and III.B) [m]."""
        zero = self.numeric.GetFrameByName(f"{self._frames}_0")
        X_W0 = zero.CalcPoseInWorld(self.numeric.CreateDefaultContext())
        X_0W = _exact_matrix(X_W0.inverse())
        poses = {}
        for label, (body, X_BF) in self.bodies.items():
            X_WB = self._plant.EvalBodyPoseInWorld(self._context, self._plant.get_body(body.index())).GetAsMatrix4()
            X_BF_exact = _exact_matrix(X_BF)
            X_0B = [[_dot(row, column) for column in X_WB.T] for row in X_0W]
            poses[label] = sympy.ImmutableDenseMatrix(
                [[self._simplified(_dot(column, row)) for column in X_BF_exact.T] for row in X_0B]
            )
        return poses

    def _simplified(self, expression: symbolic.Expression) -> sympy.Expr:
        return self.ring.to_sympy(self.ring.shortest(self.ring.from_drake(expression)))

    def potential_energy(self, label: str, axis: str) -> Polynomial:
        """P per unit of a labelled link's mass (`axis` "") or of its first moment along "x", "y" or "z" of F.

        P = -m g_W . p_WCcm is linear in m and m c: a unit of mass at the origin of F adds -g_W . p_WFo, a unit of
        first moment along an axis of F adds -g_W . that axis. Summed over the links this is the plant's own
        `CalcPotentialEnergy`, whose expanded form takes half a minute on an arm with a closed linkage.
        """
        if label not in self._heights:
            g_W = exact_rotation(self.arm.gravity / np.linalg.norm(self.arm.gravity))
            X_WB = self._plant.EvalBodyPoseInWorld(
                self._context, self._plant.get_body(self.bodies[label][0].index())
            ).GetAsMatrix4()
            # Row -g_W' (R_WB, p_WBo); zeros are left out so that no term of theirs is carried along.
            self._heights[label] = [_dot(-g_W, X_WB[:3, j]) for j in range(4)]
        column = _exact_matrix(self.bodies[label][1])[:, "xyz".index(axis) if axis else 3]
        return self.ring.shortest(self.ring.from_drake(_dot(column, self._heights[label])))


def _dot(numbers: NDArray[np.float64], expressions: Sequence[symbolic.Expression]) -> symbolic.Expression:
    terms = (float(x) * e for x, e in zip(numbers, expressions, strict=True) if x)
    return sum(terms, symbolic.Expression(0))


def _exact_matrix(X: RigidTransform) -> NDArray[np.float64]:
    """X as a matrix, (4, 4), with an exact rotation."""
    matrix = X.GetAsMatrix4()
    matrix[:3, :3] = exact_rotation(matrix[:3, :3])
    return matrix


def _tree_positions(arm: Arm, q: list[symbolic.Variable]) -> list[symbolic.Expression]:
    G, c = arm.linkage.matrix, arm.linkage.offset
    return [
        sum((G[row, j] * q[j] for j in np.flatnonzero(G[row])), symbolic.Expression(c[row])) for row in range(len(c))
    ]


def _parallel_sums(plant: MultibodyPlant, arm: Arm, q: Sequence[sympy.Symbol]) -> list[tuple[sympy.Expr, sympy.Expr]]:
    """Pairs of angles that add up, base first: those of a body and of a joint on it with the same axis.

    Both are sums of multiples of q, as the linkage has it: a bar that turns back adds the negative of what it undoes.
    """
    context = plant.CreateDefaultContext()
    turned: dict[str, tuple[NDArray[np.float64], sympy.Expr]] = {}  # body -> its axis and angle about it
    sums = []
    for name, row in zip(arm.tree_joint_names, arm.linkage.matrix, strict=True):
        joint = plant.GetJointByName(name)
        if joint.type_name() != "revolute":
            continue
        axis = joint.frame_on_parent().CalcPoseInWorld(context).rotation() @ joint.revolute_axis()
        angle = sympy.Add(*(exact_half(row[j]) * q[int(j)] for j in np.flatnonzero(row)))
        parent_axis, parent_angle = turned.get(joint.parent_body().name(), (axis, sympy.Integer(0)))
        if not np.allclose(axis, parent_axis, atol=1e-12):
            parent_angle = sympy.Integer(0)
        if parent_angle != 0 and (parent_angle, angle) not in sums:
            sums.append((parent_angle, angle))
        turned[joint.child_body().name()] = axis, parent_angle + angle
    return sums
