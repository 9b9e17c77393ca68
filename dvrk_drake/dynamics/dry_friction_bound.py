"""Bounds the dry friction of joints at rest, where the model does not determine it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.dynamics.actuator_effects import joint_row
from dvrk_drake.dynamics.dynamic_model import DynamicModel
from dvrk_drake.models.effect_kinds import EFFECT_KINDS


class DryFrictionBound:
    """Standard deviation of the dry friction along the coordinates of an arm's drive, by their velocity.

    While a coordinate moves, the model determines its dry friction. At rest, friction balances any effort between minus
    and plus the sum of its coefficients. The standard deviation is that of a uniform distribution in these bounds.

    Attributes:
        rows: Matrix (c, n) that maps joint velocities to the velocities of the coordinates with dry friction.
        deviation: Standard deviations (c,) at rest [N m, N].
    """

    def __init__(self, dynamics: DynamicModel, bandwidth: float) -> None:
        """Reads the friction of a model.

        Args:
            dynamics: Model of the arm.
            bandwidth: Bandwidth of the estimated efforts [rad/s]. A coordinate moves if it slides through its smallest
                presliding travel within the time constant of this bandwidth.
        """
        bounds: dict[str, float] = {}
        speeds: dict[str, list[float]] = {}
        for effect, coefficient in zip(dynamics.effects, dynamics.coefficients, strict=True):
            if EFFECT_KINDS[effect.kind].symmetric and coefficient:
                bounds[effect.coordinate] = bounds.get(effect.coordinate, 0.0) + coefficient
                speed = effect.scale * bandwidth if effect.kind == "presliding" else effect.scale
                speeds.setdefault(effect.coordinate, []).append(speed)
        n = dynamics.arm.num_joints
        self.rows = np.array([joint_row(dynamics.arm, name) for name in bounds]).reshape(-1, n)
        self.deviation = np.array(list(bounds.values())) / np.sqrt(3.0)
        self._speeds = np.array([min(values) for values in speeds.values()])

    def rest(self, v: NDArray[np.float64]) -> NDArray[np.float64]:
        """Returns how much each coordinate rests (..., c), from 1 at rest to 0 in motion, for velocities v (..., n)."""
        return np.asarray(1.0 - np.tanh(v @ self.rows.T / self._speeds) ** 2)

    def covariance(self, rest: NDArray[np.float64]) -> NDArray[np.float64]:
        """Returns the covariances (..., n, n) of the joint efforts [(N m)^2, N^2].

        Args:
            rest: Result (..., c) of `rest`, low-pass filtered as the efforts.
        """
        scaled = (rest * self.deviation)[..., None] * self.rows
        return np.asarray(scaled.swapaxes(-1, -2) @ scaled)
