"""Plots the results of the demo."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from dvrk_drake.experiments.demo.demo import (
    HELD_UNTIL,
    NO_DRY_FRICTION,
    PLANS,
    RELEASED_UNTIL,
    DemoResult,
)
from dvrk_drake.reports.figures.identification import plot_static_identification, plot_torque_error
from dvrk_drake.reports.figures.simulation import plot_positions


def plot_demo(output: Path, result: DemoResult) -> None:
    """Writes torque_error.png, predicted.png, fresh_torque_error.png, release.png and step.png into `output`."""
    arm = result.arm
    plot_static_identification(output, result.identification)
    plot_torque_error(
        output / "fresh_torque_error.png",
        arm,
        np.array([j.rms_torque for j in result.fresh.joints]),
        {
            "identified": np.array([j.rms_error for j in result.fresh.joints]),
            "least squares of the paper": np.array([j.rms_error for j in result.fresh_paper.joints]),
        },
        f"{arm.name} (simulated): RMS torque error at {result.fresh.poses} poses that were not used for fitting",
    )
    plot_positions(
        output / "release.png",
        arm,
        result.release_time,
        {"identified model": result.released, "nominal model (SDF)": result.released_nominal},
        f"{arm.name} (simulated without dry friction): regulated until {HELD_UNTIL} s, gravity compensation until "
        f"{RELEASED_UNTIL} s, then motion to the home position\n{NO_DRY_FRICTION}",
    )
    title = PLANS[arm.name.lower()].step_title
    plot_positions(output / "step.png", arm, result.step_time, {"identified model": result.step}, title)
