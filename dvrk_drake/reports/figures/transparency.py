"""Plots the interaction force at the handle of an arm."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from dvrk_drake.experiments.transparency import GRASP_TIME, OperatorForces
from dvrk_drake.models.arm import Arm
from dvrk_drake.reports.figures.colours import SERIES
from dvrk_drake.reports.figures.style import WIDTH, add_legend, save_figure, set_title


def plot_transparency(path: Path, arm: Arm, forces: Sequence[OperatorForces]) -> None:
    """Plots force and torque at the handle over time, with one curve per compensation."""
    figure, both = plt.subplots(2, 1, figsize=(WIDTH, 6.5), sharex=True, layout="constrained")
    for i, one in enumerate(forces):
        late = one.time >= GRASP_TIME
        label = f"{one.name} (RMS {one.rms_force:.2f} N, {1e3 * one.rms_torque:.0f} mN m)"
        for axes, vectors, scale in zip(both, (one.force, one.torque), (1.0, 1e3), strict=True):
            size = scale * np.linalg.norm(vectors[late], axis=1)
            axes.plot(
                one.time[late], size, label=label, color=SERIES[i % len(SERIES)], linestyle=("-", "--")[i // 4 % 2]
            )
    for axes, quantity in zip(both, ("force [N]", "torque [mN m]"), strict=True):
        axes.set_ylabel(quantity)
        axes.set_ylim(bottom=0)
    best = min(forces, key=lambda one: one.rms_force)
    set_title(
        figure,
        f"{arm.name}, simulated: force and torque that an operator needs to move the handle along a path. "
        f"Smallest with: {best.name}",
    )
    both[1].set_xlabel("time [s]")
    add_legend(figure)
    save_figure(figure, path)
