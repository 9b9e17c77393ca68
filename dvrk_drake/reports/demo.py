"""Prints the results of the demo and of the teleoperation to a terminal."""

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
1. Record at least 40 different static poses with dvrk-drake collect, or
   convert a recording of another program (docs/recordings.md).
2. dvrk-drake identify POSES.csv --arm {arm} --output model.yaml
3. On another day: dvrk-drake validate OTHER.csv --model model.yaml --save
4. Disable the gravity compensation of the dVRK controller. Otherwise gravity is
   compensated twice. Keep a hand on the emergency stop.
5. Only if no verdict is "do not use":
   dvrk-drake run --arm {arm} --model model.yaml --mode damped"""


def print_demo(console: Console, result: DemoResult, folder: Path, *, verbose: bool = False) -> None:
    """Prints the drift of the released arm, and the errors of the models at new poses.

    Args:
        console: Console to print to.
        result: Result of the demo.
        folder: Output folder of the demo.
        verbose: Whether to print the identified parameters, and instructions for a real arm.
    """
    arm = result.arm
    drifts = list(result.drift.values())
    angles = [np.where(arm.prismatic, 0.0, drift) for drift in drifts[:2]]
    identified, nominal = (f"{angle.max():.4f} rad ({arm.joint_names[int(np.argmax(angle))]})" for angle in angles)
    print_answer(
        console,
        f"Largest joint rotation of {arm.name} after a release without dry friction: {identified} with the identified "
        f"model, {nominal} with the nominal model.",
        f"open {folder}/arm.html in a browser",
    )
    table = make_table(
        f"RMS torque error at {result.fresh.poses} new poses [N m; N], drift and step error [rad; m]",
        *("", "no model", "identified", "paper's method", "drift, identified", "drift, nominal", "step error"),
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
            "The simulated arm has no joint stops in q2 + q3. A real arm would hit these stops in the step and in the "
            "release with the nominal model.",
        )


def print_teleoperation(console: Console, result: TeleoperationResult, file: str, *, verbose: bool = False) -> None:
    """Prints the tracking error of the instrument tip.

    Args:
        console: Console to print to.
        result: Result of the teleoperation.
        file: Path of the page with the recorded motion.
        verbose: Whether to print the definition of the errors.
    """
    print_answer(
        console,
        f"The tip follows the handle within {1e3 * result.max_position_error:.3f} mm "
        f"(RMS {1e3 * result.rms_position_error:.3f} mm).",
        f"open {file} in a browser",
    )
    table = make_table("Tracking error of the instrument tip", "", "RMS", "largest")
    table.add_row(
        escape("position [mm]"), f"{1e3 * result.rms_position_error:.3f}", f"{1e3 * result.max_position_error:.3f}"
    )
    table.add_row(
        escape("rotation [mrad]"), f"{1e3 * result.rms_rotation_error:.2f}", f"{1e3 * result.max_rotation_error:.2f}"
    )
    table.add_row(escape("motion while the clutch is open [mm]"), "", f"{1e3 * result.max_motion_held:.1g}")
    console.print(table)
    if verbose:
        console.print()
        print_note(
            console,
            "Error: motion of the tip minus the scaled motion of the handle. Both motions are measured from the "
            f"positions at which the clutch was closed. Length of the path of the handle: {result.handle_path:.2f} m.",
        )
