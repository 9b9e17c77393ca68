"""Compares a gravity-compensation file of the dVRK's controller for an MTM with a model."""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.errors import ModelError
from dvrk_drake.export.dvrk_mtm_gravity_compensation_file import (
    MTM_JOINTS,
    NUM_GRAVITY,
    NUM_JOINTS,
    GravityCompensationFile,
    controller_regressor,
    controller_torque,
    unclipped_torque,
)
from dvrk_drake.models.arm_files import known_arms
from dvrk_drake.models.files import Reportable

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
#: Number of random poses at which file and model are compared.
POSES = 20000


@dataclass(frozen=True)
class JointComparison:
    """Comparison of the torques of file and model on one joint, at rest and within the joint limits.

    Torques are in N m. Each share is a number of poses divided by the number of all poses. The sweep of the file is
    `GravityCompensationFile.sweep`.

    Attributes:
        name: Name of the joint.
        model_lower, model_upper: Range of the model's torque.
        file_lower, file_upper: Range of the file's torque before clipping.
        clip_lower, clip_upper: Torque limits of the file.
        clipped: Share of poses at which the torque of the file is clipped to a torque limit.
        opposed: Share of poses at which the clipped torque of the file and the torque of the model have opposite signs.
            Only poses at which both torques exceed `SIGN_SHARE` times the model's largest torque are counted.
        runaway: Share of poses at which the unclipped torque of the file is outside the model's torque range by more
            than half of the width of this range. 0 for the last joint, which has no torque in the file.
        polynomial: Largest magnitude of the file's polynomial in the joint position, without its constant term.
        rms_inside, rms_outside: RMS difference between the clipped torque of the file and the torque of the model, at
            poses inside and outside the file's sweep. Without a sweep, all poses are outside. NaN if no pose is inside
            or outside, respectively.
    """

    name: str
    model_lower: float
    model_upper: float
    file_lower: float
    file_upper: float
    clip_lower: float
    clip_upper: float
    clipped: float
    opposed: float
    runaway: float
    polynomial: float
    rms_inside: float
    rms_outside: float


@dataclass(frozen=True, eq=False)
class CompensationComparison(Reportable):
    """Comparison of the torques of a file and a model at random poses within the joint limits.

    Attributes:
        file, model: File and model that are compared.
        joints: One comparison per joint.
        q: Poses (m, 7) [rad], inside the joint box and the coupled limits.
        model_torque, file_torque, clipped_torque: Torques (m, 7) at rest [N m]. `file_torque` is not clipped.
        clipped, opposed, runaway: Masks (m, 7), True at the poses that `JointComparison` counts in the attribute of the
            same name.
        in_sweep: Mask (m,), True for poses at which the first six joints are inside the file's sweep.
        other_side: True if the mirror image of the model fits the file clearly better than the model. The file then
            probably belongs to an arm of the other side (left or right).
    """

    file: GravityCompensationFile
    model: IdentifiedModel
    joints: list[JointComparison]
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
        clips = [max(abs(joint.clip_lower), abs(joint.clip_upper)) for joint in self.joints]
        weak = [
            f"{joint.name} {clip:.3g} N m (effort limit {limit:.3g} N m)"
            for joint, clip, limit in zip(self.joints, clips, limits, strict=True)
            if clip > limit
        ]
        if weak:
            warnings.append(
                f"torque limits of the file are above the effort limits of the joints, so they do not protect the arm: "
                f"{', '.join(weak)}. Correct safe_lower_torque_limit and safe_upper_torque_limit"
            )
        return tuple(warnings)

    def as_dict(self) -> dict:
        """Returns the comparison as a dictionary for JSON, with None instead of NaN."""
        joints = [{k: None if v != v else v for k, v in asdict(j).items()} for j in self.joints]
        return {
            "poses": len(self.q),
            "other_side": self.other_side,
            "share_in_sweep": float(self.in_sweep.mean()),
            "joints": joints,
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
    q = arm.sample_poses(POSES, np.random.default_rng(0))
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
    polynomial = _polynomial_torque(file, q)
    error = tau_clipped - tau_model
    joints = [
        JointComparison(
            name=name,
            model_lower=float(tau_model[:, j].min()),
            model_upper=float(tau_model[:, j].max()),
            file_lower=float(tau_raw[:, j].min()),
            file_upper=float(tau_raw[:, j].max()),
            clip_lower=float(file.torque_lower[j]),
            clip_upper=float(file.torque_upper[j]),
            clipped=float(clipped[:, j].mean()),
            opposed=float(opposed[:, j].mean()),
            runaway=float(runaway[:, j].mean()),
            polynomial=float(np.abs(polynomial[:, j]).max()),
            rms_inside=_rms(error[in_sweep, j]),
            rms_outside=_rms(error[~in_sweep, j]),
        )
        for j, name in enumerate(arm.joint_names)
    ]
    return CompensationComparison(
        file,
        model,
        joints,
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
    return _rms((tau_file - tau_model)[:, _SIDE_JOINTS] / size)


def _polynomial_torque(file: GravityCompensationFile, q: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns the torque (m, 7) of the file's polynomials at rest, without their constant terms [N m]."""
    parameters = (file.positive + file.negative) / 2
    parameters[:NUM_GRAVITY] = 0.0
    parameters[NUM_GRAVITY::5] = 0.0
    return controller_regressor(q) @ parameters


def _rms(x: NDArray[np.float64]) -> float:
    return float(np.sqrt(np.mean(x**2))) if len(x) else float("nan")
