"""An arm's plant in symbols: its frames and potential energy as functions of the independent joints."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pydrake.symbolic as symbolic
import sympy
from numpy.typing import NDArray
from pydrake.math import RigidTransform
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import ModelInstanceIndex, RigidBody

from dvrk_drake.errors import ArmError
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.plant import shared_plant, tree_selector

#: Coefficients are 1 or lengths in metres: below this one is a difference of equals.
ROUNDING = 1e-14


def simplify_trigonometry(expression: sympy.Expr, sums: Sequence[tuple[sympy.Expr, sympy.Expr]]) -> sympy.Expr:
    """Writes a polynomial in sin and cos of angles with the angles of parallel joints added up.

    For a pair (a, b) in `sums`, in that order, products such as sin a cos b + cos a sin b become sin(a + b) where that
    is shorter; cos^2 is eliminated, so that what is identically zero becomes 0. Coefficients of rounding's size are
    dropped, so the result equals the expression at every pose to that. sympy's own trigsimp does the same by search and
    takes seconds.
    """
    result = expression.xreplace({x: exact_half(x) for x in expression.atoms(sympy.Float) if float(2 * x).is_integer()})
    angles = _Angles()
    names = {function: angles.name(function) for function in result.atoms(sympy.sin, sympy.cos)}
    result = _without_rounding(sympy.expand(result.xreplace(names)))
    shortest = angles.without_squared_cosines(result)
    for a, b in sums:
        trial = angles.add_up(result, a, b)
        shorter = angles.without_squared_cosines(trial)
        if sympy.count_ops(shorter) <= sympy.count_ops(shortest):
            result, shortest = trial, shorter
    shortest = _without_rounding(shortest)
    # What all terms have in common is taken out, e.g. S s4 s5 + S c4 c5 -> S (s4 s5 + c4 c5).
    return (sympy.factor_terms(shortest) if shortest.is_Add else shortest).xreplace(angles.functions)


def exact_half(x: float) -> sympy.Expr:
    """x as an exact number if it is a multiple of one half."""
    return sympy.Rational(int(2 * x), 2) if float(2 * x).is_integer() else sympy.Float(x)


class _Angles:
    """Symbols for the sine and cosine of each angle; `functions` maps them back."""

    def __init__(self) -> None:
        self._symbols: dict[sympy.Expr, tuple[sympy.Symbol, sympy.Symbol]] = {}
        self.functions: dict[sympy.Symbol, sympy.Expr] = {}

    def name(self, function: sympy.Expr) -> sympy.Symbol:
        """The symbol of sin(angle) or cos(angle)."""
        angle = function.args[0]
        if angle not in self._symbols:
            s, c = sympy.symbols(f"s{len(self._symbols)} c{len(self._symbols)}")
            self._symbols[angle] = s, c
            self.functions |= {s: sympy.sin(angle), c: sympy.cos(angle)}
        s, c = self._symbols[angle]
        return s if isinstance(function, sympy.sin) else c

    def add_up(self, e: sympy.Expr, a: sympy.Expr, b: sympy.Expr) -> sympy.Expr:
        """Puts sin(a + b) and cos(a + b) in for sin a cos b and cos a cos b in every monomial."""
        (sign_a, angle_a), (sign_b, angle_b), (sign, angle) = map(_sign_and_angle, (a, b, a + b))
        if angle_a not in self._symbols or angle_b not in self._symbols or angle_a == angle_b:
            return e
        (sa, ca), (sb, cb) = self._symbols[angle_a], self._symbols[angle_b]
        S, C = self.name(sympy.sin(angle)), self.name(sympy.cos(angle))
        e = _eliminate_product(e, sa, cb, sign_a * (sign * S - sign_b * ca * sb))
        return _eliminate_product(e, ca, cb, C + sign_a * sign_b * sa * sb)

    def without_squared_cosines(self, e: sympy.Expr) -> sympy.Expr:
        """Writes 1 - s^2 for every c^2, so that equal polynomials look equal."""
        for s, c in self._symbols.values():
            e = _eliminate_product(e, c, c, 1 - s**2)
        return e


def _sign_and_angle(angle: sympy.Expr) -> tuple[int, sympy.Expr]:
    """Such that sin(angle) = sign sin(result), the way sympy writes it."""
    function = sympy.sin(angle)
    return (1, function.args[0]) if isinstance(function, sympy.sin) else (-1, -angle)


def _without_rounding(e: sympy.Expr) -> sympy.Expr:
    """Leaves out the terms with a coefficient that is zero but for rounding, such as -0.4318 + 0.4162 + 0.0156."""
    return sympy.Add(*(term for term in sympy.Add.make_args(e) if abs(term.as_coeff_Mul()[0]) > ROUNDING))


def _eliminate_product(e: sympy.Expr, a: sympy.Symbol, b: sympy.Symbol, replacement: sympy.Expr) -> sympy.Expr:
    """Replaces the product a b (a**2 if a is b) in every monomial of e, until none is left."""
    for _ in range(8):
        changed = sympy.Integer(0)
        rest = sympy.Integer(0)
        for term in sympy.Add.make_args(e):
            powers = term.as_powers_dict()
            has = powers.get(a, 0) >= 2 if a is b else (powers.get(a, 0) >= 1 and powers.get(b, 0) >= 1)
            if has:
                changed += term / (a * b) * replacement
            else:
                rest += term
        if changed == 0:
            break
        e = sympy.expand(changed + rest)
    return e


class SymbolicPlant:
    """`MultibodyPlant.ToSymbolic()` with the linkage put in: every position is a function of q1..qn.

    Attributes:
        arm: the arm.
        numeric: the same plant in numbers.
        bodies: label ("1".."7", "crank", ...) -> moving body and the frame F its parameters are written in, X_BF.
        q: the n joint positions as sympy symbols q1..qn [rad, m].
        drake_q: the same as Drake's variables.
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
        self.drake_q = [symbolic.Variable(f"q{i + 1}") for i in range(arm.num_joints)]
        self.q = tuple(sympy.Symbol(f"q{i + 1}", real=True) for i in range(arm.num_joints))
        self._memo: dict = {}
        self._ours = {
            symbolic.to_sympy(symbolic.Expression(v), memo=self._memo): s
            for v, s in zip(self.drake_q, self.q, strict=True)
        }
        self._sums = _parallel_sums(self.numeric, arm, self.q)
        q_plant = np.empty(self._plant.num_positions(), dtype=object)
        q_plant[tree_selector(self.numeric, arm)] = _tree_positions(arm, self.drake_q)
        self._plant.SetPositions(self._context, q_plant)

    def to_sympy(self, expression: symbolic.Expression | float) -> sympy.Expr:
        """A Drake expression in q as a sympy expression in `self.q`, not simplified."""
        if isinstance(expression, float):
            return sympy.Float(expression)
        return symbolic.to_sympy(expression, memo=self._memo).xreplace(self._ours)

    def simplify(self, expression: sympy.Expr) -> sympy.Expr:
        """`simplify_trigonometry` with the angles of this arm's parallel joints added up."""
        return simplify_trigonometry(expression, self._sums)

    def frame_poses(self) -> dict[str, sympy.ImmutableDenseMatrix]:
        """X_0F(q), the pose of every link frame in frame 0: label -> 4 x 4 (the paper's II.A and III.B) [m]."""
        zero = self.numeric.GetFrameByName(f"{self._frames}_0")
        X_W0 = zero.CalcPoseInWorld(self.numeric.CreateDefaultContext())
        X_0W = _exact_matrix(X_W0.inverse())
        poses = {}
        for label, (body, X_BF) in self.bodies.items():
            X_WB = self._plant.EvalBodyPoseInWorld(self._context, self._plant.get_body(body.index())).GetAsMatrix4()
            X_WB_sympy = sympy.Matrix([[self.to_sympy(entry) for entry in row] for row in X_WB])
            X_0F = sympy.Matrix(X_0W) * X_WB_sympy * sympy.Matrix(_exact_matrix(X_BF))
            poses[label] = sympy.ImmutableDenseMatrix(X_0F.applyfunc(self.simplify))
        return poses

    def potential_energy(self, labels: Sequence[str]) -> list[list[symbolic.Expression]]:
        """P per unit of mass and first moments [1, x, y, z in F] of each labelled link, as Drake expressions.

        P = -m g_W . p_WCcm is linear in m and m c: a unit of mass at the origin of F adds -g_W . p_WFo, a unit of
        first moment along an axis of F adds -g_W . that axis. Summed over the links this is the plant's own
        `CalcPotentialEnergy`, whose expanded form takes half a minute on an arm with a closed linkage.
        """
        g_W = exact_rotation(self.arm.gravity / np.linalg.norm(self.arm.gravity))
        energies = []
        for label in labels:
            body, X_BF = self.bodies[label]
            X_WB = self._plant.EvalBodyPoseInWorld(self._context, self._plant.get_body(body.index())).GetAsMatrix4()
            X = _exact_matrix(X_BF)
            # Row -g_W' (R_WB, p_WBo), then times X_BF; zeros are left out so that no term of theirs is carried along.
            up_B = [_dot(-g_W, X_WB[:3, j]) for j in range(4)]
            up_F = [_dot(X[:, k], up_B) for k in range(4)]
            energies.append([up_F[3], *up_F[:3]])
        return energies


