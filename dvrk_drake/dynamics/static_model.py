"""Static model of an arm: regressor and holding torque tau = Y(q) beta + effects(q), without the feedforward scale."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dvrk_drake.dynamics.actuator_effects import ActuatorEffect, effect_column
from dvrk_drake.dynamics.gravity_parameters import GravityParameters, gravity_parameters
from dvrk_drake.dynamics.holding_torque import HoldingArrays, holding_torques_into
from dvrk_drake.models.arm import Arm


@dataclass(frozen=True, eq=False)
class StaticModel:
    """Regressor and holding torque of one model structure, which consists of an arm and effects.

    The parameters theta are the b base parameters [kg m, kg], then one coefficient per effect in the unit of its kind.

    Attributes:
        gravity: Base parameters of the gravity torque.
        effects: Effects with kinds in `POSITION_KINDS`, in the order of theta.
    """

    gravity: GravityParameters
    effects: tuple[ActuatorEffect, ...]

    def with_parameters(self, theta: ArrayLike) -> HoldingArrays:
        """Returns the model with parameters theta for `holding_torque_into`."""
        beta, coefficients = np.split(np.asarray(theta, dtype=np.float64), [len(self.gravity.base.names)])
        arm, weights = self.gravity.arm, self.gravity.weights(beta)
        effects = HoldingArrays.of_effects(arm, self.effects, coefficients)
        return effects.with_links(self.gravity.tree, arm.gravity, weights)

    def regressor(self, q: ArrayLike) -> NDArray[np.float64]:
        """Returns Y with tau = Y theta: (n, p) for one pose q (n,), (m, n, p) for m poses (m, n)."""
        poses = np.atleast_2d(np.asarray(q, dtype=np.float64))
        of_links = self.gravity.regressor_at(poses)
        columns = [effect_column(self.gravity.arm, effect, poses)[..., None] for effect in self.effects]
        Y = np.concatenate([of_links, *columns], axis=2) if columns else of_links
        return Y if np.ndim(q) == 2 else Y[0]

    def torque(self, q: ArrayLike, theta: ArrayLike) -> NDArray[np.float64]:
        """Returns the holding torque [N m or N]: (n,) for one pose q (n,), (m, n) for m poses (m, n)."""
        poses = np.atleast_2d(np.ascontiguousarray(q, dtype=np.float64))
        tau = np.empty(poses.shape)
        holding_torques_into(poses, self.with_parameters(theta), tau)
        return tau if np.ndim(q) == 2 else tau[0]


@cache
def static_model(arm: Arm, effects: tuple[ActuatorEffect, ...] = ()) -> StaticModel:
    """Returns the static model of an arm with effects."""
    return StaticModel(gravity_parameters(arm), effects)
