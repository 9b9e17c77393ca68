"""Converts each part of an MTM's model to parameters of the dVRK controller's gravity compensation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.polynomial import Polynomial, chebyshev
from numpy.typing import NDArray

from dvrk_drake.dynamics.actuator_effects import ActuatorEffect, joint_row, position_along
from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.export.dvrk_mtm_controller import (
    CONTROLLER_GRAVITY,
    NUM_GRAVITY,
    ORDER,
    controller_regressor,
    polynomial_columns,
)
from dvrk_drake.export.dvrk_mtm_gravity_compensation_file import NUM_JOINTS, NUM_PARAMETERS
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.effects_schema import DriveEffect

#: Kinds of effects that the first two columns of the regressor represent, for the joint shoulder_pitch.
_FIRST_EFFECTS = ("cable sine", "cable cosine")
#: Start of the names of the base parameters for the distance of the last link's centre of mass from the roll axis.
_OFF_AXIS = ("m7 c7x", "m7 c7y")


@dataclass(frozen=True, eq=False)
class ModelPart:
    """Part of a model's holding torque, and its representation in a file.

    Attributes:
        cause: Property of the model that the file cannot represent, if the two torques differ.
        torque: Torques (m, 7) of this part at the given poses [N m].
        parameters: Parameters (40,) of the controller's regressor that represent or approximate this part.
    """

    cause: str
    torque: NDArray[np.float64]
    parameters: NDArray[np.float64]


def model_parts(model: IdentifiedModel, poses: NDArray[np.float64]) -> list[ModelPart]:
    """Returns the parts of a model. The sum of their torques at `poses` (m, 7) [rad] is the model's holding torque.

    Joints with a feedforward scale of 0 do not influence the parameters, because the file limits their torque to 0.
    """
    arm, scale = model.arm, model.feedforward_scale
    off_axis = np.array([p.name.startswith(_OFF_AXIS) for p in model.base_parameters])
    parts = [
        _gravity_part("centre of mass of the last link off the roll axis", model, poses, off_axis),
        _gravity_part(_gravity_cause(model), model, poses, ~off_axis),
    ]
    regressor = model.static_model.regressor(poses)
    for i, effect in enumerate(model.holding_effects, start=len(model.base_parameters)):
        torque = scale * regressor[:, :, i] * effect.coefficient
        parts.append(ModelPart(f"effect {ActuatorEffect.of(effect)}", torque, _effect_parameters(effect, arm, scale)))
    return parts


def _gravity_cause(model: IdentifiedModel) -> str:
    down = model.arm.gravity
    tilt = float(np.rad2deg(np.arccos(np.clip(-down[2] / np.linalg.norm(down), -1.0, 1.0))))
    partial = np.any((model.feedforward_scale != 0) & (model.feedforward_scale != 1))
    causes = [f"base tilt of {tilt:.1f} deg"] * (tilt > 0.05) + ["feedforward scale between 0 and 1"] * bool(partial)
    return " and ".join(causes) or "gravity of the links"


def _gravity_part(
    cause: str, model: IdentifiedModel, poses: NDArray[np.float64], chosen: NDArray[np.bool_]
) -> ModelPart:
    """Fits parameters to the gravity torque of the chosen base parameters.

    The ten gravity parameters are fitted at random poses, which may exceed the joint limits. The polynomials
    approximate the residual torque at `poses` (m, 7). This residual torque is small if the base is not tilted.
    """
    on = model.feedforward_scale > 0
    q = np.random.default_rng(0).uniform(-np.pi, np.pi, (400, NUM_JOINTS))
    R = controller_regressor(q)[:, on, :NUM_GRAVITY]
    target = _gravity_torque(model, q, chosen)[:, on]
    solution = np.linalg.lstsq(R.reshape(-1, NUM_GRAVITY), target.ravel(), rcond=None)[0]
    parameters = np.concatenate([solution, np.zeros(NUM_PARAMETERS - NUM_GRAVITY)])
    R, torque = controller_regressor(poses), _gravity_torque(model, poses, chosen)
    residual = torque - R @ parameters
    for joint in map(int, np.flatnonzero(on[:-1])):
        columns = polynomial_columns(joint)
        parameters[columns] = np.linalg.lstsq(R[:, joint, columns], residual[:, joint], rcond=None)[0]
    return ModelPart(cause, torque, parameters)


def _gravity_torque(model: IdentifiedModel, q: NDArray[np.float64], chosen: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Returns the gravity torque (m, 7) of the chosen base parameters, multiplied by the feedforward scale [N m]."""
    beta = np.array([p.value for p in model.base_parameters])
    Y = model.static_model.regressor(q)[:, :, : len(beta)]
    return np.asarray(model.feedforward_scale * (Y @ np.where(chosen, beta, 0.0)))


def _effect_parameters(effect: DriveEffect, arm: Arm, scale: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns the parameters (40,) for an effect. The file has no torque at the last joint.

    If several joints move the coordinate of the effect, the polynomial of each joint is for zero positions of the
    other joints.
    """
    parameters = np.zeros(NUM_PARAMETERS)
    row = joint_row(arm, effect.coordinate)
    for joint in map(int, np.flatnonzero(row[:-1])):
        value = float(scale[joint] * effect.coefficient * row[joint])
        if effect.kind == "offset":
            parameters[polynomial_columns(joint).start] = value
        elif joint == 1 and row[1] == effect.scale == 1.0 and effect.kind in _FIRST_EFFECTS:
            parameters[_FIRST_EFFECTS.index(effect.kind)] = value / CONTROLLER_GRAVITY
        else:
            parameters[polynomial_columns(joint)] = value * _best_polynomial(ActuatorEffect.of(effect), arm, joint)
    return parameters


def _best_polynomial(effect: ActuatorEffect, arm: Arm, joint: int) -> NDArray[np.float64]:
    """Returns the coefficients (5,) of 1, q, ..., q^4 in a polynomial that approximates an effect over a joint's range.

    Interpolation at Chebyshev nodes makes the largest error nearly minimal.
    """
    lower, upper = arm.position_lower[joint], arm.position_upper[joint]
    middle, half = (lower + upper) / 2, (upper - lower) / 2
    x = chebyshev.chebpts1(ORDER + 1)
    along = position_along(arm, effect.coordinate, (middle + half * x)[:, None] * np.eye(NUM_JOINTS)[joint])
    series = chebyshev.chebfit(x, effect.column(along, 0 * along), ORDER)
    polynomial = Polynomial(chebyshev.cheb2poly(series))(Polynomial([-middle / half, 1 / half]))
    return np.resize(np.append(polynomial.coef, np.zeros(ORDER + 1)), ORDER + 1)
