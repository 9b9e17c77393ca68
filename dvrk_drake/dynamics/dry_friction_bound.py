"""Bounds the dry friction of an arm where the model does not determine it: at rest, at the start, after a reversal."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.dynamics.actuator_effects import is_prismatic, joint_row
from dvrk_drake.dynamics.dynamic_model import DynamicModel
from dvrk_drake.models.effect_kinds import EFFECT_KINDS

#: Time constant with which the bound of the friction grows while a joint rests [s]. A reversal of a motion takes less
#: time, and the presliding elements of the model describe it. `REST_TIME` of mode "guide" has the same length.
REST_TIME = 0.25
#: Smallest travel in `REST_TIME` that is a motion [rad], [m]. The presliding travel of gears is shorter, and less than
#: the noise of a measured velocity.
MIN_TRAVEL = 5e-4, 1e-4
#: Standard deviation of the effort of a presliding element after a reversal, as a share of its coefficient. A model has
#: elements on a grid of travels with a ratio of about 10/3. An element whose travel is between two of them differs from
#: their best combination by this share (RMS until both slide, over all travels).
REVERSAL_SHARE = 0.22


class DryFrictionBound:
    """Standard deviation of the dry friction along the coordinates of an arm's drive.

    While a coordinate slides, the model determines its dry friction. At rest, friction balances any effort between
    minus and plus the sum of its coefficients. At the start, the deflection of a presliding element is unknown, until
    the coordinate has moved over twice its presliding travel. The standard deviation is that of a uniform distribution
    in these bounds. After a reversal, it is `REVERSAL_SHARE` of the coefficient along the same distance.

    A state (4 c) has four numbers for each of c coordinates: how long it has rested, from 0 in motion to 1 after
    several times `REST_TIME`, then its smallest and its largest position since the start, and the distance since the
    last reversal, with the sign of the motion.

    Attributes:
        rows: Matrix (c, n) that maps joint positions to the positions of the coordinates with dry friction.
    """

    def __init__(self, dynamics: DynamicModel) -> None:
        """Reads the friction of a model.

        A coordinate rests if it travels less than its smallest presliding travel, or `MIN_TRAVEL`, in `REST_TIME`.
        Without presliding elements, it rests below the smallest speed at which the model has its full friction.
        """
        dry = [
            (effect, coefficient)
            for effect, coefficient in zip(dynamics.effects, dynamics.coefficients, strict=True)
            if EFFECT_KINDS[effect.kind].symmetric and coefficient
        ]
        names = list(dict.fromkeys(effect.coordinate for effect, _ in dry))
        n = dynamics.arm.num_joints
        self.rows = np.array([joint_row(dynamics.arm, name) for name in names]).reshape(-1, n)
        has_state = np.array([effect.kind == "presliding" for effect, _ in dry], bool)
        scales = np.array([effect.scale for effect, _ in dry])
        of_coordinate = np.array([[effect.coordinate == name for effect, _ in dry] for name in names], bool)
        travels = np.maximum(scales, [MIN_TRAVEL[is_prismatic(dynamics.arm, effect.coordinate)] for effect, _ in dry])
        self._speeds = np.array(
            [
                np.min(travels[own & has_state]) / REST_TIME if np.any(own & has_state) else np.min(scales[own])
                for own in of_coordinate
            ]
        )
        self._deviations = of_coordinate * np.array([c for _, c in dry]) / np.sqrt(3.0)
        self._wiped = 2.0 * scales * has_state

    def start(self) -> NDArray[np.float64]:
        """Returns the state (4 c) of an arm that may have rested for any time."""
        one = np.ones(len(self.rows))
        return np.concatenate([one, np.inf * one, -np.inf * one, 0.0 * one])

    def update(self, state: NDArray[np.float64], q: NDArray[np.float64], v: NDArray[np.float64], period: float) -> None:
        """Updates a state in place with the positions q and velocities v (n,) of the joints after a period [s]."""
        rest, low, high, distance = state.reshape(4, -1)  # views
        x, rate = self.rows @ q, self.rows @ v
        still = 1.0 - np.tanh(rate / self._speeds) ** 2
        rest[:] = np.minimum(still, rest + min(period / REST_TIME, 1.0) * (1.0 - rest))
        np.minimum(low, x, out=low)
        np.maximum(high, x, out=high)
        distance[:] = np.where(distance * rate < 0, 0.0, distance) + period * rate

    def covariance(self, states: NDArray[np.float64]) -> NDArray[np.float64]:
        """Returns the covariances (..., n, n) of the joint efforts [(N m)^2, N^2] for states (..., 4 c)."""
        rest, low, high, distance = np.split(states, 4, axis=-1)
        turns = np.abs(distance)[..., None] < self._wiped
        share = np.maximum(rest[..., None], np.sqrt(3.0) * REVERSAL_SHARE * turns)
        share[(high - low)[..., None] < self._wiped] = 1.0
        deviation = np.sum(self._deviations * share, axis=-1)
        scaled = deviation[..., None] * self.rows
        return np.asarray(scaled.swapaxes(-1, -2) @ scaled)
