"""Prints tuned gains to a terminal."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from rich.console import Console

from dvrk_drake.experiments.tuning.bench import band, step_size
from dvrk_drake.experiments.tuning.model_based import ArmDesign, JointDesign, friction
from dvrk_drake.experiments.tuning.procedure import JointProcedure
from dvrk_drake.experiments.tuning.tuning import DURATION, OWN, REST_TIME, Comparison, Tuning
from dvrk_drake.models.arm import Arm
from dvrk_drake.reports.terminal_tables import make_table, print_answer, print_note


def print_tuning(console: Console, tuning: Tuning, *, gains_path: str | None = None, verbose: bool = False) -> None:
    """Prints the best gains, then the comparison of all gains.

    The best gains have the fewest steps that do not settle. For equal numbers of such steps, the best gains have the
    smallest mean settling time.

    Args:
        console: Console to print to.
        tuning: Tuning to print.
        gains_path: Path of the written gains, for the suggested next command. None if the gains were not written.
        verbose: Whether to print the results of each tuning method, and the comparison for each joint and each pose.
    """
    comparison, name = tuning.comparison, tuning.arm.source
    best = comparison.best(tuning.found)
    found, own = (_settled(comparison.table(which, "settling").ravel()) for which in (best, OWN))
    verdict = "better than" if comparison.best([OWN, best]) == best else "not better than"
    print_answer(
        console,
        f"Gains of method {best} are {verdict} {OWN}: settled steps and mean settling time {found}; {OWN}: {own}.",
        f"dvrk-drake tune --arm {name} --output GAINS.yaml"
        if gains_path is None
        else f"dvrk-drake control --arm {name} --mode hold --gains {gains_path}",
        "green" if verdict == "better than" else "yellow",
    )
    _print_summary(console, comparison)
    if not verbose:
        return
    if tuning.procedure is not None:
        _print_procedure(console, tuning.arm, tuning.procedure)
    if tuning.design is not None:
        _print_design(console, tuning.arm, tuning.design)
    _print_joints(console, comparison)
    _print_poses(console, comparison)


def _print_summary(console: Console, comparison: Comparison) -> None:
    """Prints the settled steps and the mean settling time of all joints and poses, with one row per condition."""
    title = f"{comparison.arm.name}, simulated: number of settled steps, mean settling time"
    table = make_table(title, "condition", *comparison.gains)
    for c, condition in enumerate(comparison.conditions):
        table.add_row(condition.name, *(_settled(comparison.table(g, "settling")[c].ravel()) for g in comparison.gains))
    console.print(table)
    print_note(
        console,
        f"All joints step simultaneously, from {len(comparison.poses)} poses. G, M: factors of the true gravity torque "
        "and inertia with respect to the model. +1 tick: one more time step of delay.",
    )


def _print_procedure(console: Console, arm: Arm, joints: tuple[JointProcedure, ...]) -> None:
    """Prints the ultimate gains of the paper's procedure and the gains that follow from them."""
    columns = ("step", "dead zone", "ultimate Kp", "period [s]", "growth", "residual")
    table = make_table(f"{arm.name}, the paper's procedure", "", *columns)
    for j, joint in enumerate(joints):
        unit, found = "mm" if arm.prismatic[j] else "mrad", joint.ultimate
        table.add_row(
            arm.joint_names[j],
            f"{1e3 * step_size(arm)[j]:.0f} {unit}",
            f"{1e3 * friction(arm)[0][j] / found.gain:.2f} {unit}",
            f"{'' if found.sustained else '> '}{found.gain:.4g}",
            f"{found.period:.3f}",
            f"{found.growth:.3f}",
            f"{1e3 * joint.offset:.2f} {unit}" + ("" if joint.damped else " *"),
        )
    console.print(table)
    print_note(
        console,
        "dead zone: dry friction / ultimate Kp. growth: ratio of successive amplitudes. >: oscillations decay at "
        "this Kp, and the effort saturates at larger Kp. residual: position error after the step; *: no Kv damped the "
        "oscillation.",
    )
    _print_gains(console, f"{arm.name}, gains of the paper's procedure", arm, joints)


