"""Plots the step responses of tuned gains."""

from __future__ import annotations

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from dvrk_drake.experiments.tuning.bench import band
from dvrk_drake.experiments.tuning.tuning import OWN, PUBLISHED, Comparison
from dvrk_drake.reports.figures.style import save_figure

COLOURS = {OWN: "#9a9a9a", PUBLISHED: "#b58db6", "paper": "#edae49", "model": "#d1495b"}


def plot_steps(path: Path, comparison: Comparison) -> None:
    """Plots the step response from the first pose for all gains, with one panel per joint."""
    arm = comparison.arm
    figure, axes = plt.subplots(2, -(-arm.num_joints // 2), figsize=(15, 7), layout="constrained")
    for j, (name, ax) in enumerate(zip(arm.joint_names, axes.flat, strict=False)):
        unit = "mm" if arm.prismatic[j] else "mrad"
        for which, response in comparison.responses.items():
            displacement = 1e3 * (response.q[:, j] - response.q[0, j])
            sign = np.sign(response.q_desired[j] - response.q[0, j])
            ax.plot(response.t, sign * displacement, color=COLOURS[which], label=which, linewidth=1.2)
            goal = 1e3 * abs(response.q_desired[j] - response.q[0, j])
        half = 1e3 * band(arm)[j]
        ax.axhspan(goal - half, goal + half, color="#1f6f8b", alpha=0.15, linewidth=0)
        # Limits the axis, so that an unstable response does not flatten the other curves.
        ax.set_ylim(-0.1 * goal, 1.6 * goal)
        ax.set_title(f"J{j + 1} {name}", fontsize=9)
        ax.set_ylabel(f"displacement [{unit}]", fontsize=8)
        ax.set_xlabel("time [s]", fontsize=8)
        ax.tick_params(labelsize=8)
    for ax in axes.flat[arm.num_joints :]:
        ax.axis("off")
    handles, labels = axes.flat[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="lower right", fontsize=9)
    figure.suptitle(f"{arm.name}, simulated with all effects: simultaneous step of all joints, settling band shaded")
    save_figure(figure, path)
