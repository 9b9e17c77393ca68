"""Models of friction, cable and spring torques in the drive. Each model is linear in one coefficient.

An effect acts along a coordinate x of the drive (see `Arm.effect_coordinates`). The coordinate is the position of an
actuator, the position of a joint, or a combination of joint positions that the arm's files define. The effect adds
coefficient * shape(x, v, state) to the effort along its coordinate, see `effect_step`.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dvrk_drake.dynamics.compiled import compiled
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.effects_schema import EFFECT_KINDS, DriveEffect, kind_fault


@compiled
def effect_step(
    code: int, z: float, dx: float, x: float, v: float, scale: float
) -> tuple[float, float]:  # pragma: no cover - compiled
    """Returns the next state and the shape, without the load and the power of the position.

    Args:
        code: Code of the kind.
        z: State at the previous sample, dimensionless.
        dx: Travel of the coordinate since the previous sample [rad, m].
        x: Position of the coordinate [rad, m].
        v: Velocity of the coordinate [rad/s, m/s].
        scale: `ActuatorEffect.scale`.
    """
    if code == 0:
        return z, 1.0
    if code == 1:
        return z, v
    if code == 2:
        # Smoothed sign of v.
        return z, math.tanh(v / scale)
    if code == 3:
        # Additional friction in the direction +x.
        return z, max(math.tanh(v / scale), 0.0)
    if code == 4:
        # Additional friction at low speed. It becomes small at speeds above 5 * scale.
        return z, math.tanh(v / scale) * math.exp(-((v / (5.0 * scale)) ** 2))
    if code == 5:
        # Elasto-plastic (Prandtl) element: a spring that slides at a deflection of `scale`. Several parallel elements
        # are a generalized Maxwell slip model, which has the presliding hysteresis of dry friction.
        z = min(max(z + dx / scale, -1.0), 1.0)
        return z, z
    if code == 6:
        # Additional dry friction in the direction +x.
        z = min(max(z + dx / scale, 0.0), 1.0)
        return z, z
    if code == 7:
        # Constant outside the range of the recording, because a linear extrapolation would be unbounded.
        return z, min(max(x, -scale), scale)
    if code == 8:
        return z, math.sin(scale * x)
    return z, math.cos(scale * x)


@dataclass(frozen=True)
class ActuatorEffect:
    """Effect along a coordinate of the drive, without its coefficient.

    Attributes:
        coordinate: Key of `Arm.effect_coordinates`.
        kind: Key of `EFFECT_KINDS`.
        scale: Number with the meaning `EffectKind.scale`; 0 for kinds without a scale.
    """

    coordinate: str
    kind: str
    scale: float = 0.0

    @classmethod
    def of(cls, effect: DriveEffect) -> ActuatorEffect:
        """Returns `effect` without its coefficient."""
        return cls(effect.coordinate, effect.kind, effect.scale)

    def __str__(self) -> str:
        return f"{self.coordinate} {self.kind}" + (f" {self.scale:.3g}" if self.scale else "")

    @property
    def dissipative(self) -> bool:
        """True if the coefficient must not be negative."""
        return EFFECT_KINDS[self.kind].dissipative

    def step(self, state: float, dx: float, x: float, v: float, load: float = 0.0) -> tuple[float, float]:
        """Returns the next state and the shape, for a simulation.

        Args:
            state: Dimensionless state, initially 0. Only presliding kinds use it.
            dx: Travel of the coordinate since the previous step [rad, m].
            x, v: Position [rad, m] and velocity of the coordinate.
            load: Magnitude of the effort along the coordinate [N m, N]. Only kinds with `EffectKind.loaded` use it.
        """
        kind = EFFECT_KINDS[self.kind]
        state, shape = effect_step(kind.code, state, dx, x, v, self.scale)
        return state, shape * (load if kind.loaded else 1.0) * abs(x) ** kind.position_power

    def column(
        self, x: NDArray[np.float64], v: NDArray[np.float64], load: NDArray[np.float64] | float = 0.0
    ) -> NDArray[np.float64]:
        """Returns the shape (m,) over a motion of the coordinate, starting from state 0.

        Args:
            x, v: Positions [rad, m] and velocities (m,) of the coordinate.
            load: Magnitude (m,) of the effort along the coordinate [N m, N], see `step`.
        """
        kind = EFFECT_KINDS[self.kind]
        shape = _run_effect(kind.code, np.ascontiguousarray(x), np.ascontiguousarray(v), self.scale)
        if kind.loaded:
            shape *= load
        return shape * np.abs(x) ** kind.position_power if kind.position_power else shape


@compiled
def _run_effect(
    code: int, x: NDArray[np.float64], v: NDArray[np.float64], scale: float
) -> NDArray[np.float64]:  # pragma: no cover - compiled
    out = np.empty(len(x))
    state, previous = 0.0, x[0]
    for i in range(len(x)):
        state, out[i] = effect_step(code, state, x[i] - previous, x[i], v[i], scale)
        previous = x[i]
    return out


@dataclass(frozen=True, eq=False)
class EffectArrays:
    """Effects of an arm as arrays, for the step-by-step evaluation with `advance_effects`.

    Attributes:
        constants: Rows (k, n) that map joint motions to the coordinates of the effects, codes (k,) of the kinds, scales
            (k,), exponents (k,) of the position, and coefficients (k,).
        is_loaded: Mask (k,) of the effects that depend on the load.
        across: Matrix (n, k) with |tau @ across| = load of each effect, for transmitted actuator efforts tau (n,).
    """

    constants: tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.float64], NDArray[np.int64], NDArray]
    is_loaded: NDArray[np.bool_]
    across: NDArray[np.float64]

    @classmethod
    def of(cls, arm: Arm, effects: Sequence[ActuatorEffect], coefficients: NDArray[np.float64]) -> EffectArrays:
        """Returns the arrays of effects (k,) with their coefficients (k,)."""
        kinds = [EFFECT_KINDS[effect.kind] for effect in effects]
        h = np.array([arm.effect_coordinates[effect.coordinate] for effect in effects]).reshape(-1, arm.num_joints)
        constants = (
            np.ascontiguousarray(h @ arm.transmission.matrix),
            np.array([kind.code for kind in kinds], np.int64),
            np.array([effect.scale for effect in effects], float),
            np.array([kind.position_power for kind in kinds], np.int64),
            np.array(coefficients, float),
        )
        return cls(constants, np.array([kind.loaded for kind in kinds], bool), (h / np.sum(h**2, 1, keepdims=True)).T)

    @property
    def size(self) -> int:
        """Number of elements of the memory of `advance_effects`."""
        return 2 * len(self.is_loaded) + 1

    @cached_property
    def no_loads(self) -> NDArray[np.float64]:
        """Loads (k,) if no effect depends on the load."""
        return np.ones(len(self.is_loaded))

    def loads(self, transmitted: NDArray[np.float64]) -> NDArray[np.float64]:
        """Returns the loads (k,) for transmitted efforts (n,) of the actuators, and 1 for effects without a load."""
        return np.where(self.is_loaded, np.abs(transmitted @ self.across), 1.0)


@compiled
def advance_effects(state, constants, loads, memory, effort):  # pragma: no cover - compiled
    """Computes the effort of effects, and updates their memory.

    Args:
        state: Positions, then velocities (2 n) of the joints [rad, m; rad/s, m/s].
        constants: `EffectArrays.constants`.
        loads: Loads (k,), see `EffectArrays.loads`.
        memory: States of the effects and last positions of their coordinates, then 1. Zeros at the start.
        effort: Receives the sum of the efforts of the effects at the joints (n,) [N m, N].
    """
    rows, codes, scales, powers, coefficients = constants
    k, n = rows.shape
    for i in range(n):
        effort[i] = 0.0
    for j in range(k):
        x, v = 0.0, 0.0
        for i in range(n):
            x += rows[j, i] * state[i]
            v += rows[j, i] * state[n + i]
        dx = x - memory[k + j] if memory[2 * k] == 1.0 else 0.0
        memory[j], shape = effect_step(codes[j], memory[j], dx, x, v, scales[j])
        memory[k + j] = x
        factor = coefficients[j] * loads[j] * shape * abs(x) ** powers[j]
        for i in range(n):
            effort[i] += factor * rows[j, i]
    memory[2 * k] = 1.0


def distinct_coordinates(arm: Arm) -> list[str]:
    """Returns the names in `Arm.effect_coordinates`, without coordinates that are proportional to a previous one.

    The positions of the actuators come first, so all of them are included.
    """
    rows = arm.effect_coordinates
    kept: list[str] = []
    for name in rows:
        h = rows[name] / np.linalg.norm(rows[name])
        if not any(abs(h @ rows[k]) > (1 - 1e-9) * np.linalg.norm(rows[k]) for k in kept):
            kept.append(name)
    return kept


def is_prismatic(arm: Arm, coordinate: str) -> bool:
    """Returns whether a coordinate is the position of a prismatic actuator or joint."""
    return any(p and coordinate.endswith(f".{n}") for p, n in zip(arm.prismatic, arm.joint_names, strict=True))


def joint_row(arm: Arm, coordinate: str) -> NDArray[np.float64]:
    """Returns the row (n,) that maps joint velocities to the velocity of a coordinate.

    An effort f along the coordinate corresponds to the joint efforts row * f.
    """
    return np.asarray(arm.effect_coordinates[coordinate] @ arm.transmission.matrix)


def position_along(arm: Arm, coordinate: str, q: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns the positions (m,) [rad, m] of a coordinate at joint positions q (m, n) [rad, m]."""
    return np.asarray(arm.transmission.position(q) @ arm.effect_coordinates[coordinate])


