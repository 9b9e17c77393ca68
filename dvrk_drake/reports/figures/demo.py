"""Plots the results of the demo."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from dvrk_drake.experiments.demo.demo import DemoResult
from dvrk_drake.reports.figures.colours import FITTED, LIMIT, NEUTRAL, REFERENCE
from dvrk_drake.reports.figures.identification import plot_torque_error
from dvrk_drake.reports.figures.style import add_legend, joint_title, panel_grid, save_figure, set_title

#: Smallest half-width of the drift axis, as a multiple of the limit of the drift.
_MIN_RANGE = 2.0


def plot_demo(output: Path, result: DemoResult) -> None:
    """Writes drift.png and torque_error.png into the folder `output`."""
    plot_drift(output / "drift.png", result)
    errors = {"identified model": result.fresh, "model of the SDF": result.fresh_nominal}
    plot_torque_error(
        output / "torque_error.png",
        result.arm,
        np.array([joint.rms_torque for joint in result.fresh.joints]),
        {label: np.array([joint.rms_error for joint in fresh.joints]) for label, fresh in errors.items()},
        f"{result.arm.name} (simulated): RMS torque error at {result.fresh.poses} poses that were not used for fitting",
    )


def plot_drift(path: Path, result: DemoResult) -> None:
    """Writes a PNG of the drift of the released arm with both models.

    Each joint has one panel, in which both models have the same scale. The panel shows the largest drift of a held
    joint, and the position limits of the joint that are inside its range.
    """
    arm, t = result.arm, result.time
    figure, axes = panel_grid(arm.num_joints, height=2.5)
    limits = "15 mrad or 1.5 mm" if np.any(arm.prismatic) else "15 mrad"
    for j, ax in enumerate(axes):
        q0, held = result.identified[0, j], 1e3 * result.limits[j]
        drift = {
            "model of the SDF (not identified)": (1e3 * (result.nominal[:, j] - result.nominal[0, j]), REFERENCE, "--"),
            "identified model": (1e3 * (result.identified[:, j] - q0), FITTED, "-"),
        }
        ax.axhspan(-held, held, color=NEUTRAL, alpha=0.5, linewidth=0, label=f"limit of a held joint: {limits}")
        for label, (values, colour, line) in drift.items():
            ax.plot(t, values, line, color=colour, linewidth=1.8, label=label)
        low, high = ax.get_ylim()
        low, high = min(low, -_MIN_RANGE * held), max(high, _MIN_RANGE * held)
        for stop in (arm.position_lower[j], arm.position_upper[j]):
            if low <= 1e3 * (stop - q0) <= high:
                ax.axhline(1e3 * (stop - q0), color=LIMIT, linestyle=":", linewidth=1.5, label="joint limit")
        ax.set_ylim(low, high)
        ax.set_title(joint_title(arm, j))
        ax.set_ylabel(f"drift [{'mm' if arm.prismatic[j] else 'mrad'}]")
        ax.set_xlabel("time since the release [s]")
    add_legend(figure)
    verdict = "holds" if result.holds("identified") else "does not hold"
    set_title(
        figure,
        f"The identified model {verdict} the released {arm.name}. "
        f"With the model of the SDF, it {result.nominal_outcome}."
        "\nDrift from the release position; simulation with friction, cables, joint stops and sensors",
    )
    save_figure(figure, path)
