"""The efforts that a model expects over a motion, part by part: what friction takes and what all else does."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.analysis.signals.motion_grid import MotionGrid
from dvrk_drake.dynamics.actuator_effects import effect_coordinates
from dvrk_drake.dynamics.dynamic_model import DynamicModel
from dvrk_drake.dynamics.effect_shapes import effect_shapes

FrictionPart = Literal["dry", "viscous"]
#: Which kinds of effects are friction, and of which part: what a change of temperature or of grease changes together.
FRICTION_PARTS: dict[str, FrictionPart] = {
    **dict.fromkeys(("coulomb", "load coulomb", "stribeck", "presliding"), "dry"),
    "viscous": "viscous",
}


@dataclass(frozen=True, eq=False)
class DriveEfforts:
    """Efforts of the actuators (r, n) [N m, N] at the rows of a motion behind the low-pass, ends left out.

    Attributes:
        other: of the rigid bodies and of the effects that are no friction.
        friction: of each coordinate's dry and viscous friction.
    """

    other: NDArray[np.float64]
    friction: dict[tuple[str, FrictionPart], NDArray[np.float64]]

    def total(self) -> NDArray[np.float64]:
        """(r, n) all of it."""
        return self.other + sum(self.friction.values(), np.zeros_like(self.other))

    def friction_part(self, part: FrictionPart) -> NDArray[np.float64]:
        """(r, n) of all coordinates together."""
        return sum((x for (_, own), x in self.friction.items() if own == part), np.zeros_like(self.other))


def drive_efforts(model: DynamicModel, grid: MotionGrid) -> DriveEfforts:
    """What `model` expects of the motion on `grid`."""
    other = model.rigid_body_effort(grid.q, grid.v, grid.vd)
    friction: dict[tuple[str, FrictionPart], NDArray[np.float64]] = {}
    rows = effect_coordinates(model.arm)
    shapes = effect_shapes(model.regressor, model.effects, grid.q, grid.v)
    for effect, coefficient, shape in zip(model.effects, model.coefficients, shapes, strict=True):
        if not coefficient:
            continue
        effort = coefficient * shape[:, None] * rows[effect.coordinate]
        if effect.kind in FRICTION_PARTS:
            key = (effect.coordinate, FRICTION_PARTS[effect.kind])
            friction[key] = friction.get(key, 0.0) + effort
        else:
            other = other + effort
    return DriveEfforts(
        grid.behind_filter(grid.efforts_at_rows(other)),
        {key: grid.behind_filter(grid.efforts_at_rows(x)) for key, x in friction.items()},
    )
