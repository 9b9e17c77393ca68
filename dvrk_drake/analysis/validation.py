"""Validates a model on a recording that was not used for the identification, and predicts efforts of recordings."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.analysis.check.recording_check import require_usable, with_power
from dvrk_drake.analysis.estimation.robust_fit import rms
from dvrk_drake.analysis.motion_identification import DynamicIdentification
from dvrk_drake.analysis.motion_validation import (
    DynamicValidation,
    filtered_efforts,
    find_other_robot,
    predict_motion,
    validate_motion,
)
from dvrk_drake.analysis.observations.finding import Finding
from dvrk_drake.analysis.observations.observations import Observations
from dvrk_drake.analysis.observations.static_poses import (
    MIN_POSES,
    ExcludedMeasurement,
    check_effort_unit,
    find_excluded,
    usable_measurements,
)
from dvrk_drake.analysis.results import (
    NEGLIGIBLE,
    Identification,
    JudgedError,
    Prediction,
    Validation,
    coverage,
    judge,
    rule_text,
    tolerances,
    unexplained_effort,
)
from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.errors import ModelError, RecordingError
from dvrk_drake.progress import Progress, step_progress
from dvrk_drake.recordings.recording import MAX_PERIOD, MIN_ROWS, FileCoordinates, Recording, file_transmission


@dataclass(frozen=True, kw_only=True)
class JointError(JudgedError):
    """RMS torque error of one joint over a recording, in the coordinates of the recording.

    Attributes with the suffix `_included` omit the excluded measurements.

    Attributes:
        rms_torque: RMS measured torque [N m, N if prismatic]. It is also the RMS error of zero torque.
        rms_error: RMS of measured minus predicted torque [N m, N if prismatic].
        relative_error: rms_error / rms_torque [1], None if rms_torque is 0.
        rms_torque_included: RMS measured torque of the included measurements [N m, N if prismatic].
        rms_error_included: RMS error of the included measurements [N m, N if prismatic].
        relative_error_included: rms_error_included / rms_torque_included [1], None if rms_torque_included is 0.
        num_excluded: Number of measurements that are excluded because the joint is at a stop or the effort is beyond
            its limit.
    """

    rms_torque: float
    rms_error: float
    relative_error: float | None
    rms_torque_included: float
    rms_error_included: float
    relative_error_included: float | None
    num_excluded: int

    @property
    def judged_error(self) -> float | None:
        """Relative error for the verdict, without the excluded measurements."""
        return self.relative_error_included


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class StaticValidation(Validation):
    """Errors of the holding torques of a model at the poses of a recording.

    Attributes:
        joints: Errors of the joints, in the arm's order.
        poses: Number of poses.
        residuals: Measured minus predicted efforts (m, n), in the coordinates of the recording [N m, N].
        excluded: Measurements that the verdicts do not use, and the reasons for the exclusion.
        usable: Mask (m, n) of the efforts that are not excluded, in the coordinates of the recording.
    """

    joints: list[JointError]
    poses: int
    residuals: NDArray[np.float64]
    excluded: list[ExcludedMeasurement]
    usable: NDArray[np.bool_]

    @property
    def errors(self) -> list[JointError]:
        """Errors of the joints."""
        return self.joints

    def as_dict(self) -> dict:
        """Returns the output of `validate --json` as a dictionary."""
        return {
            "verdict": self.verdict,
            "rule": rule_text(),
            "joints": [asdict(joint) for joint in self.joints],
            "poses": self.poses,
            "excluded": [{"where": measurement.where, "reason": measurement.reason} for measurement in self.excluded],
        }


def predict_static(
    model: IdentifiedModel, recording: Recording, coordinates: FileCoordinates | None = None
) -> NDArray[np.float64]:
    """Returns the predicted holding torques (m, n) at the poses of a recording [N m, N].

    Args:
        model: Identified model.
        recording: Poses.
        coordinates: Coordinates of the torques. Default: those of the recording.

    Raises:
        RecordingError: The recording does not fit the model's arm.
    """
    arm = model.arm
    recording.check_fits(arm)
    tau = model.holding_torque(recording.in_joint_coordinates(arm).q)
    # tau_joint = J' tau_file, so the inverse map transforms efforts from joints to the coordinates of the file.
    return file_transmission(arm, coordinates or recording.coordinates).inverse.pull_back_effort(tau)


def validate_static(model: IdentifiedModel, recording: Recording) -> StaticValidation:
    """Compares a model's holding torques with a recording.

    Args:
        model: Identified model.
        recording: Poses with efforts, in joint or actuator coordinates.

    Raises:
        RecordingError: The recording does not fit the model's arm, or has no efforts.
    """
    arm = model.arm
    measured = recording.measured_effort()
    predicted = predict_static(model, recording)
    residuals = measured - predicted
    in_joints = recording.in_joint_coordinates(arm)
    check_effort_unit(in_joints, arm)
    excluded = find_excluded(in_joints, arm)
    usable = usable_measurements(measured.shape, excluded)
    if recording.coordinates == "actuator":
        # An excluded measurement of a joint excludes the measurements of all actuators that drive the joint.
        usable = ~((~usable) @ (arm.transmission.matrix.T != 0))
    usable = usable & ~recording.unmeasured
    covered = coverage(arm, np.ptp(in_joints.q, axis=0), recording.coordinates)
    joints = []
    for j, (name, tolerance) in enumerate(zip(arm.joint_names, tolerances(arm, recording.coordinates), strict=True)):
        use = usable[:, j]
        torque, error = rms(measured[:, j]), rms(residuals[:, j])
        torque_used, error_used = rms(measured[use, j]), rms(residuals[use, j])
        is_negligible = rms(predicted[:, j]) <= NEGLIGIBLE * tolerance.friction and error_used <= tolerance.friction
        commanded = bool(np.any(predicted[:, j])) and not is_negligible
        joints.append(
            JointError(
                name=name,
                rms_torque=torque,
                rms_error=error,
                relative_error=error / torque if torque > 0 else None,
                rms_torque_included=torque_used,
                rms_error_included=error_used,
                relative_error_included=error_used / torque_used if torque_used > 0 else None,
                num_excluded=int(np.sum(~use)),
                coverage=float(covered[j]),
                verdict=judge(torque_used, error_used, tolerance, float(covered[j]), commanded=commanded),
            )
        )
    return StaticValidation(
        model=model,
        recording=recording,
        joints=joints,
        poses=len(recording),
        residuals=residuals,
        excluded=excluded,
        usable=usable,
    )


def validate(
    model: IdentifiedModel, recording: Recording, *, progress: Progress | None = None
) -> StaticValidation | DynamicValidation:
    """Compares a model's efforts with the efforts of a recording, as `dvrk-drake validate` does.

    For a motion and a model with dynamics, efforts are compared after the low-pass filter of the identification.
    Otherwise, holding torques are compared.

    Args:
        model: Model from `identify` or `IdentifiedModel.load`.
        recording: Poses or a motion with efforts (m, n), not used for the identification of the model.
        progress: Callback that receives the name of the step ("checking the recording" or "validating") and the
            finished share of the step (0 to 1).

    Returns:
        Result with the `verdicts` and `relative_errors` of the joints, the least favourable `verdict`, `warnings`, and
        detailed errors.

    Raises:
        RecordingError: The recording does not fit the model's arm, or `check` rejects the recording. The attribute
            `findings` of the error contains the reasons. Or the arm moves, but the model has no dynamics.

    Example:
        >>> import dvrk_drake as dvrk, numpy as np
        >>> arm = dvrk.load_arm("psm")
        >>> model = dvrk.IdentifiedModel.from_arm(arm)
        >>> q = arm.sample_poses(20, np.random.default_rng(0))
        >>> errors = dvrk.validate(model, dvrk.Recording(q=q, tau=1.1 * model.holding_torque(q)))
        >>> errors.verdict, round(errors.relative_errors["pitch"], 3)
        ('good', 0.091)
    """
    arm = model.arm
    recording, dropped = with_power(recording, arm)
    poses = Observations.for_model(recording, model).poses()
    report = require_usable(poses.observations, progress)
    share = step_progress(progress, "validating")
    share(0.0)
    validation: StaticValidation | DynamicValidation
    if poses.moves and model.dynamics is not None:
        validation = validate_motion(model, poses.observations)
        errors = validation.relative_errors
        found = unexplained_effort({name: errors[name] for name, v in validation.verdicts.items() if v == "do not use"})
        found += find_other_robot(validation)
    else:
        _refuse_motion(model, poses.recording)
        validation = validate_static(model, poses.recording)
        found = ()
    share(1.0)
    if validation.of_same_recording:
        what = "the model was identified from this recording, so the errors are those of the fit"
        found += (Finding("warning", "same recording", report.source, what, "Validate with another recording."),)
    return replace(validation, warnings=(*dropped, *report.warnings, *found), note=poses.note)


def _refuse_motion(model: IdentifiedModel, recording: Recording) -> None:
    """Raises RecordingError if the arm moves, because holding torques can be compared only at rest."""
    if motion := recording.motion(model.arm):
        why = "the model is static: it has no inertia and no friction"
        if model.dynamics is not None:
            why = f"it is no motion for a dynamic model: {MIN_ROWS} rows with t, less than {MAX_PERIOD} s apart"
        raise RecordingError(
            f"{recording.source or 'recording'}: the arm moves ({motion}), but {why}. Validate with poses at rest, "
            f"or with a recording that has at least {MIN_POSES} static poses."
        )


def predict(
    model: IdentifiedModel,
    recording: Recording,
    *,
    coordinates: FileCoordinates | None = None,
    progress: Progress | None = None,
) -> Prediction:
    """Predicts the efforts at the rows of a recording, as `dvrk-drake predict` does.

    Args:
        model: Model from `identify` or `IdentifiedModel.load`.
        recording: Poses or a motion. Efforts are not required.
        coordinates: Coordinates of the result: "joint", "actuator" or "wpi". Default: those of the recording.
        progress: Callback that receives the name of the step ("checking the recording" or "predicting") and the
            finished share of the step (0 to 1).

    Returns:
        Result with efforts `tau` (m, n) [N m, N] in these coordinates, and `warnings`. For a motion and a model with
        dynamics, `tau` contains the total motor efforts after the low-pass filter of the identification, and
        `half_width` the half widths of their 95 % prediction intervals, also for another day than that of the recording
        of the model (`half_width_other_day`). Otherwise, `tau` contains holding torques.

    Raises:
        RecordingError: The recording does not fit the model's arm, or `check` rejects the recording. The attribute
            `findings` of the error contains the reasons.

    Example:
        >>> import dvrk_drake as dvrk, numpy as np
        >>> arm = dvrk.load_arm("mtml")
        >>> model = dvrk.IdentifiedModel.from_arm(arm)
        >>> q = arm.sample_poses(3, np.random.default_rng(0))
        >>> dvrk.predict(model, dvrk.Recording(q=q)).tau.shape
        (3, 7)
    """
    arm = model.arm
    # The checks require efforts, so zeros replace missing efforts.
    measured = recording if recording.tau is not None else replace(recording, tau=np.zeros_like(recording.q))
    observations = Observations.for_model(measured, model)
    moves = observations.poses().moves
    if model.dynamics is None or not moves:
        step_progress(progress, "predicting")(0.0)
        return Prediction(predict_static(model, recording, coordinates))
    report = require_usable(observations, progress, ignored_kind="no effort" if recording.tau is None else "")
    share = step_progress(progress, "predicting")
    share(0.0)
    to_actuator = arm.transmission.matrix @ file_transmission(arm, coordinates or recording.coordinates).inverse.matrix
    tau = predict_motion(model, observations) @ to_actuator
    widths = [model.dynamic_model.combined_half_width(to_actuator.T, other_day=day) for day in (False, True)]
    same_day, other_day = (width if np.all(width > 0) else None for width in widths)
    share(1.0)
    return Prediction(tau, same_day, other_day, report.warnings)


def baseline_efforts(
    result: Identification | Validation, previous: IdentifiedModel | None = None
) -> dict[str, NDArray[np.float64]]:
    """Returns the efforts (r, n) that other models predict for the (first) recording of a result [N m, N].

    The rows and the coordinates are those of the measured efforts of the result.

    Args:
        result: Result for static poses or for a motion.
        previous: Previous model of the arm, or None.

    Returns:
        Mapping from "SDF" and, with a previous model, "previous" to efforts.

    Raises:
        ModelError: The previous model belongs to another arm, or has no dynamics for a motion.
    """
    arm = result.model.arm
    if previous is not None and previous.arm.name != arm.name:
        raise ModelError(f"the previous model belongs to {previous.arm.name}, the recording to {arm.name}")
    is_motion = isinstance(result, DynamicIdentification | DynamicValidation)
    models = {"SDF": IdentifiedModel.from_arm(arm, dynamics=is_motion)}
    if previous is not None:
        models["previous"] = previous
    if isinstance(result, DynamicIdentification | DynamicValidation):
        grid = result.motions[0].grid if isinstance(result, DynamicIdentification) else result.grid
        return {name: filtered_efforts(model, grid) for name, model in models.items()}
    return {name: predict_static(model, result.recording) for name, model in models.items()}
