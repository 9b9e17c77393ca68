"""Page of an identification or a validation, for static poses and for motions."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.analysis.dynamic.dynamic_identification import DynamicIdentification
from dvrk_drake.analysis.dynamic.validation import DynamicValidation
from dvrk_drake.analysis.results import Identification, Validation
from dvrk_drake.analysis.static.static_identification import StaticIdentification
from dvrk_drake.analysis.static.validation import StaticValidation
from dvrk_drake.dynamics.dynamic_section import DynamicSection
from dvrk_drake.errors import DvrkDrakeError
from dvrk_drake.recordings.recording import Recording
from dvrk_drake.reports.answers import answer_of, percent
from dvrk_drake.reports.html.consistency import consistency_blocks
from dvrk_drake.reports.html.drive_plots import friction_over_speed, torque_over_position
from dvrk_drake.reports.html.error_budget import error_budget, motion_budget, pose_budget
from dvrk_drake.reports.html.joint_summary import (
    coverage_bars,
    coverage_table,
    error_dots,
    error_table,
    joint_summaries,
    verdict_table,
    worst_level,
)
from dvrk_drake.reports.html.motion_plots import MotionEfforts, efforts_over_time, residuals_over_position_and_speed
from dvrk_drake.reports.html.page import Block, Command, Meshcat, Page, Plot, Section, Table, Text
from dvrk_drake.reports.html.parameter_tables import parameter_tables
from dvrk_drake.reports.html.playback import playback
from dvrk_drake.reports.html.pose_plots import (
    PoseEfforts,
    efforts_of_poses,
    predicted_over_measured,
    residuals_over_position,
)
from dvrk_drake.reports.provenance import Provenance

Efforts = MotionEfforts | PoseEfforts


def identification_page(
    result: Identification | Validation,
    provenance: Provenance,
    *,
    model_path: str = "MODEL.yaml",
    file_options: str = "",
    saved: bool = False,
) -> Page:
    """Returns the page of a result of `identify` or `validate`.

    Args:
        result: Result for static poses or for a motion.
        provenance: Origin of the report. If it names no input, the page names the recording of the result.
        model_path: Path of the model, for the suggested next command.
        file_options: Options with which the recording was read, beginning with a space, for the suggested next command.
        saved: Whether the verdicts of a validation are stored in the model file.
    """
    efforts: Efforts
    others: list[MotionEfforts] = []
    if isinstance(result, DynamicIdentification | DynamicValidation):
        efforts = MotionEfforts.of(result)
        if isinstance(result, DynamicIdentification):
            others = [MotionEfforts.of(result, k) for k in range(1, len(result.motions))]
    else:
        assert isinstance(result, StaticIdentification | StaticValidation)
        efforts = PoseEfforts.of(result)
    answer = answer_of(result, model_path=model_path, file_options=file_options, saved=saved)
    recording = result.recording
    name = _name(recording) + "".join(f", {_name(other.recording)}" for other in others)
    if not provenance.inputs:
        provenance = replace(provenance, inputs=((recording.source or "recording", recording.sha256),))
    of_what = f"{len(recording)} static poses"
    if isinstance(efforts, MotionEfforts):
        motions = [efforts, *others]
        seconds = sum(motion.grid.t[-1] - motion.grid.t[0] for motion in motions)
        of_what = f"motion of {seconds:.0f} s" if not others else f"{len(motions)} motions, {seconds:.0f} s"
    task = "validation" if isinstance(result, Validation) else "identification"
    return Page(
        title=f"{result.model.arm.name}: {task} with {name}, {of_what}",
        subtitle=answer.text,
        level=worst_level([joint.verdict for joint in joint_summaries(result)]),
        sections=[
            Section("Verdict per joint", [verdict_table(result), *_locked(result)]),
            _data_quality(result, efforts),
            Section("Parameters", parameter_tables(result.model), note=_parameter_note(result)),
            *_error_sections(efforts, _name(recording) if others else ""),
            *(section for other in others for section in _error_sections(other, _name(other.recording), first=False)),
            _cross_validation(result, efforts),
            Section("Physical consistency", consistency_blocks(result.model)),
            _drives(result, efforts),
        ],
        provenance=provenance,
        closing=[Section("Next step", [Command(answer.next_command, answer.next_purpose)])],
    )


def _name(recording: Recording) -> str:
    return Path(recording.source).name or "recording"


def _error_sections(efforts: Efforts, name: str, *, first: bool = True) -> list[Section]:
    """Returns the sections on the efforts and errors of one recording, with its name unless it is the only one."""
    sections = [_efforts(efforts, with_view=first), _residuals(efforts), _error_budget(efforts)]
    return [replace(section, title=f"{section.title}: {name}") for section in sections] if name else sections


def _locked(result: Identification | Validation) -> list[Block]:
    arm = result.model.arm
    if not arm.locked_joints:
        return []
    return [
        Text(
            f"Not in the recording: {', '.join(arm.locked_joints)}. The model is valid only for {arm.locked_text} "
            "[rad, m], and it has no efforts of these joints.",
            "warning",
        )
    ]


def _data_quality(result: Identification | Validation, efforts: Efforts) -> Section:
    arm = result.model.arm
    q = result.recording.in_joint_coordinates(arm).q
    v = efforts.grid.v if isinstance(efforts, MotionEfforts) else None
    blocks: list[Block] = [coverage_table(result, q, v), Plot(coverage_bars(arm, q), "Recorded range of each joint")]
    if v is None:
        blocks.append(Text("Speeds: static poses have none."))
    warnings = [finding for finding in result.warnings if finding.severity == "warning"]
    blocks += [Text(f"{finding.where}: {finding.what}. {finding.advice}".rstrip(), "warning") for finding in warnings]
    if not warnings:
        blocks.append(Text("The check of the recording reported no warnings.", "good"))
    return Section("Data quality", [*blocks, *_excluded(result, efforts)], note=result.note)


def _excluded(result: Identification | Validation, efforts: Efforts) -> list[Block]:
    """Returns the rows and measurements that were not used."""
    blocks: list[Block] = [Text(f"Reading: {note}") for note in result.recording.notes]
    if isinstance(efforts, MotionEfforts):
        rows, distinct = len(result.recording), len(efforts.grid.clock.rows)
        used = f"{len(efforts.t)} of {rows} rows were compared. Both ends were omitted because of filter transients."
        repeated = f" {rows - distinct} rows repeat the previous row and were not used." if distinct < rows else ""
        return [*blocks, Text(used + repeated)]
    if isinstance(result, Identification) and len(result.recording) < result.num_rows:
        blocks.append(
            Text(
                f"The {result.num_rows} rows contain {len(result.recording)} distinct poses. Samples of one pose were "
                "averaged."
            )
        )
    count = int(np.sum(~efforts.usable))
    blocks.append(Text(f"{count} of {efforts.usable.size} measurements were excluded."))
    if efforts.excluded:
        listed = [(measurement.where, measurement.reason) for measurement in efforts.excluded]
        caption = f"Excluded measurements in {len({m.where for m in efforts.excluded})} poses"
        blocks.append(Table(("pose", "reason"), listed, caption=caption, collapsed=len(listed) > 8))
    return blocks


def _parameter_note(result: Identification | Validation) -> str:
    provenance = result.model.provenance
    if isinstance(result, Validation):
        source = provenance.recording or "no recording"
        return f"Parameters of the model that was validated. It was identified from {source}."
    return "Estimates with 95 % intervals, beside the values of the arm's SDF."


def _efforts(efforts: Efforts, *, with_view: bool = True) -> Section:
    arm = efforts.arm
    title = "Measured, fitted and held-out efforts" if len(efforts.predicted) > 1 else "Measured and predicted efforts"
    if isinstance(efforts, MotionEfforts):
        figure, drawn = efforts_over_time(efforts)
        drawn = f"{drawn} {efforts.model.interval_scope}"
        cut_off = efforts.grid.settings.effort_cut_off
        caption = f"Efforts of the actuators after low-pass filtering at {cut_off:.3g} Hz"
        grid, tau = efforts.grid, efforts.recording.in_joint_coordinates(arm).measured_effort()
        on_grid = np.column_stack([np.interp(grid.t, grid.row_times, x) for x in tau.T])
        view = _view(efforts, grid.t - grid.row_times[0], grid.q, on_grid) if with_view else []
        blocks: list[Block] = [*view, Plot(figure, caption, time=with_view)]
    else:
        poses = efforts.recording.in_joint_coordinates(arm)
        view = _view(efforts, np.arange(len(poses), dtype=float), poses.q, poses.measured_effort())
        drawn = "The 3D view shows one pose per second. Excluded efforts beyond the axes are drawn at their edge."
        caption = "Holding effort of each pose"
        scatter = "Predicted against measured effort of each pose, without excluded measurements"
        blocks = [
            *view,
            Plot(efforts_of_poses(efforts), caption, time=True),
            Plot(predicted_over_measured(efforts), scatter),
        ]
    return Section(title, blocks, note=f"{_EXPLANATION[efforts.judged]} {drawn}")


_EXPLANATION = {
    "held out": "Fitted: model identified from all data. Held out: prediction of a model that was identified without "
    "the fold of the data that it predicts. Drag in a plot to zoom, double-click to reset. Click a name in the legend "
    "to hide or show it.",
    "predicted": "Predicted: efforts of the model for the positions of this recording. Drag in a plot to zoom, "
    "double-click to reset. Click a name in the legend to hide or show it.",
}


def _view(efforts: Efforts, t: NDArray[np.float64], q: NDArray[np.float64], tau: NDArray[np.float64]) -> list[Block]:
    try:
        html = playback(efforts.arm, t, q, tau)
    except DvrkDrakeError as error:
        return [Text(f"No 3D view: {error}.", "warning")]
    caption = "Recorded poses. Click a plot to show a pose."
    if isinstance(efforts, MotionEfforts):
        caption = "Recorded motion. Click a plot to move the arm to this time."
    return [Meshcat(html, caption, start=float(t[0]))]


def _residuals(efforts: Efforts) -> Section:
    which = f"Measured minus {_adjective(efforts)} effort"
    if isinstance(efforts, MotionEfforts):
        figure, dots = residuals_over_position_and_speed(efforts)
        return Section("Residuals over position and speed", [Plot(figure, which)], note=dots)
    figure, dots = residuals_over_position(efforts)
    note = f"Static poses have no speed, so the residuals are shown over the position only. {dots}"
    return Section("Residuals over position", [Plot(figure, which)], note=note)


def _adjective(efforts: Efforts) -> str:
    return efforts.judged.replace(" ", "-")


def _error_budget(efforts: Efforts) -> Section:
    caption = f"Relative RMS error of the {_adjective(efforts)} efforts and its causes"
    if isinstance(efforts, MotionEfforts):
        note = (
            "Each bar is divided by shares of the squared error. The causes are fitted in this order: offset, friction "
            "and position of the actuator, accelerations, positions of the other actuators. Each share is the "
            "additional reduction of the squared error. The remaining error has three parts: differences between "
            "periods, frequencies above 2 Hz, and other."
        )
        budgets = motion_budget(efforts)
    else:
        note = (
            "Each bar is divided by shares of the squared error: offset, sine and cosine of the position, and other, "
            "such as friction and measurement noise."
        )
        budgets = pose_budget(efforts)
    return Section("Error budget", [Plot(error_budget(budgets), caption)], note=note)


def _cross_validation(result: Identification | Validation, efforts: Efforts) -> Section:
    notes: dict[type, str] = {
        StaticIdentification: "Cross-validation: 10 folds over the poses. Effects, parameters and feedforward scales "
        "are estimated anew in each fold. Repeatability: unknown, because repeated samples of one pose were averaged.",
        DynamicIdentification: "Cross-validation: 6 folds over the phase of the motion. Effects, base tilt and "
        "parameters are estimated anew in each fold. Repeatability: difference between periods of the motion.",
        StaticValidation: "This recording was not used for the identification, unless a warning states it. "
        "Repeatability: unknown for static poses.",
        DynamicValidation: "This recording was not used for the identification, unless a warning states it. "
        "Repeatability: difference between periods of this motion.",
    }
    note = notes[type(result)]
    if isinstance(result, DynamicIdentification) and len(result.motions) > 1:
        note = (
            "Cross-validation: each recording is predicted by a model of the other recordings. Effects, base tilt and "
            "parameters are estimated anew for each. Repeatability: difference between periods of a motion."
        )
    if isinstance(efforts, MotionEfforts) and not np.any(efforts.repeatability > 0):
        note = note.partition(" Repeatability")[0] + " Repeatability: unknown, because the motion does not repeat."
    blocks: list[Block] = [error_table(result), Plot(error_dots(result), "Relative RMS errors of each joint")]
    if isinstance(result, DynamicIdentification) and len(result.motions) > 1:
        blocks.append(_error_of_each_recording(result))
    return Section("Cross-validation and repeatability", blocks, note=note)


def _error_of_each_recording(result: DynamicIdentification) -> Table:
    rows = [
        (_name(motion.recording), *(percent(error) if np.isfinite(error) else "" for error in motion.held_out_errors))
        for motion in result.motions
    ]
    caption = "Relative RMS error of each recording, predicted by a model of the other recordings"
    return Table(("recording", *result.model.arm.joint_names), rows, caption=caption)


def _drives(result: Identification | Validation, efforts: Efforts) -> Section:
    arm = efforts.arm
    blocks: list[Block] = []
    if isinstance(efforts, MotionEfforts):
        section: DynamicSection = result.model.dynamic_model.section
        if figure := friction_over_speed(efforts):
            note = (
                "Line: model in steady sliding. Dots: measured effort minus all other efforts of the model, after "
                "low-pass filtering. Near zero speed, presliding makes the dots differ from the line."
            )
            blocks += [Plot(figure, "Friction along each coordinate over its speed"), Text(note)]
        effects = section.effects
        q = arm.transmission.inverse.position(efforts.q)
        residuals = arm.transmission.pull_back_effort(efforts.residuals)
    else:
        blocks.append(Text("Friction over speed: static poses do not determine it."))
        effects = result.model.holding_effects
        q = efforts.recording.in_joint_coordinates(arm).q
        # The residuals of the unscaled model, because the curves do not contain the feedforward scale.
        unscaled = result.model.static_model.torque(q, result.model.theta)
        residuals = efforts.recording.in_joint_coordinates(arm).measured_effort() - unscaled
        residuals[~efforts.usable] = np.nan
    if figure := torque_over_position(arm, effects, q, residuals):
        caption = "Offset, cables and springs along each coordinate over its position, in the range of the recording"
        blocks.append(Plot(figure, caption))
    else:
        blocks.append(Text("Torque over position: the model has no cable or spring."))
    return Section("Friction and cable curves", blocks)
