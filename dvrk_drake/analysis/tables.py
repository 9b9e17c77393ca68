"""Results as tables in a terminal."""

from __future__ import annotations

from collections.abc import Sequence

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from dvrk_drake.analysis.doubts import Doubt
from dvrk_drake.analysis.validation import Validation
from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.dynamics.symbolic_gravity import SymbolicGravity


def print_model(console: Console, model: IdentifiedModel) -> None:
    """Parameters with their standard errors, then how each joint was fitted."""
    provenance = model.provenance
    console.print(
        f"{model.arm.upper()}, {provenance.poses} poses, method {provenance.method}, rank {provenance.rank} of "
        f"{len(model.base_parameters)}, condition number {provenance.condition_number:.3g}"
    )
    table = _table("Base parameters [kg m]", "parameter", "value", "standard error", "")
    for p in model.base_parameters:
        table.add_row(escape(p.name), f"{p.value:+.5f}", f"{p.standard_error:.5f}", _verdict(p.distinguishable))
    console.print(table)
    if model.joint_effects:
        table = _table("Joint effects [N m; N if prismatic]", "effect", "value", "standard error", "")
        for e in model.joint_effects:
            name = f"{e.joint} {e.kind}"
            table.add_row(name, f"{e.value:+.5f}", f"{e.standard_error:.5f}", _verdict(e.distinguishable))
        console.print(table)
    table = _table(
        "RMS torque error [N m] without doubted measurements; all poses in brackets",
        "joint",
        "zero torque",
        "fit",
        "leave-one-out",
        "ten-fold*",
        "trust",
        "doubted",
        "poses cover",
    )
    for j in model.joints:
        table.add_row(
            j.name,
            f"{j.rms_zero_torque_undoubted:.4f} ({j.rms_zero_torque:.4f})",
            f"{j.rms_fit_undoubted:.4f} ({j.rms_fit:.4f})",
            f"{j.rms_leave_one_out_undoubted:.4f} ({j.rms_leave_one_out:.4f})",
            f"{j.rms_cross_validation_undoubted:.4f}",
            f"{j.trust:.2f}",
            str(j.num_doubted),
            f"{j.position_lower:+.2f}..{j.position_upper:+.2f} ({100 * j.coverage:.0f} %)",
        )
    console.print(table)
    console.print("* joint effects and trust chosen anew in every fold", style="dim")
    for j in model.joints:
        if j.trust == 0.0:
            console.print(
                f"{j.name}: no torque will be commanded, because the measured torque is too small to tell a model from "
                "friction, or leave-one-out shows no gain over zero torque",
                style="yellow",
            )


def print_symbolic_model(console: Console, gravity: SymbolicGravity) -> None:
    """The base parameters of an arm with the values that its SDF gives them, and its joints' limits."""
    arm = gravity.arm
    table = _table(f"{arm.name}: base parameters of gravity [kg m]", "parameter", "nominal value")
    for name, value in zip(gravity.base.names, gravity.base_values, strict=True):
        table.add_row(escape(name), f"{value:+.5f}")
    console.print(table)
    table = _table("Joints [rad, N m; m, N if prismatic]", "joint", "position", "effort limit")
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
        console.print(f"  {doubt.where}: {doubt.reason}", style="yellow", highlight=False, soft_wrap=True)
    if len(doubts) > most:
        console.print(f"  and {len(doubts) - most} more", style="yellow")


def print_validation(console: Console, validation: Validation) -> None:
    """Error beside zero torque, joint by joint."""
    table = _table(
        f"RMS over {validation.poses} poses [N m]; without doubted measurements in brackets",
        "joint",
        "zero torque",
        "model",
        "ratio",
        "doubted",
    )
    for j in validation.joints:
        worse = j.rms_error > j.rms_torque
        table.add_row(
            j.name,
            f"{j.rms_torque:.4f} ({j.rms_torque_undoubted:.4f})",
            f"{j.rms_error:.4f} ({j.rms_error_undoubted:.4f})",
            f"{j.relative_error:.2f}",
            str(j.num_doubted),
            style="red" if worse else "",
        )
    console.print(table)


def _table(title: str, *columns: str) -> Table:
    table = Table(title=title, title_justify="left", title_style="bold", box=None, pad_edge=False)
    for i, column in enumerate(columns):
        table.add_column(column, justify="left" if i == 0 else "right", no_wrap=True)
    return table


def _verdict(distinguishable: bool) -> str:
    return "" if distinguishable else "not distinguishable from zero"
