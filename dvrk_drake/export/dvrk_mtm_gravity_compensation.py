"""Gravity compensation of an MTM in the dVRK controller, and conversion of a model to the file of this controller."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.polynomial import Polynomial, chebyshev
from numpy.typing import ArrayLike, NDArray

from dvrk_drake.dynamics.actuator_effects import ActuatorEffect, joint_row, position_along
from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.errors import ModelError
from dvrk_drake.export.dvrk_mtm_gravity_compensation_file import NUM_JOINTS, NUM_PARAMETERS, GravityCompensationFile
from dvrk_drake.models.arm import Arm

#: Kinds of effects that model dry friction.
DRY_KINDS = ("coulomb", "presliding")
#: Gravitational acceleration in the gravity columns of the controller's regressor [m/s^2].
CONTROLLER_GRAVITY = 9.81
#: Number of gravity columns of the controller's regressor.
NUM_GRAVITY = 10
#: Order of the polynomials in a joint position.
ORDER = 4
#: Kinds of effects that the first two columns of the regressor represent, for the joint shoulder_pitch.
_FIRST_EFFECTS = ("cable sine", "cable cosine")
MTM_JOINTS = (
    "outer_yaw",
    "shoulder_pitch",
    "elbow_pitch",
    "wrist_platform",
    "wrist_pitch",
    "wrist_yaw",
    "wrist_roll",
)


@dataclass(frozen=True)
class CompensationOptions:
    """Entries of the gravity-compensation file that a model does not contain, and the largest accepted torque error.

    Attributes:
        coulomb: Coulomb friction (7,) of the joints [N m].
        friction_ratio: Share of the Coulomb friction to compensate on each joint (7,) during a motion, 0 to 1.
        dead_band, saturation: Speeds (7,) [rad/s], see `GravityCompensationFile`. The default values come from
            gravity-compensation files of the dVRK.
        tolerance: Largest accepted difference between the torques of the file and of the model [N m].
    """

    coulomb: tuple[float, ...] = (0.0,) * NUM_JOINTS
    friction_ratio: tuple[float, ...] = (0.8, 0.8, 0.8, 0.4, 0.6, 0.6, 0.0)
    dead_band: tuple[float, ...] = (0.02, 0.02, 0.02, 0.01, 0.008, 0.008, 0.01)
    saturation: tuple[float, ...] = (0.4, 0.2, 0.2, 0.4, 0.4, 0.2, 0.4)
    tolerance: float = 1e-6


def controller_regressor(q: ArrayLike) -> NDArray[np.float64]:
    """Returns the regressor R (m, 7, 40) at poses q (m, 7) [rad]. R times the parameters (40,) is the torque [N m].

    The formula is from the class robGravityCompensationMTM of sawIntuitiveResearchKit, the software of the dVRK.
    """
    q = np.atleast_2d(np.asarray(q, dtype=np.float64))
    s4, s5, s6 = np.sin(q[:, 3:6]).T
    c4, c5, c6 = np.cos(q[:, 3:6]).T
    S, C = np.sin(q[:, 1] + q[:, 2]), np.cos(q[:, 1] + q[:, 2])
    R = np.zeros((len(q), NUM_JOINTS, NUM_PARAMETERS))
    R[:, 1, 0], R[:, 1, 1] = np.sin(q[:, 1]), np.cos(q[:, 1])
    R[:, 1, 2:10] = np.stack(
        [
            C,
            -S,
            C * c4,
            -C * s4,
            -(S * c5 + C * c4 * s5),
            C * c4 * c5 - S * s5,
            C * s4 * s6 + S * c6 * s5 - C * c4 * c5 * c6,
            C * c6 * s4 - S * s5 * s6 + C * c4 * c5 * s6,
        ],
        axis=1,
    )
    R[:, 2, 2:10] = R[:, 1, 2:10]
    R[:, 3, 4:10] = np.stack(
        [-S * s4, -S * c4, S * s4 * s5, -S * c5 * s4, S * (c4 * s6 + c5 * c6 * s4), S * (c4 * c6 - c5 * s4 * s6)],
        axis=1,
    )
    R[:, 4, 6:10] = np.stack(
        [
            -(C * s5 + S * c4 * c5),
            C * c5 - S * c4 * s5,
            -C * c5 * c6 + S * c4 * c6 * s5,
            C * c5 * s6 - S * c4 * s5 * s6,
        ],
        axis=1,
    )
    R[:, 5, 8] = S * c6 * s4 + C * s5 * s6 + S * c4 * c5 * s6
    R[:, 5, 9] = C * c6 * s5 - S * s4 * s6 + S * c4 * c5 * c6
    R *= CONTROLLER_GRAVITY
    for joint in range(NUM_JOINTS - 1):
        R[:, joint, polynomial_columns(joint)] = q[:, joint, None] ** np.arange(ORDER + 1)
    return R


def polynomial_columns(joint: int) -> slice:
    """Returns the slice of the five regressor columns (powers 0 to 4 of the position) of a joint with index 0 to 5."""
    first = NUM_GRAVITY + (ORDER + 1) * joint
    return slice(first, first + ORDER + 1)


def unclipped_torque(file: GravityCompensationFile, q: ArrayLike, v: ArrayLike | None = None) -> NDArray[np.float64]:
    """Returns the torque (m, 7) that the controller computes from a file, before clipping to the torque limits [N m].

    Args:
        file: Content of the file.
        q: Poses (m, 7) [rad].
        v: Velocities (m, 7) [rad/s]. None: all velocities are zero.
    """
    R = controller_regressor(q)
    v = np.zeros(R.shape[:2]) if v is None else np.atleast_2d(np.asarray(v, dtype=np.float64))
    share = np.clip((np.abs(v) - file.dead_band) / (file.saturation - file.dead_band), 0.0, 1.0)
    alpha = 0.5 + 0.5 * file.friction_ratio * share * np.sign(v)
    return alpha * (R @ file.positive) + (1.0 - alpha) * (R @ file.negative)


def controller_torque(file: GravityCompensationFile, q: ArrayLike, v: ArrayLike | None = None) -> NDArray[np.float64]:
    """Returns the torque (m, 7) that the controller applies: `unclipped_torque`, clipped to the torque limits [N m]."""
    return np.clip(unclipped_torque(file, q, v), file.torque_lower, file.torque_upper)


def compensation_from_model(
    model: IdentifiedModel, options: CompensationOptions | None = None
) -> GravityCompensationFile:
    """Converts a model to a gravity-compensation file of the controller.

    The ten gravity columns of `controller_regressor` represent the gravity torque exactly if the MTM is upright and its
    last link is balanced about the roll axis. Polynomials in the joint positions approximate the additional gravity
    torque of a tilted base. The constant term of each joint's polynomial represents the offset torque of this joint.
    The first two columns represent the cable torque of shoulder_pitch. Polynomials approximate all other effects that
    depend on one joint position.

    The torque limits are the range of the torque within the joint limits, including Coulomb friction. This range is
    extended by 10 % of its width at both ends, up to the effort limits of the arm. The torque of joint 7 is zero.

    Raises:
        ModelError: The model is not of an MTM, an option is invalid, or the torque error exceeds `options.tolerance`.
    """
    options = options or CompensationOptions()
    arm = model.arm
    if arm.joint_names != MTM_JOINTS:
        raise ModelError(
            f"{arm.name} is not an MTM. The format dvrk-gc supports only an MTM; for a PSM, use dvrk-kinematic-gc"
        )
    check_tolerance(options.tolerance)
    poses = arm.sample_poses(20000, np.random.default_rng(0))
    gravity, effects = _gravity_parameters(model, poses[:4000]), _effect_parameters(model, arm)
    _check_errors(model, gravity, effects, poses[:4000], options.tolerance)
    parameters = gravity + effects
    coulomb = _checked_values("coulomb", options.coulomb)
    friction = np.zeros(NUM_PARAMETERS)
    friction[[polynomial_columns(j).start for j in range(NUM_JOINTS - 1)]] = coulomb[:-1]
    torque = controller_regressor(poses) @ parameters
    lower, upper = _torque_limits(arm, torque.min(axis=0) - coulomb, torque.max(axis=0) + coulomb)
    file = GravityCompensationFile(
        positive=parameters + friction,
        negative=parameters - friction,
        torque_lower=lower,
        torque_upper=upper,
        dead_band=_checked_values("dead_band", options.dead_band),
        saturation=_checked_values("saturation", options.saturation),
        friction_ratio=_checked_values("friction_ratio", options.friction_ratio),
    )
    file.check()
    return file


def dry_friction(model: IdentifiedModel) -> tuple[float, ...]:
    """Returns the dry friction (7,) of the joints [N m]. Each value is valid if no other joint moves.

    The dry friction is the sum of the Coulomb and presliding effects in the model's dynamics. An effect along a
    coordinate that several joints move contributes to the dry friction of each of these joints.

    Raises:
        ModelError: The model has no dynamics.
    """
    if model.dynamics is None:
        raise ModelError("the model has no dynamics, so its friction is unknown. Give the friction with --coulomb")
    arm = model.arm
    friction = np.zeros(arm.num_joints)
    for effect in model.dynamics.effects:
        if effect.kind in DRY_KINDS:
            friction += effect.coefficient * np.abs(joint_row(arm, effect.coordinate))
    return tuple(float(f) for f in friction)


def largest_differences(file: GravityCompensationFile, model: IdentifiedModel) -> NDArray[np.float64]:
    """Returns the largest torque difference (7,) between file and model at rest, at random poses [N m]."""
    poses = model.arm.sample_poses(4000, np.random.default_rng(1))
    return np.asarray(np.abs(controller_torque(file, poses) - model.holding_torque(poses)).max(axis=0))


def _gravity_torque(model: IdentifiedModel, q: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns the gravity torque (m, 7) of the base parameters, multiplied by the feedforward scale [N m]."""
    beta = np.array([p.value for p in model.base_parameters])
    return np.asarray(model.feedforward_scale * (model.static_model.regressor(q)[:, :, : len(beta)] @ beta))


