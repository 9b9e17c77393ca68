"""Common parts of the results of identification, recalibration, validation and prediction."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.analysis.observations.finding import Finding
from dvrk_drake.analysis.verdict import Requirement, unfit, worst
from dvrk_drake.dynamics.identified_model import IdentifiedModel, ValidationSummary, Verdict
from dvrk_drake.errors import DvrkDrakeError, ModelError
from dvrk_drake.models.files import Reportable, refuse_existing
from dvrk_drake.recordings.recording import Recording


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
        """Verdict on each joint, see `dvrk_drake.analysis.verdict`."""
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