def effect_column(arm: Arm, effect: ActuatorEffect, q: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns the joint torques (m, n) of a position-dependent effect at poses q (m, n), for a coefficient of 1."""
    x = position_along(arm, effect.coordinate, q)
    return effect.column(x, 0 * x)[:, None] * joint_row(arm, effect.coordinate)


def sliding_effort(
    effects: Iterable[DriveEffect], x: ArrayLike, v: NDArray[np.float64], load: ArrayLike = 0.0
) -> NDArray[np.float64]:
    """Returns the effort (k,) of effects along their common coordinate at constant speeds v (k,) [N m, N].

    Presliding effects have their final value, because the coordinate slides. At v = 0, friction is 0.

    Args:
        effects: Effects of one coordinate.
        x: Positions (k,) of the coordinate [rad, m], or a number.
        v: Speeds of the coordinate [rad/s, m/s].
        load: Magnitudes (k,) of the effort along the coordinate, or a number, for load-dependent friction [N m, N].
    """
    effort = np.zeros(len(v))
    travels = np.where(v == 0, 0.0, np.copysign(np.inf, v))
    rows = list(zip(*np.broadcast_arrays(travels, x, v, load), strict=True))
    for effect in effects:
        law = ActuatorEffect.of(effect)
        effort += effect.coefficient * np.array([law.step(0.0, *row)[1] for row in rows])
    return effort


def spring_over(coordinate: str, x: NDArray[np.float64]) -> ActuatorEffect:
    """Returns a spring effect whose linear range is 1 % larger than the largest |x| of positions x (m,) [rad, m]."""
    return ActuatorEffect(coordinate, "spring", float(f"{1.01 * np.abs(x).max():.3g}"))


def effect_fault(
    arm: Arm, effect: ActuatorEffect, kinds: Collection[str] = EFFECT_KINDS, coefficient: float = 0.0
) -> str:
    """Returns a message that explains why an effect is not valid for an arm, or "" if it is valid.

    The message includes the allowed values.

    Args:
        arm: Arm of the effect.
        effect: Effect to check.
        kinds: Allowed kinds.
        coefficient: Coefficient of the effect, if it is known.
    """
    coordinates = arm.effect_coordinates
    if effect.coordinate not in coordinates:
        return f'coordinate is "{effect.coordinate}"; allowed: {", ".join(coordinates)}'
    if fault := kind_fault(effect.kind, effect.scale, coefficient, kinds):
        return fault
    if EFFECT_KINDS[effect.kind].revolute and is_prismatic(arm, effect.coordinate):
        return f"kind {effect.kind} requires a revolute coordinate, but {effect.coordinate} is prismatic"
    return ""
