"""Plots the positions of a simulation over time."""

from __future__ import annotations

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from numpy.typing import NDArray

from dvrk_drake.experiments.scenario import Scenario
from dvrk_drake.experiments.simulation import Simulation
from dvrk_drake.models.arm import Arm
from dvrk_drake.reports.figures.style import MEASURED_COLOUR, MODEL_COLOUR, save_figure


def plot_simulation(path: Path, simulation: Simulation, scenario: Scenario) -> None:
    """Writes a PNG of the simulated positions and, if available, the desired positions."""
    curves = {"simulated": simulation.recording.q}
    if simulation.desired is not None:
        curves["desired"] = simulation.desired
    arm = scenario.mounted_arm
    plot_positions(
        path,
        arm,
        simulation.time,
        curves,
        f"{arm.name}: simulated joint positions, controller mode {scenario.controller.mode}",
    )


def plot_positions(
    path: Path, arm: Arm, t: NDArray[np.float64], curves: dict[str, NDArray[np.float64]], title: str
) -> None:
    """Plots positions over time, with one panel per joint.

    Args:
        path: PNG file to write.
        arm: Arm of the joints.
        t: Times (m,) [s].
        curves: Positions (m, n) [rad; m] by label. The second and later curves are dashed.
        title: Title of the figure.
    """
    names = arm.joint_names
    figure, axes = plt.subplots(2, -(-len(names) // 2), figsize=(13, 6.5), layout="constrained")
    colours = [MODEL_COLOUR, MEASURED_COLOUR, "#edae49"]
    for j, (name, ax) in enumerate(zip(names, axes.flat, strict=False)):
        for i, (label, q) in enumerate(curves.items()):
            ax.plot(t, q[:, j], "-" if i == 0 else "--", color=colours[i % 3], linewidth=1.2, label=label)
        low, high = ax.get_ylim()
        if high - low < 2e-3:  # avoids a magnified view of the noise of a joint at rest
            ax.set_ylim((low + high) / 2 - 1e-3, (low + high) / 2 + 1e-3)
        ax.set_title(f"J{j + 1} {name}", fontsize=10)
        ax.set_ylabel(f"position [{'m' if arm.prismatic[j] else 'rad'}]", fontsize=8)
        ax.set_xlabel("time [s]", fontsize=8)
        ax.tick_params(labelsize=7)
        ax.grid(alpha=0.3)
    for ax in axes.flat[len(names) :]:
        ax.axis("off")
    key = next((ax.get_legend_handles_labels() for ax in axes.flat if ax.has_data()), None)
    if key:
        figure.legend(*key, loc="lower right", fontsize=8)
    figure.suptitle(title)
    save_figure(figure, path)
