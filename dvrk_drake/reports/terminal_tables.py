"""Results as tables in a terminal."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.markup import escape
from rich.measure import Measurement
from rich.table import Table
from rich.text import Text

from dvrk_drake.analysis.static.doubts import Doubt
from dvrk_drake.analysis.static.validation import StaticValidation
from dvrk_drake.analysis.verdict import rule_text, worst
from dvrk_drake.dynamics.actuator_effects import ActuatorEffect
from dvrk_drake.dynamics.gravity_regressor import SymbolicGravity, derive_gravity
from dvrk_drake.dynamics.identified_model import IdentifiedModel, Verdict
from dvrk_drake.experiments.demo.demo import NO_DRY_FRICTION, DemoResult
from dvrk_drake.experiments.demo.teleoperation import TeleoperationResult
from dvrk_drake.experiments.simulation import Simulation
from dvrk_drake.models.arm import Arm

TABLE_WIDTH = 112
RULE_WIDTH = 80
#: A space in a heading, but none of a unit in brackets or at a bar.
_BETWEEN_WORDS = re.compile(r"(?<!\|) (?![^\[]*\]|\|)")

NEXT_STEPS = """
Open {folder}/arm.html in a browser: the arm is held, released, and driven home.

With a real arm:
  1. Record poses at rest: move it by hand to 40 or more varied poses inside its limits, let position control hold
     each, coming from changing sides (friction is in every measurement), and write q1..q7, tau1..tau7 of every
     settled pose into a CSV [rad, N m; m, N] (lines for that are in docs/public_recordings.md).
  2. dvrk-drake identify poses.csv --arm {arm} --output model.yaml --plots plots
  3. Record some more on another day:  dvrk-drake validate model.yaml other.csv --require usable --save
  4. Only when no joint's verdict is "do not use" there, let GravityPidController(model) near the arm, with a
     hand on the stop button. Switch the controller's own gravity compensation off first, or it is compensated twice."""


class TableConsole(Console):
    """Prints a table as wide as the terminal, or as its numbers need.

    In a narrow one headings are stacked and names folded; digits are never lost.
    """

    def print(self, *objects: Any, **options: Any) -> None:
        """As rich's Console does."""
        width = self.width
        for table in (thing for thing in objects if isinstance(thing, Table)):
            if self._least_width(table) > width:
                for column in table.columns:
                    column.header = _BETWEEN_WORDS.sub("\n", str(column.header))
            self.width = max(self.width, self._least_width(table))
        try:
            super().print(*objects, **options)
        finally:
            self.width = width

    def _least_width(self, table: Table) -> int:
        """With the numbers on one line each. Rich's own measure breaks them between words."""
        free = self.options.update(max_width=10 * TABLE_WIDTH)
        least = 2 * (len(table.columns) - 1)
        for column in table.columns:
            sizes = [Measurement.get(self, free, cell) for cell in (column.header, *column.cells)]
            least += max(size.maximum if column.no_wrap else size.minimum for size in sizes)
        return least


def make_console() -> Console:
    """A console on stdout, as wide as the terminal; where it is none, as wide as the tables."""
    console = TableConsole(highlight=False)
    if not console.is_terminal and "COLUMNS" not in os.environ:
        console.width = TABLE_WIDTH
    return console


