"""The shapes of effects in the drives of an arm, over a motion of its joints."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dvrk_drake.dynamics.actuator_effects import EFFECT_KINDS, ActuatorEffect, effect_coordinates
from dvrk_drake.dynamics.dynamic_regressor import DynamicRegressor


def effect_shapes(
    regressor: DynamicRegressor, effects: Sequence[ActuatorEffect], q: ArrayLike, v: ArrayLike
) -> Iterator[NDArray[np.float64]]:
    """(m,) shape of each effect along its coordinate x = h a, from state 0.

    The load of a coordinate is the effort f along it that bears the arm's weight as the SDF states it: of the efforts
    tau of the actuators at rest the part h f, f = h tau / h h.

    Args:
        regressor: of the arm.
        effects: in its drives.
        q, v: (m, n) positions and velocities of the joints [rad, m], evenly sampled.
    """
    arm, q = regressor.arm, np.asarray(q, dtype=np.float64)
    a, a_dot = arm.transmission.position(q), arm.transmission.velocity(v)
    rows = effect_coordinates(arm)
    weight = np.zeros_like(a)
    if any(EFFECT_KINDS[effect.kind].loaded for effect in effects):
        weight = nominal_weight(regressor, q)
    for effect in effects:
        h = rows[effect.coordinate]
        yield effect.column(a @ h, a_dot @ h, np.abs(weight @ h) / (h @ h))


def nominal_weight(regressor: DynamicRegressor, q: ArrayLike) -> NDArray[np.float64]:
    """(m, n) efforts of the actuators [N m, N] that bear the arm's weight at poses q (m, n), as the SDF states it."""
    rest = np.zeros_like(q, dtype=np.float64)
    return regressor.arm.transmission.inverse().pull_back_effort(regressor.torque(q, rest, rest, regressor.values))
