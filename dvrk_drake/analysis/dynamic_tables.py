"""An arm's identified dynamics, and its errors on another motion, in a terminal."""

from __future__ import annotations

import numpy as np
from rich.console import Console

from dvrk_drake.analysis.dynamic_validation import DynamicValidation
from dvrk_drake.analysis.tables import make_table
from dvrk_drake.dynamics.actuator_effects import EFFECT_KINDS
from dvrk_drake.dynamics.dynamic_section import ActuatorStatistics, DynamicSection
from dvrk_drake.dynamics.identified_model import IdentifiedModel


def print_dynamics(console: Console, model: IdentifiedModel) -> None:
    """Links, rotors, the drive's effects, and how each actuator's effort was fitted."""
    section = model.dynamic_model.section
    table = make_table("Links", "", "mass [kg]", "centre of mass [m]", "least eigenvalue of the pseudo-inertia")
    for link in section.links:
        m, *h = link.parameters[:4]
        com = ", ".join(f"{x / m:+.3f}" for x in h)
        table.add_row(link.link, f"{m:.4f}", com, f"{link.least_eigenvalue:.1e}")
    console.print(table)
    _print_drive(console, section)
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
    """Errors on a motion and of what kind they are."""
    title = f"Efforts of the actuators behind {validation.cut_off:g} Hz [N m; N]"
    kinds = ("bias", "friction-like", "position", "other")
    table = make_table(title, "", "measured RMS", "error", "%", "floor %", *kinds)
    for a in validation.actuators:
        relative = "" if a.relative_error is None else f"{100 * a.relative_error:.1f}"
        floor = "" if a.repeatability is None else f"{100 * a.repeatability:.1f}"
        shares = (a.bias, a.friction_like, a.position_dependent, a.other)
        table.add_row(
            a.name, f"{a.rms_effort:.4f}", f"{a.rms_error:.4f}", relative, floor, *(f"{s:.0%}" for s in shares)
        )
    table.add_row("mean", "", "", f"{100 * validation.mean_relative_error:.1f}", "", *[""] * len(kinds))
    console.print(table)
    console.print(
        "bias ... other: shares of the squared error. Much bias or friction: recalibrate; much position: cables\n",
        style="dim",
        soft_wrap=True,
    )


_MEANS = ("rms_fit", "rms_cross_validation", "rms_repeatability")


def _print_drive(console: Console, section: DynamicSection) -> None:
    table = make_table("Effects in the drive", "", "kind", "scale", "value", "standard error", "unit if it turns")
    for rotor in section.rotors:
        row = (f"{rotor.value:.3g}", f"{rotor.standard_error:.1g}", "kg m^2")
        table.add_row(f"actuator.{rotor.actuator}", "rotor", "", *row)
    for e in sorted(section.effects, key=lambda e: (e.coordinate, e.kind, e.scale)):
        scale = f"{e.scale:g}" if e.scale else ""
        numbers = (f"{e.value:+.3g}", f"{e.standard_error:.1g}")
        table.add_row(e.coordinate, e.kind, scale, *numbers, EFFECT_KINDS[e.kind].unit)
    console.print(table)


def _percent(part: float, whole: float) -> str:
    return f"{100 * part / whole:.1f}" if whole > 0 and part > 0 else ""


def _mean_percent(actuators: list[ActuatorStatistics], which: str) -> str:
    shares = [getattr(a, which) / a.rms_effort for a in actuators if a.rms_effort > 0]
    return f"{100 * np.mean(shares):.1f}" if shares and np.any(shares) else ""


def _angle(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b))
