"""Page of tuned gains: comparison, step responses and efforts."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.experiments.tuning import DURATION, OWN, REST_TIME, Comparison, Tuning
from dvrk_drake.experiments.tuning_bench import band, step_size
from dvrk_drake.experiments.tuning_model_based import ArmDesign, JointDesign, friction
from dvrk_drake.experiments.tuning_procedure import JointProcedure
from dvrk_drake.models.arm import Arm
from dvrk_drake.reports.colours import COMMANDED, LIMIT, REFERENCE
from dvrk_drake.reports.page import Block, Page, Plot, Section, Table
from dvrk_drake.reports.plot import Curve, Guide, Mark, Panel, joint_label, series


def tuning_page(tuning: Tuning, *, gains_path: str | None = None) -> Page:
    """Returns the page of a tuning.

    The best gains have the fewest steps that do not settle. For equal numbers of such steps, the best gains have the
    smallest mean settling time.

    Args:
        tuning: Result of `tune_arm`.
        gains_path: Path of the written gains, for the suggested next command. None if they were not written.
    """
    comparison, name = tuning.comparison, tuning.arm.source
    best = comparison.best(tuning.found)
    found, own = (_settled(comparison.settling[which].ravel()) for which in (best, OWN))
    is_better = comparison.best([OWN, best]) == best
    details: list[Block] = []
    if tuning.procedure is not None:
        details += _procedure_tables(tuning.arm, tuning.procedure)
    if tuning.design is not None:
        details += _design_tables(tuning.arm, tuning.design)
    details.append(_joint_table(comparison))
    plots = [_step_plot(comparison), _effort_plot(comparison)] if comparison.responses else []
    return Page(
        f"Controller gains of {tuning.arm.name}, simulated",
        f"Gains of method {best} are {'better' if is_better else 'not better'} than {OWN}: settled steps and mean "
        f"settling time {found}; {OWN}: {own}.",
        [
            Section("Comparison of the gains", [_summary_table(comparison)]),
            Section("Step responses", plots),
            Section("Tuning methods and joints", details, folded=True),
        ],
        "good" if is_better else "warning",
        f"dvrk-drake simulate tune --arm {name} --output GAINS.yaml"
        if gains_path is None
        else f"dvrk-drake control --arm {name} --mode hold --gains {gains_path}",
    )


def _summary_table(comparison: Comparison) -> Table:
    """Returns the settled steps and the mean settling time of all joints and poses, with one row per condition."""
    rows = [
        (condition.name, *(_settled(comparison.settling[g][c].ravel()) for g in comparison.gains))
        for c, condition in enumerate(comparison.conditions)
    ]
    return Table(
        ("condition", *comparison.gains),
        rows,
        f"{comparison.arm.name}, simulated: number of settled steps, mean settling time",
        f"All joints step simultaneously, from {len(comparison.poses)} poses. G, M: factors of the true gravity torque "
        "and inertia with respect to the model. +1 tick: one more time step of delay.",
    )


def _procedure_tables(arm: Arm, joints: Sequence[JointProcedure]) -> list[Block]:
    """Returns the ultimate gains of the paper's procedure and the gains that follow from them."""
    rows = []
    for j, joint in enumerate(joints):
        unit, found = "mm" if arm.prismatic[j] else "mrad", joint.ultimate
        rows.append(
            (
                arm.joint_names[j],
                f"{1e3 * step_size(arm)[j]:.0f} {unit}",
                f"{1e3 * friction(arm)[0][j] / found.gain:.2f} {unit}",
                f"{'' if found.sustained else '> '}{found.gain:.4g}",
                f"{found.period:.3f}",
                f"{found.growth:.3f}",
                f"{1e3 * joint.offset:.2f} {unit}" + ("" if joint.damped else " *"),
            )
        )
    table = Table(
        ("", "step", "dead zone", "ultimate Kp", "period [s]", "growth", "residual"),
        rows,
        f"{arm.name}, the paper's procedure",
        "dead zone: dry friction / ultimate Kp. growth: ratio of successive amplitudes. >: oscillations decay at "
        "this Kp, and the effort saturates at larger Kp. residual: position error after the step; *: no Kv damped the "
        "oscillation.",
        show="details",
    )
    return [table, _gains(f"{arm.name}, gains of the paper's procedure", arm, joints)]


def _gains(caption: str, arm: Arm, joints: Sequence[JointProcedure | JointDesign]) -> Table:
    rows = [
        (name, *(f"{value:.3g}" for value in (joint.kp, joint.kd, joint.ki)))
        for name, joint in zip(arm.joint_names, joints, strict=True)
    ]
    return Table(("", "Kp", "Kv", "Ki"), rows, caption, show="details")


