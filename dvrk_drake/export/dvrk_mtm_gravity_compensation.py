"""Gravity compensation formula of the dVRK's controller for a master arm, and its file from an identified model."""

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

#: Effects of a drive that remain at low sliding speed.
DRY_KINDS = ("coulomb", "presliding")
#: Gravity by which the controller multiplies its ten gravity columns [m/s^2].
CONTROLLER_GRAVITY = 9.81
NUM_GRAVITY = 10
ORDER = 4
#: Meaning of the first two columns at the shoulder.
_FIRST = ("cable sine", "cable cosine")
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
    """Entries of the controller's file that a model does not contain.

    Attributes:
        coulomb: Coulomb friction (7,) of each joint [N m], of which `friction_ratio` is compensated in motion.
        friction_ratio: Compensated share (7,), 0..1. Defaults to the values of dVRK files in use.
        dead_band, saturation: Speeds (7,) [rad/s]. Default to the values of dVRK files in use.
        tolerance: Accepted error [N m] of the approximation of the model by the file.
    """

    coulomb: tuple[float, ...] = (0.0,) * NUM_JOINTS
    friction_ratio: tuple[float, ...] = (0.8, 0.8, 0.8, 0.4, 0.6, 0.6, 0.0)
    dead_band: tuple[float, ...] = (0.02, 0.02, 0.02, 0.01, 0.008, 0.008, 0.01)
    saturation: tuple[float, ...] = (0.4, 0.2, 0.2, 0.4, 0.4, 0.2, 0.4)
    tolerance: float = 1e-6


def controller_regressor(q: ArrayLike) -> NDArray[np.float64]:
    """Returns the regressor R (m, 7, 40) at poses q (m, 7) [rad]. R times the parameters is a torque [N m].

    Source: sawIntuitiveResearchKit, robGravityCompensationMTM.
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
    """Returns the columns of 1, q, .. q^4 of a joint 0..5."""
    first = NUM_GRAVITY + (ORDER + 1) * joint
    return slice(first, first + ORDER + 1)


def unclipped_torque(file: GravityCompensationFile, q: ArrayLike, v: ArrayLike | None = None) -> NDArray[np.float64]:
    """Returns the torque (m, 7) [N m] of the file at poses q (m, 7) [rad], velocities v (m, 7) [rad/s] or at rest."""
    R = controller_regressor(q)
    v = np.zeros(R.shape[:2]) if v is None else np.atleast_2d(np.asarray(v, dtype=np.float64))
    share = np.clip((np.abs(v) - file.dead_band) / (file.saturation - file.dead_band), 0.0, 1.0)
    alpha = 0.5 + 0.5 * file.friction_ratio * share * np.sign(v)
    return alpha * (R @ file.positive) + (1.0 - alpha) * (R @ file.negative)


def controller_torque(file: GravityCompensationFile, q: ArrayLike, v: ArrayLike | None = None) -> NDArray[np.float64]:
    """Returns `unclipped_torque` limited to the file's range, as the controller applies it."""
    return np.clip(unclipped_torque(file, q, v), file.torque_lower, file.torque_upper)


def compensation_from_model(
    model: IdentifiedModel, options: CompensationOptions | None = None
) -> GravityCompensationFile:
    """Converts a model to the file of the controller.

    The ten columns span the gravity of an upright MTM whose last link is balanced about its axis. They follow exactly
    from the base parameters. The additional gravity of a tilted base is approximated by polynomials in the joint
    positions. The offset of a joint is its constant, and the cable torque of the shoulder uses the first two columns.
    Other effects are approximated by polynomials over the joint's range. Torque limits are the required range over the
    joint box plus a tenth, at most the arm's effort limits. Joint 7 has no torque.

    Raises:
        ModelError: The model is not of an MTM, options have the wrong length, or the error exceeds `options.tolerance`.
    """
    options = options or CompensationOptions()
    arm = model.arm
    if arm.joint_names != MTM_JOINTS:
        raise ModelError(f"{arm.name}: the controller's gravity-compensation file is one of an MTM; joints differ")
    check_tolerance(options.tolerance)
    poses = arm.sample_poses(20000, np.random.default_rng(0))
    gravity, effects = _gravity_parameters(model, poses[:4000]), _effect_parameters(model, arm)
    _refuse_errors(model, gravity, effects, poses[:4000], options.tolerance)
    parameters = gravity + effects
    coulomb = _seven("coulomb", options.coulomb)
    friction = np.zeros(NUM_PARAMETERS)
    friction[[polynomial_columns(j).start for j in range(NUM_JOINTS - 1)]] = coulomb[:-1]
    needed = controller_regressor(poses) @ parameters
    lower, upper = _torque_limits(arm, needed.min(axis=0) - coulomb, needed.max(axis=0) + coulomb)
    file = GravityCompensationFile(
        positive=parameters + friction,
        negative=parameters - friction,
        torque_lower=lower,
        torque_upper=upper,
        dead_band=_seven("dead_band", options.dead_band),
        saturation=_seven("saturation", options.saturation),
        friction_ratio=_seven("friction_ratio", options.friction_ratio),
    )
    file.check()
    return file


