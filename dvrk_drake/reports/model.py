"""Prints the gravity model of an arm to a terminal."""

from __future__ import annotations

from rich.console import Console
from rich.markup import escape

from dvrk_drake.dynamics.symbolic_gravity import SymbolicGravity
from dvrk_drake.reports.terminal_tables import make_table, print_answer


def print_symbolic_model(console: Console, gravity: SymbolicGravity, *, verbose: bool = False) -> None:
    """Prints the base parameters of gravity with their nominal values from the SDF.

    Args:
        console: Console to print to.
        gravity: Symbolic gravity model of an arm.
        verbose: Whether to print the joint limits.
    """
    arm, base = gravity.arm, gravity.base
    print_answer(
        console,
        f"The gravity torque of {arm.name} depends on {len(base.names)} base parameters.",
        f"dvrk-drake equations --arm {arm.source} --format latex",
    )
    table = make_table(f"{arm.name}: base parameters of gravity", "", "nominal value (SDF)", "unit")
    for name, value, unit in zip(base.names, gravity.base_values, base.units, strict=True):
        table.add_row(escape(name), f"{value:+.5f}", unit)
    console.print(table)
    if not verbose:
        return
    console.print()
    table = make_table("Joint limits [rad, N m; m, N if prismatic]", "", "position", "effort")
    for i, name in enumerate(arm.joint_names):
        position = f"{arm.position_lower[i]:+.4f}..{arm.position_upper[i]:+.4f}"
        table.add_row(f"q{i + 1} {name}", position, f"{arm.effort_limits[i]:.4g}")
    for limit in arm.coupled_limits:
        terms = " + ".join(f"{c:g} {joint}" if c != 1 else joint for joint, c in limit.coefficients.items())
        table.add_row(f"{limit.name}: {terms}", f"{limit.lower:+.4f}..{limit.upper:+.4f}", "")
    console.print(table)
