"""Prints the interaction force at the handle of an arm, and writes it to a file."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console

from dvrk_drake.experiments.transparency import GRASP_TIME, OperatorForces
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.files import atomic_write
from dvrk_drake.reports.terminal_tables import make_table, print_answer, print_note


def print_transparency(console: Console, arm: Arm, forces: Sequence[OperatorForces], *, verbose: bool = False) -> None:
    """Prints the compensation with the smallest interaction force, then the forces and torques with each compensation.

    Args:
        console: Console to print to.
        arm: Simulated arm.
        forces: One result per compensation. The first is without compensation.
        verbose: Whether to print the definition of the numbers.
    """
    best, without = min(forces, key=lambda one: one.rms_force), forces[0]
    answer = f"Smallest interaction force at the handle: {best.rms_force:.2f} N RMS with {best.name}"
    answer += "." if best is without else f", {without.rms_force:.2f} N without compensation."
    print_answer(console, answer, f"dvrk-drake transparency --arm {arm.source} --model MODEL.yaml --plots FOLDER")
    headings = ("RMS force [N]", "95 % force [N]", "RMS torque [mN m]", "95 % torque [mN m]", "largest deviation [mm]")
    title = f"{arm.name}, simulated: interaction force and torque at the handle during {forces[0].time[-1]:.3g} s"
    table = make_table(title, "compensation", *headings)
    scales, formats = (1, 1, 1e3, 1e3, 1e3), (".2f", ".2f", ".0f", ".0f", ".1f")
    for one in forces:
        name = "none" if one is without else one.name
        values = zip(_numbers(one).values(), scales, formats, strict=True)
        table.add_row(name, *(f"{scale * value:{form}}" for value, scale, form in values))
    console.print(table)
    if verbose:
        console.print()
        print_note(
            console,
            "95 %: 95th percentile over time. Deviation: distance of the handle from the path of the hand. "
            f"The first {GRASP_TIME:g} s are excluded.",
        )


def write_transparency(path: Path, forces: Sequence[OperatorForces]) -> None:
    """Writes a CSV file with the values of `print_transparency` in SI units. Replaces the file atomically."""
    with atomic_write(path) as stream:
        rows = csv.writer(stream, lineterminator="\n")
        rows.writerow(["compensation", *_numbers(forces[0])])
        rows.writerows([one.name, *(f"{value:.6g}" for value in _numbers(one).values())] for one in forces)


def _numbers(forces: OperatorForces) -> dict[str, float]:
    peak_force, peak_torque = forces.peak()
    late = forces.time >= GRASP_TIME
    return {
        "rms_force": forces.rms_force,
        "force_95": peak_force,
        "rms_torque": forces.rms_torque,
        "torque_95": peak_torque,
        "largest_deviation": float(forces.deviation[late].max()),
    }
