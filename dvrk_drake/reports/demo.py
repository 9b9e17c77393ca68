"""Prints the results of the demo and of the teleoperation to a terminal."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.markup import escape

from dvrk_drake.experiments.demo.demo import PLANS, DemoResult
from dvrk_drake.experiments.demo.teleoperation import TeleoperationResult
from dvrk_drake.models.arm import Arm
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
   dvrk-drake control --arm {arm} --model model.yaml --mode damped
"""
#: Note on the simulated arm and on the start of the release.
GROUND_TRUTH = (
    "The simulated arm has the friction, cables, stops and sensors of the arm file. Its links are {:g} to {:g} times "
    "as heavy as in the SDF, except for its counterweights. At the start of the release, its friction carries no load. "
    "After an approach from one side, a joint can move back or slip further than the limit."
)


def print_demo(console: Console, result: DemoResult, folder: Path, *, verbose: bool = False) -> None:
    """Prints whether the released arm stays at its pose, its drift, and the errors of the models at new poses.

    Args:
        console: Console to print to.
        result: Result of the demo.
        folder: Output folder of the demo.
        verbose: Whether to print the identified parameters, and instructions for a real arm.
    """
    arm, duration = result.arm, result.time[-1]
    drifts = result.drifts
    largest = {model: _largest_rotation(arm, drift) for model, drift in drifts.items()}
    print_answer(
        console,
        f"Verdict: the identified model {'holds' if result.holds('identified') else 'does not hold'} the released "
        f"{arm.name} for {duration:g} s. Largest drift: {largest['identified']}, limit 15 mrad. With the model of the "
        f"SDF, the same arm {result.nominal_outcome}. Its largest drift is {largest['nominal']}.",
        f"open {folder}/arm.html in a browser, or drift.png",
        style="green" if result.holds("identified") else "yellow",
    )
    table = make_table(
        f"Largest drift in {duration:g} s [mrad; mm], RMS torque error at {result.fresh.poses} new poses [N m; N]",
        *("", "drift, identified", "drift, SDF", "error, identified", "error, SDF", "no model"),
    )
    for i, (ours, sdf) in enumerate(zip(result.fresh.joints, result.fresh_nominal.joints, strict=True)):
        drift = (f"{1e3 * drifts[model][i]:.1f}" for model in ("identified", "nominal"))
        errors = (f"{error:.4f}" for error in (ours.rms_error, sdf.rms_error, ours.rms_torque))
        table.add_row(ours.name, *drift, *errors)
    console.print(table)
    console.print()
    for purpose, command in (
        (
            "Plots and parameters with intervals:",
            f"{folder}/poses.csv --arm {arm.source} \\\n    --output new_model.yaml --report report.html",
        ),
        ("With a real arm:", f"POSES.csv --arm {arm.source} --output MODEL.yaml"),
    ):
        console.print(f"{purpose}\n  dvrk-drake identify {command}", markup=False, soft_wrap=True)
    if not verbose:
        return
    print_note(console, GROUND_TRUTH.format(*PLANS[arm.source].mass_ratios))
    print_static_parameters(console, result.identification.model)
    console.print(WITH_A_REAL_ARM.format(arm=arm.source), markup=False)


def _largest_rotation(arm: Arm, drift: NDArray[np.float64]) -> str:
    """Returns the largest drift (n,) of the rotating joints with its unit and joint."""
    angles = np.where(arm.prismatic, 0.0, drift)
    return f"{1e3 * angles.max():.1f} mrad ({arm.joint_names[int(np.argmax(angles))]})"


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
