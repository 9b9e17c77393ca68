"""Identified models, recalibrations and their errors on recordings: tables in a terminal, and figures of efforts."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from rich.console import Console
from rich.markup import escape

from dvrk_drake.analysis.dynamic.dynamic_identification import DynamicIdentification
from dvrk_drake.analysis.dynamic.estimates import DRY_KINDS, LEAST_TOLD
from dvrk_drake.analysis.dynamic.validation import DynamicValidation, validate_motion
from dvrk_drake.analysis.recalibration import FOLDS, Recalibration
from dvrk_drake.analysis.results import Identification, Validation
from dvrk_drake.analysis.static.static_identification import StaticIdentification
from dvrk_drake.analysis.static.validation import StaticValidation
from dvrk_drake.dynamics.actuator_effects import EFFECT_KINDS
from dvrk_drake.dynamics.dynamic_section import (
    ActuatorStatistics,
    CorrelatedEstimates,
    DynamicSection,
)
from dvrk_drake.dynamics.physical_consistency import total_mass_reached
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.effects_schema import DriveEffect
from dvrk_drake.reports.figures import (
    MEASURED_COLOUR,
    MODEL_COLOUR,
    ZERO_COLOUR,
    plot_static_identification,
    plot_static_validation,
    save_figure,
)
from dvrk_drake.reports.terminal_tables import (
    VERDICT_STYLES,
    make_table,
    print_doubts,
    print_model,
    print_rule,
    print_static_validation,
    print_verdict,
)

#: On a screen: base parameters of more than so many standard errors, so many pairs, so many effects beside friction.
SHOWN_BEYOND, SHOWN_PAIRS, SHOWN_EFFECTS = 10.0, 5, 10


def print_identification(console: Console, result: Identification, full: bool = False) -> None:
    """Prints parameters, effects and errors.

    Args:
        console: to print to.
        result: of poses or of a motion.
        full: print every parameter, and nothing but the model.
    """
    if isinstance(result, DynamicIdentification):
        print_dynamics(console, result, full)
    elif isinstance(result, StaticIdentification):
        if not full:
            print_doubts(console, result.doubts)
        print_model(console, result.model)
        if not full and len(result.recording) < result.num_rows:
            console.print(
                f"{result.num_rows} rows are {len(result.recording)} distinct poses; samples of a pose are averaged"
            )


def print_validation(console: Console, validation: Validation) -> None:
    """Prints verdicts and errors on poses or on a motion."""
    if isinstance(validation, DynamicValidation):
        print_dynamic_validation(console, validation)
    elif isinstance(validation, StaticValidation):
        print_static_validation(console, validation)
        print_doubts(console, validation.doubts)


def plot_identification(folder: Path, result: Identification) -> None:
    """Writes PNGs of fitted and predicted efforts; a motion's as `plot_motion`."""
    if isinstance(result, DynamicIdentification):
        fit = validate_motion(result.model, result.recording)
        arm = result.model.arm
        plot_motion(folder, arm, fit, f"{arm.name}, fitted to {Path(result.recording.source).name}")
    elif isinstance(result, StaticIdentification):
        plot_static_identification(folder, result)


def plot_validation(folder: Path, validation: Validation) -> None:
    """Writes PNGs of errors; a motion's as `plot_motion`."""
    if isinstance(validation, DynamicValidation):
        arm = validation.model.arm
        plot_motion(folder, arm, validation, f"{arm.name}, {Path(validation.recording.source).name}")
    elif isinstance(validation, StaticValidation):
        plot_static_validation(folder, validation)


def print_dynamics(console: Console, result: DynamicIdentification, full: bool = False) -> None:
    """Links, base parameters, the drive, and how each actuator's effort was fitted; `full`: every number of them."""
    section = result.model.dynamic_model.section
    _print_links(console, section, result.nominal_mass)
    _print_base_parameters(console, section, full)
    if full:
        _print_effects(console, section)
    _print_drive(console, section, result.dry_friction)
    tilt = np.degrees(_angle(np.array(section.gravity), np.array(section.gravity_expected)))
    if tilt > 0.1:
        console.print(
            f"gravity in the base frame: {', '.join(f'{x:.3f}' for x in section.gravity)} m/s^2, {tilt:.1f} deg from "
            "what was expected: the base leans, or was not levelled\n",
            soft_wrap=True,
        )
    title = f"Efforts of the actuators behind {section.signals.effort_cut_off:g} Hz [N m; N]"
    table = make_table(title, "", "measured RMS", "error, fit", "cross-validated*", "%, fit", "%, cross*", "%, floor**")
    for a in section.actuators:
        shares = [_percent(x, a.rms_effort) for x in (a.rms_fit, a.rms_cross_validation, a.rms_repeatability)]
        numbers = (a.rms_effort, a.rms_fit, a.rms_cross_validation)
        table.add_row(a.name, *(f"{x:.4f}" for x in numbers), *shares)
    table.add_row("mean", "", "", "", *(_mean_percent(section.actuators, w) for w in _MEANS))
    console.print(table)
    console.print(
        "* sixths of the motion's phases (stretches, if it does not repeat) predicted by models that know nothing of "
        "them: neither parameters nor the choice of effects nor how the base leans. What the arm's file says of its "
        "drives flatters, for it was chosen on such motions; on another day friction is another",
        style="dim",
        soft_wrap=True,
    )
    console.print(
        "** what differs from period to period; a fit is below it where the executed motion differs too\n", style="dim"
    )


