"""The demo and the teleoperation as text in a terminal."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from rich.console import Console
from rich.markup import escape

from dvrk_drake.experiments.demo.demo import NO_DRY_FRICTION, DemoResult
from dvrk_drake.experiments.demo.teleoperation import TeleoperationResult
from dvrk_drake.reports.identification import print_static_parameters
from dvrk_drake.reports.terminal_tables import make_table, print_answer, print_note

WITH_A_REAL_ARM = """
With a real arm:
1. Record 40 or more varied poses at rest (dvrk-drake collect, or
   docs/public_recordings.md for other programs).
2. dvrk-drake identify POSES.csv --arm {arm} --output model.yaml
3. On another day: dvrk-drake validate OTHER.csv --model model.yaml --save
4. Only when no joint's verdict is "do not use":
   dvrk-drake run --arm {arm} --model model.yaml --mode gravity
   Keep a hand on the stop button. Switch the controller's own gravity
   compensation off first, or gravity is compensated twice."""


def print_demo(console: Console, result: DemoResult, folder: Path, *, verbose: bool = False) -> None:
    """Prints how far the arm drifts when it is released, and the errors of the models on fresh poses.

    Args:
        console: to print to.
        result: to print.
        folder: which the demo wrote.
        verbose: also print the identified parameters and the steps with a real arm.
    """
    arm = result.arm
    drifts = list(result.drift.values())
    angles = [np.where(arm.prismatic, 0.0, drift) for drift in drifts[:2]]
    identified, drawn = (f"{angle.max():.4f} rad ({arm.joint_names[int(np.argmax(angle))]})" for angle in angles)
    print_answer(
        console,
        f"Released without dry friction, {arm.name} turns by at most {identified} with the identified model, and by "
        f"{drawn} with that of the SDF.",
        f"open {folder}/arm.html in a browser",
    )
    table = make_table(
        f"RMS torque error at {result.fresh.poses} fresh poses [N m; N], drift and step error [rad; m]",
        *("", "no model", "identified model", "paper's method", *(f"drift, {k}" for k in result.drift), "step error"),
    )
    for i, (ours, paper) in enumerate(zip(result.fresh.joints, result.fresh_paper.joints, strict=True)):
        errors = (ours.rms_torque, ours.rms_error, paper.rms_error, *(drift[i] for drift in drifts))
        table.add_row(ours.name, *(f"{e:.4f}" for e in errors), f"{result.step_error[i]:.5f}")
    console.print(table)
    console.print()
    print_note(console, NO_DRY_FRICTION)
    if not verbose:
        console.print(f"With a real arm: dvrk-drake identify POSES.csv --arm {arm.source} --output MODEL.yaml")
        return
    print_static_parameters(console, result.identification.model)
    console.print(WITH_A_REAL_ARM.format(arm=arm.source), markup=False)
    if arm.coupled_limits:
        print_note(
            console,
            "The simulated arm has no stops in q2 + q3: the step, and the release with the SDF's model, pass where a "
            "real arm would hit them.",
        )


def print_teleoperation(console: Console, result: TeleoperationResult, file: str, *, verbose: bool = False) -> None:
    """Prints how well the tip followed the handle.

    Args:
        console: to print to.
        result: to print.
        file: page with the recorded motion.
        verbose: also print how the errors are computed.
    """
    print_answer(
        console,
        f"The tip follows the handle within {1e3 * result.max_position_error:.3f} mm "
        f"(RMS {1e3 * result.rms_position_error:.3f} mm).",
        f"open {file} in a browser",
    )
    table = make_table("Error of the tip", "", "RMS", "largest")
    table.add_row(
        escape("position [mm]"), f"{1e3 * result.rms_position_error:.3f}", f"{1e3 * result.max_position_error:.3f}"
    )
    table.add_row(
        escape("rotation [mrad]"), f"{1e3 * result.rms_rotation_error:.2f}", f"{1e3 * result.max_rotation_error:.2f}"
    )
    table.add_row(escape("motion with an open clutch [mm]"), "", f"{1e3 * result.max_motion_held:.1g}")
    console.print(table)
    if verbose:
        console.print()
        print_note(
            console,
            "Error: motion of the tip less the scaled motion of the handle since the clutch closed, over "
            f"{result.handle_path:.2f} m of the handle's path.",
        )
