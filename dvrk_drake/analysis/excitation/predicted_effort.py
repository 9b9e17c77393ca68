"""Efforts that are predicted for a motion before it is executed."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.dynamics.actuator_effects import ActuatorEffect, joint_row, position_along
from dvrk_drake.dynamics.dynamic_regressor import DynamicRegressor
from dvrk_drake.dynamics.holding_torque import HoldingArrays, holding_torques_into
from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.effects_schema import EFFECT_KINDS, DriveEffect
from dvrk_drake.models.plant import inverse_dynamics


@dataclass(frozen=True, eq=False)
class PredictedEffort:
    """Efforts of an arm according to its files or to an identified model.

    A model with dynamics replaces the parameters of the SDF, and the friction, cables and springs in the arm file. A
    model without dynamics replaces the holding efforts. Friction that depends on load or position is not included.

    Attributes:
        arm: Arm that moves, with the gravity vector of the model.
        model: Identified model of the arm. None: SDF, friction, cables and springs of the arm's files.
    """

    arm: Arm
    model: IdentifiedModel | None = None

    @cached_property
    def _known(self) -> IdentifiedModel:
        """The model, or a model without dynamics of the arm's files."""
        return self.model or IdentifiedModel.from_arm(self.arm, self.arm.effects.position_dependent)

    @cached_property
    def _holding_arrays(self) -> HoldingArrays:
        """Static model with its parameters. An optimisation computes holding efforts thousands of times."""
        return self._known.static_model.with_parameters(self._known.theta)

    @cached_property
    def regressor(self) -> DynamicRegressor:
        """Regressor of the arm."""
        return DynamicRegressor(self.arm)

    @cached_property
    def parameters(self) -> NDArray[np.float64]:
        """Parameters (p,) of `regressor`: those of a model with dynamics, otherwise those of the SDF."""
        if self.model is None or self.model.dynamics is None:
            return self.regressor.values
        return self.model.dynamic_model.parameters

    @cached_property
    def dry_friction(self) -> NDArray[np.float64]:
        """Largest dry friction (n,) on each joint [N m, N]."""
        if self.model is None or self.model.dynamics is None:
            return self.arm.dry_friction()
        rows = [
            joint_row(self.arm, e.coordinate) * e.coefficient for e in self._effects if EFFECT_KINDS[e.kind].bounded
        ]
        return np.sum(np.abs(rows).reshape(-1, self.arm.num_joints), axis=0)

    def without_dry_friction(
        self, q: NDArray[np.float64], v: NDArray[np.float64], vd: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Returns the joint efforts (m, n) without dry friction [N m, N], computed with the regressor.

        Args:
            q, v, vd: Positions [rad, m], velocities and accelerations (m, n) of the joints.
        """
        return self.regressor.torque(q, v, vd, self.parameters) + self._correction(q, v)

    def holding(self, q: NDArray[np.float64]) -> NDArray[np.float64]:
        """Returns the joint efforts (m, n) that hold the arm at poses q (m, n) [N m, N], without dry friction."""
        poses = np.ascontiguousarray(q, dtype=np.float64)
        tau = np.empty(poses.shape)
        holding_torques_into(poses, self._holding_arrays, tau)
        return tau

    def by_drake(self, q: NDArray[np.float64], v: NDArray[np.float64], vd: NDArray[np.float64]) -> NDArray[np.float64]:
        """Returns the same efforts as `without_dry_friction`, computed with Drake's inverse dynamics."""
        if self.model is None or self.model.dynamics is None:
            return inverse_dynamics(self.arm, q, v, vd) + self._correction(q, v)
        J, rotors = self.arm.transmission, np.array([rotor.value for rotor in self.model.dynamics.rotors])
        inertias = {link.link: link.to_spatial_inertia() for link in self.model.dynamic_model.links}
        of_links = inverse_dynamics(self.arm, q, v, vd, inertias)
        return of_links + (J.velocity(vd) * rotors) @ J.matrix + self._correction(q, v)

    def _correction(self, q: NDArray[np.float64], v: NDArray[np.float64]) -> NDArray[np.float64]:
        """Returns the joint efforts (m, n) that are not those of rigid bodies with `parameters`, without dry friction.

        These are the cables, springs, offsets and viscous friction of a model with dynamics, and the difference between
        the holding efforts of the model and of the SDF otherwise.
        """
        model = self._known
        if model.dynamics is None:
            rest = np.zeros_like(q)
            of_sdf = self.regressor.torque(q, rest, rest, self.parameters)
            return self.holding(q) - of_sdf
        tau = np.zeros(q.shape)
        for effect in self._effects:
            if EFFECT_KINDS[effect.kind].role != "dry":
                row = joint_row(self.arm, effect.coordinate)
                shape = ActuatorEffect.of(effect).column(position_along(self.arm, effect.coordinate, q), v @ row)
                tau += effect.coefficient * shape[:, None] * row
        return tau

    @property
    def _effects(self) -> list[DriveEffect]:
        assert self.model is not None and self.model.dynamics is not None
        return self.model.dynamics.effects