def _design_tables(arm: Arm, design: ArmDesign) -> list[Block]:
    """Returns inertia and stability margins of the model-based design, and its gains."""
    rows = [
        (
            name,
            "{:.3g}..{:.3g}".format(*properties.inertia),
            f"{joint.frequency:.1f}",
            "..".join(f"{np.degrees(margins.phase):.0f}" for margins in joint.margins),
            "..".join(f"{margins.gain:.1f}" for margins in joint.margins),
            joint.limited_by,
        )
        for name, properties, joint in zip(arm.joint_names, design.properties, design.joints, strict=True)
    ]
    table = Table(
        ("", "inertia", "frequency [rad/s]", "phase", "gain", "limited by"),
        rows,
        f"{arm.name}, model-based design",
        "inertia: smallest (all other joints free) and largest (all other joints locked) over the joint range [kg m^2; "
        "kg]. frequency: natural frequency of the closed loop. phase [deg] and gain: stability margins. limited by "
        "other joints: the joint is slower than in its single-joint design, so that all joints are stable together.",
        show="details",
    )
    return [table, _gains(f"{arm.name}, gains of the model-based design", arm, design.joints)]


def _joint_table(comparison: Comparison) -> Table:
    """Returns the largest settling time of each joint with all gains, or the number of steps that do not settle."""
    arm, rows = comparison.arm, []
    for j, joint in enumerate(arm.joint_names):
        unit = "mm" if arm.prismatic[j] else "mrad"
        step = f"{1e3 * step_size(arm)[j]:g} {unit}, band {1e3 * band(arm)[j]:.2g} {unit}"
        rows.append((joint, step, *(_slowest(settling[:, :, j]) for settling in comparison.settling.values())))
    return Table(
        ("", "step", *comparison.settling),
        rows,
        "Largest settling time of each joint [s] over all conditions and poses",
        "Settling band: 2 % of the step, but at least one encoder count. a/b: a of b steps do not settle within "
        f"{DURATION - REST_TIME:g} s.",
        show="details",
    )


def _slowest(settling: NDArray[np.float64]) -> str:
    failed = int(np.count_nonzero(~np.isfinite(settling)))
    return f"{failed}/{settling.size}" if failed else f"{settling.max():.2f}"


def _settled(settling: NDArray[np.float64]) -> str:
    inside = np.isfinite(settling)
    mean = f", {settling[inside].mean():.2f} s" if inside.any() else ""
    return f"{np.count_nonzero(inside)}/{len(settling)}{mean}"


def _step_plot(comparison: Comparison) -> Plot:
    """Returns the displacements of all joints, with the goal and the settling band."""
    arm, panels = comparison.arm, []
    for j in range(arm.num_joints):
        marks: list[Mark] = []
        goal = 0.0
        for i, (name, response) in enumerate(comparison.responses.items()):
            step = response.q_desired[j] - response.q[0, j]
            goal = 1e3 * abs(step)
            displacement = 1e3 * np.sign(step) * (response.q[:, j] - response.q[0, j])
            marks.append(Curve(name, response.t, displacement, **series(i)))
        half = 1e3 * band(arm)[j]
        marks.append(Guide("y", goal - half, goal + half, REFERENCE, "settling band"))
        marks.append(Guide("y", goal, None, COMMANDED, "target"))
        # Limits the axis, so that an unstable response does not flatten the other curves.
        limits = (-0.1 * goal, 1.6 * goal)
        unit = "mm" if arm.prismatic[j] else "mrad"
        panels.append(Panel(joint_label(arm, j), marks, "time [s]", f"displacement [{unit}]", y_range=limits))
    caption = "Simultaneous step of all joints from the first pose, with all effects"
    return Plot("steps", caption, panels, columns=2)


def _effort_plot(comparison: Comparison) -> Plot:
    """Returns the commanded efforts of all joints during the step, as shares of their limits."""
    arm, panels = comparison.arm, []
    for j in range(arm.num_joints):
        marks: list[Mark] = [
            Curve(name, response.t, 100 * response.effort[:, j] / arm.effort_limits[j], **series(i))
            for i, (name, response) in enumerate(comparison.responses.items())
        ]
        marks += [Guide("y", limit, None, LIMIT, "effort limit") for limit in (-100, 100)]
        panels.append(Panel(joint_label(arm, j), marks, "time [s]", "effort / limit [%]"))
    caption = "Commanded efforts during the step, as shares of the effort limits"
    return Plot("step_efforts", caption, panels, columns=2)
