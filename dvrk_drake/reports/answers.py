"""States the result of an identification or validation in one or two sentences, with the suggested next command."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.analysis.motion_identification import DynamicIdentification
from dvrk_drake.analysis.motion_validation import DynamicValidation
from dvrk_drake.analysis.results import Identification, Validation, cross_validated_verdicts, worst
from dvrk_drake.analysis.validation import StaticValidation
from dvrk_drake.dynamics.identified_model import Verdict
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.locked_joints import locked_option
from dvrk_drake.recordings.recording import Recording


@dataclass(frozen=True)
class Answer:
    """Result in one or two sentences.

    Attributes:
        verdict: Least favourable verdict of all joints.
        text: Verdict, error, and joints without feedforward.
        next_command: Command line of the suggested next step.
        next_purpose: Purpose of this command, in one sentence.
    """

    verdict: Verdict
    text: str
    next_command: str
    next_purpose: str


def answer_of(
    result: Identification | Validation,
    *,
    model_path: str = "MODEL.yaml",
    file_options: str = "",
    saved: bool = False,
) -> Answer:
    """Returns the answer of `identify` or `validate`.

    Args:
        result: Result for static poses or for a motion.
        model_path: Path of the model, for the suggested next command.
        file_options: Options with which the recording was read, beginning with a space, for the suggested next command.
        saved: Whether the verdicts of a validation are stored in the model file, from which the command `control` reads
            them.
    """
    if isinstance(result, Validation):
        verdicts, step = result.verdicts, _after_validation(result, model_path, file_options, saved)
    else:
        verdicts = cross_validated_verdicts(result.model)
        step = _after_identification(result, verdicts, model_path, file_options)
    verdict, names = worst(verdicts)
    which = "" if verdict == "good" or len(names) == len(verdicts) else f" ({', '.join(names)})"
    off = ""
    for text, is_disabled in (("Feedforward disabled", True), ("Negligible model torque", False)):
        names = [
            j.name
            for j in result.model.joints
            if verdicts[j.name] == "off" and is_disabled == (j.feedforward_scale == 0)
        ]
        off += f" {text}: {', '.join(names)}." if names else ""
    return Answer(verdict, f"Verdict: {verdict}{which}. {_error(result)}".rstrip() + off, *step)


def _after_identification(
    result: Identification, verdicts: Mapping[str, Verdict], model_path: str, file_options: str
) -> tuple[str, str]:
    if tilt := next((finding for finding in result.warnings if finding.kind == "base tilt"), None):
        source = f"{source_argument(result.recording, file_options)} --arm {arm_argument(result.model.arm)}"
        how, gravity = "Estimate", "estimate"
        if gravity not in tilt.advice:
            how, gravity = "Measure", "X Y Z"
        command = f"dvrk-drake identify {source} --gravity {gravity} --output {model_path} --overwrite"
        return command, f"{how} the direction of gravity, because the base seems to be tilted."
    if worst(verdicts)[0] == "do not use":
        return _check(result.recording, result.model.arm, file_options)
    return _validate_other(model_path, file_options)


def _after_validation(validation: Validation, model_path: str, file_options: str, saved: bool) -> tuple[str, str]:
    arm, source = validation.model.arm, source_argument(validation.recording, file_options)
    if validation.of_same_recording:
        return _validate_other(model_path, file_options)
    if validation.verdict == "do not use":
        # Errors above 100 % are due to wrong signs, units or coordinates, which a refit of friction does not correct.
        plausible = all(error is None or error <= 1 for error in validation.relative_errors.values())
        if isinstance(validation, DynamicValidation) and plausible:
            command = f"dvrk-drake identify recalibrate {source} --model {model_path} --output NEW.yaml"
            return command, "Refit the friction and the offsets of the model to this recording."
        return _check(validation.recording, arm, file_options)
    if not saved:
        replaces = " --overwrite" if validation.model.validation is not None else ""
        command = f"dvrk-drake validate {source} --model {model_path} --save{replaces}"
        return command, "Store the verdicts in the model file, from which the command control reads them."
    if arm.locked_joints:  # control requires all joints
        command = f"dvrk-drake predict {source} --model {model_path} --output FILE.csv"
        return command, "Predict the efforts of a recording of these joints."
    command = f"dvrk-drake control --arm {arm.source} --model {model_path} --mode damped"
    return command, "Compensate gravity on the arm, with damping."


def _check(recording: Recording, arm: Arm, file_options: str) -> tuple[str, str]:
    command = f"dvrk-drake check {source_argument(recording, file_options)} --arm {arm_argument(arm)}"
    return command, "Check the recording for wrong units, signs, channels and joints at a stop."


def _validate_other(model_path: str, file_options: str) -> tuple[str, str]:
    command = f"dvrk-drake validate OTHER.csv{file_options} --model {model_path} --save"
    return command, "Evaluate the model on a recording that was not used for the identification."


def arm_argument(arm: Arm) -> str:
    """Returns the value of --arm, and the option --locked if joints are locked."""
    return arm.source + locked_option(arm)


def source_argument(recording: Recording, file_options: str) -> str:
    """Returns the path of a recording and the options to read it, as arguments of a command."""
    return f"{recording.source or 'RECORDING.csv'}{file_options}"


def _error(result: Identification | Validation) -> str:
    """Returns a sentence about the error: the mean for a motion, the largest of all joints for poses."""
    arm = result.model.arm
    if isinstance(result, DynamicValidation):
        return f"Mean relative effort error: {percent(result.mean_relative_error)}."
    if isinstance(result, DynamicIdentification):
        actuators = result.model.dynamic_model.section.actuators
        fit, held_out = (
            np.mean([getattr(a, which) / a.rms_effort for a in actuators if a.rms_effort > 0])
            for which in ("rms_fit", "rms_cross_validation")
        )
        return f"Mean relative effort error: {percent(held_out)} in cross-validation, {percent(fit)} in the fit."
    if isinstance(result, StaticValidation):
        errors = np.array([j.rms_error_included for j in result.joints])
        torques = np.array([0.0 if j.verdict == "off" else j.rms_torque_included for j in result.joints])
        return _largest_error(arm, errors, torques)
    joints = result.model.joints
    errors = np.array([j.rms_cross_validation_included for j in joints])
    return _largest_error(arm, errors, np.array([j.rms_zero_torque_included for j in joints]), "cross-validation ")


def _largest_error(arm: Arm, errors: NDArray[np.float64], torques: NDArray[np.float64], kind: str = "") -> str:
    """Returns a sentence about the joint with the largest ratio of error to effort limit, or "" without a torque."""
    if not np.any(torques > 0):
        return ""
    j = int(np.nanargmax(np.where(torques > 0, errors / arm.effort_limits, -1.0)))
    unit, share = "N" if arm.prismatic[j] else "N m", percent(errors[j] / arm.effort_limits[j])
    return f"Largest {kind}error: {share} of the effort limit ({arm.joint_names[j]}, {errors[j]:.3g} {unit})."


def percent(share: float) -> str:
    """Returns a share as text in percent, with one decimal."""
    return f"{100 * share:.1f} %"
