"""An arm's gravity effort and mass matrix, one pose at a time, for control loops."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.dynamics.dynamic_regressor import DynamicRegressor
from dvrk_drake.dynamics.identified_model import IdentifiedModel


class ControlModel:
    """Gravity effort and mass matrix of one arm, evaluated fast enough for each tick of a control loop."""

    def __init__(self, model: IdentifiedModel, *, with_gravity: bool = True) -> None:
        """Compiles the gravity effort of `model` and reads its inertial parameters.

        Args:
            model: of the arm, mounted as it is. A model that was identified from poses has no inertias: those of the
                arm's SDF are used then.
            with_gravity: False for an arm that adds its own gravity compensation to all efforts: it needs none.

        Raises:
            ModelError: the model does not fit its arm.
        """
        model.check()
        self._torque_into = model.static_model.torque_into
        self._theta = np.ascontiguousarray(model.theta)
        self._scale = model.trust * with_gravity
        if model.dynamics is None:
            self._regressor = DynamicRegressor(model.load_arm())
            self._parameters = self._regressor.values
        else:
            self._regressor, self._parameters = model.dynamic_model.regressor, model.dynamic_model.parameters

    def gravity_effort(self, q: NDArray[np.float64]) -> NDArray[np.float64]:
        """Returns the effort (n,) [N m, N] that holds the arm at q (n,) [rad, m], a C-contiguous array."""
        effort = np.empty(len(q))
        self._torque_into(q, self._theta, effort)
        return effort * self._scale

    def mass_matrix(self, q: NDArray[np.float64]) -> NDArray[np.float64]:
        """Returns the mass matrix (n, n) of the independent joints at q (n,) [rad, m], rotors included."""
        return self._regressor.mass_matrix(q[None], self._parameters)[0]