def print_model(console: Console, model: IdentifiedModel) -> None:
    """Parameters with their standard errors, then how each joint was fitted."""
    provenance = model.provenance
    console.print(
        f"{model.arm.name}, {provenance.poses} poses, method {provenance.method}, rank {provenance.rank} of "
        f"{len(model.base_parameters)}, condition number {provenance.condition_number:.3g}\n"
    )
    table = make_table("Base parameters", "", "value", "standard error", "unit", "|value| < 2 se")
    units = derive_gravity(model.arm).base.units
    for p, unit in zip(model.base_parameters, units, strict=True):
        zero = "" if p.distinguishable else "zero?"
        table.add_row(escape(p.name), f"{p.value:+.5f}", f"{p.standard_error:.5f}", unit, zero)
    console.print(table)
    if model.effects:
        table = make_table("Effects [N m; N if prismatic]", "", "value", "standard error", "|value| < 2 se")
        for e in model.effects:
            numbers = (f"{e.coefficient:+.5f}", f"{e.standard_error:.5f}", "" if e.distinguishable else "zero?")
            table.add_row(str(ActuatorEffect.of(e)), *numbers)
        console.print(table)
    rows = [
        (
            j.name,
            j.rms_zero_torque_undoubted,
            j.rms_fit_undoubted,
            j.rms_leave_one_out_undoubted,
            j.rms_cross_validation_undoubted,
        )
        for j in model.joints
    ]
    title = "RMS torque error [N m; N if prismatic], doubted measurements left out"
    table = make_table(title, "", "zero torque", "fit", "leave-one-out", "ten-fold*", "doubted", "trust", "poses cover")
    for j, (name, *errors) in zip(model.joints, rows, strict=True):
        cover = f"{j.position_lower:+.2f}..{j.position_upper:+.2f} ({100 * j.coverage:.0f} %)"
        table.add_row(name, *(f"{e:.4f}" for e in errors), str(j.num_doubted), f"{j.trust:.2f}", cover)
    console.print(table)
    console.print(
        "* each tenth of the poses predicted from the rest, joint effects and trust chosen anew\n", style="dim"
    )
    if any(j.num_doubted for j in model.joints):
        table = make_table("The same with the doubted measurements", "", "zero torque", "fit", "leave-one-out")
        for j in model.joints:
            errors = [j.rms_zero_torque, j.rms_fit, j.rms_leave_one_out]
            table.add_row(j.name, *(f"{e:.4f}" for e in errors))
        console.print(table)
    for j in model.joints:
        if j.trust == 0.0:
            why = "it hardly moved, or what was measured cannot tell its gravity from friction"
            if j.rms_zero_torque == 0.0:
                why = "no holding torque of it was measured"
            console.print(
                f"{j.name}: no torque will be commanded: {why}",
                style="yellow",
                soft_wrap=True,
            )


def print_simulation(console: Console, simulation: Simulation, arm: Arm) -> None:
    """Where each joint was and how far from where it was wanted, over all recorded samples."""
    recording, desired = simulation.recording, simulation.desired
    effort = np.abs(recording.measured_effort())
    table = make_table(
        f"{arm.name}, simulated for {simulation.time[-1]:g} s [rad, N m; m, N if prismatic]",
        "",
        "start",
        "end",
        "largest error",
        "error at the end",
        "largest effort",
        "effort limit",
    )
    for j, name in enumerate(arm.joint_names):
        errors = ("-", "-")
        if desired is not None:
            error = np.abs(recording.q[:, j] - desired[:, j])
            errors = (f"{error.max():.5f}", f"{error[-1]:.5f}")
        q = recording.q[:, j]
        table.add_row(
            name, f"{q[0]:z.4f}", f"{q[-1]:z.4f}", *errors, f"{effort[:, j].max():.4f}", f"{arm.effort_limits[j]:.4f}"
        )
    console.print(table)


def print_demo(console: Console, result: DemoResult, folder: Path) -> None:
    """What the demo measured, what it wrote, and what a person would do next."""
    print_model(console, result.identification.model)
    fresh = list(zip(result.fresh.joints, result.fresh_paper.joints, strict=True))
    table = make_table(
        f"RMS torque error on {result.fresh.poses} fresh poses [N m; N if prismatic]",
        "",
        "zero torque",
        "identified",
        "paper's method",
    )
    for ours, paper in fresh:
        table.add_row(ours.name, f"{ours.rms_torque:.4f}", f"{ours.rms_error:.4f}", f"{paper.rms_error:.4f}")
    console.print(table)
    table = make_table(
        "Released for 4 s without dry friction, then a step home [rad; m if prismatic]",
        "",
        *(f"drift, {k}" for k in result.drift),
        "step error",
    )
    for i, (ours, _) in enumerate(fresh):
        drifts = [f"{values[i]:.4f}" for values in result.drift.values()]
        table.add_row(ours.name, *drifts, f"{result.step_error[i]:.5f}")
    console.print(table)
    console.print(NO_DRY_FRICTION, style="dim", soft_wrap=True)
    files = sorted(path.name for path in folder.iterdir() if path.is_file())
    console.print(f"written to {folder}: {', '.join(files)}", soft_wrap=True)
    if result.identification.model.arm.coupled_limits:
        console.print(
            "The simulated arm has no stops in q2 + q3 yet: the step, and the release with the model as drawn, pass "
            "where a real arm would hit them.",
            style="dim",
            soft_wrap=True,
        )
    console.print(
        NEXT_STEPS.format(folder=folder, arm=result.identification.model.arm.source), markup=False, soft_wrap=True
    )