def dry_friction(model: IdentifiedModel) -> tuple[float, ...]:
    """Returns the Coulomb friction [N m] of each joint when it moves alone, from the effects of the model's dynamics.

    Smoothed Coulomb terms and presliding elements, which friction is once they slip, add up; along a coordinate of the
    drive that several joints move, each of them has its share.

    Raises:
        ModelError: The model has no dynamics.
    """
    if model.dynamics is None:
        raise ModelError("the model has no dynamics, so it has no friction; give it with --coulomb")
    arm = model.arm
    friction = np.zeros(arm.num_joints)
    for effect in model.dynamics.effects:
        if effect.kind in DRY_KINDS:
            friction += effect.coefficient * np.abs(joint_row(arm, effect.coordinate))
    return tuple(float(f) for f in friction)


def largest_differences(file: GravityCompensationFile, model: IdentifiedModel) -> NDArray[np.float64]:
    """Returns the largest differences (7,) [N m] between the torques of file and model at rest over the joint box."""
    poses = model.arm.sample_poses(4000, np.random.default_rng(1))
    return np.asarray(np.abs(controller_torque(file, poses) - model.holding_torque(poses)).max(axis=0))


def _gravity_torque(model: IdentifiedModel, q: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns the gravity torque (m, 7) of the base parameters, including the feedforward scale."""
    beta = np.array([p.value for p in model.base_parameters])
    return np.asarray(model.feedforward_scale * (model.static_model.regressor(q)[:, :, : len(beta)] @ beta))


def _gravity_parameters(model: IdentifiedModel, poses: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns the parameters (40,), with the ten gravity columns fitted over full turns of all joints.

    The residual, which is small unless the base is tilted, is approximated by polynomials over the joint box.
    """
    q = np.random.default_rng(0).uniform(-np.pi, np.pi, (400, NUM_JOINTS))
    R = controller_regressor(q)[:, :, :NUM_GRAVITY]
    solution = np.linalg.lstsq(R.reshape(-1, NUM_GRAVITY), _gravity_torque(model, q).ravel(), rcond=None)[0]
    parameters = np.concatenate([solution, np.zeros(NUM_PARAMETERS - NUM_GRAVITY)])
    R = controller_regressor(poses)
    left = _gravity_torque(model, poses) - R @ parameters
    for joint in range(NUM_JOINTS - 1):
        columns = polynomial_columns(joint)
        parameters[columns] = np.linalg.lstsq(R[:, joint, columns], left[:, joint], rcond=None)[0]
    return parameters


def _effect_parameters(model: IdentifiedModel, arm: Arm) -> NDArray[np.float64]:
    parameters = np.zeros(NUM_PARAMETERS)
    for estimate in model.holding_effects:
        row = joint_row(arm, estimate.coordinate)
        # The file has nothing for the last joint, nor for what moves with two: _refuse_errors measures what that costs.
        for joint in map(int, np.flatnonzero(row[:-1])):
            value = float(model.feedforward_scale[joint] * estimate.coefficient * row[joint])
            if estimate.kind == "offset":
                parameters[polynomial_columns(joint).start] += value
            elif np.count_nonzero(row) > 1:
                continue
            elif joint == 1 and estimate.scale == 1.0 and estimate.kind in _FIRST:
                parameters[_FIRST.index(estimate.kind)] += value / CONTROLLER_GRAVITY
            else:
                parameters[polynomial_columns(joint)] += value * _best_polynomial(
                    ActuatorEffect.of(estimate), arm, joint
                )
    return parameters


def _best_polynomial(effect: ActuatorEffect, arm: Arm, joint: int) -> NDArray[np.float64]:
    """Returns coefficients (5,) of 1 .. q^4 that approximate an effect over a joint's range, nearly minimax."""
    lower, upper = arm.position_lower[joint], arm.position_upper[joint]

    middle, half = (lower + upper) / 2, (upper - lower) / 2
    x = chebyshev.chebpts1(ORDER + 1)
    along = position_along(arm, effect.coordinate, (middle + half * x)[:, None] * np.eye(NUM_JOINTS)[joint])
    series = chebyshev.chebfit(x, effect.column(along, 0 * along), ORDER)
    polynomial = Polynomial(chebyshev.cheb2poly(series))(Polynomial([-middle / half, 1 / half]))
    return np.resize(np.append(polynomial.coef, np.zeros(ORDER + 1)), ORDER + 1)


def _refuse_errors(
    model: IdentifiedModel,
    gravity: NDArray[np.float64],
    effects: NDArray[np.float64],
    poses: NDArray[np.float64],
    tolerance: float,
) -> None:
    """Raises ModelError with the errors of the gravity and effect parameters (40,) over the joint box."""
    R, tau = controller_regressor(poses), _gravity_torque(model, poses)
    gravity_off = np.abs(R @ gravity - tau).max(axis=0)
    effects_off = np.abs(R @ effects - (model.holding_torque(poses) - tau)).max(axis=0)
    error = np.abs(R @ (gravity + effects) - model.holding_torque(poses)).max(axis=0)
    if not error.max() > tolerance:
        return
    least = min(tolerance, 1e-6)
    off = ", ".join(f"{name} {e:.2g}" for name, e in zip(MTM_JOINTS, error, strict=True) if e > least)
    down = model.arm.gravity
    lean = float(np.rad2deg(np.arccos(np.clip(-down[2] / np.linalg.norm(down), -1.0, 1.0))))
    limits = ["a last link balanced about its roll axis"]
    if lean > 0.05:
        limits.append(f"an upright base, here tilted by {lean:.1f} deg")
    if np.any((model.feedforward_scale != 0) & (model.feedforward_scale != 1)):
        limits.append("no feedforward scale below 1")
    reasons = {
        f"gravity {gravity_off.max():.2g} (the file supports {', '.join(limits)})": gravity_off.max(),
        f"effects {effects_off.max():.2g} (it supports polynomials of order 4 in a joint's own position, nothing at "
        "joint 7)": effects_off.max(),
    }
    raise ModelError(
        "the controller's file cannot hold this model: over the joint box it would be off by up to "
        f"{off} N m. Of that: {', '.join(reason for reason, size in reasons.items() if size > least)}. "
        f"{_estimates_note(model)}To accept it, repeat the command with --gc-tolerance {round_up(error.max()):g}"
    )


def _estimates_note(model: IdentifiedModel) -> str:
    """Returns a note for a model that was not identified and uses estimated masses."""
    if model.provenance.method != "nominal":
        return ""
    return (
        "The masses are estimates of the SDF, not of your arm: better identify it first (dvrk-drake identify) and "
        "export that model. "
    )


def check_tolerance(tolerance: float) -> None:
    """Raises ModelError unless the tolerance is a non-negative number."""
    if not 0 <= tolerance < np.inf:
        raise ModelError(f"--gc-tolerance is {tolerance:g}; allowed: a number of N m from 0")


def round_up(x: float) -> float:
    """Returns x rounded up to two digits."""
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


def _seven(name: str, values: tuple[float, ...]) -> NDArray[np.float64]:
    if len(values) != NUM_JOINTS or not np.all(np.isfinite(values)) or min(values) < 0:
        raise ModelError(f"{name} must be {NUM_JOINTS} numbers of 0 or more, one per joint")
    return np.array(values, dtype=np.float64)
