"""The interaction force at an arm's handle: text in a terminal, and a file with its numbers."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console

from dvrk_drake.experiments.transparency import TAKES_HOLD, Felt
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.files import atomic_write
from dvrk_drake.reports.terminal_tables import make_table, print_answer, print_note


def print_transparency(console: Console, arm: Arm, felt: Sequence[Felt], *, verbose: bool = False) -> None:
    """Prints the compensation with the smallest interaction force, then force and torque with each.

    Args:
        console: to print to.
        arm: which is simulated.
        felt: one result per compensation; the first is without compensation.
        verbose: also print how the numbers are defined.
    """
    best, without = min(felt, key=lambda one: one.rms_force), felt[0]
    answer = f"Smallest interaction force at the handle: {best.rms_force:.2f} N RMS with {best.name}"
    answer += "." if best is without else f", {without.rms_force:.2f} N with {without.name}."
    print_answer(console, answer, f"dvrk-drake transparency --arm {arm.source} --model MODEL.yaml --plots FOLDER")
    headings = ("RMS force [N]", "95 % force [N]", "RMS torque [mN m]", "95 % torque [mN m]", "largest deviation [mm]")
    title = f"{arm.name}, simulated: a hand moves the handle for {felt[0].time[-1]:.3g} s"
    table = make_table(title, "compensation", *headings)
    scales, formats = (1, 1, 1e3, 1e3, 1e3), (".2f", ".2f", ".0f", ".0f", ".1f")
    for one in felt:
        values = zip(_numbers(one).values(), scales, formats, strict=True)
        table.add_row(one.name, *(f"{scale * value:{form}}" for value, scale, form in values))
    console.print(table)
    if verbose:
        console.print()
        print_note(
            console,
            "95 %: exceeded in a twentieth of the time. Deviation: of the handle from the path of the hand. "
            f"The first {TAKES_HOLD:g} s are left out.",
        )


def write_transparency(path: Path, felt: Sequence[Felt]) -> None:
    """The table's numbers in SI as CSV, at once or not at all."""
    with atomic_write(path) as stream:
        rows = csv.writer(stream, lineterminator="\n")
        rows.writerow(["compensation", *_numbers(felt[0])])
        rows.writerows([one.name, *(f"{value:.6g}" for value in _numbers(one).values())] for one in felt)


def _numbers(felt: Felt) -> dict[str, float]:
    peak_force, peak_torque = felt.peak()
    late = felt.time >= TAKES_HOLD
    return {
        "rms_force": felt.rms_force,
        "force_95": peak_force,
        "rms_torque": felt.rms_torque,
        "torque_95": peak_torque,
        "largest_deviation": float(felt.deviation[late].max()),
    }
