"""Pictures of measured and predicted efforts in a motion, and of what the model leaves."""

from __future__ import annotations

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from dvrk_drake.analysis.dynamic.validation import DynamicValidation
from dvrk_drake.models.arm import Arm
from dvrk_drake.reports.figures import MEASURED_COLOUR, MODEL_COLOUR, ZERO_COLOUR, save_figure


def plot_motion(folder: Path, arm: Arm, validation: DynamicValidation, title: str) -> None:
    """Writes efforts.png, residuals.png and error_budget.png of a motion."""
    _plot_efforts(folder / "efforts.png", arm, validation, title)
    _plot_residuals(folder / "residuals.png", arm, validation, title)
    _plot_budget(folder / "error_budget.png", validation, title)


def _plot_efforts(path: Path, arm: Arm, validation: DynamicValidation, title: str) -> None:
    """One panel an actuator: measured and predicted effort over time, and their difference."""
    count = arm.num_joints
    figure, axes = plt.subplots(count, 1, figsize=(13, 1.9 * count), sharex=True, layout="constrained")
    for i, (actuator, ax) in enumerate(zip(validation.actuators, axes, strict=True)):
        measured, predicted = validation.measured[:, i], validation.predicted[:, i]
        ax.plot(validation.t, measured - predicted, color=ZERO_COLOUR, linewidth=0.8, label="measured - predicted")
        ax.plot(validation.t, measured, color=MEASURED_COLOUR, linewidth=1.0, label="measured")
        ax.plot(validation.t, predicted, color=MODEL_COLOUR, linewidth=1.0, label="predicted")
        relative = "" if actuator.relative_error is None else f", error {100 * actuator.relative_error:.1f} %"
        ax.set_title(f"actuator {i + 1} {actuator.name}{relative}", fontsize=9)
        ax.set_ylabel("N" if arm.prismatic[i] else "N m", fontsize=8)
        ax.tick_params(labelsize=7)
    axes[-1].set_xlabel("time [s]", fontsize=8)
    axes[0].legend(fontsize=7, loc="upper right", ncols=3)
    figure.suptitle(f"{title}: efforts of the actuators behind {validation.cut_off:g} Hz")
    save_figure(figure, path)


def _plot_residuals(path: Path, arm: Arm, validation: DynamicValidation, title: str) -> None:
    """One column an actuator: the difference over position, velocity and time."""
    count = arm.num_joints
    figure, axes = plt.subplots(3, count, figsize=(2.6 * count, 7), sharey="col", layout="constrained")
    residuals = validation.measured - validation.predicted
    for i, actuator in enumerate(validation.actuators):
        length = "m" if arm.prismatic[i] else "rad"
        over = (
            (validation.q[:, i], f"position [{length}]"),
            (validation.v[:, i], f"velocity [{length}/s]"),
            (validation.t, "time [s]"),
        )
        for (x, label), ax in zip(over, axes[:, i], strict=True):
            ax.plot(x, residuals[:, i], ",", color=MODEL_COLOUR, alpha=0.5)
            ax.axhline(0.0, color="black", linewidth=0.6)
            ax.set_xlabel(label, fontsize=8)
            ax.tick_params(labelsize=7)
        axes[0, i].set_title(f"{i + 1} {actuator.name}\n[{'N' if arm.prismatic[i] else 'N m'}]", fontsize=9)
    figure.suptitle(f"{title}: measured - predicted effort")
    save_figure(figure, path)


def _plot_budget(path: Path, validation: DynamicValidation, title: str) -> None:
    """Stacked shares of each actuator's squared error, their height the relative error."""
    kinds = ("bias", "friction_like", "position_dependent", "other")
    colours = ("#edae49", MEASURED_COLOUR, MODEL_COLOUR, ZERO_COLOUR)
    figure, ax = plt.subplots(figsize=(11, 5), layout="constrained")
    heights = np.array([100 * (a.relative_error or 0.0) for a in validation.actuators])
    bottom = np.zeros(len(heights))
    for kind, colour in zip(kinds, colours, strict=True):
        part = heights * np.array([getattr(a, kind) for a in validation.actuators])
        ax.bar(range(len(heights)), part, 0.6, bottom=bottom, color=colour, label=kind.replace("_", " "))
        bottom += part
    for i, actuator in enumerate(validation.actuators):
        if actuator.repeatability is not None:
            floor = 100 * actuator.repeatability
            ax.plot(
                [i - 0.35, i + 0.35], [floor, floor], color="black", linewidth=1.2, label="_" if i else "repeatability"
            )
    ax.set_xticks(range(len(heights)), [a.name.replace("_", "\n") for a in validation.actuators], fontsize=8)
    ax.set_ylabel("relative error [%], split by shares of its square")
    ax.set_title(title)
    ax.legend(fontsize=8)
    save_figure(figure, path)
