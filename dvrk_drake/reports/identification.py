"""Prints identification, validation and recalibration results to a terminal."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import chain
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.markup import escape

from dvrk_drake.analysis.dynamic.dynamic_identification import DynamicIdentification
from dvrk_drake.analysis.dynamic.estimates import MIN_IDENTIFIABILITY
from dvrk_drake.analysis.dynamic.validation import SHARE_LABELS, DynamicValidation
from dvrk_drake.analysis.recalibration import FOLDS, Recalibration
from dvrk_drake.analysis.results import Identification, Validation
from dvrk_drake.analysis.static.excluded_measurements import ExcludedMeasurement
from dvrk_drake.analysis.static.static_identification import StaticIdentification
from dvrk_drake.analysis.static.validation import StaticValidation
from dvrk_drake.analysis.verdict import MIN_COVERAGE, cross_validated_verdicts, identified_coverage, rule_text
from dvrk_drake.dynamics.actuator_effects import ActuatorEffect
from dvrk_drake.dynamics.dynamic_section import CorrelatedEstimates, DynamicSection
from dvrk_drake.dynamics.gravity_parameters import gravity_parameters
from dvrk_drake.dynamics.identified_model import IdentifiedModel, Verdict
from dvrk_drake.dynamics.physical_consistency import total_mass_reached
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.effect_kinds import EFFECT_KINDS
from dvrk_drake.models.effects_schema import DriveEffect, half_width
from dvrk_drake.reports.answers import Answer, answer_of, percent
from dvrk_drake.reports.terminal_tables import make_table, print_answer, print_note

#: Colours of table rows by verdict.
_STYLES: dict[Verdict, str] = {"do not use": "red", "not judged": "yellow"}
_EFFECT_COLUMNS = ("", "kind", "scale", "value", "+-", "unit (revolute)")
_NAME_WIDTH = 64


def print_identification(
    console: Console,
    result: Identification,
    *,
    model_path: str = "MODEL.yaml",
    file_options: str = "",
    verbose: bool = False,
) -> None:
    """Prints the verdict and the cross-validated error of each joint.

    Args:
        console: Console to print to.
        result: Result for static poses or for a motion.
        model_path: Path of the written model, for the suggested next command.
        file_options: Options with which the recording was read, beginning with a space, for the suggested next command.
        verbose: Whether to print each parameter with its standard error, and the excluded measurements.
    """
    answer = answer_of(result, model_path=model_path, file_options=file_options)
    _print_answer(console, answer)
    verdicts = cross_validated_verdicts(result.model)
    if isinstance(result, DynamicIdentification):
        _print_motion_errors(console, result, verdicts)
        if verbose:
            _print_motion_details(console, result)
    elif isinstance(result, StaticIdentification):
        _print_pose_errors(console, result, verdicts, verbose)
        if verbose:
            _print_pose_details(console, result)
    _print_coverage(console, verdicts, identified_coverage(result.model).tolist())
    _print_locked_joints(console, result.model.arm)


def _print_coverage(console: Console, verdicts: Mapping[str, Verdict], covered: Sequence[float]) -> None:
    """Prints the joints of which too little of the range is covered for the verdict "good"."""
    judged = zip(verdicts.items(), covered, strict=True)
    few = [name for (name, verdict), share in judged if verdict == "usable" and share < MIN_COVERAGE]
    if few:
        limit = f"less than {100 * MIN_COVERAGE:g} % of the range (at most 180 deg) is covered"
        text = f"At most usable, because {limit}: {', '.join(few)}."
        console.print(text, markup=False)


def _print_locked_joints(console: Console, arm: Arm) -> None:
    """Prints the locked joints, and the positions for which the model is valid."""
    if arm.locked_joints:
        console.print(
            f"Not in the recording: {', '.join(arm.locked_joints)}. The model is valid only for {arm.locked_text} "
            "[rad, m], and it has no efforts of these joints.",
            style="yellow",
            markup=False,
        )


def print_validation(
    console: Console,
    validation: Validation,
    *,
    model_path: str = "MODEL.yaml",
    file_options: str = "",
    saved: bool = False,
    verbose: bool = False,
) -> None:
    """Prints the verdict on a recording and the error of each joint.

    Args:
        console: Console to print to.
        validation: Result for static poses or for a motion.
        model_path: Path of the model, for the suggested next command.
        file_options: Options with which the recording was read, beginning with a space, for the suggested next command.
        saved: Whether the verdicts are stored in the model file, from which the command `control` reads them.
        verbose: Whether to print the rule for the verdicts, the kinds of errors, and the excluded measurements.
    """
    answer = answer_of(validation, model_path=model_path, file_options=file_options, saved=saved)
    _print_answer(console, answer)
    if isinstance(validation, DynamicValidation):
        _print_motion_validation(console, validation, verbose)
    elif isinstance(validation, StaticValidation):
        _print_pose_validation(console, validation, verbose)
    if isinstance(validation, DynamicValidation | StaticValidation):
        judged = validation.actuators if isinstance(validation, DynamicValidation) else validation.joints
        _print_coverage(console, validation.verdicts, [joint.coverage for joint in judged])
    _print_locked_joints(console, validation.model.arm)


def print_recalibration(
    console: Console, result: Recalibration, *, model_path: str = "MODEL.yaml", verbose: bool = False
) -> None:
    """Prints the errors before and after the refit, and the change of friction and offsets.

    Args:
        console: Console to print to.
        result: Result of the recalibration.
        model_path: Path of the new model, for the suggested next command.
        verbose: Whether to print the definition of the errors, and the factors of friction that acts on several
            actuators.
    """
    before, after = (float(np.mean([getattr(a, which) for a in result.actuators])) for which in ("before", "after"))
    kept = sum(a.kept for a in result.actuators)
    print_answer(
        console,
        f"Mean effort error {percent(before)} before and {percent(after)} after the refit, cross-validated; "
        f"{kept} of {len(result.actuators)} actuators refitted.",
        f"dvrk-drake validate OTHER.csv --model {model_path} --save",
    )
    table = make_table(
        f"{result.model.arm.name}, {result.seconds:.1f} s of motion: effort error, change of friction and offset",
        *(
            "",
            "error before",
            "error after",
            "dry friction factor",
            "viscous factor",
            "offset change [N m; N]",
            "unchanged because",
        ),
    )
    for a in result.actuators:
        new = [_factor(a.dry), _factor(a.viscous), f"{a.offset:+.4f}"] if a.kept else ["", "", ""]
        table.add_row(a.name, percent(a.before), percent(a.after), *new, a.reason)
    table.columns[-1].justify, table.columns[-1].no_wrap = "left", False
    table.add_row("mean", percent(before), percent(after), "", "", "", "")
    console.print(table)
    print_note(
        console,
        "The improvement is valid for similar motions. At other positions and speeds, the improvement can be much "
        "smaller. Validate the new model on the motion that you need.",
    )
    if not verbose:
        return
    print_note(
        console,
        f"Error: RMS(measured - predicted effort) / RMS(measured effort), after the low-pass filter of the model. "
        f"Error after: {FOLDS}-fold cross-validation over the motion. Factors and offsets: fit to the whole motion.",
    )
    if result.shared:
        shared = ", ".join(f"{name} x {scale:.2f}" for name, scale in result.shared.items())
        console.print(f"Factors of friction that acts on several actuators: {shared}", markup=False)


def _print_answer(console: Console, answer: Answer) -> None:
    print_answer(console, answer.text, answer.next_command, _STYLES.get(answer.verdict, "green"))


def _print_motion_errors(console: Console, result: DynamicIdentification, verdicts: Mapping[str, Verdict]) -> None:
    section = result.model.dynamic_model.section
    several = f"{len(result.motions)} recordings, " if len(result.motions) > 1 else ""
    title = f"{result.model.arm.name}, {several}{result.num_rows} rows of motion: effort and relative error (RMS)"
    columns = ("", "effort [N m; N]", "fit error", "cross-validation error", "repeatability", "verdict")
    table = make_table(title, *columns)
    table.columns[-1].justify = "left"
    errors = ("rms_fit", "rms_cross_validation", "rms_repeatability")
    shares = {
        a.name: [getattr(a, which) / a.rms_effort if a.rms_effort > 0 else 0.0 for which in errors]
        for a in section.actuators
    }
    for a in section.actuators:
        verdict = verdicts[a.name]
        cells = (percent(share) if share > 0 else "" for share in shares[a.name])
        table.add_row(a.name, f"{a.rms_effort:.4f}", *cells, verdict, style=_STYLES.get(verdict, ""))
    moved = [shares[a.name] for a in section.actuators if a.rms_effort > 0]
    means = np.mean(moved, axis=0) if moved else np.zeros(3)
    table.add_row("mean", "", *(percent(mean) if mean > 0 else "" for mean in means), "")
    console.print(table)
    if several:
        console.print()
        _print_error_of_each_recording(console, result)
    tilt = np.degrees(_angle(np.array(section.gravity), np.array(section.gravity_expected)))
    if tilt > 0.1:
        gravity = ", ".join(f"{x:.3f}" for x in section.gravity)
        console.print(
            f"The base is tilted by {tilt:.1f} deg. Gravity in the base frame: {gravity} m/s^2.", markup=False
        )
    console.print()


def _print_error_of_each_recording(console: Console, result: DynamicIdentification) -> None:
    names = [Path(motion.recording.source).name or "recording" for motion in result.motions]
    table = make_table("Relative error of each recording, predicted by a model of the others", "", *names)
    errors = np.column_stack([motion.held_out_errors for motion in result.motions])
    for name, row in zip(result.model.arm.joint_names, errors, strict=True):
        table.add_row(name, *(percent(error) if np.isfinite(error) else "" for error in row))
    table.add_row("mean", *map(percent, np.nanmean(errors, axis=0)))
    console.print(table)
    print_note(console, f"The intervals include only the differences between these {len(names)} recordings.")


def _print_motion_details(console: Console, result: DynamicIdentification) -> None:
    """Prints each parameter with its standard error."""
    section = result.model.dynamic_model.section
    how = "6 folds over the phase of the motion; effects, base tilt and parameters are estimated anew in each fold"
    if len(result.motions) > 1:
        how = "each recording is predicted by a model of the others, with the mean of their offsets and friction"
    print_note(
        console,
        f"Low-pass filter of the efforts: {section.signals.effort_cut_off:g} Hz. Cross-validation: {how}. On another "
        "recording the error can be larger, because friction changes from day to day. Repeatability: difference "
        "between periods of the motion. The fit error can be smaller than the repeatability if the periods of the "
        "executed motion differ.",
    )
    _print_links(console, section, result.nominal_mass)
    _print_base_parameters(console, section)
    _print_correlations(console, section.correlations)
    _print_drive(console, section, result.dry_friction)
    _print_effects(console, section)


def _print_links(console: Console, section: DynamicSection, nominal_mass: float) -> None:
    table = make_table("Links, centre of mass in the link frame", "", "mass [kg]", "+-", "centre of mass [m]", "+-", "")
    table.columns[0].no_wrap, table.columns[-1].no_wrap = True, False
    for link in section.links:
        m, *h = link.parameters[:4]
        com = np.array(h) / m
        errors = np.array(link.standard_errors[:4])
        # First-order propagation of independent errors of mass and first moments.
        spread = float(np.max(np.hypot(errors[1:], com * errors[0]))) / m
        remark = (
            "; ".join(link.bounds) + " *" if link.bounds else ("SDF's mass" if link.mass_identifiability < 0.5 else "")
        )
        place = ", ".join(f"{x:+.3f}" for x in com)
        table.add_row(link.link, f"{m:.4g}", f"{errors[0]:.1g}", place, f"{spread:.1g}", remark)
    total = sum(link.parameters[0] for link in section.links)
    reached = total_mass_reached(total, nominal_mass)
    table.add_row("all", f"{total:.4g}", "", "", "", f"SDF: {nominal_mass:.4g}" + " *" * reached)
    console.print(table)
    if reached or any(link.bounds for link in section.links):
        console.print("* The estimate is at its bound, so the recording does not determine the value.", style="yellow")
    print_note(
        console,
        "+-: standard error. Base parameters combine parameters of several links. A motion determines the base "
        "parameters more accurately than the parameters of one link.",
    )


def _print_base_parameters(console: Console, section: DynamicSection) -> None:
    table = make_table("Base parameters of the dynamics", "", "value", "+-", "unit", "")
    table.columns[0].max_width = _NAME_WIDTH
    for p in section.base_parameters:
        remark = "" if p.identifiability >= MIN_IDENTIFIABILITY else "from the SDF"
        if not remark and abs(p.value) < half_width(p.standard_error, section.degrees_of_freedom):
            remark = "zero?"
        table.add_row(escape(p.name), f"{p.value:+.3g}", f"{p.standard_error:.1g}", p.unit, remark)
    console.print(table)
    print_note(
        console,
        "from the SDF: the motion does not determine this parameter. zero?: the 95 % interval contains 0.",
    )


def _print_correlations(console: Console, pairs: Sequence[CorrelatedEstimates]) -> None:
    for pair in pairs:
        what = "difference" if pair.correlation > 0 else "sum"
        console.print(
            f"not identifiable separately: {pair.first} and {pair.second} (correlation {pair.correlation:+.3f}). Only "
            f"a scaled {what} is identifiable.",
            style="yellow",
            markup=False,
        )
    if pairs:
        console.print()


def _print_drive(console: Console, section: DynamicSection, dry: dict[str, tuple[float, float]]) -> None:
    table = make_table(
        "Friction and offset [N m, N m s/rad; N, N s/m]", "", "dry", "+-", "viscous", "+-", "offset", "+-"
    )
    for name in dict.fromkeys([*dry, *(e.coordinate for e in section.effects)]):
        cells = [f"{dry[name][0]:.3g}", f"{dry[name][1]:.1g}"] if name in dry else ["", ""]
        for kind in ("viscous", "offset"):
            found = next((e for e in section.effects if e.coordinate == name and e.kind == kind), None)
            cells += ["", ""] if found is None else [f"{found.coefficient:.3g}", f"{found.standard_error:.1g}"]
        table.add_row(name, *cells)
    console.print(table)
    console.print()


def _print_effects(console: Console, section: DynamicSection) -> None:
    table = make_table("Rotor inertias and joint effects", *_EFFECT_COLUMNS)
    for rotor in section.rotors:
        row = (f"{rotor.value:.3g}", f"{rotor.standard_error:.1g}", "kg m^2")
        table.add_row(f"actuator.{rotor.actuator}", "rotor", "", *row)
    for e in sorted(section.effects, key=lambda e: (e.coordinate, e.kind, e.scale)):
        table.add_row(*_effect_cells(e))
    console.print(table)


def _effect_cells(e: DriveEffect) -> tuple[str, ...]:
    scale = f"{e.scale:.2g}" if e.scale else ""
    return e.coordinate, e.kind, scale, f"{e.coefficient:+.3g}", f"{e.standard_error:.1g}", EFFECT_KINDS[e.kind].unit


def _print_pose_errors(
    console: Console, result: StaticIdentification, verdicts: Mapping[str, Verdict], verbose: bool
) -> None:
    joints, poses = result.model.joints, len(result.recording)
    title = f"{result.model.arm.name}, {poses} static poses: RMS effort and cross-validation error [N m; N]"
    columns = ("measured", "error", "ratio", "feedforward scale", "range covered", "verdict")
    table = make_table(title, "", *columns)
    table.columns[-1].justify = "left"
    for j in joints:
        torque, error, verdict = j.rms_zero_torque_included, j.rms_cross_validation_included, verdicts[j.name]
        table.add_row(
            *(j.name, f"{torque:.4f}", f"{error:.4f}", f"{error / torque:.2f}" if torque > 0 else ""),
            *(f"{j.feedforward_scale:.2f}", f"{100 * j.coverage:.0f} %", verdict),
            style=_STYLES.get(verdict, ""),
        )
    console.print(table)
    if num_excluded := sum(j.num_excluded for j in joints):
        lists = "" if verbose else " --verbose lists them."
        console.print(f"{num_excluded} of {result.usable.size} measurements were excluded.{lists}")
    if poses < result.num_rows:
        console.print(f"The {result.num_rows} rows contain {poses} distinct poses. Samples of one pose were averaged.")
    for j in joints:
        if j.feedforward_scale == 0.0:
            why = "the recording does not separate gravity from friction."
            if j.rms_zero_torque == 0.0:
                why = "its effort was not measured."
            console.print(f"{j.name}: feedforward disabled, because {why}", style="yellow", markup=False)
    console.print()


def _print_pose_details(console: Console, result: StaticIdentification) -> None:
    """Prints the excluded measurements, the parameters with standard errors, and the errors of each joint."""
    print_note(
        console,
        "Cross-validation error: 10 folds over the poses. Effects, parameters and feedforward scales are estimated "
        "anew in each fold.",
    )
    _print_excluded(console, result.excluded)
    print_static_parameters(console, result.model)


def print_static_parameters(console: Console, model: IdentifiedModel) -> None:
    """Prints the parameters of a static model with standard errors, then the errors of each joint."""
    provenance = model.provenance
    table = make_table("Base parameters of gravity", "", "value", "standard error", "unit", "")
    units = gravity_parameters(model.arm).base.units
    for p, unit in zip(model.base_parameters, units, strict=True):
        zero = "" if p.distinguishable else "zero?"
        table.add_row(escape(p.name), f"{p.value:+.5f}", f"{p.standard_error:.5f}", unit, zero)
    console.print(table)
    print_note(
        console,
        f"Method {provenance.method}, rank {provenance.rank} of {len(model.base_parameters)}, condition number "
        f"{provenance.condition_number:.3g}. zero?: the 95 % interval contains 0.",
    )
    if model.effects:
        table = make_table("Joint effects [N m; N]", "", "value", "standard error", "")
        for e in model.effects:
            numbers = (f"{e.coefficient:+.5f}", f"{e.standard_error:.5f}", "" if e.distinguishable else "zero?")
            table.add_row(str(ActuatorEffect.of(e)), *numbers)
        console.print(table)
        console.print()
    title = "RMS error [N m; N] (* including the excluded measurements)"
    table = make_table(
        title, "", "fit", "leave-one-out", "zero torque*", "fit*", "leave-one-out*", "positions [rad; m]"
    )
    for j in model.joints:
        own = (j.rms_fit_included, j.rms_leave_one_out_included)
        errors = (*own, j.rms_zero_torque, j.rms_fit, j.rms_leave_one_out)
        positions = f"{j.position_lower:+.2f}..{j.position_upper:+.2f}"
        table.add_row(j.name, *(f"{e:.4f}" for e in errors), positions)
    console.print(table)
    console.print()


def _print_excluded(console: Console, excluded: Sequence[ExcludedMeasurement]) -> None:
    if not excluded:
        return
    console.print(f"Excluded measurements in {len({d.where for d in excluded})} poses:", style="yellow")
    for measurement in excluded:
        console.print(f"  {measurement.where}: {measurement.reason}", style="yellow", markup=False)
    console.print()


def _print_motion_validation(console: Console, validation: DynamicValidation, verbose: bool) -> None:
    name = Path(validation.recording.source).name or "recording"
    title = f"{validation.model.arm.name}, motion of {name}: RMS effort and error [N m; N]"
    table = make_table(title, "", "effort", "error", "ratio", "repeatability", "inside", "other day", "verdict")
    table.columns[-1].justify = "left"
    for a in validation.actuators:
        shares = (
            "" if x is None else percent(x) for x in (a.relative_error, a.repeatability, a.inside, a.inside_other_day)
        )
        style = _STYLES.get(a.verdict, "")
        table.add_row(a.name, f"{a.rms_effort:.4f}", f"{a.rms_error:.4f}", *shares, a.verdict, style=style)
    table.add_row("mean", "", "", percent(validation.mean_relative_error), "", "", "", "")
    console.print(table)
    console.print()
    if not verbose:
        return
    print_note(
        console,
        "inside: share of the measured efforts inside the prediction interval of the same day. other day: inside the "
        f"interval of another day. {validation.model.interval_scope}",
    )
    print_note(console, f"{rule_text()} Low-pass filter: {validation.cut_off:g} Hz.")
    table = make_table("Largest shares of the squared error", "", "share", "cause", "share", "cause")
    for a in validation.actuators:
        causes = [(share, label) for share, label in zip(a.shares, SHARE_LABELS, strict=True) if share is not None]
        largest = sorted(causes, reverse=True)[:2]
        table.add_row(a.name, *chain.from_iterable((f"{100 * share:.0f} %", label) for share, label in largest))
    for column in (2, 4):
        table.columns[column].justify = "left"
    console.print(table)
    print_note(
        console,
        "If the share of the bias or of the friction-like error is large, recalibrate. A large position-dependent "
        "share indicates that the cables changed. No model reduces the share that does not repeat between periods. "
        "--report shows all shares.",
    )


def _print_pose_validation(console: Console, validation: StaticValidation, verbose: bool) -> None:
    name = Path(validation.recording.source).name or "recording"
    title = f"{validation.model.arm.name}, {validation.poses} poses of {name}: RMS effort and error [N m; N]"
    table = make_table(title, "", "measured", "error", "ratio", "excluded", "verdict")
    table.columns[-1].justify = "left"
    for j in validation.joints:
        ratio = "" if j.relative_error_included is None else f"{j.relative_error_included:.2f}"
        numbers = (f"{j.rms_torque_included:.4f}", f"{j.rms_error_included:.4f}", ratio, f"{j.num_excluded or ''}")
        table.add_row(j.name, *numbers, j.verdict, style=_STYLES.get(j.verdict, ""))
    console.print(table)
    console.print()
    if not verbose:
        return
    print_note(console, rule_text())
    if validation.excluded:
        table = make_table("RMS effort and error [N m; N], all measurements", "", "measured", "error", "ratio")
        for j in validation.joints:
            ratio = "" if j.relative_error is None else f"{j.relative_error:.2f}"
            table.add_row(j.name, f"{j.rms_torque:.4f}", f"{j.rms_error:.4f}", ratio)
        console.print(table)
        console.print()
    _print_excluded(console, validation.excluded)


def _factor(factor: float | None) -> str:
    return "none" if factor is None else f"{factor:.2f}"


def _angle(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b))
