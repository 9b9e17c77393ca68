"""Prints the result of a simulation to a terminal."""

from __future__ import annotations

import numpy as np
from rich.console import Console

from dvrk_drake.experiments.simulation import Simulation
from dvrk_drake.models.arm import Arm
from dvrk_drake.reports.terminal_tables import make_table, print_answer


def print_simulation(
    console: Console, simulation: Simulation, arm: Arm, *, scenario: str | None = None, verbose: bool = False
) -> None:
    """Prints the largest tracking error or, without desired positions, the largest distance from the initial position.

    Args:
        console: Console to print to.
        simulation: Simulation to print.
        arm: Simulated arm.
        scenario: Argument of the command that selects the scenario, for the suggested next command. None if the
            command has already written figures.
        verbose: Whether to print the start and end positions, and the effort limits.
    """
    recording, desired = simulation.recording, simulation.desired
    reference = recording.q[:1] if desired is None else desired
    error = np.abs(recording.q - reference)
    effort = np.abs(recording.measured_effort()).max(axis=0)
    j = int(np.argmax(error.max(axis=0) / (arm.position_upper - arm.position_lower)))
    what = "Largest motion from the start" if desired is None else "Largest tracking error"
    unit = "m" if arm.prismatic[j] else "rad"
    print_answer(
        console,
        f"{what} {error[:, j].max():.2g} {unit} ({arm.joint_names[j]}), at the end {error[-1, j]:.2g} {unit}.",
        scenario and f"dvrk-drake simulate {scenario} --plots FOLDER",
    )
    kind = "motion" if desired is None else "error"
    table = make_table(
        f"{arm.name}, simulated for {simulation.time[-1]:g} s [rad, N m; m, N if prismatic]",
        *("", f"largest {kind}", f"{kind} at the end", "largest effort", "effort / limit"),
    )
    for i, name in enumerate(arm.joint_names):
        share = f"{100 * effort[i] / arm.effort_limits[i]:.0f} %"
        table.add_row(name, f"{error[:, i].max():.5f}", f"{error[-1, i]:.5f}", f"{effort[i]:.4f}", share)
    console.print(table)
    if verbose:
        console.print()
        table = make_table("Positions [rad; m] and effort limits [N m; N]", "", "start", "end", "effort limit")
        for i, name in enumerate(arm.joint_names):
            q = recording.q[:, i]
            table.add_row(name, f"{q[0]:z.4f}", f"{q[-1]:z.4f}", f"{arm.effort_limits[i]:.4f}")
        console.print(table)
