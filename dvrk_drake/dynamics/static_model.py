"""Compiled holding torque tau = Y(q) beta + effects(q) of an arm with given effects, without the feedforward scale."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, cached_property

import numpy as np
import sympy
from numpy.typing import ArrayLike, NDArray

from dvrk_drake.dynamics import codegen
from dvrk_drake.dynamics.actuator_effects import ActuatorEffect, joint_row
from dvrk_drake.dynamics.gravity_regressor import GRAVITY, SymbolicGravity, derive_gravity
from dvrk_drake.models.arm import Arm


@dataclass(frozen=True, eq=False)
class StaticModel:
    """Compiled regressor and holding torque of one model structure, which consists of an arm and effects.

    The parameters theta are the b base parameters [kg m, kg], then one coefficient per effect in the unit of its kind.
    Each function is compiled at its first use, because a controller does not need the regressor and identification does
    not need the torque.

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
        terms = codegen.share_terms(sympy.Array(list(self._symbolic_regressor * sympy.Matrix(theta))))
        return codegen.compile_function("torque", [("q", self.gravity.q), ("theta", theta)], terms)

    @cached_property
    def _symbolic_regressor(self) -> sympy.Matrix:
        return symbolic_regressor(self.gravity, self.effects)

    @cached_property
    def _regressor_batch(self) -> Callable[..., NDArray[np.float64]]:
        terms = codegen.share_terms(self._symbolic_regressor)
        regressor = codegen.compile_function("regressor", [("q", self.gravity.q)], terms)
        return codegen.compile_batch(regressor, 1, self._symbolic_regressor.shape)

    @cached_property
    def _torque_batch(self) -> Callable[..., NDArray[np.float64]]:
        return codegen.compile_batch(self.torque_into, 2, (self.gravity.arm.num_joints,))

    @property
    def num_parameters(self) -> int:
        """Length of theta."""
        return len(self.gravity.base.names) + len(self.effects)

    def regressor(self, q: ArrayLike) -> NDArray[np.float64]:
        """Returns Y with tau = Y theta: (n, p) for one pose q (n,), (m, n, p) for m poses (m, n)."""
        q = np.asarray(q, dtype=np.float64)
        return self._regressor_batch(q) if q.ndim == 2 else self._regressor_batch(q[None])[0]

    def torque(self, q: ArrayLike, theta: ArrayLike) -> NDArray[np.float64]:
        """Returns the holding torque [N m or N]: (n,) for one pose q (n,), (m, n) for m poses (m, n)."""
        q = np.asarray(q, dtype=np.float64)
        theta = np.ascontiguousarray(theta, dtype=np.float64)
        return self._torque_batch(q, theta) if q.ndim == 2 else self._torque_batch(q[None], theta)[0]


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
