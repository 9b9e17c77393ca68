"""What of an arm's dynamics holds it at rest: base parameters of the links, and joint effects as controllers read them."""

from __future__ import annotations

import numpy as np
import sympy
from numpy.typing import NDArray

from dvrk_drake.dynamics.actuator_effects import ActuatorEffect, effect_coordinates
from dvrk_drake.dynamics.dynamic_regressor import DynamicRegressor
from dvrk_drake.dynamics.dynamic_section import DynamicSection
from dvrk_drake.dynamics.identified_model import BaseParameterEstimate, EffectEstimate
from dvrk_drake.dynamics.joint_effects import EFFECT_KINDS, kinds_of
from dvrk_drake.dynamics.symbolic_gravity import GRAVITY, SymbolicGravity, derive_gravity
from dvrk_drake.models.arm import Arm

#: Effects that act at rest too; friction holds either way and is left to the arm.
STATIC_KINDS = ("offset", "spring", "cable sine", "cable cosine")


def static_part(
    arm: Arm,
    section: DynamicSection,
    regressor: DynamicRegressor,
    covariance: NDArray[np.float64],
    q: NDArray[np.float64],
) -> tuple[list[BaseParameterEstimate], list[EffectEstimate]]:
    """Base parameters with standard errors, and joint effects fitted to the drive's over the recorded poses.

    Args:
        arm: mounted as expected; a tilt of the base is left out.
        section: the identified dynamics.
        regressor: of the arm.
        covariance: of the links' parameters, which come first.
        q: (m, n) recorded poses of the joints.
    """
    gravity = derive_gravity(arm)
    B = base_parameter_map(gravity, regressor)
    phi = np.concatenate([link.parameters for link in section.links])
    values = B @ phi
    errors = np.sqrt(np.diag(B @ covariance[: len(phi), : len(phi)] @ B.T))
    base = [
        BaseParameterEstimate(name, float(value), float(error), bool(abs(value) > 2 * error))
        for name, value, error in zip(gravity.base.names, values, errors, strict=True)
    ]
    return base, _joint_effects(arm, section, q)


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


def _joint_effects(arm: Arm, section: DynamicSection, q: NDArray[np.float64]) -> list[EffectEstimate]:
    """The joint effects whose torque is nearest to that of the drive's static effects at the poses q."""
    a, rows = arm.transmission.position(q), effect_coordinates(arm)
    tau = np.zeros(a.shape)
    for e in section.effects:
        if e.kind in STATIC_KINDS:
            h = rows[e.coordinate]
            shape = ActuatorEffect(e.coordinate, e.kind, e.scale).column(a @ h, 0 * (a @ h))
            tau += e.value * shape[:, None] * h
    tau = arm.transmission.pull_back_effort(tau)
    estimates = []
    for j, name in enumerate(arm.joint_names):
        if not np.any(tau[:, j]):
            continue
        kinds = kinds_of(bool(arm.prismatic[j]))
        symbol = sympy.Symbol("q")
        X = np.column_stack(
            [np.broadcast_to(sympy.lambdify(symbol, EFFECT_KINDS[k](symbol), "numpy")(q[:, j]), len(q)) for k in kinds]
        )
        for kind, value in zip(kinds, np.linalg.lstsq(X, tau[:, j], rcond=None)[0], strict=True):
            estimates.append(EffectEstimate(name, kind, float(value), 0.0, True))
    return estimates
