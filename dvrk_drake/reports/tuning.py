"""Tuned gains as tables in a terminal and as figures."""

from __future__ import annotations

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from numpy.typing import NDArray
from rich.console import Console

from dvrk_drake.experiments.tuning.bench import band, step_size
from dvrk_drake.experiments.tuning.model_based import ArmDesign, friction
from dvrk_drake.experiments.tuning.procedure import JointProcedure
from dvrk_drake.experiments.tuning.tuning import DURATION, OWN, PUBLISHED, REST, Comparison, Tuning
from dvrk_drake.models.arm import Arm
from dvrk_drake.reports.figures import save_figure
from dvrk_drake.reports.terminal_tables import make_table


def print_tuning(console: Console, tuning: Tuning) -> None:
    """How the gains were found, then how they compare."""
    if tuning.procedure is not None:
        print_procedure(console, tuning.arm, tuning.procedure)
    if tuning.design is not None:
        print_design(console, tuning.arm, tuning.design)
    print_comparison(console, tuning.comparison)


def print_procedure(console: Console, arm: Arm, joints: tuple[JointProcedure, ...]) -> None:
    """Ultimate gains and what was made of them."""
    columns = ("joint", "pushed by", "sticks within", "ultimate Kp", "period s", "growth", "Kp", "Kv", "Ki", "left")
    table = make_table(f"{arm.name} by the paper's procedure", *columns)
    for j, joint in enumerate(joints):
        unit, found = "mm" if arm.prismatic[j] else "mrad", joint.ultimate
        table.add_row(
            arm.joint_names[j],
            f"{1e3 * step_size(arm)[j]:.0f} {unit}",
            f"{1e3 * friction(arm)[0][j] / found.gain:.2f} {unit}",
            f"{'' if found.sustained else '> '}{found.gain:.4g}",
            f"{found.period:.3f}",
            f"{found.growth:.3f}",
            *(f"{value:.3g}" for value in (joint.kp, joint.kd, joint.ki)),
            f"{1e3 * joint.offset:.2f} {unit}" + ("" if joint.damped else ", swings"),
        )
    console.print(table)
    console.print(
        "pushed by: how far the joint is moved away and let go; sticks within: dry friction over the ultimate Kp; "
        "growth: of a swing over the one before; >: swings died away up to this Kp, beyond it the motor only "
        "switches; left: of the step.\n"
    )


def print_design(console: Console, arm: Arm, design: ArmDesign) -> None:
    """What the model says of each joint, and the gains that follow."""
    columns = ("joint", "inertia", "rad/s", "phase", "gain", "Kp", "Kv", "Ki", "limited by")
    table = make_table(f"{arm.name} by the model", *columns)
    for name, fact, joint in zip(arm.joint_names, design.facts, design.joints, strict=True):
        table.add_row(
            name,
            "{:.3g}..{:.3g}".format(*fact.inertia),
            f"{joint.frequency:.1f}",
            "..".join(f"{np.degrees(margins.phase):.0f}" for margins in joint.margins),
            "..".join(f"{margins.gain:.1f}" for margins in joint.margins),
            *(f"{value:.3g}" for value in (joint.kp, joint.kd, joint.ki)),
            joint.limited_by,
        )
    console.print(table)
    console.print(
        "inertia in the joint box: least, all other joints free, and largest, all others held [kg m^2; kg]; margins "
        "of phase [deg] and gain: there. Limited by other joints: slower than alone, so that all are stable at once.\n",
        markup=False,
    )


