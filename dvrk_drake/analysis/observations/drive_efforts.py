"""Predicts the efforts of a motion and separates friction from all other efforts."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.analysis.observations.motion_grid import MotionGrid
from dvrk_drake.dynamics.dynamic_model import DynamicModel
from dvrk_drake.errors import RecordingError
from dvrk_drake.models.effect_kinds import EFFECT_KINDS
from dvrk_drake.recordings.recording import Recording

#: Roles of friction effects. All effects of one role at a coordinate change together, for example with temperature or
#: lubrication.
FrictionPart = Literal["dry", "viscous"]


@dataclass(frozen=True, eq=False)
class DriveEfforts:
    """Predicted actuator efforts at the inner rows of a motion (`MotionGrid.inner`), after low-pass filtering.

    Attributes:
        other: Efforts (r, n) of the rigid bodies and of all effects except friction [N m, N].
        friction: Actuator efforts (r, n) of the dry or viscous friction at each coordinate [N m, N].
    """

    other: NDArray[np.float64]
    friction: dict[tuple[str, FrictionPart], NDArray[np.float64]]

    def total(self) -> NDArray[np.float64]:
        """Returns the sum (r, n) of friction and all other efforts."""
        return self.other + sum(self.friction.values(), np.zeros_like(self.other))

    def friction_part(self, part: FrictionPart) -> NDArray[np.float64]:
        """Returns the actuator efforts (r, n) of the dry or viscous friction, summed over all coordinates."""
        return sum((x for (_, own), x in self.friction.items() if own == part), np.zeros_like(self.other))


def drive_efforts(model: DynamicModel, grid: MotionGrid) -> DriveEfforts:
    """Returns the efforts that `model` predicts for the motion on `grid`."""
    if grid.segments:
        parts = [drive_efforts(model, own) for own in grid.segments]
        return DriveEfforts(
            np.concatenate([part.other for part in parts]),
            {key: np.concatenate([part.friction[key] for part in parts]) for key in parts[0].friction},
        )
    other = model.rigid_body_effort(grid.q, grid.v, grid.vd)
    friction: dict[tuple[str, FrictionPart], NDArray[np.float64]] = {}
    rows = model.arm.effect_coordinates
    shapes = model.effect_shapes(grid.q, grid.v, grid.vd)
    for effect, coefficient, shape in zip(model.effects, model.coefficients, shapes, strict=True):
        if not coefficient:
            continue
        effort = coefficient * shape[:, None] * rows[effect.coordinate]
        role = EFFECT_KINDS[effect.kind].role
        if role == "dry" or role == "viscous":
            key = (effect.coordinate, role)
            friction[key] = friction.get(key, 0.0) + effort
        else:
            other = other + effort
    return DriveEfforts(
        grid.filter_efforts(grid.efforts_at_rows(other)),
        {key: grid.filter_efforts(grid.efforts_at_rows(x)) for key, x in friction.items()},
    )


#: Largest correlation between measured and predicted efforts that indicates a wrong sign of the effort. It is near 0
#: for unrelated efforts, and at least 0.87 for models of public motions on other motions of the same arm.
MAX_OPPOSITE_CORRELATION = -0.3


def refuse_opposite_efforts(
    recording: Recording, names: tuple[str, ...], tau: NDArray[np.float64], expected: NDArray[np.float64]
) -> None:
    """Rejects measured efforts whose sign is opposite to the sign of the predicted efforts. Offsets are ignored.

    Args:
        recording: Recording of the efforts, for the message.
        names: Names of the n joints of the actuators.
        tau: Measured efforts (r, n) of the actuators after low-pass filtering [N m, N].
        expected: Predicted efforts (r, n) after the same filter [N m, N].

    Raises:
        RecordingError: The measured efforts of an actuator are opposite to the predicted efforts.
    """
    x, y = tau - np.mean(tau, axis=0), expected - np.mean(expected, axis=0)
    size = np.sqrt(np.sum(x**2, axis=0) * np.sum(y**2, axis=0))
    correlation = np.sum(x * y, axis=0) / np.maximum(size, np.finfo(float).tiny)
    if len(wrong := np.flatnonzero(correlation < MAX_OPPOSITE_CORRELATION)):
        which = ", ".join(f"{names[j]} (correlation {correlation[j]:.2f})" for j in wrong)
        raise RecordingError(
            f"{recording.source or 'recording'}: measured efforts are opposite to the efforts of the model: {which}. "
            "Check the signs of tau and q (efforts are positive in the direction of +q), and check the arm."
        )
