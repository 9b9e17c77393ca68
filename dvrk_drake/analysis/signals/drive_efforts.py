"""Computes the efforts that a model predicts over a motion, with friction separated from all other efforts."""

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
#: Friction kinds and their part. The kinds of one part change together with temperature or lubrication.
FRICTION_PARTS: dict[str, FrictionPart] = {
    **dict.fromkeys(("coulomb", "load coulomb", "stribeck", "presliding"), "dry"),
    "viscous": "viscous",
}


@dataclass(frozen=True, eq=False)
class DriveEfforts:
    """Efforts of the actuators (r, n) [N m, N] at the rows of a motion after low-pass filtering, without the ends.

    Attributes:
        other: Efforts of the rigid bodies and of all effects except friction.
        friction: Dry and viscous friction of each coordinate.
    """

    other: NDArray[np.float64]
    friction: dict[tuple[str, FrictionPart], NDArray[np.float64]]

    def total(self) -> NDArray[np.float64]:
        """Returns the sum (r, n) of all efforts."""
        return self.other + sum(self.friction.values(), np.zeros_like(self.other))

    def friction_part(self, part: FrictionPart) -> NDArray[np.float64]:
        """Returns one part of the friction (r, n), summed over all coordinates."""
        return sum((x for (_, own), x in self.friction.items() if own == part), np.zeros_like(self.other))


def drive_efforts(model: DynamicModel, grid: MotionGrid) -> DriveEfforts:
    """Returns the efforts that `model` predicts for the motion on `grid`."""
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


#: Efforts whose correlation with the model is below this have the opposite sign. For a random sign it is near 0.
OPPOSITE = -0.3


def refuse_opposite_efforts(
    recording: Recording, names: tuple[str, ...], tau: NDArray[np.float64], expected: NDArray[np.float64]
) -> None:
    """Compares the sign of measured and expected efforts, without their offsets.

    Args:
        recording: Recording that the message names.
        names: Names of the n joints of the actuators.
        tau: (r, n) measured efforts of the actuators after low-pass filtering [N m, N].
        expected: (r, n) expected efforts after the same filter [N m, N].

    Raises:
        RecordingError: The efforts of an actuator are opposite to those of the model.
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
