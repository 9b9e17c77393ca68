"""Torques of friction, cables and springs in the drive: each a named model, linear in one coefficient.

An effect acts along a coordinate x of the drive (see `effect_coordinates`): an actuator, a joint that actuators share, or
a place where parts rub. The effort that the motors must add is coefficient * shape(x, v, state), pulled back to the
actuators. A shape is written once, as a step; a batch runs the step over a motion, a simulation runs it in time.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from dvrk_drake.models.arm import Arm


@dataclass(frozen=True)
class EffectKind:
    """One kind of effect.

    Attributes:
        code: what the compiled step calls it.
        dissipative: it takes energy in all motions, so its coefficient is not negative.
        revolute: only of a coordinate that turns.
        unit: of the coefficient, of a coordinate that turns (N for N m and m for rad of one that slides).
    """

    code: int
    dissipative: bool
    revolute: bool
    unit: str


EFFECT_KINDS: dict[str, EffectKind] = {
    "offset": EffectKind(0, False, False, "N m"),
    "viscous": EffectKind(1, True, False, "N m s/rad"),
    "coulomb": EffectKind(2, True, False, "N m"),
    "coulomb forward": EffectKind(3, False, False, "N m"),
    "stribeck": EffectKind(4, False, False, "N m"),
    "presliding": EffectKind(5, True, False, "N m"),
    "spring": EffectKind(6, False, False, "N m/rad"),
    "cable sine": EffectKind(7, False, True, "N m"),
    "cable cosine": EffectKind(8, False, True, "N m"),
}


@numba.njit(cache=True)
def _step(code: int, z: float, dx: float, x: float, v: float, scale: float) -> tuple[float, float]:
    """The next state and the shape of the kind with this code."""
    if code == 1:
        return z, v
    if code == 2:
        # The sign of v, smoothed.
        return z, math.tanh(v / scale)
    if code == 3:
        # What friction towards +x has more than towards -x.
        return z, max(math.tanh(v / scale), 0.0)
    if code == 4:
        # What friction has more at low speeds; it falls off within five widths of the smoothed sign.
        return z, math.tanh(v / scale) * math.exp(-((v / (5.0 * scale)) ** 2))
    if code == 5:
        # An elasto-plastic element (Prandtl): a spring that gives way when it is stretched by `scale`. Several in
        # parallel are a generalised Maxwell slip model, which has the hysteresis of dry friction before it slides.
        z = min(max(z + dx / scale, -1.0), 1.0)
        return z, z
    if code == 6:
        return z, x
    if code == 7:
        return z, math.sin(scale * x)
    if code == 8:
        return z, math.cos(scale * x)
    return z, 1.0


#: The compiled step itself, for the compiled code of simulations: (code, state, dx, x, v, scale) -> (state, shape).
effect_step = _step


@dataclass(frozen=True)
class ActuatorEffect:
    """One effect along one coordinate of the drive.

    Attributes:
        coordinate: a key of `effect_coordinates(arm)`.
        kind: a key of `EFFECT_KINDS`.
        scale: width of the smoothed sign [rad/s, m/s], travel until an element slips [rad, m], or the number of periods
            in a turn; 0 for kinds that have none.
    """

    coordinate: str
    kind: str
    scale: float = 0.0

    def __str__(self) -> str:
        return f"{self.coordinate} {self.kind}" + (f" {self.scale:.3g}" if self.scale else "")

    @property
    def dissipative(self) -> bool:
        """Whether its coefficient must not be negative."""
        return EFFECT_KINDS[self.kind].dissipative

    def step(self, state: float, dx: float, x: float, v: float) -> tuple[float, float]:
        """The next state, and the shape there: for a simulation.

        Args:
            state: dimensionless, 0 at the start; only `presliding` has one.
            dx: travel of the coordinate since the last step [rad, m].
            x, v: its position [rad, m] and velocity now.
        """
        return _step(EFFECT_KINDS[self.kind].code, state, dx, x, v, self.scale)

    def column(self, x: NDArray[np.float64], v: NDArray[np.float64]) -> NDArray[np.float64]:
        """The shape (m,) over a motion of the coordinate, x and v (m,), from state 0."""
        return _run(EFFECT_KINDS[self.kind].code, np.ascontiguousarray(x), np.ascontiguousarray(v), self.scale)


@numba.njit(cache=True)
def _run(code: int, x: NDArray[np.float64], v: NDArray[np.float64], scale: float) -> NDArray[np.float64]:
    out = np.empty(len(x))
    state, before = 0.0, x[0]
    for i in range(len(x)):
        state, out[i] = _step(code, state, x[i] - before, x[i], v[i], scale)
        before = x[i]
    return out


def effect_coordinates(arm: Arm) -> dict[str, NDArray[np.float64]]:
    """The coordinates that effects can act along: name -> row h (n,) with x = h a of the actuators' positions a.

    "actuator.<name>" for every actuator, "joint.<name>" for every joint that more than its own actuator moves, and the
    arm's own `friction_coordinates`. The actuators' efforts for an effort f along x are h' f.
    """
    J_inverse = arm.transmission.inverse().matrix
    rows = {f"actuator.{name}": unit for name, unit in zip(arm.joint_names, np.eye(arm.num_joints), strict=True)}
    for name, row in zip(arm.joint_names, J_inverse, strict=True):
        if np.count_nonzero(np.abs(row) > 1e-12) > 1:
            rows[f"joint.{name}"] = row
    rows.update({name: row @ J_inverse for name, row in arm.friction_coordinates.items()})
    return rows


def slides(arm: Arm, coordinate: str) -> bool:
    """Whether a coordinate is a length [m] rather than an angle: of the actuator or joint that slides itself."""
    return any(p and coordinate.endswith(f".{n}") for p, n in zip(arm.prismatic, arm.joint_names, strict=True))