def print_dynamic_validation(console: Console, validation: DynamicValidation) -> None:
    """Verdicts, errors on a motion and of what kind they are."""
    print_verdict(console, validation.verdicts)
    title = f"RMS effort error of the actuators behind {validation.cut_off:g} Hz [N m; N]"
    table = make_table(title, "", "measured RMS", "error", "ratio %", "floor %", "verdict")
    table.columns[-1].justify = "left"
    for a in validation.actuators:
        numbers = ("" if x is None else f"{100 * x:.1f}" for x in (a.relative_error, a.repeatability))
        style = VERDICT_STYLES.get(a.verdict, "")
        table.add_row(a.name, f"{a.rms_effort:.4f}", f"{a.rms_error:.4f}", *numbers, a.verdict, style=style)
    table.add_row("mean", "", "", f"{100 * validation.mean_relative_error:.1f}", "", "")
    console.print(table)
    print_rule(console, in_motion=True)
    table = make_table("Shares of the squared error", "", "bias", "friction-like", "position", "other")
    for a in validation.actuators:
        shares = (a.bias, a.friction_like, a.position_dependent, a.other)
        table.add_row(a.name, *(f"{s:.0%}" for s in shares))
    console.print(table)
    console.print("Much bias or friction: recalibrate; much position: cables\n", style="dim", soft_wrap=True)


_COLUMNS = ("", "value", "+-", "unit")
_EFFECT_COLUMNS = ("", "kind", "scale", "value", "+-", "unit if it turns")
_NAME_WIDTH, _REMARK_WIDTH = 64, 30
_MEANS = ("rms_fit", "rms_cross_validation", "rms_repeatability")


def _print_links(console: Console, section: DynamicSection, nominal_mass: float) -> None:
    table = make_table("Links", "", "mass [kg]", "+-", "centre of mass [m]", "+-", "")
    table.columns[-1].no_wrap, table.columns[-1].max_width = False, _REMARK_WIDTH
    for link in section.links:
        m, *h = link.parameters[:4]
        com = np.array(h) / m
        errors = np.array(link.standard_errors[:4])
        # First order, mass and first moments taken for independent: the better known of both decides.
        spread = float(np.max(np.hypot(errors[1:], com * errors[0]))) / m
        remark = "; ".join(link.bounds) + " *" if link.bounds else ("mass: the SDF's" if link.mass_told < 0.5 else "")
        place = ", ".join(f"{x:+.3f}" for x in com)
        table.add_row(link.link, f"{m:.4g}", f"{errors[0]:.1g}", place, f"{spread:.1g}", remark)
    total = sum(link.parameters[0] for link in section.links)
    reached = total_mass_reached(total, nominal_mass)
    table.add_row("all", f"{total:.4g}", "", "", "", f"{nominal_mass:.4g} in the SDF" + " *" * reached)
    console.print(table)
    if reached or any(link.bounds for link in section.links):
        console.print("* at its bound: this number is the bound's, not the motion's", style="yellow")
    console.print(
        "+-: standard errors, of one by one: a motion tells sums of links far better, the base parameters\n",
        style="dim",
        soft_wrap=True,
    )


def _print_base_parameters(console: Console, section: DynamicSection, full: bool) -> None:
    parameters = section.base_parameters
    known = [p for p in parameters if p.told >= LEAST_TOLD and abs(p.value) > SHOWN_BEYOND * p.standard_error]
    title = "Base parameters" if full else f"Base parameters known to {1 / SHOWN_BEYOND:.0%}"
    table = make_table(title, *_COLUMNS, *([""] if full else []))
    table.columns[0].max_width = _NAME_WIDTH
    for p in parameters if full else known:
        remark = "" if p.told >= LEAST_TOLD else "not told"
        if not remark and abs(p.value) < 2 * p.standard_error:
            remark = "zero?"
        numbers = (f"{p.value:+.3g}", f"{p.standard_error:.1g}", p.unit, *([remark] if full else []))
        table.add_row(escape(p.name), *numbers)
    console.print(table)
    rest = [p for p in parameters if p not in known]
    untold = sum(p.told < LEAST_TOLD for p in rest)
    vague = sum(p.told >= LEAST_TOLD and abs(p.value) < 2 * p.standard_error for p in rest)
    console.print(
        f"of {len(parameters)}: {len(rest) - untold - vague} more known to a half, {vague} not told from 0, "
        f"{untold} better told by the SDF",
        style="dim",
        soft_wrap=True,
    )
    _print_correlations(console, section.correlations, len(section.correlations) if full else SHOWN_PAIRS)


