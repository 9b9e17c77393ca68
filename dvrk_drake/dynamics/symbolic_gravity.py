"""Derives link frames, gravity torque and its regressor symbolically from an arm's MultibodyPlant.

Reference: Rutfield et al., "Gravity Compensation Control of da Vinci Robot" (2015), sections III.B to III.D and III.H.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields
from functools import cache

import numpy as np
import pydrake.symbolic as symbolic
import sympy
from numpy.typing import NDArray
from pydrake.math import RigidTransform
from sympy.polys.domains import RR
from sympy.polys.orderings import lex
from sympy.polys.rings import PolyElement, PolyRing

from dvrk_drake.dynamics.gravity_parameters import GravityParameters, exact_rotation, gravity_parameters, link_frames
from dvrk_drake.dynamics.kinematic_tree import KinematicTree
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.plant import DH_PREFIX, shared_plant, tree_selector

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
def derive_gravity(arm: Arm) -> SymbolicGravity:
    """Derives the gravity torque of `arm` from its symbolic plant.

    The potential energy P is linear in the mass and the first moments of each link. P is derived as a function of the
    independent joint positions q, per unit of each parameter in `base.columns`. The regressor is the derivative of P
    with respect to q.

    Raises:
        ArmError: See `gravity_parameters`.
    """
    parameters = gravity_parameters(arm)
    plant = SymbolicPlant(arm)
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

    def __init__(self, arm: Arm) -> None:
        """Converts the plant of an arm to symbolic form and substitutes the positions of the linkage."""
        self.arm = arm
        self.numeric = shared_plant(arm)
        self.bodies = link_frames(arm)
        self._plant = self.numeric.ToSymbolic()
        self._context = self._plant.CreateDefaultContext()
        drake_q = [symbolic.Variable(f"q{i + 1}") for i in range(arm.num_joints)]
        self.q = tuple(sympy.Symbol(f"q{i + 1}", real=True) for i in range(arm.num_joints))
        self._heights: dict[str, list[symbolic.Expression]] = {}
        self._memo: dict = {}
        self._sums = _parallel_sums(KinematicTree.from_plant(self.numeric, arm), self.q)
        q_plant = np.empty(self._plant.num_positions(), dtype=object)
        q_plant[tree_selector(self.numeric, arm)] = _tree_positions(arm, drake_q)
        self._plant.SetPositions(self._context, q_plant)

    def frame_poses(self) -> dict[str, sympy.ImmutableDenseMatrix]:
        """Returns label -> pose X_0F(q) (4, 4) of each link frame in frame 0 [m] (Rutfield et al., 2015)."""
        zero = self.numeric.GetFrameByName(f"{DH_PREFIX}0")
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


def _parallel_sums(tree: KinematicTree, q: Sequence[sympy.Symbol]) -> list[tuple[sympy.Expr, sympy.Expr]]:
    """Returns pairs of angles whose sums occur in link poses, from the base to the tip.

    A pair consists of the rotation angle of a body and the angle of a revolute joint on this body. Both angles are
    about the same axis. They are linear combinations of q according to the linkage, so opposite rotations cancel in
    their sum.
    """

    def angle(rates: NDArray[np.float64]) -> sympy.Expr:
        return sympy.Add(*(exact_half(rates[j]) * q[int(j)] for j in np.flatnonzero(rates)))

    pairs = [(angle(parent), angle(own)) for parent, own in zip(tree.inherited_rates, tree.G, strict=True)]
    return list(dict.fromkeys(pair for pair in pairs if pair[0] != 0))


#: Coefficients with an absolute value up to this limit are rounding errors. Other coefficients are 1 or lengths [m].
ROUNDING = 1e-14


def shortest_form(expression: sympy.Expr, sums: Sequence[tuple[sympy.Expr, sympy.Expr]]) -> sympy.Expr:
    """Returns an equal expression with the angles of parallel joints combined, and with its common factors in front.

    For each pair (a, b) of `sums`, terms such as sin a cos b + cos a sin b become sin(a + b) if this shortens the
    expression. Squared cosines are eliminated, so that an expression that is identically zero becomes 0. sympy's
    trigsimp gives the same result, but its search takes minutes.

    Args:
        expression: Polynomial in symbols and in sines and cosines of their sums.
        sums: Pairs of angles, in the order in which they are combined.
    """
    trial, shortest = expression, None
    for a, b in [(sympy.Integer(0), sympy.Integer(0)), *sums]:
        present = sorted(trial.atoms(sympy.sin, sympy.cos), key=str)
        if shortest is not None and not {sympy.cos(a), sympy.cos(b)} <= {sympy.cos(x.args[0]) for x in present}:
            continue
        angles = [a, b, a + b, *(x.args[0] for x in present)]
        # Division eliminates leading monomials. They are sin a cos b and cos a cos b, since cos b comes first.
        variables = [*map(sympy.cos, [b, *angles]), *map(sympy.sin, angles), *trial.free_symbols]
        ring = _Ring(variables)
        sine = sympy.sin(a) * sympy.cos(b) + sympy.cos(a) * sympy.sin(b) - sympy.sin(a + b)
        cosine = sympy.cos(a) * sympy.cos(b) - sympy.sin(a) * sympy.sin(b) - sympy.cos(a + b)
        combined = ring.remainder(ring.polynomial(trial), [sine, cosine])
        squares = [sympy.cos(angle) ** 2 + sympy.sin(angle) ** 2 - 1 for angle in angles]
        shorter = ring.remainder(combined, squares)
        if shortest is None or _operations(shorter) <= _operations(shortest):
            trial, shortest, result = combined.as_expr(*ring.variables), shorter, ring.factored(shorter)
    return result


class _Ring:
    """Ring of polynomials in symbols, sines and cosines, with lexicographic order.

    Attributes:
        variables: Symbols, sines and cosines, the first one in the order first.
    """

    def __init__(self, variables: Sequence[sympy.Expr]) -> None:
        # sympy writes cos(-x) as cos(x), sin(-x) as -sin(x), and numbers for constant angles.
        positive = [-x if x.could_extract_minus_sign() else x for x in variables]
        self.variables = list(dict.fromkeys(x for x in positive if not x.is_number))
        self._names = {x: sympy.Symbol(f"x{i}") for i, x in enumerate(self.variables)}
        self._ring = PolyRing(list(self._names.values()), RR, lex)

    def polynomial(self, expression: sympy.Expr) -> PolyElement:
        return self._ring.from_expr(expression.xreplace(self._names))

    def remainder(self, polynomial: PolyElement, divisors: Sequence[sympy.Expr]) -> PolyElement:
        """Returns the remainder without rounding errors."""
        result = polynomial.rem([p for p in map(self.polynomial, map(sympy.sympify, divisors)) if p])
        return self._ring.from_dict({powers: x for powers, x in result.items() if abs(x) > ROUNDING})

    def factored(self, polynomial: PolyElement) -> sympy.Expr:
        """Converts a polynomial to an expression with the common factors of all terms in front."""
        monomials = [powers for powers, _ in polynomial.terms()]
        common = (
            [min(column) for column in zip(*monomials, strict=True)]
            if len(monomials) > 1
            else [0] * len(self.variables)
        )
        sign = -1 if any(common) and all(x < 0 for x in polynomial.coeffs()) else 1
        terms = [
            exact_half(sign * float(x)) * self._product(p - c for p, c in zip(powers, common, strict=True))
            for powers, x in polynomial.terms()
        ]
        return sign * self._product(common) * sympy.Add(*terms)

    def _product(self, powers: Iterable[int]) -> sympy.Expr:
        return sympy.Mul(*(x**power for x, power in zip(self.variables, powers, strict=True)))


def exact_half(x: float) -> sympy.Expr:
    """Converts a multiple of 1/2 to an exact number, and any other x to a floating-point number."""
    return sympy.Rational(int(2 * x), 2) if float(2 * x).is_integer() else sympy.Float(x)


def _operations(polynomial: PolyElement) -> int:
    """Returns the number of additions, multiplications and powers. A leading minus sign counts as one operation."""
    count = max(len(polynomial) - 1, 0) + bool(polynomial and all(x < 0 for x in polynomial.coeffs()))
    for powers, x in polynomial.terms():
        factors = [power for power in powers if power]
        count += max(len(factors) + (abs(x) != 1) - 1, 0) + sum(power > 1 for power in factors)
    return count
