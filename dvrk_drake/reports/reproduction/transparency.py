"""Simulates the interaction force at the handle (transparency) with each kind of gravity and friction compensation."""

from __future__ import annotations

from pathlib import Path

from dvrk_drake.dynamics.friction_compensation import MAX_RATIO
from dvrk_drake.experiments.reproduction.session import OperatorCase, ReproductionSession, simulate_case
from dvrk_drake.experiments.transparency import OperatorForces
from dvrk_drake.reports.reproduction.page import ResultTable, Section
from dvrk_drake.reports.transparency import forces_plot


def reproduce_transparency(session: ReproductionSession) -> Section:
    """Moves the handle along one path with each compensation, and returns the interaction forces."""
    mtm, paper = session.mtm, session.paper_file
    poses, seed = session.sample_sizes.path_poses, session.seed
    rows: list[tuple[str, Path | None, float]] = [
        ("no compensation", None, 0.0),
        ("the paper's compensation", paper, 0.0),
        ("ours", mtm.file, 0.0),
        (f"ours, friction {MAX_RATIO:g}", mtm.file, MAX_RATIO),
    ]
    cases = [OperatorCase(name, mtm.truth.arm, str(model or ""), ratio, poses, seed) for name, model, ratio in rows]
    forces = []
    for one in session.executor.map(simulate_case, cases):
        forces.append(one)
        session.progress("simulating the operator", len(forces) / len(cases))
    table = ResultTable(
        "transparency",
        "Interaction force and torque at the handle, RMS and 95th percentile",
        ("", "RMS force [N]", "95 % force [N]", "RMS torque [mN m]", "95 % torque [mN m]"),
        tuple(_row(one) for one in forces),
    )
    remarks = (
        "The paper proposes this experiment as future work. A simulated hand (spring and damper) slowly moves the "
        "handle of the ground-truth arm along a path through random poses.",
        mtm.truth.origin,
        f"In the last row, friction is compensated with a ratio of at most {MAX_RATIO:g}. The ratio is smaller on "
        "joints whose friction must resist the error of the identified gravity torque (docs/friction_compensation.md).",
    )
    return Section(
        "transparency",
        "Transparency: interaction force at the handle",
        f"RMS interaction force: {forces[0].rms_force:.2f} N without compensation, {forces[1].rms_force:.2f} N with "
        f"the paper's, {forces[2].rms_force:.2f} N with ours, {forces[3].rms_force:.2f} N with friction compensation.",
        remarks,
        (table,),
        plots=(forces_plot(forces),),
    )


def _row(forces: OperatorForces) -> tuple[str, ...]:
    force, torque = forces.peak()
    values = (f"{forces.rms_force:.2f}", f"{force:.2f}", f"{1e3 * forces.rms_torque:.0f}", f"{1e3 * torque:.0f}")
    return forces.name, *values