def _print_correlations(console: Console, pairs: Sequence[CorrelatedEstimates], most: int) -> None:
    for pair in pairs[:most]:
        what = "difference" if pair.correlation > 0 else "sum"
        console.print(
            f"not told apart: {pair.first} | {pair.second}: {pair.correlation:+.3f}, only their scaled {what} is known",
            style="yellow",
            markup=False,
            soft_wrap=True,
        )
    if len(pairs) > most:
        console.print(f"and {len(pairs) - most} more pairs", style="yellow")
    console.print()


def _print_drive(console: Console, section: DynamicSection, dry: dict[str, tuple[float, float]]) -> None:
    others = [e for e in section.effects if e.kind not in (*DRY_KINDS, "viscous", "offset")]
    table = make_table("Drive [N m, N m s/rad; N, N s/m]", "", "dry friction", "+-", "viscous", "+-", "offset", "+-")
    for name in dict.fromkeys([*dry, *(e.coordinate for e in section.effects)]):
        cells = [f"{dry[name][0]:.3g}", f"{dry[name][1]:.1g}"] if name in dry else ["", ""]
        for kind in ("viscous", "offset"):
            found = next((e for e in section.effects if e.coordinate == name and e.kind == kind), None)
            cells += ["", ""] if found is None else [f"{found.coefficient:.3g}", f"{found.standard_error:.1g}"]
        table.add_row(name, *cells)
    console.print(table)
    if others:
        strongest = sorted(others, key=lambda e: -abs(e.coefficient) / (e.standard_error or 1.0))[:SHOWN_EFFECTS]
        table = make_table("Springs, cables, friction by direction", *_EFFECT_COLUMNS)
        for e in strongest:
            table.add_row(*_effect_cells(e))
        console.print(table)
        if len(others) > len(strongest):
            console.print(f"and {len(others) - len(strongest)} more, less certain", style="dim")
    console.print()


def _print_effects(console: Console, section: DynamicSection) -> None:
    table = make_table("Effects in the drive", *_EFFECT_COLUMNS)
    for rotor in section.rotors:
        row = (f"{rotor.value:.3g}", f"{rotor.standard_error:.1g}", "kg m^2")
        table.add_row(f"actuator.{rotor.actuator}", "rotor", "", *row)
    for e in sorted(section.effects, key=lambda e: (e.coordinate, e.kind, e.scale)):
        table.add_row(*_effect_cells(e))
    console.print(table)


def _effect_cells(e: DriveEffect) -> tuple[str, ...]:
    scale = f"{e.scale:g}" if e.scale else ""
    return e.coordinate, e.kind, scale, f"{e.coefficient:+.3g}", f"{e.standard_error:.1g}", EFFECT_KINDS[e.kind].unit


def _percent(part: float, whole: float) -> str:
    return f"{100 * part / whole:.1f}" if whole > 0 and part > 0 else ""


def _mean_percent(actuators: list[ActuatorStatistics], which: str) -> str:
    shares = [getattr(a, which) / a.rms_effort for a in actuators if a.rms_effort > 0]
    return f"{100 * np.mean(shares):.1f}" if shares and np.any(shares) else ""


def _angle(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b))


def plot_motion(folder: Path, arm: Arm, validation: DynamicValidation, title: str) -> None:
    """Writes efforts.png, residuals.png and error_budget.png of a motion."""
    _plot_efforts(folder / "efforts.png", arm, validation, title)
    _plot_residuals(folder / "residuals.png", arm, validation, title)
    _plot_budget(folder / "error_budget.png", validation, title)


def _plot_efforts(path: Path, arm: Arm, validation: DynamicValidation, title: str) -> None:
    """One panel an actuator: measured and predicted effort over time, and their difference."""
    count = arm.num_joints
    figure, axes = plt.subplots(count, 1, figsize=(13, 1.9 * count), sharex=True, layout="constrained")
    for i, (actuator, ax) in enumerate(zip(validation.actuators, axes, strict=True)):
        measured, predicted = validation.measured[:, i], validation.predicted[:, i]
        ax.plot(validation.t, measured - predicted, color=ZERO_COLOUR, linewidth=0.8, label="measured - predicted")
        ax.plot(validation.t, measured, color=MEASURED_COLOUR, linewidth=1.0, label="measured")
        ax.plot(validation.t, predicted, color=MODEL_COLOUR, linewidth=1.0, label="predicted")
        relative = "" if actuator.relative_error is None else f", error {100 * actuator.relative_error:.1f} %"
        ax.set_title(f"actuator {i + 1} {actuator.name}{relative}", fontsize=9)
        ax.set_ylabel("N" if arm.prismatic[i] else "N m", fontsize=8)
        ax.tick_params(labelsize=7)
    axes[-1].set_xlabel("time [s]", fontsize=8)
    axes[0].legend(fontsize=7, loc="upper right", ncols=3)
    figure.suptitle(f"{title}: efforts of the actuators behind {validation.cut_off:g} Hz")
    save_figure(figure, path)


