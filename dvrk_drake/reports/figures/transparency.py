"""Plots the interaction force at the handle of an arm."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from dvrk_drake.experiments.transparency import GRASP_TIME, OperatorForces
from dvrk_drake.models.arm import Arm
from dvrk_drake.reports.figures.style import save_figure


def plot_transparency(path: Path, arm: Arm, forces: Sequence[OperatorForces]) -> None:
    """Plots force and torque at the handle over time, with one curve per compensation."""
    figure, both = plt.subplots(2, 1, figsize=(11, 6.5), sharex=True, layout="constrained")
    for one in forces:
        late = one.time >= GRASP_TIME
        for axes, vectors in zip(both, (one.force, one.torque), strict=True):
            axes.plot(one.time[late], np.linalg.norm(vectors[late], axis=1), label=one.name, linewidth=1.2)
    for axes, label in zip(both, ("force [N]", "torque [N m]"), strict=True):
        axes.set_ylabel(label)
        axes.set_ylim(bottom=0)
        axes.grid(alpha=0.3)
    figure.suptitle(f"{arm.name}, simulated: magnitude of interaction force and torque at the handle")
    both[0].legend(fontsize=8, ncols=min(4, len(forces)), loc="lower right", bbox_to_anchor=(1.0, 1.0))
    both[1].set_xlabel("time [s]")
    save_figure(figure, path)
