"""Transparency: the interaction force at the handle with each compensation."""

from __future__ import annotations

from pathlib import Path

from dvrk_drake.dynamics.friction_compensation import LARGEST_RATIO
from dvrk_drake.experiments.reproduction.laboratory import Laboratory, Lead, led
from dvrk_drake.experiments.transparency import Felt
from dvrk_drake.reports.figures.transparency import plot_transparency
from dvrk_drake.reports.reproduction.page import ResultTable, Section


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
