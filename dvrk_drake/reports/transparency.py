"""The interaction force at an arm's handle: a table, a file with its numbers, a figure, the reproduction's section."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from rich.console import Console

from dvrk_drake.dynamics.friction_compensation import LARGEST_RATIO
from dvrk_drake.experiments.reproduction.laboratory import Laboratory, Lead, led
from dvrk_drake.experiments.transparency import TAKES_HOLD, Felt
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.files import atomic_write
from dvrk_drake.reports.figures import save_figure
from dvrk_drake.reports.reproduction.page import ResultTable, Section
from dvrk_drake.reports.terminal_tables import make_table


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


def print_transparency(console: Console, arm: Arm, felt: Sequence[Felt]) -> None:
    """RMS of the force and torque that the hand needs, and what they exceed in a twentieth of the time."""
    headings = ("force, RMS [N]", "95 % [N]", "torque, RMS [mN m]", "95 % [mN m]", "handle off by at most [mm]")
    table = make_table(
        f"{arm.name}, simulated: what a hand feels along {felt[0].time[-1]:.3g} s of path", "", *headings
    )
    scales, formats = (1, 1, 1e3, 1e3, 1e3), (".2f", ".2f", ".0f", ".0f", ".1f")
    for one in felt:
        values = zip(_numbers(one).values(), scales, formats, strict=True)
        table.add_row(one.name, *(f"{scale * value:{form}}" for value, scale, form in values))
    console.print(table)


def write_transparency(path: Path, felt: Sequence[Felt]) -> None:
    """The table's numbers in SI as CSV, at once or not at all."""
    with atomic_write(path) as stream:
        rows = csv.writer(stream, lineterminator="\n")
        rows.writerow(["compensation", *_numbers(felt[0])])
        rows.writerows([one.name, *(f"{value:.6g}" for value in _numbers(one).values())] for one in felt)


def plot_transparency(path: Path, arm: Arm, felt: Sequence[Felt]) -> None:
    """Force and torque at the handle over time, one curve each compensation."""
    figure, both = plt.subplots(2, 1, figsize=(11, 6.5), sharex=True, layout="constrained")
    for one in felt:
        late = one.time >= TAKES_HOLD
        for axes, vectors in zip(both, (one.force, one.torque), strict=True):
            axes.plot(one.time[late], np.linalg.norm(vectors[late], axis=1), label=one.name, linewidth=1.2)
    for axes, label in zip(both, ("force [N]", "torque [N m]"), strict=True):
        axes.set_ylabel(label)
        axes.set_ylim(bottom=0)
        axes.grid(alpha=0.3)
    figure.suptitle(f"{arm.name}, simulated: what a hand feels that leads the handle")
    both[0].legend(fontsize=8, ncols=min(4, len(felt)), loc="lower right", bbox_to_anchor=(1.0, 1.0))
    both[1].set_xlabel("time [s]")
    save_figure(figure, path)


def reproduce_transparency(laboratory: Laboratory) -> Section:
    """Leads the handle along one path with each compensation."""
    mtm, paper = laboratory.mtm, laboratory.paper_file
    poses, seed = laboratory.extent.path_poses, laboratory.seed
    rows: list[tuple[str, Path | None, float]] = [
        ("limp motors", None, 0.0),
        ("the paper's compensation", paper, 0.0),
        ("ours", mtm.file, 0.0),
        (f"ours, friction {LARGEST_RATIO:g}", mtm.file, LARGEST_RATIO),
    ]
    leads = [Lead(name, mtm.truth.arm, str(model or ""), ratio, poses, seed) for name, model, ratio in rows]
    felt = []
    for one in laboratory.executor.map(led, leads):
        felt.append(one)
        laboratory.progress("a hand leads the MTM", len(felt) / len(leads))
    plot_transparency(laboratory.folder / "transparency.png", mtm.truth.arm, felt)
    table = ResultTable(
        "transparency",
        "What the hand must exert",
        ("", "force, RMS [N]", "force, 95 % [N]", "torque, RMS [mN m]", "torque, 95 % [mN m]"),
        tuple(_row(one) for one in felt),
    )
    remarks = (
        "The paper wishes for it and gives no number: force and torque at the handle while a hand (a spring and damper "
        "of a person's stiffness) leads the true arm along a path through random poses, slowly.",
        mtm.truth.origin,
        f"The last row also takes {LARGEST_RATIO:g} of the friction off the hand, less where what remains must hold "
        "the arm against the error of the identified gravity (docs/friction_compensation.md).",
    )
    return Section(
        "transparency",
        "Transparency: what the operator feels",
        remarks,
        (table,),
        {"transparency.png": "Force and torque of the hand over time"},
    )


def _row(felt: Felt) -> tuple[str, ...]:
    force, torque = felt.peak()
    values = (f"{felt.rms_force:.2f}", f"{force:.2f}", f"{1e3 * felt.rms_torque:.0f}", f"{1e3 * torque:.0f}")
    return felt.name, *values
