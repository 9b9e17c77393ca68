"""Bounds the dry friction of joints at rest, where the model does not determine it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.dynamics.actuator_effects import joint_row
from dvrk_drake.dynamics.dynamic_model import DynamicModel
from dvrk_drake.models.effect_kinds import EFFECT_KINDS

#: Time constant with which the bound of the friction grows while a joint rests [s]. A reversal of a motion takes less
#: time, and the presliding elements of the model describe it. `REST_TIME` of mode "guide" has the same length.
REST_TIME = 0.25


class DryFrictionBound:
    """Standard deviation of the dry friction along the coordinates of an arm's drive, by their velocity.

    While a coordinate moves, or turns back, the model determines its dry friction. At rest, friction balances any
    effort between minus and plus the sum of its coefficients. The standard deviation is that of a uniform distribution
    in these bounds.

    Attributes:
        rows: Matrix (c, n) that maps joint velocities to the velocities of the coordinates with dry friction.
        deviation: Standard deviations (c,) at rest [N m, N].
    """

    def __init__(self, dynamics: DynamicModel) -> None:
        """Reads the friction of a model.

        A coordinate rests if it travels less than its smallest presliding travel in `REST_TIME`. Without presliding
        elements, it rests below the smallest speed at which the model has its full friction.
        """
        bounds: dict[str, float] = {}
        speeds: dict[str, list[tuple[bool, float]]] = {}
        for effect, coefficient in zip(dynamics.effects, dynamics.coefficients, strict=True):
            if EFFECT_KINDS[effect.kind].symmetric and coefficient:
                bounds[effect.coordinate] = bounds.get(effect.coordinate, 0.0) + coefficient
                is_speed = effect.kind != "presliding"
                speed = effect.scale if is_speed else effect.scale / REST_TIME
                speeds.setdefault(effect.coordinate, []).append((is_speed, speed))
        n = dynamics.arm.num_joints
        self.rows = np.array([joint_row(dynamics.arm, name) for name in bounds]).reshape(-1, n)
        self.deviation = np.array(list(bounds.values())) / np.sqrt(3.0)
        # Presliding travels precede speeds in the order of the tuples.
        self._speeds = np.array([min(values)[1] for values in speeds.values()])

    def rest(self, v: NDArray[np.float64], before: NDArray[np.float64], period: float) -> NDArray[np.float64]:
        """Returns how long each coordinate has rested (c,), from 0 in motion to 1 after several times `REST_TIME`.

        Args:
            v: Velocities (n,) of the joints [rad/s, m/s].
            before: Result (c,) at the previous sample; ones for an arm that rested before.
            period: Time since the previous sample [s].
        """
        still = 1.0 - np.tanh(self.rows @ v / self._speeds) ** 2
        return np.minimum(still, before + period / REST_TIME * (1.0 - before))

    def covariance(self, rest: NDArray[np.float64]) -> NDArray[np.float64]:
        """Returns the covariances (..., n, n) of the joint efforts [(N m)^2, N^2].

        Args:
            rest: Results (..., c) of `rest`.
        """
        scaled = (rest * self.deviation)[..., None] * self.rows
        return np.asarray(scaled.swapaxes(-1, -2) @ scaled)
