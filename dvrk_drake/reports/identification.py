"""Pages of an identification, a validation and a recalibration, for static poses and for motions."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from itertools import zip_longest
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.analysis.motion_identification import DynamicIdentification
from dvrk_drake.analysis.motion_validation import DynamicValidation
from dvrk_drake.analysis.pose_identification import StaticIdentification
from dvrk_drake.analysis.recalibration import FOLDS, Recalibration
from dvrk_drake.analysis.results import (
    MIN_COVERAGE,
    Identification,
    Validation,
    cross_validated_verdicts,
    identified_coverage,
    rule_text,
)
from dvrk_drake.analysis.validation import StaticValidation
from dvrk_drake.dynamics.identified_model import Verdict as VerdictWord
from dvrk_drake.recordings.recording import Recording
from dvrk_drake.reports.answers import answer_of, percent
from dvrk_drake.reports.drives import drive_plots
from dvrk_drake.reports.efforts import (
    Efforts,
    budget_plot,
    efforts_of,
    efforts_plot,
    residuals_plot,
    structure_table,
)
from dvrk_drake.reports.page import Block, Cell, Level, Page, Scene, Section, Table, Text, Verdict, warning_texts
from dvrk_drake.reports.parameters import parameter_blocks
from dvrk_drake.reports.playback import playback

#: Level of each verdict. "off" and "not judged" have no colour.
LEVELS: dict[VerdictWord, Level] = {
    "good": "good",
    "usable": "warning",
    "do not use": "bad",
    "off": "plain",
    "not judged": "plain",
}
Result = Identification | Validation


def identification_page(
    result: Result,
    *,
    model_path: str = "MODEL.yaml",
    file_options: str = "",
    saved: bool = False,
    baselines: Mapping[str, NDArray[np.float64]] | None = None,
) -> Page:
    """Returns the page of a result of `identify` or `validate`.

    Args:
        result: Result for static poses or for a motion.
        model_path: Path of the model, for the suggested next command.
        file_options: Options with which the recording was read, beginning with a space, for the suggested next command.
        saved: Whether the verdicts of a validation are stored in the model file.
        baselines: Efforts of other models for the (first) recording, see `baseline_efforts`.
    """
    efforts = efforts_of(result, baselines)
    others = [efforts_of(result, None, k) for k in range(1, _num_recordings(result))]
    answer = answer_of(result, model_path=model_path, file_options=file_options, saved=saved)
    every = [efforts, *others]
    names = ", ".join(_name(own.recording) for own in every)
    what = f"{len(efforts.measured)} static poses"
    if efforts.v is not None:
        seconds = sum(own.x[-1] - own.x[0] for own in every)
        what = f"motion of {seconds:.0f} s" if not others else f"{len(every)} motions, {seconds:.0f} s"
    task = "validation" if isinstance(result, Validation) else "identification"
    verdicts = result.verdicts if isinstance(result, Validation) else cross_validated_verdicts(result.model)
    sections = [
        Section("Verdict per joint", [*_errors(result, efforts, verdicts), *_remarks(result, verdicts)]),
        *_effort_sections(efforts, "" if not others else names.split(", ")[0], ""),
    ]
    for k, own in enumerate(others, 2):
        sections += _effort_sections(own, _name(own.recording), f"_{k}")
    sections += [
        Section("Data quality", _data_quality(result, efforts), folded=True),
        Section("Friction and cable curves", drive_plots(efforts), folded=True),
        Section("Parameters and physical consistency", parameter_blocks(result.model), folded=True),
    ]
    return Page(
        f"{result.model.arm.name}: {task} with {names}, {what}",
        answer.text,
        [section for section in sections if section.blocks],
        LEVELS[answer.verdict],
        answer.next_command,
        answer.next_purpose,
    )


def _name(recording: Recording) -> str:
    return Path(recording.source).name or "recording"


def _num_recordings(result: Result) -> int:
    return len(result.motions) if isinstance(result, DynamicIdentification) else 1


def _errors(result: Result, efforts: Efforts, verdicts: Mapping[str, VerdictWord]) -> list[Block]:
    """Returns the table of verdicts and errors, with the errors of other models beside them."""
    if isinstance(result, DynamicIdentification):
        return _identified_motion(result, efforts, verdicts)
    if isinstance(result, StaticIdentification):
        return _identified_poses(result, efforts, verdicts)
    if isinstance(result, DynamicValidation):
        return _validated_motion(result, efforts, verdicts)
    assert isinstance(result, StaticValidation)
    return _validated_poses(result, efforts, verdicts)


def _verdict_table(
    verdicts: Mapping[str, VerdictWord], columns: Mapping[str, Sequence[str]], caption: str, zero_torque: str
) -> Table:
    """Returns a table with one row per joint, without empty columns.

    Args:
        verdicts: Verdict of each joint.
        columns: Heading -> cells of the joints. A further cell is the mean of the joints.
        caption: Caption.
        zero_torque: Relative error of zero torque as text.
    """
    columns = {heading: cells for heading, cells in columns.items() if any(cells)}
    labels = [Verdict(word, LEVELS[word]) for word in verdicts.values()]
    has_mean = any(len(cells) > len(verdicts) for cells in columns.values())
    names = [*verdicts, *(["mean"] if has_mean else [])]
    note = ""
    if "SDF error" in columns:
        note = (
            "SDF error: relative error of the nominal model, which consists of the SDF and the arm file. Zero torque "
            f"has a relative error of {zero_torque}."
        )
    every: list[Sequence[Cell]] = [names, labels, *columns.values()]
    rows = list(zip_longest(*every, fillvalue=""))
    return Table(("joint", "verdict", *columns), rows, caption, note)


def _numbers(values: Iterable[float]) -> list[str]:
    return [f"{value:.4f}" for value in values]


def _ratios(errors: Iterable[float], efforts: Iterable[float]) -> list[str]:
    """Returns relative errors as text, "" for a joint without an effort."""
    return [f"{error / effort:.2f}" if effort > 0 else "" for error, effort in zip(errors, efforts, strict=True)]


def _relative(errors: Iterable[float], efforts: Iterable[float]) -> list[str]:
    """Returns relative errors in percent and their mean, "" for a joint without an effort or with an unknown error."""
    pairs = zip(errors, efforts, strict=True)
    return _percents([error / effort if effort > 0 and error > 0 else None for error, effort in pairs])


def _percents(shares: Sequence[float | None]) -> list[str]:
    """Returns shares as text in percent, and their mean. A share that is None is unknown, and its text is ""."""
    known = [share for share in shares if share is not None]
    mean = float(np.mean(known)) if known else None
    return ["" if share is None else percent(share) for share in (*shares, mean)]


def _baselines(
    efforts: Efforts, relative: Callable[[Iterable[float], Iterable[float]], list[str]]
) -> dict[str, list[str]]:
    """Returns the relative errors of other models by heading."""
    measured = efforts.rms(efforts.measured)
    return {f"{name} error": relative(efforts.rms_of_baseline(name), measured) for name in efforts.baselines}


def _identified_motion(
    result: DynamicIdentification, efforts: Efforts, verdicts: Mapping[str, VerdictWord]
) -> list[Block]:
    section = result.model.dynamic_model.section
    effort = [a.rms_effort for a in section.actuators]
    columns = {
        "effort [N m; N]": _numbers(effort),
        "cross-validation error": _relative([a.rms_cross_validation for a in section.actuators], effort),
        "fit error": _relative([a.rms_fit for a in section.actuators], effort),
        "repeatability": _relative([a.rms_repeatability for a in section.actuators], effort),
        **_baselines(efforts, _relative),
    }
    several = f"{len(result.motions)} recordings, " if len(result.motions) > 1 else ""
    how = "6 folds over the phase of the motion; effects, base tilt and parameters are estimated anew in each fold"
    if several:
        how = "each recording is predicted by a model of the others, with the mean of their offsets and friction"
    caption = f"{several}{result.num_rows} rows of motion: actuator effort and relative error (RMS)"
    blocks: list[Block] = [
        _verdict_table(verdicts, columns, caption, "100 %"),
        Text(
            f"Low-pass filter of the efforts: {section.signals.effort_cut_off:g} Hz. Cross-validation: {how}. On "
            "another recording the error can be larger, because friction changes from day to day. Repeatability: "
            "difference between periods of the motion. The fit error can be smaller than the repeatability if the "
            "periods of the executed motion differ.",
            show="details",
        ),
    ]
    if several:
        blocks.append(_error_of_each_recording(result))
    tilt = np.degrees(_angle(np.array(section.gravity), np.array(section.gravity_expected)))
    if tilt > 0.1:
        gravity = ", ".join(f"{x:.3f}" for x in section.gravity)
        blocks.append(Text(f"The base is tilted by {tilt:.1f} deg. Gravity in the base frame: {gravity} m/s^2."))
    return blocks


def _error_of_each_recording(result: DynamicIdentification) -> Table:
    """Returns the relative errors of each recording. Those of a joint without an effort are not finite."""
    names = [_name(motion.recording) for motion in result.motions]
    columns = (
        _percents([float(error) if np.isfinite(error) else None for error in motion.held_out_errors])
        for motion in result.motions
    )
    rows = list(zip((*result.model.arm.joint_names, "mean"), *columns, strict=True))
    caption = "Relative error of each recording, predicted by a model of the others"
    note = f"The intervals include only the differences between these {len(names)} recordings."
    return Table(("", *names), rows, caption, note)


def _identified_poses(
    result: StaticIdentification, efforts: Efforts, verdicts: Mapping[str, VerdictWord]
) -> list[Block]:
    joints, poses = result.model.joints, len(result.recording)
    torque, error = (
        [getattr(own, name) for own in joints] for name in ("rms_zero_torque_included", "rms_cross_validation_included")
    )
    columns = {
        "effort": _numbers(torque),
        "error": _numbers(error),
        "ratio": _ratios(error, torque),
        **_baselines(efforts, _ratios),
        "feedforward scale": [f"{own.feedforward_scale:.2f}" for own in joints],
        "range covered": [f"{100 * own.coverage:.0f} %" for own in joints],
    }
    details = []
    for own in joints:
        errors = (own.rms_fit_included, own.rms_leave_one_out_included)
        with_excluded = (own.rms_zero_torque, own.rms_fit, own.rms_leave_one_out)
        positions = f"{own.position_lower:+.2f}..{own.position_upper:+.2f}"
        details.append((own.name, *_numbers((*errors, *with_excluded)), positions))
    fits = ("", "fit", "leave-one-out", "zero torque*", "fit*", "leave-one-out*", "positions [rad; m]")
    caption = f"{poses} static poses: RMS joint effort, cross-validation error [N m; N] and ratio"
    blocks: list[Block] = [
        _verdict_table(verdicts, columns, caption, "1"),
        Text(
            "Cross-validation error: 10 folds over the poses. Effects, parameters and feedforward scales are estimated "
            "anew in each fold. The effort is the error of zero torque.",
            show="details",
        ),
        Table(fits, details, "RMS error [N m; N] (* including the excluded measurements)", show="details", folded=True),
    ]
    if count := sum(joint.num_excluded for joint in joints):
        text = f"{count} of {result.usable.size} measurements were excluded."
        blocks += [Text(f"{text} --verbose lists them.", show="brief"), Text(text, show="details")]
    if poses < result.num_rows:
        text = f"The {result.num_rows} rows contain {poses} distinct poses. Samples of one pose were averaged."
        blocks.append(Text(text))
    for own in joints:
        if own.feedforward_scale == 0.0:
            why = "the recording does not separate gravity from friction."
            if own.rms_zero_torque == 0.0:
                why = "its effort was not measured."
            blocks.append(Text(f"{own.name}: feedforward disabled, because {why}", "warning"))
    return blocks


def _validated_motion(
    validation: DynamicValidation, efforts: Efforts, verdicts: Mapping[str, VerdictWord]
) -> list[Block]:
    actuators, n = validation.actuators, len(validation.actuators)
    columns = {
        "effort": _numbers(a.rms_effort for a in actuators),
        "error": _numbers(a.rms_error for a in actuators),
        "ratio": _percents([a.relative_error for a in actuators]),
        # Only errors have a mean.
        "repeatability": _percents([a.repeatability for a in actuators])[:n],
        "inside": _percents([a.inside for a in actuators])[:n],
        "other day": _percents([a.inside_other_day for a in actuators])[:n],
        **_baselines(efforts, _relative),
    }
    caption = f"Motion of {_name(validation.recording)}: RMS actuator effort and error [N m; N], relative error"
    return [
        _verdict_table(verdicts, columns, caption, "100 %"),
        Text(
            "inside: share of the measured efforts inside the prediction interval of the same day. other day: inside "
            f"the interval of another day. {validation.model.interval_scope}",
            show="details",
        ),
        Text(f"{rule_text()} Low-pass filter: {validation.grid.settings.effort_cut_off:g} Hz.", show="details"),
    ]


def _validated_poses(
    validation: StaticValidation, efforts: Efforts, verdicts: Mapping[str, VerdictWord]
) -> list[Block]:
    torque, error = (
        [getattr(own, name) for own in validation.joints] for name in ("rms_torque_included", "rms_error_included")
    )
    columns = {
        "effort": _numbers(torque),
        "error": _numbers(error),
        "ratio": _ratios(error, torque),
        **_baselines(efforts, _ratios),
        "excluded": [f"{own.num_excluded or ''}" for own in validation.joints],
    }
    caption = f"{validation.poses} poses of {_name(validation.recording)}: RMS joint effort and error [N m; N], ratio"
    blocks: list[Block] = [
        _verdict_table(verdicts, columns, caption, "1"),
        Text(rule_text(), show="details"),
    ]
    if validation.excluded:
        every = [
            (own.name, *_numbers((own.rms_torque, own.rms_error)), *_ratios([own.rms_error], [own.rms_torque]))
            for own in validation.joints
        ]
        caption = "RMS effort and error [N m; N], all measurements"
        blocks.append(Table(("", "effort", "error", "ratio"), every, caption, show="details", folded=True))
    return blocks


def _remarks(result: Result, verdicts: Mapping[str, VerdictWord]) -> list[Block]:
    """Returns the joints with a small covered range, the locked joints, and the warnings about the recording."""
    blocks: list[Block] = []
    if isinstance(result, StaticValidation | DynamicValidation):
        judged = result.joints if isinstance(result, StaticValidation) else result.actuators
        covered = [joint.coverage for joint in judged]
    else:
        covered = identified_coverage(result.model).tolist()
    few = [
        name
        for (name, verdict), share in zip(verdicts.items(), covered, strict=True)
        if verdict == "usable" and share < MIN_COVERAGE
    ]
    if few:
        limit = f"less than {100 * MIN_COVERAGE:g} % of the range (at most 180 deg) is covered"
        blocks.append(Text(f"At most usable, because {limit}: {', '.join(few)}."))
    arm = result.model.arm
    if arm.locked_joints:
        blocks.append(
            Text(
                f"Not in the recording: {', '.join(arm.locked_joints)}. The model is valid only for {arm.locked_text} "
                "[rad, m], and it has no efforts of these joints.",
                "warning",
            )
        )
    return [*blocks, *warning_texts(result.warnings)]


def _effort_sections(efforts: Efforts, name: str, suffix: str) -> list[Section]:
    """Returns the sections on the efforts and errors of one recording, with its name unless it is the only one."""
    of = f": {name}" if name else ""
    views = [] if suffix else [_view(efforts)]
    blocks: list[Block] = [*views, efforts_plot(efforts, f"efforts{suffix}", time=not suffix)]
    note = "Predicted: efforts of the model for the positions of this recording."
    if efforts.judged != "predicted":
        note = (
            "Fitted: model identified from all data. Held out: prediction of a model that was identified without the "
            "fold of the data that it predicts."
        )
        if efforts.v is not None:
            note += f" {efforts.model.interval_scope}"
    causes = "offset, first and second harmonic of the position, load"
    if efforts.v is not None:
        causes = "offset, friction and position of the actuator, accelerations, positions of the other actuators"
    budget_note = (
        f"Each bar is divided by shares of the squared error. The causes are fitted in this order: {causes}. Each "
        "share is the additional reduction of the squared error."
    )
    if efforts.v is not None:
        budget_note += (
            " The remaining error has three parts: differences between periods, frequencies above 2 Hz, and other. If "
            "the share of the bias or of the friction-like error is large, recalibrate. No model reduces the share "
            "that does not repeat between periods."
        )
    return [
        Section(f"Measured and predicted efforts{of}", blocks, note),
        Section(f"Residuals{of}", [residuals_plot(efforts, f"residuals{suffix}")]),
        Section(
            f"Error budget{of}", [budget_plot(efforts, f"error_budget{suffix}"), structure_table(efforts)], budget_note
        ),
    ]


def _view(efforts: Efforts) -> Scene:
    arm, recorded = efforts.arm, efforts.recording.in_joint_coordinates(efforts.arm)
    if (grid := efforts.grid) is None:
        caption = "Recorded poses. Click a plot to show a pose."
        html = partial(playback, arm, efforts.x, recorded.q, recorded.measured_effort())
        return Scene(html, caption, 1.0, len(recorded))
    tau = np.column_stack([np.interp(grid.t, grid.row_times, x) for x in recorded.measured_effort().T])
    t = grid.t - grid.row_times[0]
    caption = "Recorded motion. Click a plot to move the arm to this time."
    return Scene(partial(playback, arm, t, grid.q, tau), caption, float(t[0]))


def _data_quality(result: Result, efforts: Efforts) -> list[Block]:
    """Returns the notes on reading, and the rows and measurements that were not used."""
    recording = result.recording
    blocks: list[Block] = [Text(f"Reading: {note}", show="page") for note in recording.notes]
    if not any(finding.severity == "warning" for finding in result.warnings):
        blocks.append(Text("The check of the recording reported no warnings.", "good", show="page"))
    if efforts.grid is not None:
        count, distinct = len(recording), len(efforts.grid.clock.rows)
        text = f"{len(efforts.x)} of {count} rows were compared. Both ends were omitted because of filter transients."
        repeated = f" {count - distinct} rows repeat the previous row and were not used." if distinct < count else ""
        blocks.append(Text(text + repeated, show="page"))
    if efforts.excluded:
        listed = [(measurement.where, measurement.reason) for measurement in efforts.excluded]
        caption = f"Excluded measurements in {len({m.where for m in efforts.excluded})} poses"
        blocks.append(Table(("pose", "reason"), listed, caption, show="details", folded=len(listed) > 8))
    return blocks


def recalibration_page(result: Recalibration, *, model_path: str = "MODEL.yaml", file_options: str = "") -> Page:
    """Returns the errors before and after the refit, and the change of friction and offsets.

    Args:
        result: Result of the recalibration.
        model_path: Path of the new model, for the suggested next command.
        file_options: Options with which the recording was read, beginning with a space, for the suggested next command.
    """
    before, after = (float(np.mean([getattr(a, which) for a in result.actuators])) for which in ("before", "after"))
    rows = []
    for a in result.actuators:
        new = [_factor(a.dry), _factor(a.viscous), f"{a.offset:+.4f}"] if a.kept else ["", "", ""]
        rows.append((a.name, percent(a.before), percent(a.after), *new, a.reason))
    rows.append(("mean", percent(before), percent(after), "", "", "", ""))
    errors, changes = ("error before", "error after"), ("dry friction factor", "viscous factor")
    header = ("", *errors, *changes, "offset change [N m; N]", "unchanged because")
    caption = f"{result.seconds:.1f} s of motion: effort error, change of friction and offset"
    blocks: list[Block] = [
        Table(header, rows, caption),
        Text(
            "The improvement is valid for similar motions. At other positions and speeds, the improvement can be much "
            "smaller. Validate the new model on the motion that you need."
        ),
        Text(
            "Error: RMS(measured - predicted effort) / RMS(measured effort), after the low-pass filter of the model. "
            f"Error after: {FOLDS}-fold cross-validation over the motion. Factors and offsets: fit to all rows.",
            show="details",
        ),
    ]
    if result.shared:
        shared = ", ".join(f"{name} x {scale:.2f}" for name, scale in result.shared.items())
        blocks.append(Text(f"Factors of friction that acts on several actuators: {shared}", show="details"))
    kept = sum(a.kept for a in result.actuators)
    return Page(
        f"{result.model.arm.name}: recalibration",
        f"Mean effort error {percent(before)} before and {percent(after)} after the refit, cross-validated; "
        f"{kept} of {len(result.actuators)} actuators refitted.",
        [Section("Errors", blocks)],
        "good",
        f"dvrk-drake validate OTHER.csv{file_options} --model {model_path} --save",
    )


def _factor(factor: float | None) -> str:
    return "none" if factor is None else f"{factor:.2f}"


def _angle(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b))
