"""Transparency: the interaction force at the handle with each compensation."""

from __future__ import annotations

from pathlib import Path

from dvrk_drake.dynamics.friction_compensation import MAX_RATIO
from dvrk_drake.experiments.reproduction.session import OperatorCase, ReproductionSession, simulate_case
from dvrk_drake.experiments.transparency import OperatorForces
from dvrk_drake.reports.figures.transparency import plot_transparency
from dvrk_drake.reports.reproduction.page import ResultTable, Section


def reproduce_transparency(session: ReproductionSession) -> Section:
    """Leads the handle along one path with each compensation."""
    mtm, paper = session.mtm, session.paper_file
    poses, seed = session.sample_sizes.path_poses, session.seed
    rows: list[tuple[str, Path | None, float]] = [
        ("limp motors", None, 0.0),
        ("the paper's compensation", paper, 0.0),
        ("ours", mtm.file, 0.0),
        (f"ours, friction {MAX_RATIO:g}", mtm.file, MAX_RATIO),
    ]
    cases = [OperatorCase(name, mtm.truth.arm, str(model or ""), ratio, poses, seed) for name, model, ratio in rows]
    forces = []
    for one in session.executor.map(simulate_case, cases):
        forces.append(one)
        session.progress("a hand cases the MTM", len(forces) / len(cases))
    plot_transparency(session.folder / "transparency.png", mtm.truth.arm, forces)
    table = ResultTable(
        "transparency",
        "What the hand must exert",
        ("", "force, RMS [N]", "force, 95 % [N]", "torque, RMS [mN m]", "torque, 95 % [mN m]"),
        tuple(_row(one) for one in forces),
    )
    remarks = (
        "The paper proposes it and gives no number: force and torque at the handle while a hand (a spring and damper "
        "of a person's stiffness) moves the ground-truth arm along a path through random poses, slowly.",
        mtm.truth.origin,
        f"The last row also takes {MAX_RATIO:g} of the friction off the hand, less where what remains must hold "
        "the arm against the error of the identified gravity (docs/friction_compensation.md).",
    )
    return Section(
        "transparency",
        "Transparency: interaction force at the handle",
        remarks,
        (table,),
        {"transparency.png": "Force and torque of the hand over time"},
    )


def _row(forces: OperatorForces) -> tuple[str, ...]:
    force, torque = forces.peak()
    values = (f"{forces.rms_force:.2f}", f"{force:.2f}", f"{1e3 * forces.rms_torque:.0f}", f"{1e3 * torque:.0f}")
    return forces.name, *values