def _dot(numbers: NDArray[np.float64], expressions: Sequence[symbolic.Expression]) -> symbolic.Expression:
    terms = (float(x) * e for x, e in zip(numbers, expressions, strict=True) if x)
    return sum(terms, symbolic.Expression(0))


def exact_rotation(R: NDArray[np.float64]) -> NDArray[np.float64]:
    """R with the entries that are 0 or +-1 but for the rounding of their angles made exactly that."""
    return np.where(np.abs(R - np.round(R)) < 1e-12, np.round(R), R)


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


def labelled_bodies(plant: MultibodyPlant, frames: str) -> dict[str, tuple[RigidBody, RigidTransform]]:
    """Bodies by label with the frame F that their parameters are written in, X_BF; numbered links first.

    The links are those with a frame <frames>_<number>, the base's 0 left out, or dh_<name> for links of a linkage.
    """
    bodies = {}
    for index in plant.GetFrameIndices(arm_instance(plant)):
        frame = plant.get_frame(index)
        prefix, _, label = frame.name().partition("_")
        if (prefix == frames or (prefix == "dh" and not label.isdigit())) and not plant.IsAnchored(frame.body()):
            bodies[label] = (frame.body(), frame.GetFixedPoseInBodyFrame())
    if not any(label.isdigit() for label in bodies):
        raise ArmError(f'the SDF has no frames "{frames}_1", "{frames}_2", ...; try "dh"')
    return dict(sorted(bodies.items(), key=lambda item: (not item[0].isdigit(), item[0])))


def arm_instance(plant: MultibodyPlant) -> ModelInstanceIndex:
    """The model instance of the arm in a plant that holds one."""
    return plant.GetBodyByName("base_link").model_instance()


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