def _print_gains(console: Console, title: str, arm: Arm, joints: Sequence[JointProcedure | JointDesign]) -> None:
    table = make_table(title, "", "Kp", "Kv", "Ki")
    for name, joint in zip(arm.joint_names, joints, strict=True):
        table.add_row(name, *(f"{value:.3g}" for value in (joint.kp, joint.kd, joint.ki)))
    console.print(table)
    console.print()


def _print_design(console: Console, arm: Arm, design: ArmDesign) -> None:
    """Prints inertia and stability margins of the model-based design, and its gains."""
    columns = ("inertia", "frequency [rad/s]", "phase", "gain", "limited by")
    table = make_table(f"{arm.name}, model-based design", "", *columns)
    for name, properties, joint in zip(arm.joint_names, design.properties, design.joints, strict=True):
        table.add_row(
            name,
            "{:.3g}..{:.3g}".format(*properties.inertia),
            f"{joint.frequency:.1f}",
            "..".join(f"{np.degrees(margins.phase):.0f}" for margins in joint.margins),
            "..".join(f"{margins.gain:.1f}" for margins in joint.margins),
            joint.limited_by,
        )
    console.print(table)
    print_note(
        console,
        "inertia: smallest (all other joints free) and largest (all other joints locked) over the joint range [kg m^2; "
        "kg]. frequency: natural frequency of the closed loop. phase [deg] and gain: stability margins. limited by "
        "other joints: the joint is slower than in its single-joint design, so that all joints are stable together.",
    )
    _print_gains(console, f"{arm.name}, gains of the model-based design", arm, design.joints)


def _print_joints(console: Console, comparison: Comparison) -> None:
    """Prints one table per joint with the settling times and other measures of all gains."""
    arm, poses = comparison.arm, len(comparison.poses)
    print_note(
        console,
        "Settling time [s] of the slowest pose. The settling band is 2 % of the step, but at least one encoder count. "
        f"n/{poses}: not settled within {DURATION - REST_TIME:g} s at n poses. Overshoot, steady-state error and "
        "ripple "
        "(peak-to-peak effort at rest / effort limit): largest values over all poses, if the arm equals its model.",
    )
    for j, joint in enumerate(arm.joint_names):
        unit, size = ("mm", step_size(arm)[j]) if arm.prismatic[j] else ("mrad", step_size(arm)[j])
        title = f"{joint}, step {1e3 * size:g} {unit}, band {1e3 * band(arm)[j]:.2g} {unit}"
        names = [condition.name for condition in comparison.conditions]
        table = make_table(title, "", *names, "overshoot", f"error [{unit}]", "ripple")
        for which in comparison.gains:
            settling = comparison.table(which, "settling")[:, :, j]
            worst = [
                comparison.table(which, name)[0, :, j].max() for name in ("overshoot", "steady_error", "oscillation")
            ]
            table.add_row(
                which,
                *(_slowest(row) for row in settling),
                f"{100 * worst[0]:.0f} %",
                f"{1e3 * worst[1]:.2f}",
                f"{100 * worst[2]:.1f} %",
            )
        console.print(table)
        console.print()


def _print_poses(console: Console, comparison: Comparison) -> None:
    table = make_table("Number of settled joints by pose [rad; m], mean settling time", "", *comparison.gains)
    for p, q in enumerate(comparison.poses):
        cells = [_settled(comparison.table(which, "settling")[0, p]) for which in comparison.gains]
        table.add_row(" ".join(f"{x:.2f}" for x in q), *cells)
    console.print(table)


def _slowest(settling: NDArray[np.float64]) -> str:
    failed = int(np.count_nonzero(~np.isfinite(settling)))
    return f"{failed}/{len(settling)}" if failed else f"{settling.max():.2f}"


def _settled(settling: NDArray[np.float64]) -> str:
    inside = np.isfinite(settling)
    mean = f", {settling[inside].mean():.2f} s" if inside.any() else ""
    return f"{np.count_nonzero(inside)}/{len(settling)}{mean}"
