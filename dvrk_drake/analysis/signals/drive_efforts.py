"""The efforts that a model expects over a motion, part by part: what friction takes and what all else does."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.analysis.signals.motion_grid import MotionGrid
from dvrk_drake.dynamics.dynamic_model import DynamicModel, effect_shapes
from dvrk_drake.errors import RecordingError
from dvrk_drake.recordings.recording import Recording

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
    rows = model.arm.effect_coordinates
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


#: Efforts that correlate with the model's by less than this have the other sign: one of unknown sign is near 0.
OPPOSITE = -0.3


def refuse_opposite_efforts(
    recording: Recording, names: tuple[str, ...], tau: NDArray[np.float64], expected: NDArray[np.float64]
) -> None:
    """Compares measured efforts with what a model expects, offsets aside.

    Args:
        recording: for the message.
        names: of the n joints whose actuators they are.
        tau, expected: (r, n) of the actuators, behind one low-pass [N m, N].

    Raises:
        RecordingError: an actuator's efforts go against the model's.
    """
    x, y = tau - np.mean(tau, axis=0), expected - np.mean(expected, axis=0)
    size = np.sqrt(np.sum(x**2, axis=0) * np.sum(y**2, axis=0))
    correlation = np.sum(x * y, axis=0) / np.maximum(size, np.finfo(float).tiny)
    if len(wrong := np.flatnonzero(correlation < OPPOSITE)):
        which = ", ".join(f"{names[j]} ({correlation[j]:.2f})" for j in wrong)
        raise RecordingError(
            f"{recording.source or 'recording'}: efforts go against the model's (correlation): {which}; tau or the "
            "direction of q has the wrong sign there, or it is another arm: efforts are positive towards +q"
        )