def print_symbolic_model(console: Console, gravity: SymbolicGravity) -> None:
    """The base parameters of an arm with the values that its SDF gives them, and its joints' limits."""
    arm = gravity.arm
    table = make_table(f"{arm.name}: base parameters of gravity", "", "nominal value", "unit")
    for name, value, unit in zip(gravity.base.names, gravity.base_values, gravity.base.units, strict=True):
        table.add_row(escape(name), f"{value:+.5f}", unit)
    console.print(table)
    table = make_table("Joints [rad, N m; m, N if prismatic]", "", "position", "effort limit")
    for i, name in enumerate(arm.joint_names):
        position = f"{arm.position_lower[i]:+.4f}..{arm.position_upper[i]:+.4f}"
        table.add_row(f"q{i + 1} {name}", position, f"{arm.effort_limits[i]:.4g}")
    for limit in arm.coupled_limits:
        terms = " + ".join(f"{c:g} {joint}" if c != 1 else joint for joint, c in limit.coefficients.items())
        table.add_row(f"{limit.name}: {terms}", f"{limit.lower:+.4f}..{limit.upper:+.4f}", "")
    console.print(table)


def print_doubts(console: Console, doubts: Sequence[Doubt], most: int = 30) -> None:
    """One line a doubted pose."""
    if not doubts:
        return
    console.print(f"{len({d.where for d in doubts})} poses doubted; the torques named are left out:", style="yellow")
    for doubt in doubts[:most]:
        console.print(f"  {doubt.where}: {doubt.reason}", style="yellow", markup=False, soft_wrap=True)
    if len(doubts) > most:
        console.print(f"  and {len(doubts) - most} more", style="yellow")


#: Colours of rows by verdict.
VERDICT_STYLES: dict[Verdict, str] = {"do not use": "red", "not judged": "yellow"}


def print_verdict(console: Console, verdicts: Mapping[str, Verdict]) -> None:
    """The least favourable verdict and the joints that have it, in one line."""
    verdict, names = worst(verdicts)
    console.print(
        f"verdict: {verdict} ({', '.join(names)})", style=VERDICT_STYLES.get(verdict, "green"), soft_wrap=True
    )


def print_rule(console: Console, in_motion: bool) -> None:
    """The rule behind the verdicts."""
    console.print(rule_text(in_motion) + "\n", style="dim", width=min(console.width, RULE_WIDTH))


def print_static_validation(console: Console, validation: StaticValidation) -> None:
    """Verdict and error beside zero torque, joint by joint."""
    print_verdict(console, validation.verdicts)
    title = f"RMS torque error, {validation.poses} poses [N m; N if prismatic]"
    doubted = any(j.num_doubted for j in validation.joints)
    if doubted:
        title += "; doubted left out"
    table = make_table(title, "", "zero torque", "model", "ratio", "doubted", "verdict")
    table.columns[-1].justify = "left"
    for j in validation.joints:
        table.add_row(
            j.name,
            f"{j.rms_torque_undoubted:.4f}",
            f"{j.rms_error_undoubted:.4f}",
            "" if j.relative_error_undoubted is None else f"{j.relative_error_undoubted:.2f}",
            str(j.num_doubted),
            j.verdict,
            style=VERDICT_STYLES.get(j.verdict, ""),
        )
    console.print(table)
    print_rule(console, in_motion=False)
    if doubted:
        table = make_table("The same with the doubted measurements", "", "zero torque", "model", "ratio")
        for j in validation.joints:
            ratio = "" if j.relative_error is None else f"{j.relative_error:.2f}"
            table.add_row(j.name, f"{j.rms_torque:.4f}", f"{j.rms_error:.4f}", ratio)
        console.print(table)
        console.print()


def print_teleoperation(console: Console, result: TeleoperationResult, file: str) -> None:
    """How well the tip followed."""
    table = make_table("Tip against handle", "", "RMS", "largest")
    table.add_row(
        escape("position [mm]"), f"{1e3 * result.rms_position_error:.3f}", f"{1e3 * result.max_position_error:.3f}"
    )
    table.add_row(
        escape("rotation [mrad]"), f"{1e3 * result.rms_rotation_error:.2f}", f"{1e3 * result.max_rotation_error:.2f}"
    )
    console.print(table)
    console.print(
        "The error of the tip against the scaled way of the handle since the clutch closed, over "
        f"{result.handle_path:.2f} m of it. With an open clutch the tip moved {1e3 * result.max_motion_held:.1g} mm. "
        f"Open {file} in a browser.",
        markup=False,
        soft_wrap=True,
    )


def make_table(title: str, *columns: str) -> Table:
    """An empty table with a bold title; the first column left, the others right."""
    # A title may be wider than its table, and would be wrapped.
    text = Text(title, style="bold", no_wrap=True, overflow="ignore")
    table = Table(title=text, title_justify="left", box=None, pad_edge=False, expand=False)
    for i, column in enumerate(columns):
        # The name of a base parameter may be long; numbers are never cut.
        # Units in brackets are no markup.
        table.add_column(escape(column), justify="left" if i == 0 else "right", no_wrap=i > 0, overflow="fold")
    return table
