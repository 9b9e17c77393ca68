"""Converts a model of an MTM to the gravity-compensation file of the dVRK controller, and compares file and model."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.polynomial import Polynomial, chebyshev
from numpy.typing import NDArray

from dvrk_drake.dynamics.actuator_effects import ActuatorEffect, joint_row, position_along
from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.errors import ModelError
from dvrk_drake.export.dvrk_mtm_gravity_compensation_file import (
    CONTROLLER_GRAVITY,
    MTM_JOINTS,
    NUM_GRAVITY,
    NUM_JOINTS,
    NUM_PARAMETERS,
    ORDER,
    GravityCompensationFile,
    controller_regressor,
    controller_torque,
    polynomial_columns,
    unclipped_torque,
)
from dvrk_drake.export.gravity_compensation_loss import CompensationLoss, accepted_differences, make_loss
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.arm_files import known_arms
from dvrk_drake.models.effects_schema import EFFECT_KINDS, DriveEffect
from dvrk_drake.models.files import Reportable

#: Number of random poses at which the torques of file and model are compared.
POSES = 20000


@dataclass(frozen=True)
class CompensationOptions:
    """Entries of the gravity-compensation file that a model does not contain, and the largest accepted difference.

    Attributes:
        coulomb: Coulomb friction (7,) of the joints [N m].
        friction_ratio: Share of the Coulomb friction to compensate on each joint (7,) during a motion, 0 to 1.
        dead_band, saturation: Speeds (7,) [rad/s], see `GravityCompensationFile`. The default values come from
            gravity-compensation files of the dVRK.
        tolerance: Largest accepted difference between the torques of the file and of the model on any joint [N m].
            None: the dry friction of each joint, see `gravity_compensation_loss.accepted_differences`, and no limit at
            joint 7, because the controller applies no torque there.
    """

    coulomb: tuple[float, ...] = (0.0,) * NUM_JOINTS
    friction_ratio: tuple[float, ...] = (0.8, 0.8, 0.8, 0.4, 0.6, 0.6, 0.0)
    dead_band: tuple[float, ...] = (0.02, 0.02, 0.02, 0.01, 0.008, 0.008, 0.01)
    saturation: tuple[float, ...] = (0.4, 0.2, 0.2, 0.4, 0.4, 0.2, 0.4)
    tolerance: float | None = None


def compensation_from_model(
    model: IdentifiedModel, options: CompensationOptions | None = None
) -> GravityCompensationFile:
    """Converts a model to a gravity-compensation file of the controller.

    The ten gravity columns of `controller_regressor` represent the gravity torque exactly if the MTM is upright and its
    last link is balanced about the roll axis. Polynomials in the joint positions approximate the additional gravity
    torque of a tilted base. The constant term of each joint's polynomial represents the offset torque of this joint.
    The first two columns represent the cable torque of shoulder_pitch. Polynomials approximate all other effects that
    depend on the position of a joint.

    The torque limits are the range of the torque within the joint limits, including Coulomb friction. This range is
    extended by 10 % of its width at both ends, up to the effort limits of the arm. The torque limits of joint 7 and of
    joints with a feedforward scale of 0 are zero.

    Raises:
        ModelError: The model is not of an MTM, an option is invalid, or a torque difference exceeds
            `options.tolerance`.
    """
    options = options or CompensationOptions()
    arm = model.arm
    if arm.joint_names != MTM_JOINTS:
        raise ModelError(
            f"{arm.name} is not an MTM. The format dvrk-gc supports only an MTM; for a PSM, use dvrk-kinematic-gc"
        )
    tolerance = accepted_differences(arm, options.tolerance)
    if options.tolerance is None:
        # The controller applies no torque at joint 7, with or without a file.
        tolerance[-1] = np.inf
    poses = _poses(arm)
    parameters = sum((part.parameters for part in model_parts(model, poses)), np.zeros(NUM_PARAMETERS))
    coulomb = _checked_values("coulomb", options.coulomb)
    friction = np.zeros(NUM_PARAMETERS)
    friction[[polynomial_columns(j).start for j in range(NUM_JOINTS - 1)]] = coulomb[:-1]
    torque = controller_regressor(poses) @ parameters
    lower, upper = _torque_limits(arm, torque.min(axis=0) - coulomb, torque.max(axis=0) + coulomb)
    off = model.feedforward_scale == 0
    off[-1] = True
    file = GravityCompensationFile(
        positive=parameters + friction,
        negative=parameters - friction,
        torque_lower=np.where(off, 0.0, lower),
        torque_upper=np.where(off, 0.0, upper),
        dead_band=_checked_values("dead_band", options.dead_band),
        saturation=_checked_values("saturation", options.saturation),
        friction_ratio=_checked_values("friction_ratio", options.friction_ratio),
    )
    file.check()
    compensation_loss(file, model).check(tolerance)
    return file


def compensation_loss(file: GravityCompensationFile, model: IdentifiedModel) -> CompensationLoss:
    """Returns the largest torque differences between a file and the model from which it was computed, at rest.

    The torque of the model is limited to the effort limits of the arm, because its motors cannot apply more.
    """
    arm = model.arm
    poses = _poses(arm)
    expected = np.clip(model.holding_torque(poses), -arm.effort_limits, arm.effort_limits)
    regressor = controller_regressor(poses)
    causes = {part.cause: regressor @ part.parameters - part.torque for part in model_parts(model, poses)}
    return make_loss(arm, poses, controller_torque(file, poses) - expected, causes)


def _poses(arm: Arm) -> NDArray[np.float64]:
    return arm.sample_poses(POSES, np.random.default_rng(0))


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
        if EFFECT_KINDS[effect.kind].symmetric:
            friction += effect.coefficient * np.abs(joint_row(arm, effect.coordinate))
    return tuple(float(f) for f in friction)


def _torque_limits(
    arm: Arm, least: NDArray[np.float64], most: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    margin = 0.1 * (most - least)
    lower = np.clip(least - margin, -arm.effort_limits, arm.effort_limits)
    upper = np.clip(most + margin, -arm.effort_limits, arm.effort_limits)
    return lower, upper


def _checked_values(name: str, values: tuple[float, ...]) -> NDArray[np.float64]:
    if len(values) != NUM_JOINTS or not np.all(np.isfinite(values)) or min(values) < 0:
        raise ModelError(f"{name} must be {NUM_JOINTS} numbers of 0 or more, one per joint")
    return np.array(values, dtype=np.float64)


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


#: Factors (7,) that convert joint positions and torques of an arm to those of its mirror image. The wrists of MTML and
#: MTMR are mirror images.
_MIRROR = np.array([-1.0, 1.0, 1.0, -1.0, 1.0, -1.0, -1.0])
#: Joints with different torques on MTML and MTMR: shoulder_pitch, elbow_pitch and wrist_platform.
_SIDE_JOINTS = slice(1, 4)
#: Ratio below which the mirror image of the model fits clearly better: error of the mirror image / error of the model.
#: For the four public files of MTMs, the error of a model of the wrong side is 1.8 to 2.1 times the error of a model of
#: the correct side.
_MAX_ERROR_RATIO = 0.8
#: Smallest number of poses inside the file's sweep. If fewer poses are inside, model and mirror image are compared at
#: all poses.
_MIN_POSES = 200
#: Smallest torque whose sign is compared, divided by the model's largest torque on the same joint.
SIGN_SHARE = 0.1


@dataclass(frozen=True, eq=False)
class CompensationComparison(Reportable):
    """Comparison of the torques of a file and a model at random poses within the joint limits.

    Attributes:
        file, model: File and model that are compared.
        q: Poses (m, 7) [rad], inside the joint box and the coupled limits.
        model_torque, file_torque, clipped_torque: Torques (m, 7) at rest [N m]. `file_torque` is not clipped to the
            torque limits of the file.
        clipped: Mask (m, 7), True where the torque of the file is clipped to a torque limit.
        opposed: Mask (m, 7), True where the clipped torque of the file and the torque of the model have opposite signs,
            and both exceed `SIGN_SHARE` times the model's largest torque. False for the last joint.
        runaway: Mask (m, 7), True where the unclipped torque of the file is outside the model's torque range by more
            than half of the width of this range. False for the last joint, which has no torque in the file.
        in_sweep: Mask (m,), True for poses at which the first six joints are inside the file's sweep.
        other_side: True if the mirror image of the model fits the file clearly better than the model. The file then
            probably belongs to an arm of the other side (left or right).
    """

    file: GravityCompensationFile
    model: IdentifiedModel
    q: NDArray[np.float64]
    model_torque: NDArray[np.float64]
    file_torque: NDArray[np.float64]
    clipped_torque: NDArray[np.float64]
    clipped: NDArray[np.bool_]
    opposed: NDArray[np.bool_]
    runaway: NDArray[np.bool_]
    in_sweep: NDArray[np.bool_]
    other_side: bool

    @property
    def warnings(self) -> tuple[str, ...]:
        """Warnings about the file."""
        warnings = []
        if self.other_side:
            warnings.append(
                "the mirror image of the model fits better than the model. The file probably belongs to an arm of the "
                f"other side (left or right), not to {self.model.arm.name}. Check ARM_NAME and the serial number"
            )
        limits = self.model.arm.effort_limits
        clips = np.maximum(np.abs(self.file.torque_lower), np.abs(self.file.torque_upper))
        weak = [
            f"{MTM_JOINTS[j]} {clips[j]:.3g} N m (effort limit {limits[j]:.3g} N m)"
            for j in np.flatnonzero(clips > limits)
        ]
        if weak:
            warnings.append(
                f"torque limits of the file are above the effort limits of the joints, so they do not protect the arm: "
                f"{', '.join(weak)}. Correct safe_lower_torque_limit and safe_upper_torque_limit"
            )
        return tuple(warnings)

    def rms_difference(self, chosen: NDArray[np.bool_]) -> NDArray[np.float64]:
        """Returns the RMS differences (7,) of the torques at the poses in a mask (m,) [N m], NaN if there are none."""
        error = (self.clipped_torque - self.model_torque)[chosen]
        return np.sqrt(np.mean(error**2, axis=0)) if len(error) else np.full(NUM_JOINTS, np.nan)

    def as_dict(self) -> dict:
        """Returns the comparison as a dictionary for JSON, with None instead of NaN. Shares are those of the poses."""
        columns = {
            "model_lower": self.model_torque.min(axis=0),
            "model_upper": self.model_torque.max(axis=0),
            "file_lower": self.file_torque.min(axis=0),
            "file_upper": self.file_torque.max(axis=0),
            "clip_lower": self.file.torque_lower,
            "clip_upper": self.file.torque_upper,
            "clipped": self.clipped.mean(axis=0),
            "opposed": self.opposed.mean(axis=0),
            "runaway": self.runaway.mean(axis=0),
            "rms_inside": self.rms_difference(self.in_sweep),
            "rms_outside": self.rms_difference(~self.in_sweep),
        }
        numbers = {key: [None if np.isnan(x) else float(x) for x in values] for key, values in columns.items()}
        return {
            "poses": len(self.q),
            "other_side": self.other_side,
            "share_in_sweep": float(self.in_sweep.mean()),
            "joints": [{"name": name} | {k: x[j] for k, x in numbers.items()} for j, name in enumerate(MTM_JOINTS)],
        }


def compare_compensation(file: GravityCompensationFile, model: IdentifiedModel) -> CompensationComparison:
    """Compares the torques of file and model at random poses, which are uniformly distributed within the joint limits.

    Raises:
        ModelError: The model is not of an MTM, or the file belongs to another arm.
    """
    arm = model.arm
    arm.refuse_locked_joints("a comparison")
    if arm.joint_names != MTM_JOINTS:
        raise ModelError(f"{arm.name} is not an MTM; only the gravity-compensation file of an MTM can be compared")
    known = [name.upper() for name in known_arms()]
    if file.arm_name.upper() != arm.name.upper() and {file.arm_name.upper(), arm.name.upper()} <= set(known):
        raise ModelError(
            f"the file belongs to {file.arm_name} (ARM_NAME or file name), but the model belongs to {arm.name}. "
            f"Use a model of {file.arm_name}, or correct ARM_NAME in the file"
        )
    q = _poses(arm)
    tau_model, tau_raw, tau_clipped = model.holding_torque(q), unclipped_torque(file, q), controller_torque(file, q)
    half_range = 0.5 * np.ptp(tau_model, axis=0)
    threshold = SIGN_SHARE * np.abs(tau_model).max(axis=0)
    clipped = tau_raw != tau_clipped
    opposed = (tau_model * tau_clipped < 0) & (np.abs(tau_model) > threshold) & (np.abs(tau_clipped) > threshold)
    runaway = (tau_raw < tau_model.min(axis=0) - half_range) | (tau_raw > tau_model.max(axis=0) + half_range)
    # Excluded: joints without gravity torque, and the last joint, which the file does not compensate.
    compared = (half_range > 1e-9) & (np.arange(NUM_JOINTS) < NUM_JOINTS - 1)
    runaway, opposed = runaway & compared, opposed & compared
    in_sweep = np.zeros(len(q), dtype=bool)
    if file.sweep is not None:
        # The torque of the file does not depend on the position of the last joint.
        in_sweep = np.all(
            (q >= file.sweep[0]) & (q <= file.sweep[1]), axis=1, where=np.arange(NUM_JOINTS) < NUM_JOINTS - 1
        )
    return CompensationComparison(
        file,
        model,
        q,
        tau_model,
        tau_raw,
        tau_clipped,
        clipped,
        opposed,
        runaway,
        in_sweep,
        other_side=_is_of_other_side(model, q, tau_clipped, in_sweep),
    )


def _is_of_other_side(
    model: IdentifiedModel, q: NDArray[np.float64], tau_file: NDArray[np.float64], in_sweep: NDArray[np.bool_]
) -> bool:
    """Returns whether the mirror image of the model fits the torque of a file clearly better than the model.

    If at least `_MIN_POSES` poses are inside the file's sweep, only these poses are compared.
    """
    if np.count_nonzero(in_sweep) >= _MIN_POSES:
        q, tau_file = q[in_sweep], tau_file[in_sweep]
    unmirrored, mirrored = model.holding_torque(q), _MIRROR * model.holding_torque(_MIRROR * q)
    return _side_error(tau_file, mirrored) < _MAX_ERROR_RATIO * _side_error(tau_file, unmirrored)


def _side_error(tau_file: NDArray[np.float64], tau_model: NDArray[np.float64]) -> float:
    """Returns the RMS torque error of `_SIDE_JOINTS`. Each joint's error is divided by its RMS torque in the file."""
    size = np.sqrt(np.mean(tau_file[:, _SIDE_JOINTS] ** 2, axis=0)) + 1e-12
    return float(np.sqrt(np.mean(((tau_file - tau_model)[:, _SIDE_JOINTS] / size) ** 2)))
