"""Compiled holding torque tau = Y(q) beta + effects(q) of an arm with given effects, without the feedforward scale."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, cached_property

import numpy as np
import sympy
from numpy.typing import ArrayLike, NDArray

from dvrk_drake.dynamics import codegen
from dvrk_drake.dynamics.actuator_effects import ActuatorEffect, effect_column, joint_row
from dvrk_drake.dynamics.gravity_regressor import GRAVITY, SymbolicGravity, derive_gravity
from dvrk_drake.models.arm import Arm

#: Number of poses whose regressor is computed at a time for a torque, which limits the memory.
_ROWS = 20_000


@dataclass(frozen=True, eq=False)
class StaticModel:
    """Compiled regressor and holding torque of one model structure, which consists of an arm and effects.

    The parameters theta are the b base parameters [kg m, kg], then one coefficient per effect in the unit of its kind.
    Each function is compiled at its first use, because a controller does not need the regressor and identification does
    not need the torque. The regressor of the links is compiled once per arm, for all effects.

    Attributes:
        gravity: Symbolic gravity torque.
        effects: Effects with kinds in `POSITION_KINDS`, in the order of theta.
    """

    gravity: SymbolicGravity
    effects: tuple[ActuatorEffect, ...]

    @cached_property
    def torque_into(self) -> Callable[[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]], None]:
        """Compiled function f(q, theta, out) for control loops, which writes the holding torque to `out`.

        The arguments are C-contiguous float64 arrays (n,) [rad, m], (b + e,) and (n,) [N m, N].
        """
        theta = sympy.symbols(f"theta0:{self.num_parameters}")
        total = symbolic_regressor(self.gravity, self.effects) * sympy.Matrix(theta)
        terms = codegen.share_terms(sympy.Array(list(total)))
        return codegen.compile_function("torque", [("q", self.gravity.q), ("theta", theta)], terms)

    @property
    def num_parameters(self) -> int:
        """Length of theta."""
        return len(self.gravity.base.names) + len(self.effects)

    def regressor(self, q: ArrayLike) -> NDArray[np.float64]:
        """Returns Y with tau = Y theta: (n, p) for one pose q (n,), (m, n, p) for m poses (m, n)."""
        poses = np.atleast_2d(np.asarray(q, dtype=np.float64))
        of_links = _compiled_link_regressor(self.gravity)(poses)
        columns = [effect_column(self.gravity.arm, effect, poses)[..., None] for effect in self.effects]
        Y = np.concatenate([of_links, *columns], axis=2) if columns else of_links
        return Y if np.ndim(q) == 2 else Y[0]

    def torque(self, q: ArrayLike, theta: ArrayLike) -> NDArray[np.float64]:
        """Returns the holding torque [N m or N]: (n,) for one pose q (n,), (m, n) for m poses (m, n)."""
        poses, theta = np.atleast_2d(np.asarray(q, dtype=np.float64)), np.asarray(theta, dtype=np.float64)
        tau = np.empty(poses.shape)
        for begin in range(0, len(poses), _ROWS):
            tau[begin : begin + _ROWS] = self.regressor(poses[begin : begin + _ROWS]) @ theta
        return tau if np.ndim(q) == 2 else tau[0]


@cache
def _compiled_link_regressor(gravity: SymbolicGravity) -> Callable[..., NDArray[np.float64]]:
    """Compiles a function that returns the regressor (m, n, b) of the base parameters at poses (m, n)."""
    symbolic = symbolic_regressor(gravity, ())
    function = codegen.compile_function("regressor", [("q", gravity.q)], codegen.share_terms(symbolic))
    return codegen.compile_batch(function, symbolic.shape)


def symbolic_regressor(gravity: SymbolicGravity, effects: tuple[ActuatorEffect, ...]) -> sympy.Matrix:
    """Returns the regressor (n, b + e) as a sympy matrix, with the numeric value of |gravity|."""
    of_links = sympy.Matrix(gravity.regressor).subs(GRAVITY, sympy.Float(gravity.gravity_magnitude))
    return sympy.Matrix.hstack(of_links, *_effect_columns(gravity.arm, gravity.q, effects))


def _effect_columns(
    arm: Arm, joint_positions: Sequence[sympy.Symbol], effects: Sequence[ActuatorEffect]
) -> list[sympy.Matrix]:
    columns = []
    for effect in effects:
        row = [_number(r) for r in joint_row(arm, effect.coordinate).tolist()]
        offset = arm.effect_coordinates[effect.coordinate] @ arm.transmission.offset
        x = sum((r * q for r, q in zip(row, joint_positions, strict=True)), _number(float(offset)))
        columns.append(sympy.Matrix(row) * effect.position_shape(x))
    return columns


def _number(x: float) -> sympy.Expr:
    # Integers are exact, so that 1.0 x is simplified to x.
    return sympy.Integer(round(x)) if abs(x - round(x)) < 1e-12 else sympy.Float(x)


@cache
def compile_static_model(arm: Arm, effects: tuple[ActuatorEffect, ...] = ()) -> StaticModel:
    """Returns the static model of an arm with effects. The model is cached, and compiled at its first use."""
    return StaticModel(derive_gravity(arm), effects)


@cache
def compile_effect_torque(arm: Arm, effects: tuple[ActuatorEffect, ...]) -> Callable[..., None]:
    """Compiles a function f(q, coefficients, out) for the joint torque that compensates the effects at rest.

    The arguments are C-contiguous float64 arrays (n,) [rad, m], (e,) [units of the kinds] and (n,) [N m, N]. The kinds
    of the effects must be in `POSITION_KINDS`.
    """
    q = sympy.symbols(f"q1:{arm.num_joints + 1}", real=True)
    coefficients = sympy.symbols(f"c0:{len(effects)}")
    total = sympy.zeros(arm.num_joints, 1)
    for coefficient, column in zip(coefficients, _effect_columns(arm, q, effects), strict=True):
        total += coefficient * column
    arguments = [("q", q), ("coefficients", coefficients)]
    return codegen.compile_function("effect_torque", arguments, codegen.share_terms(sympy.Array(list(total))))