def _plot_residuals(path: Path, arm: Arm, validation: DynamicValidation, title: str) -> None:
    """One column an actuator: the difference over position, velocity and time."""
    count = arm.num_joints
    figure, axes = plt.subplots(3, count, figsize=(2.6 * count, 7), sharey="col", layout="constrained")
    residuals = validation.measured - validation.predicted
    for i, actuator in enumerate(validation.actuators):
        length = "m" if arm.prismatic[i] else "rad"
        over = (
            (validation.q[:, i], f"position [{length}]"),
            (validation.v[:, i], f"velocity [{length}/s]"),
            (validation.t, "time [s]"),
        )
        for (x, label), ax in zip(over, axes[:, i], strict=True):
            ax.plot(x, residuals[:, i], ",", color=MODEL_COLOUR, alpha=0.5)
            ax.axhline(0.0, color="black", linewidth=0.6)
            ax.set_xlabel(label, fontsize=8)
            ax.tick_params(labelsize=7)
        axes[0, i].set_title(f"{i + 1} {actuator.name}\n[{'N' if arm.prismatic[i] else 'N m'}]", fontsize=9)
    figure.suptitle(f"{title}: measured - predicted effort")
    save_figure(figure, path)


def _plot_budget(path: Path, validation: DynamicValidation, title: str) -> None:
    """Stacked shares of each actuator's squared error, their height the relative error."""
    kinds = ("bias", "friction_like", "position_dependent", "other")
    colours = ("#edae49", MEASURED_COLOUR, MODEL_COLOUR, ZERO_COLOUR)
    figure, ax = plt.subplots(figsize=(11, 5), layout="constrained")
    heights = np.array([100 * (a.relative_error or 0.0) for a in validation.actuators])
    bottom = np.zeros(len(heights))
    for kind, colour in zip(kinds, colours, strict=True):
        part = heights * np.array([getattr(a, kind) for a in validation.actuators])
        ax.bar(range(len(heights)), part, 0.6, bottom=bottom, color=colour, label=kind.replace("_", " "))
        bottom += part
    for i, actuator in enumerate(validation.actuators):
        if actuator.repeatability is not None:
            floor = 100 * actuator.repeatability
            ax.plot(
                [i - 0.35, i + 0.35], [floor, floor], color="black", linewidth=1.2, label="_" if i else "repeatability"
            )
    ax.set_xticks(range(len(heights)), [a.name.replace("_", "\n") for a in validation.actuators], fontsize=8)
    ax.set_ylabel("relative error [%], split by shares of its square")
    ax.set_title(title)
    ax.legend(fontsize=8)
    save_figure(figure, path)


def print_recalibration(console: Console, result: Recalibration) -> None:
    """Errors before and after, what is kept, and the new scales."""
    title = f"Error over {result.seconds:.1f} s*, and friction after the fit to all of it"
    table = make_table(title, "", "before", "refit", "", "dry friction x", "viscous x", "offset +")
    for a in result.actuators:
        new = [_scale(a.dry), _scale(a.viscous), f"{a.offset:+.4f}"] if a.kept else ["as it was", "", ""]
        table.add_row(a.name, f"{100 * a.before:.1f} %", f"{100 * a.after:.1f} %", "kept" if a.kept else a.reason, *new)
    before, after = (float(np.mean([getattr(a, which) for a in result.actuators])) for which in ("before", "after"))
    table.add_row("mean", f"{100 * before:.1f} %", f"{100 * after:.1f} %", "", "", "", "")
    console.print(table)
    console.print(
        "* actuators: |tau_f - tau_hat| / |tau_f| behind the model's low-pass; refit: each of "
        f"{FOLDS} parts of the motion predicted from the others\n",
        style="dim",
    )
    console.print(
        "This gain is for motions like the recalibration recording. At other positions and speeds it can be much "
        "smaller: validate the new model on the motion that you need.\n",
        soft_wrap=True,
    )
    shared = [f"{name} x {scale:.2f}" for name, scale in result.shared.items()]
    if shared:
        console.print(f"friction that actuators share: {', '.join(shared)}", soft_wrap=True)


def _scale(scale: float | None) -> str:
    return "none" if scale is None else f"{scale:.2f}"