def print_comparison(console: Console, comparison: Comparison) -> None:
    """One table a joint and one over poses."""
    arm, poses = comparison.arm, len(comparison.poses)
    console.print(
        f"All joints of {arm.name} step at once, from {poses} poses. Settling time [s]: afterwards the joint stays "
        f"inside its band, 2 % of the step or a count of its encoder; the slowest pose; n/{poses}: from n poses it "
        f"has not settled in {DURATION - REST:g} s. Overshoot, what is left, unrest (peak to peak of effort at rest, "
        "over its limit): the worst pose, arm as modelled. G, M: true gravity torque, true inertia over the model's.\n",
        markup=False,
    )
    for j, joint in enumerate(arm.joint_names):
        unit, size = ("mm", step_size(arm)[j]) if arm.prismatic[j] else ("mrad", step_size(arm)[j])
        title = f"{joint}, step {1e3 * size:g} {unit}, band {1e3 * band(arm)[j]:.2g} {unit}"
        names = [condition.name for condition in comparison.conditions]
        table = make_table(title, "", *names, "overshoot", "left", "unrest")
        for which in comparison.gains:
            settling = comparison.table(which, "settling")[:, :, j]
            worst = [comparison.table(which, name)[0, :, j].max() for name in ("overshoot", "steady_error", "unrest")]
            table.add_row(
                which,
                *(_slowest(row) for row in settling),
                f"{100 * worst[0]:.0f} %",
                f"{1e3 * worst[1]:.2f} {unit}",
                f"{100 * worst[2]:.1f} %",
            )
        console.print(table)
        console.print()
    _print_poses(console, comparison)


def _print_poses(console: Console, comparison: Comparison) -> None:
    n = comparison.arm.num_joints
    table = make_table(
        f"Joints of {n} that settle, and their mean settling time [s]",
        "pose [rad, m]",
        *comparison.gains,
    )
    for p, q in enumerate(comparison.poses):
        cells = [_settled(comparison.table(which, "settling")[0, p]) for which in comparison.gains]
        table.add_row(" ".join(f"{x:.2f}" for x in q), *cells)
    table.add_section()
    for c, condition in enumerate(comparison.conditions):
        cells = [_settled(comparison.table(which, "settling")[c].ravel()) for which in comparison.gains]
        table.add_row(f"all poses, {condition.name}", *cells)
    console.print(table)


def _slowest(settling: NDArray[np.float64]) -> str:
    failed = int(np.count_nonzero(~np.isfinite(settling)))
    return f"{failed}/{len(settling)}" if failed else f"{settling.max():.2f}"


def _settled(settling: NDArray[np.float64]) -> str:
    inside = np.isfinite(settling)
    mean = f", {settling[inside].mean():.2f}" if inside.any() else ""
    return f"{np.count_nonzero(inside)}/{len(settling)}{mean}"


COLOURS = {OWN: "#9a9a9a", PUBLISHED: "#b58db6", "paper": "#edae49", "model": "#d1495b"}


def plot_steps(path: Path, comparison: Comparison) -> None:
    """One panel a joint: the step of all joints at once from the first pose, with all gains; the band is shaded."""
    arm = comparison.arm
    figure, axes = plt.subplots(2, -(-arm.num_joints // 2), figsize=(15, 7), layout="constrained")
    for j, (name, ax) in enumerate(zip(arm.joint_names, axes.flat, strict=False)):
        unit = "mm" if arm.prismatic[j] else "mrad"
        for which, response in comparison.responses.items():
            way = 1e3 * (response.q[:, j] - response.q[0, j])
            sign = np.sign(response.q_desired[j] - response.q[0, j])
            ax.plot(response.t, sign * way, color=COLOURS[which], label=which, linewidth=1.2)
            goal = 1e3 * abs(response.q_desired[j] - response.q[0, j])
        half = 1e3 * band(arm)[j]
        ax.axhspan(goal - half, goal + half, color="#1f6f8b", alpha=0.15, linewidth=0)
        # What runs away would flatten all the others.
        ax.set_ylim(-0.1 * goal, 1.6 * goal)
        ax.set_title(f"J{j + 1} {name}", fontsize=9)
        ax.set_ylabel(f"[{unit}]", fontsize=8)
        ax.set_xlabel("time [s]", fontsize=8)
        ax.tick_params(labelsize=8)
    for ax in axes.flat[arm.num_joints :]:
        ax.axis("off")
    handles, labels = axes.flat[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="lower right", fontsize=9)
    figure.suptitle(f"{arm.name}, simulated with all effects: all joints step at once; shaded: settled")
    save_figure(figure, path)
