"""Validates a model on a recording that was not used for the identification, and predicts efforts."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from dvrk_drake.analysis.check.recording_check import require_usable, with_power
from dvrk_drake.analysis.motion_validation import (
    DynamicValidation,
    find_other_robot,
    predict_motion,
    validate_motion,
)
from dvrk_drake.analysis.observations.finding import Finding
from dvrk_drake.analysis.observations.observations import Observations
from dvrk_drake.analysis.observations.static_poses import MIN_POSES
from dvrk_drake.analysis.pose_validation import StaticValidation, predict_static, validate_static
from dvrk_drake.analysis.results import Prediction
from dvrk_drake.analysis.verdict import unexplained_effort
from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.errors import RecordingError
from dvrk_drake.progress import Progress, step_progress
from dvrk_drake.recordings.recording import MAX_PERIOD, MIN_ROWS, FileCoordinates, Recording, file_transmission


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
