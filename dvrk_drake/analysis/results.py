"""Verdicts, and common parts of the results of identification, recalibration, validation and prediction."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.analysis.observations.finding import Finding
from dvrk_drake.dynamics.friction_compensation import HOLDING_ERROR_FACTOR, HOLDING_TRAVEL
from dvrk_drake.dynamics.identified_model import IdentifiedModel, ValidationSummary, Verdict
from dvrk_drake.errors import DvrkDrakeError, ModelError
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.arm_files import has_converted_model
from dvrk_drake.models.effects_schema import EFFECT_KINDS
from dvrk_drake.models.files import Reportable, refuse_existing
from dvrk_drake.recordings.recording import MIN_RANGE, Coordinates, Recording

Requirement = Literal["good", "usable"]

#: Largest ratio of the RMS error to the RMS measured effort. The ratio of zero torque is 1. In motions, 0.34 is the
#: largest published ratio on another motion, and 0.54 is that of a PSM's pitch with a payload that is not modelled.
LARGEST_RATIO = 0.5
#: Largest ratio for an error that the dry friction holds. Torques that are independent of the measurement reach this
#: ratio at ten poses by chance, at two standard deviations: sqrt(1 - 4 / 10) = 0.77.
LARGEST_RATIO_IN_FRICTION = 0.75
#: Smallest covered share of the range of a joint for the verdict "good". With a smaller share, most of the torques
#: within the limits would be extrapolated.
MIN_COVERAGE = 0.5
#: Torque below which a model commands no torque, as a share of the dry friction. If a pose is approached from both
#: sides by a short distance, about 12 % of the dry friction remains in the measurement, so the error of a smaller
#: torque cannot be measured.
NEGLIGIBLE = 0.15
#: Smallest assumed torque of the gains at `HOLDING_TRAVEL` for the links of a model file, as a share of the effort
#: limit. Its gains are derived from inertias that often omit the rotors, and are then too small by a factor of 100 or
#: more (wrist of a UR10e). The gains of this package's arms have shares from 0.018 (roll of a PSM) to 0.5.
MIN_STIFFNESS = 0.015


class Tolerance(NamedTuple):
    """Largest errors of the torque of a joint at which the joint can be used [N m, N].

    Attributes:
        friction: Dry friction, which holds the joint at rest despite the error. If the arm file states no friction, it
            is the same as `stiffness`.
        stiffness: Torque of the joint's proportional gain at a deflection of `HOLDING_TRAVEL`, see `MIN_STIFFNESS`.
    """

    friction: float
    stiffness: float


def tolerances(arm: Arm, coordinates: Coordinates) -> list[Tolerance]:
    """Returns the tolerances (n,) of the joints or actuators of an arm.

    An effort error at one actuator deflects all joints that this actuator drives.
    """
    J, rows = arm.transmission.matrix, arm.effect_coordinates
    at_15_mrad = np.asarray(arm.gains.kp * arm.per_joint(*HOLDING_TRAVEL))
    if has_converted_model(arm):
        at_15_mrad = np.maximum(at_15_mrad, MIN_STIFFNESS * arm.effort_limits)
    drives = J if coordinates == "actuator" else np.eye(arm.num_joints)
    with np.errstate(divide="ignore"):
        stiffness = np.min(np.where(drives != 0, at_15_mrad / np.abs(drives), np.inf), axis=1)
    dry = [e.coefficient * rows[e.coordinate] for e in arm.effects.friction if EFFECT_KINDS[e.kind].role == "dry"]
    friction = np.abs(np.reshape(dry, (-1, arm.num_joints)) @ (np.eye(len(J)) if coordinates == "actuator" else J))
    found = [(f or k, k) for f, k in zip(friction.sum(axis=0), stiffness, strict=True)]
    return [Tolerance(float(f), float(k)) for f, k in found]


def coverage(arm: Arm, travel: NDArray[np.float64], coordinates: Coordinates) -> NDArray[np.float64]:
    """Returns the share (n,) of the range between the limits that a recording covers, 0 for a joint that did not move.

    At most half a revolution of a revolute joint counts as its range, because the gravity torque changes its sign after
    half a revolution. The share is at most 1.

    Args:
        arm: Arm that was recorded.
        travel: Ranges (n,) of the recorded positions of the joints [rad, m].
        coordinates: Coordinates of the result.
    """
    to_output = np.abs(arm.transmission.matrix) if coordinates == "actuator" else np.eye(arm.num_joints)
    width = np.minimum(arm.position_upper - arm.position_lower, arm.per_joint(np.pi, np.inf))
    moved = to_output @ travel > arm.per_joint(*MIN_RANGE)
    return np.asarray(np.where(moved, np.minimum((to_output @ travel) / (to_output @ width), 1.0), 0.0))


def judge(effort: float, error: float, tolerance: Tolerance, covered: float, *, commanded: bool = True) -> Verdict:
    """Returns the verdict on one joint.

    Args:
        effort: RMS measured effort [N m, N], which is also the RMS error of zero torque. 0 if no effort was measured.
        error: RMS of measured minus predicted effort [N m, N], NaN if unknown.
        tolerance: Tolerances of the joint.
        covered: Share of the joint's range that the recording covers, 0 if the joint did not move, see `coverage`.
        commanded: False if the model commands no torque, because identification disabled the feedforward of this joint
            or its torque is negligible (`NEGLIGIBLE`).
    """
    if not commanded:
        return "off"
    if not (np.isfinite(effort) and np.isfinite(error) and effort > 0 and covered > 0):
        return "not judged"
    is_good = HOLDING_ERROR_FACTOR * error <= min(tolerance) and covered >= MIN_COVERAGE
    if is_good and error <= LARGEST_RATIO * effort:
        return "good"
    rests = error <= tolerance.friction
    is_small = error <= (LARGEST_RATIO_IN_FRICTION if rests else LARGEST_RATIO) * effort
    return "usable" if is_small and error <= max(tolerance) else "do not use"


def rule_text() -> str:
    """Returns the rule of `judge` as text, with the thresholds."""
    return (
        f"ratio: RMS error / RMS measured effort (1 for zero torque). good: {HOLDING_ERROR_FACTOR:g} x RMS error is "
        "below the dry friction, which then holds the joint, and below the torque of the gains at 15 mrad (1.5 mm); "
        f"ratio up to {LARGEST_RATIO:g}; at least {100 * MIN_COVERAGE:g} % of the range covered. usable: RMS error is "
        f"below one of both, and ratio up to {LARGEST_RATIO:g}, or {LARGEST_RATIO_IN_FRICTION:g} if the error is below "
        "the dry friction. do not use: all other joints. off: the model commands no torque, or one below "
        f"{100 * NEGLIGIBLE:g} % of the dry friction. not judged: no effort was measured, or the joint did not move."
    )


def worst(verdicts: Mapping[str, Verdict]) -> tuple[Verdict, list[str]]:
    """Returns the least favourable verdict and the joints that have it."""
    result = max(verdicts.values(), key=get_args(Verdict).index)
    return result, [name for name, verdict in verdicts.items() if verdict == result]


def unfit(verdicts: Mapping[str, str], required: Requirement) -> list[str]:
    """Returns the joints that do not meet a requirement, each as "name (verdict)".

    The verdict "off" meets every requirement, because the model commands no torque.
    """
    accepted = ("good", "off") if required == "good" else ("good", "usable", "off")
    return [f"{name} ({verdict})" for name, verdict in verdicts.items() if verdict not in accepted]


def unexplained_effort(errors: Mapping[str, float | None]) -> tuple[Finding, ...]:
    """Returns a warning for the joints whose relative error in motion exceeds `LARGEST_RATIO`.

    Args:
        errors: Relative error of each joint [1], None if the measured effort is 0.
    """
    bad = [f"{name} ({100 * e:.0f} %)" for name, e in errors.items() if e is not None and e > LARGEST_RATIO]
    if not bad:
        return ()
    what = "the RMS error of the model exceeds half of the RMS effort"
    advice = (
        "Do not use the model for these joints. Check the arm, the signs and units of the columns, and --coordinates."
    )
    return (Finding("warning", "unexplained effort", ", ".join(bad), what, advice),)


def identified_coverage(model: IdentifiedModel) -> NDArray[np.float64]:
    """Returns the `coverage` (n,) of the recording of the identification. For a motion, it is that of the actuators."""
    travel = np.array([j.position_upper - j.position_lower for j in model.joints])
    return coverage(model.arm, travel, "joint" if model.dynamics is None else "actuator")


def cross_validated_verdicts(model: IdentifiedModel) -> dict[str, Verdict]:
    """Returns the verdict on each joint from the cross-validated errors of the identification.

    Validation with another recording is a stronger test.
    """
    numbers = (
        [(j.rms_zero_torque_included, j.rms_cross_validation_included) for j in model.joints]
        if model.dynamics is None
        else [(a.rms_effort, a.rms_cross_validation) for a in model.dynamics.actuators]
    )
    limits = tolerances(model.arm, "joint" if model.dynamics is None else "actuator")
    return {
        joint.name: judge(effort, error, limit, float(covered), commanded=joint.feedforward_scale > 0)
        for joint, (effort, error), limit, covered in zip(
            model.joints, numbers, limits, identified_coverage(model), strict=True
        )
    }


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class ModelResult:
    """Model with warnings.

    Attributes:
        model: Identified or recalibrated model.
        warnings: Findings about the recording or the fit. They indicate that the model may be less accurate. `str` of a
            finding is one line.
    """

    model: IdentifiedModel
    warnings: tuple[Finding, ...] = ()

    def __repr__(self) -> str:
        return f"<{type(self).__name__} of {self.model.arm.name}: {len(self.warnings)} warnings>"

    def save(self, path: str | Path, *, overwrite: bool = False) -> None:
        """Writes the model file atomically.

        Args:
            path: YAML file to write.
            overwrite: True to replace an existing file.

        Raises:
            DvrkDrakeError: The file exists and `overwrite` is False, or the file cannot be written.
        """
        refuse_existing(path, overwrite)
        self.model.save(path)


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class Identification(ModelResult, Reportable):
    """Result of `identify`: a `StaticIdentification` or a `DynamicIdentification`.

    Attributes:
        recording: Recording used for the fit: distinct poses in joint coordinates, or the motion as recorded.
        note: Note on how poses were extracted from a motion, "" if no poses were extracted.
        num_rows: Number of rows of the recording, or number of poses extracted from a motion, before repeated poses are
            averaged.
    """

    recording: Recording
    note: str = ""
    num_rows: int = 0


@dataclass(frozen=True, kw_only=True)
class JudgedError(ABC):
    """Error of the efforts of one joint or actuator over a recording.

    Attributes:
        name: Name of the joint.
        coverage: Share of the range between the limits that the recording covers, see `verdict.coverage` [1].
        verdict: Verdict from the error, see `judge`.
    """

    name: str
    coverage: float
    verdict: Verdict

    @property
    @abstractmethod
    def judged_error(self) -> float | None:
        """Ratio of RMS error to RMS measured effort for the verdict [1], None if the effort is 0."""


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class Validation(Reportable, ABC):
    """Result of `validate`: a `StaticValidation` or a `DynamicValidation`.

    Attributes:
        model: Model that was validated.
        recording: Recording used for the comparison: poses, or the motion as recorded.
        warnings: Findings about the recording or the comparison. `str` of a finding is one line.
        note: Note on how poses were extracted from a motion, "" if no poses were extracted.
    """

    model: IdentifiedModel
    recording: Recording
    warnings: tuple[Finding, ...] = ()
    note: str = ""

    @property
    @abstractmethod
    def errors(self) -> Sequence[JudgedError]:
        """Errors of the joints, in the arm's order."""

    @property
    def verdicts(self) -> dict[str, Verdict]:
        """Verdict on each joint, see `dvrk_drake.analysis.results`."""
        return {error.name: error.verdict for error in self.errors}

    @property
    def relative_errors(self) -> dict[str, float | None]:
        """Ratio of RMS error to RMS measured effort of each joint [1], None if the effort is 0.

        Excluded measurements are not used.
        """
        return {error.name: error.judged_error for error in self.errors}

    @property
    def verdict(self) -> Verdict:
        """Least favourable verdict of all joints."""
        return worst(self.verdicts)[0]

    def __repr__(self) -> str:
        verdicts = ", ".join(f"{name}: {verdict}" for name, verdict in self.verdicts.items())
        return f"<{type(self).__name__} of {self.model.arm.name}: {verdicts}; {len(self.warnings)} warnings>"

    @abstractmethod
    def as_dict(self) -> dict:
        """Returns the output of `validate --json` as a dictionary."""

    def unfit(self, required: Requirement) -> list[str]:
        """Returns the joints whose verdict is worse than `required`, each as "name (verdict)"."""
        return unfit(self.verdicts, required)

    @property
    def of_same_recording(self) -> bool:
        """True if the model was identified from this recording. The errors are then errors of the fit."""
        return self.model.provenance.includes(self.recording.sha256)

    def save(self, path: str | Path, *, overwrite: bool = False) -> None:
        """Writes the model with the verdicts. `dvrk-drake control` prints a warning for a model without verdicts.

        Args:
            path: File of the model, or a new file.
            overwrite: True to replace the verdicts of an earlier validation, or an existing file that contains another
                model.

        Raises:
            ModelError: The model was identified from this recording, or the model already has verdicts and `overwrite`
                is False.
            DvrkDrakeError: The file exists and contains another model, and `overwrite` is False.
        """
        source = self.recording.source or "recording"
        if self.of_same_recording:
            raise ModelError(
                f"{source}: the model was identified from this recording. Validate with another recording."
            )
        if self.model.validation is not None and not overwrite:
            saved = self.model.validation.recording
            raise ModelError(
                f"{path}: the model already has verdicts from {saved}. Set overwrite=True to replace these verdicts."
            )
        if not self._is_own_file(path):
            refuse_existing(path, overwrite)
        summary = ValidationSummary(self.recording.source, self.recording.sha256, dict(self.verdicts))
        replace(self.model, validation=summary).save(path)

    def _is_own_file(self, path: str | Path) -> bool:
        try:
            other = IdentifiedModel.load(path)
        except DvrkDrakeError:
            return False
        return other.arm.name == self.model.arm.name and other.provenance == self.model.provenance


@dataclass(frozen=True, eq=False)
class Prediction:
    """Result of `predict`.

    Attributes:
        tau: Predicted efforts (m, n), in the coordinates given to `predict` [N m, N].
        half_width: Half widths (n,) of the 95 % prediction intervals (`DynamicModel.half_width`), in the same
            coordinates [N m, N]. None for holding torques. `IdentifiedModel.interval_scope` states their day.
        half_width_other_day: Half widths (n,) on another day (`DynamicModel.combined_half_width`) [N m, N], or None.
        warnings: Findings of `check`. `str` of a finding is one line.
    """

    tau: NDArray[np.float64]
    half_width: NDArray[np.float64] | None = None
    half_width_other_day: NDArray[np.float64] | None = None
    warnings: tuple[Finding, ...] = ()