def _gravity_parameters(model: IdentifiedModel, poses: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns parameters (40,) that approximate the gravity torque of the model.

    The ten gravity parameters are fitted at random poses, which may exceed the joint limits. The polynomials
    approximate the residual torque at `poses` (m, 7). This residual torque is small if the base is not tilted.
    """
    q = np.random.default_rng(0).uniform(-np.pi, np.pi, (400, NUM_JOINTS))
    R = controller_regressor(q)[:, :, :NUM_GRAVITY]
    solution = np.linalg.lstsq(R.reshape(-1, NUM_GRAVITY), _gravity_torque(model, q).ravel(), rcond=None)[0]
    parameters = np.concatenate([solution, np.zeros(NUM_PARAMETERS - NUM_GRAVITY)])
    R = controller_regressor(poses)
    residual = _gravity_torque(model, poses) - R @ parameters
    for joint in range(NUM_JOINTS - 1):
        columns = polynomial_columns(joint)
        parameters[columns] = np.linalg.lstsq(R[:, joint, columns], residual[:, joint], rcond=None)[0]
    return parameters


def _effect_parameters(model: IdentifiedModel, arm: Arm) -> NDArray[np.float64]:
    parameters = np.zeros(NUM_PARAMETERS)
    for estimate in model.holding_effects:
        row = joint_row(arm, estimate.coordinate)
        # The file has no torque at the last joint and no functions of two joint positions. `_check_errors` includes the
        # resulting error.
        for joint in map(int, np.flatnonzero(row[:-1])):
            value = float(model.feedforward_scale[joint] * estimate.coefficient * row[joint])
            if estimate.kind == "offset":
                parameters[polynomial_columns(joint).start] += value
            elif np.count_nonzero(row) > 1:
                continue
            elif joint == 1 and estimate.scale == 1.0 and estimate.kind in _FIRST_EFFECTS:
                parameters[_FIRST_EFFECTS.index(estimate.kind)] += value / CONTROLLER_GRAVITY
            else:
                parameters[polynomial_columns(joint)] += value * _best_polynomial(
                    ActuatorEffect.of(estimate), arm, joint
                )
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


def _check_errors(
    model: IdentifiedModel,
    gravity: NDArray[np.float64],
    effects: NDArray[np.float64],
    poses: NDArray[np.float64],
    tolerance: float,
) -> None:
    """Raises ModelError if the torque error of the file's parameters at `poses` (m, 7) exceeds `tolerance` [N m].

    The file's parameters are the sum of `gravity` (40,) and `effects` (40,).
    """
    R, tau = controller_regressor(poses), _gravity_torque(model, poses)
    gravity_error = np.abs(R @ gravity - tau).max(axis=0)
    effects_error = np.abs(R @ effects - (model.holding_torque(poses) - tau)).max(axis=0)
    error = np.abs(R @ (gravity + effects) - model.holding_torque(poses)).max(axis=0)
    if not error.max() > tolerance:
        return
    least = min(tolerance, 1e-6)
    errors = ", ".join(f"{name} {e:.2g}" for name, e in zip(MTM_JOINTS, error, strict=True) if e > least)
    down = model.arm.gravity
    tilt = float(np.rad2deg(np.arccos(np.clip(-down[2] / np.linalg.norm(down), -1.0, 1.0))))
    limits = ["a last link balanced about its roll axis"]
    if tilt > 0.05:
        limits.append(f"a base tilt of 0 instead of {tilt:.1f} deg")
    if np.any((model.feedforward_scale != 0) & (model.feedforward_scale != 1)):
        limits.append("feedforward scales of 0 or 1")
    reasons = {
        f"gravity {gravity_error.max():.2g} N m (the file requires {', '.join(limits)})": gravity_error.max(),
        f"effects {effects_error.max():.2g} N m (the file supports only polynomials of order 4 in the joint's own "
        "position, and no torque at joint 7)": effects_error.max(),
    }
    raise ModelError(
        f"the controller's file cannot represent this model: the largest torque errors are {errors} N m. "
        f"Errors by cause: {', '.join(reason for reason, size in reasons.items() if size > least)}. "
        f"{_estimates_note(model)}To accept the errors, repeat the command with "
        f"--gc-tolerance {round_up(error.max()):g}"
    )


def _estimates_note(model: IdentifiedModel) -> str:
    """Returns advice for a model with the masses of the SDF, or "" for an identified model."""
    if model.provenance.method != "nominal":
        return ""
    return (
        "This model has the estimated masses of the SDF. Identify your arm first (dvrk-drake identify) and export the "
        "identified model. "
    )


def check_tolerance(tolerance: float) -> None:
    """Raises ModelError unless the tolerance is finite and not negative."""
    if not 0 <= tolerance < np.inf:
        raise ModelError(f"--gc-tolerance is {tolerance:g}; allowed: a finite number of 0 or more [N m, N]")


def round_up(x: float) -> float:
    """Returns x, rounded up to two significant digits."""
    unit = 10.0 ** (np.floor(np.log10(x)) - 1)
    return float(np.ceil(x / unit) * unit)


def _torque_limits(
    arm: Arm, least: NDArray[np.float64], most: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    margin = 0.1 * (most - least)
    lower = np.clip(least - margin, -arm.effort_limits, arm.effort_limits)
    upper = np.clip(most + margin, -arm.effort_limits, arm.effort_limits)
    lower[-1] = upper[-1] = 0.0
    return lower, upper


def _checked_values(name: str, values: tuple[float, ...]) -> NDArray[np.float64]:
    if len(values) != NUM_JOINTS or not np.all(np.isfinite(values)) or min(values) < 0:
        raise ModelError(f"{name} must be {NUM_JOINTS} numbers of 0 or more, one per joint")
    return np.array(values, dtype=np.float64)
