"""Sections of Table I, Fig. 4, Fig. 7 and of the interaction force at the handle."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

import dvrk_drake as dvrk
from dvrk_drake.analysis.pose_identification import StaticIdentification, identify_static
from dvrk_drake.dynamics.friction_compensation import MAX_RATIO, Friction
from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.experiments.paper import PAPER, ReproductionSession
from dvrk_drake.experiments.paper_experiments import (
    DURATION,
    OUR_DURATION,
    PERIOD,
    TABLE_POSES,
    longest_period,
    oscillation_modes,
    paper_simulated_arm,
    recomputed_table,
    simulate_ours,
    simulate_paper_controller,
)
from dvrk_drake.experiments.transparency import Compensation, OperatorForces, random_path, simulate_operator
from dvrk_drake.models.arm import Arm
from dvrk_drake.progress import step_progress
from dvrk_drake.reports.colours import COMMANDED, HELD_OUT, LIMIT, MEASURED, REFERENCE, SERIES
from dvrk_drake.reports.page import Block, Plot, Section, Table, Text
from dvrk_drake.reports.plot import Curve, Guide, Mark, Panel, Style, joint_label
from dvrk_drake.reports.reproduction_drift import JOINTS, numbers
from dvrk_drake.reports.transparency import forces_plot, forces_table
from dvrk_drake.workers import await_results

#: Smallest drawn squared error [(N m)^2]. Smaller squared errors are drawn at this value. They occur if an effort was
#: measured as exactly 0.
FLOOR = 1e-9


def reproduce_table_1(session: ReproductionSession) -> Section:
    """Compares Table I of the paper with the DH parameters of the simulated MTM."""
    ours, worst = recomputed_table(dvrk.load_arm(PAPER.arm))
    published = np.array(PAPER.table_1, float)
    rows = []
    for j, (mine, theirs, symbols) in enumerate(zip(ours, published, PAPER.lengths, strict=True), start=1):
        angles = [f"{'+' if sign > 0 else '-'}q{j} {offset:+.4f}" for sign, offset in (theirs[:2], mine[:2])]
        lengths = [(f"{symbol} = {theirs[k]:.4f}", f"{mine[k]:.4f}") for symbol, k in zip(symbols, (2, 4), strict=True)]
        alpha = f"{theirs[3]:+.4f}", f"{mine[3]:+.4f}"
        rows.append((f"{j}", *angles, *lengths[0], *alpha, *lengths[1]))
    angle = np.abs(np.angle(np.exp(1j * (ours - published)[:, [1, 3]]))).max()
    length = np.abs(ours - published)[:, [0, 2, 4]].max()
    compared = [heading for name in ("theta", "d [m]", "alpha", "a [m]") for heading in (f"{name}, paper", "plant")]
    remark = (
        f"The DH parameters of the plant are computed from the link poses at {TABLE_POSES} random joint positions. "
        f"Their transformation matrices have an error of at most {worst:.0e}. Table I contains neither L1, which "
        "affects no joint, nor the parallelogram, which transmits elbow torque to the shoulder motor and has stops in "
        "q2 + q3."
    )
    caption = "DH parameters [rad, m], theta = +-q + offset"
    finding = f"The simulated arm has the DH parameters of the paper, within {angle:.0e} rad and {length:.0e} m."
    blocks: list[Block] = [Text(finding), Table(("joint", *compared), rows, caption, name="table1"), Text(remark)]
    return Section("Table I: DH parameters of the MTM", blocks)


def reproduce_figure_4(session: ReproductionSession) -> Section:
    """Computes the squared torque errors of joints 2-7 at the 72 poses of the paper.

    Raises:
        RecordingError: The recording is missing.
    """
    recording, arm = session.recordings.poses, dvrk.load_arm(PAPER.arm)
    paper = identify_static(recording, arm, "paper")
    ours = identify_static(recording, arm, progress=step_progress(session.progress, "identifying"))
    zero = recording.measured_effort()
    included = np.ones(zero.shape, bool)
    for measurement in ours.excluded:
        included[measurement.row, list(measurement.joints)] = False
    errors = {
        "zero torque": zero,
        "the paper's, leave-one-out": paper.leave_one_out_residuals,
        "ours, leave-one-out": ours.leave_one_out_residuals,
    }

    def rms(values: NDArray[np.float64], use: NDArray[np.bool_]) -> tuple[str, ...]:
        return numbers([np.sqrt(np.mean(values[use[:, j], j] ** 2)) for j in range(1, 7)], ".4f")

    fits = (("the paper's least squares, reproduced", paper.residuals), ("zero torque", zero), ("ours", ours.residuals))
    squared = Table(
        ("", *JOINTS[1:]),
        (
            ("published", *numbers(PAPER.figure_4_means, ".2e")),
            *((name, *numbers(np.mean(values[:, 1:] ** 2, axis=0), ".2e")) for name, values in fits),
        ),
        "Fig. 4: mean squared torque error of the fit at 72 poses [(N m)^2]",
        name="fig4_mean_squared",
    )
    ten_fold = [joint.rms_cross_validation_included for joint in ours.model.joints[1:]]
    left_out = Table(
        ("", *JOINTS[1:]),
        (
            *((name, *rms(values, included)) for name, values in errors.items()),
            ("ours, 10-fold, effects selected anew", *numbers(ten_fold, ".4f")),
            *((f"all measurements: {name}", *rms(e, np.ones_like(included))) for name, e in errors.items()),
        ),
        "RMS torque error in cross-validation [N m], without excluded measurements and with all measurements",
        name="fig4_left_out",
    )
    better = sum(
        np.mean(errors["ours, leave-one-out"][included[:, j], j] ** 2)
        < np.mean(errors["the paper's, leave-one-out"][included[:, j], j] ** 2)
        for j in range(1, 7)
    )
    finding = (
        f"In cross-validation, our identification has a smaller torque error than the paper's on {better} of 6 joints."
    )
    worse = [JOINTS[j] for j in range(1, 7) if np.mean(paper.residuals[:, j] ** 2) > np.mean(zero[:, j] ** 2)]
    same = ""
    if (published := session.recordings.figure_4) is not None:
        largest = np.abs(paper.residuals[:, 1:] ** 2 - published).max()
        same = f"The squared errors differ from the published ones by at most {largest:.0e} (N m)^2. "
    remarks = (
        f"The paper's method is unweighted least squares with twelve parameters (eq. 10). {same}On {', '.join(worse)}, "
        "its error is larger than that of zero torque, because the larger torques of joints 2 and 3 determine the "
        "parameters.",
        f"{int(np.sum(~included))} measurements at joint stops and outliers are excluded (crosses in the figure). With "
        "all measurements, the paper's method has a smaller error on J2, because it fits the torque of the joint stop "
        "together with gravity.",
    )
    plot = _squared_errors_plot(ours, errors, included)
    return Section("Fig. 4: torque errors", [Text(finding), squared, left_out, plot, *map(Text, remarks)])


def _squared_errors_plot(
    ours: StaticIdentification, errors: dict[str, NDArray[np.float64]], included: NDArray[np.bool_]
) -> Plot:
    """Returns the squared torque errors of joints 2-7 at each pose."""
    pose, panels = np.arange(1, len(included) + 1), []
    looks: tuple[tuple[str, Style], ...] = ((MEASURED, "dots"), (REFERENCE, "diamonds"), (HELD_OUT, "circles"))
    for j in range(1, 7):
        marks: list[Mark] = []
        use = included[:, j]
        for (name, values), (colour, style) in zip(errors.items(), looks, strict=True):
            squared = np.maximum(values[:, j] ** 2, FLOOR)
            marks.append(Curve(name, pose[use], squared[use], colour, style))
            marks.append(Curve("excluded measurement", pose[~use], squared[~use], LIMIT, "crosses"))
        labels = "pose [1]", "squared error [(N m)²]"
        panels.append(Panel(joint_label(ours.model.arm, j), marks, *labels, log_y=True, height=230))
    caption = (
        f"Fig. 4 reproduced: squared torque error at {len(pose)} poses of the paper. Each pose was not used to fit "
        f"(leave-one-out). Errors below {FLOOR:g} are drawn at {FLOOR:g}"
    )
    return Plot("fig4", caption, panels, columns=2)


def reproduce_figure_7(session: ReproductionSession, duration: float = DURATION) -> Section:
    """Simulates the paper's controller on the paper's arm and ours on the arm of Fig. 5."""
    mtm, arm = session.mtm, dvrk.load_arm(PAPER.arm)

    def progress(start: float) -> Callable[[float], object]:
        return step_progress(session.progress, "stepping to zero", start, start + 0.4)

    theirs = paper_simulated_arm(arm, session.folder / "paper_simulated_mtm.sdf")
    faulty, damped = (
        simulate_paper_controller(theirs, duration, fault, progress(start))
        for fault, start in ((True, 0.0), (False, 0.4))
    )
    ours = simulate_ours(mtm.arm, mtm.model, min(duration, OUR_DURATION))
    settled = min(3.0, duration / 2)
    rows = (
        ("published (read from the figure)", "-", f"{PAPER.late_2:.3f}", "-", "-", "-", "0.0220", "0.0155"),
        ("the paper's controller, as published", *numbers(_largest(faulty), ".4f")),
        ("the paper's controller, fault corrected", *numbers(_largest(damped), ".4f")),
        (f"ours, from {settled:g} s on", *numbers(_largest(ours, settled), ".1e")),
    )
    caption = "Largest |q| [rad] in the last 10 s (published: J2 at 59 s, J6 and J7 near the end)"
    with_fault, without = (oscillation_modes(theirs, fault)[0].real.max() for fault in (True, False))
    remarks = (
        "The step is from J5 = 3.13, J3 = -0.79, J2 = -0.22 rad to zero. Joints 6 and 7 start at their published "
        "amplitudes. The controller of the paper has a fault: the damping terms of joints 5-7 use positions instead of "
        f"velocities. With the fault, the least damped oscillation near zero (joint 7) has a decay rate of "
        f"{max(0.0, -with_fault):.3f} /s, without it at least {-without:.3f} /s. The oscillation period of J2 confirms "
        f"the assumed inertia of each link, {PAPER.link_inertia:g} kg m^2: {PAPER.period_2:.0f} s published, "
        f"{longest_period(theirs):.0f} s here.",
        "Our controller regulates the simulated MTM of Fig. 5 without joint stops, because the start pose is beyond "
        f"them. The largest position error in the last second is {1e3 * _largest(ours, -1.0).max():.1f} mrad, because "
        "friction resists small integral efforts.",
    )
    finding = (
        f"In the last 10 s, joint 7 moves up to {_largest(faulty)[6]:.3f} rad with the paper's controller as "
        f"published, and up to {_largest(damped)[6]:.0e} rad after its programming fault is corrected."
    )
    table = Table(("", *JOINTS), rows, caption, name="fig7")
    plot = _steps_plot(arm, faulty, ours)
    return Section("Fig. 7: step to zero", [Text(finding), table, plot, *map(Text, remarks)])


def _largest(q: NDArray[np.float64], start: float = -10.0) -> NDArray[np.float64]:
    """Returns the largest |q| (n,) from a time on [s]. A negative time is relative to the end."""
    first = round(start / PERIOD) + (len(q) if start < 0 else 0)
    return np.abs(q[max(first, 0) :]).max(axis=0)


def _steps_plot(arm: Arm, faulty: NDArray[np.float64], ours: NDArray[np.float64]) -> Plot:
    """Returns the positions of all joints in the step to zero, beside them enlarged."""
    panels = []
    runs = ((ours, "ours on the arm of Fig. 5"), (faulty, "paper's on the paper's arm"))
    for q, label in runs:
        t = PERIOD * np.arange(len(q))
        marks: list[Mark] = [
            Curve(joint_label(arm, j), t[::5], q[::5, j], SERIES[j], "dashed" if j % 2 else "line")
            for j in range(arm.num_joints)
        ]
        marks.append(Guide("y", 0.0, None, COMMANDED, "target"))
        title, labels = f"{label}, {t[-1]:.0f} s", ("time [s]", "position [rad]")
        panels.append(Panel(title, marks, *labels, height=260))
        panels.append(Panel(f"{title}, enlarged", marks, *labels, y_range=(-0.1, 0.1), height=260))
    return Plot("fig7", "Fig. 7 reproduced: joint positions in the step to zero", panels, columns=2)


def reproduce_transparency(session: ReproductionSession) -> Section:
    """Moves the handle along one path with each compensation, and returns the interaction forces."""
    mtm = session.mtm
    cases: list[tuple[str, IdentifiedModel | None, float]] = [
        ("no compensation", None, 0.0),
        ("the paper's compensation", session.paper_model, 0.0),
        ("ours", mtm.model, 0.0),
        (f"ours, friction {MAX_RATIO:g}", mtm.model, MAX_RATIO),
    ]
    poses = session.sample_sizes.path_poses
    futures = [session.executor.submit(_operate, mtm.arm, *case, poses, session.seed) for case in cases]
    forces = await_results(futures, step_progress(session.progress, "simulating the operator"))
    rms = [f"{one.rms_force:.2f} N" for one in forces]
    finding = (
        f"RMS interaction force: {rms[0]} without compensation, {rms[1]} with the paper's, {rms[2]} with ours, "
        f"{rms[3]} with friction compensation."
    )
    remark = (
        "A simulated hand (spring and damper) slowly moves the handle of the arm of Fig. 5 along a path through random "
        f"poses. In the last row, friction is compensated with a ratio of at most {MAX_RATIO:g}. It is smaller on "
        "joints whose friction must resist the error of the identified gravity torque (docs/friction_compensation.md)."
    )
    table = dataclasses.replace(forces_table(mtm.arm, forces), name="transparency")
    return Section(
        "Transparency: interaction force at the handle", [Text(finding), table, forces_plot(forces), Text(remark)]
    )


def _operate(
    arm: Arm, name: str, model: IdentifiedModel | None, friction_ratio: float, poses: int, seed: int
) -> OperatorForces:
    # The controller uses the friction of the arm files, but an identified gravity model.
    compensation = Compensation(name, model, friction_ratio, Friction.of_arm(dvrk.load_arm(arm.source)))
    return simulate_operator(arm, random_path(arm, poses, seed=seed), compensation, effects=arm.effects, seed=seed)
