"""The base parameters of an arm whose links were identified in motion."""

from __future__ import annotations

import numpy as np
import sympy
from numpy.typing import NDArray

from dvrk_drake.dynamics.dynamic_regressor import DynamicRegressor
from dvrk_drake.dynamics.dynamic_section import DynamicSection
from dvrk_drake.dynamics.gravity_regressor import GRAVITY, SymbolicGravity, derive_gravity
from dvrk_drake.dynamics.identified_model import BaseParameterEstimate
from dvrk_drake.models.arm import Arm


def base_parameter_estimates(
    arm: Arm, section: DynamicSection, regressor: DynamicRegressor, covariance: NDArray[np.float64]
) -> list[BaseParameterEstimate]:
    """Base parameters of the section's links, with standard errors.

    Args:
        arm: mounted as the section says.
        section: the identified dynamics.
        regressor: of that arm.
        covariance: of the links' parameters, which come first.
    """
    gravity = derive_gravity(arm)
    B = base_parameter_map(gravity, regressor)
    phi = np.concatenate([link.parameters for link in section.links])
    values = B @ phi
    errors = np.sqrt(np.diag(B @ covariance[: len(phi), : len(phi)] @ B.T))
    return [
        BaseParameterEstimate(name, float(value), float(error), bool(abs(value) > 2 * error))
        for name, value, error in zip(gravity.base.names, values, errors, strict=True)
    ]


def base_parameter_map(gravity: SymbolicGravity, regressor: DynamicRegressor) -> NDArray[np.float64]:
    """(b, 10 links) B with beta = B phi: both regressors give the torque that holds the arm, at all poses."""
    arm = gravity.arm
    q = np.random.default_rng(0).uniform(-1, 1, (60, arm.num_joints))
    Y = sympy.lambdify(
        gravity.q, gravity.regressor.subs(GRAVITY, gravity.gravity_magnitude).tolist(), "numpy", cse=True
    )
    ours = np.array([Y(*pose) for pose in q], dtype=float).reshape(-1, len(gravity.base.names))
    rest = np.zeros_like(q)
    full = regressor.regressor(q, rest, rest)[..., : 10 * len(regressor.links)]
    B = np.linalg.lstsq(ours, full.reshape(len(ours), -1), rcond=None)[0]
    return np.where(np.abs(B) < 1e-12, 0.0, B)
