"""Plots measured and predicted efforts of a motion, their difference, and the causes of the difference."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from numpy.typing import NDArray

from dvrk_drake.analysis.dynamic.validation import SHARE_LABELS, DynamicValidation
from dvrk_drake.reports.colours import FITTED, HELD_OUT, MEASURED, NEUTRAL, SERIES
from dvrk_drake.reports.figures.style import (
    WIDTH,
    add_legend,
    effort_unit,
    joint_title,
    position_unit,
    save_figure,
    set_title,
)

#: Number of bins over position or velocity in `residuals.png`, and smallest number of rows in a drawn bin.
_BINS, _MIN_ROWS = 30, 10
#: Range of the residuals that is drawn, in multiples of their RMS.
_RANGE = 4.0
_SHARE_COLOURS = (*SERIES[:5], *SERIES[6:], NEUTRAL)


def plot_motion(folder: Path, validation: DynamicValidation, held_out: NDArray[np.float64] | None = None) -> None:
    """Writes efforts.png, residuals.png and error_budget.png of a motion into `folder`.

    Args:
        folder: Existing folder.
        validation: Errors of a model on the motion.
        held_out: Efforts (r, n) that cross-validation predicts for the motion, if the model was fitted to it [N m, N].
            None: `validation` is of another motion.
    """
    recording = validation.recording
    name = f"{validation.model.arm.name}, {Path(recording.source).name}"
    is_fitted = held_out is not None or validation.of_same_recording
    curves = {"fitted": (FITTED, validation.predicted)} if is_fitted else {}
    if held_out is not None:
        curves["held out (cross-validation)"] = (HELD_OUT, held_out)
    elif not is_fitted:
        curves["held out (the motion was not used to fit)"] = (HELD_OUT, validation.predicted)
    _plot_efforts(folder / "efforts.png", validation, curves, name)
    label, (_, predicted) = list(curves.items())[-1]
    _plot_residuals(folder / "residuals.png", validation, predicted, f"{name}, {label}")
    _plot_budget(folder / "error_budget.png", validation, predicted, f"{name}, {label}")


def _plot_efforts(
    path: Path, validation: DynamicValidation, curves: dict[str, tuple[str, NDArray[np.float64]]], name: str
) -> None:
    """Plots efforts over time, and below them their errors, for each actuator."""
    arm = validation.model.arm
    count = arm.num_joints
    figure = plt.figure(figsize=(WIDTH, 2.3 * count + 1), layout="constrained")
    panels = figure.subplots(2 * count, 1, sharex=True, height_ratios=[2, 1] * count)
    for i, (efforts, errors) in enumerate(zip(panels[::2], panels[1::2], strict=True)):
        measured = validation.measured[:, i]
        efforts.plot(validation.t, measured, color=MEASURED, alpha=0.35, linewidth=3.5, label="measured")
        ratios = []
        for k, (label, (colour, predicted)) in enumerate(curves.items()):
            error = measured - predicted[:, i]
            # The first curve is thin and drawn last, so that it does not hide the second.
            style: dict[str, Any] = {"color": colour, "linewidth": 0.9 + 0.8 * k, "zorder": 3 - k / 2}
            efforts.plot(validation.t, predicted[:, i], label=label, **style)
            errors.plot(validation.t, error, **style)
            if np.any(measured):
                ratio = np.sqrt(np.mean(error**2) / np.mean(measured**2))
                ratios.append(f"{label.split(' (')[0]} {100 * ratio:.1f} %")
        efforts.set_title(f"{joint_title(arm, i)}: relative RMS error {', '.join(ratios) or '-'}", loc="left")
        efforts.set_ylabel(f"effort [{effort_unit(arm, i)}]")
        errors.axhline(0.0, color=MEASURED, linewidth=0.6)
        errors.set_ylabel(f"error [{effort_unit(arm, i)}]")
        errors.locator_params(axis="y", nbins=3)
    figure.align_ylabels(panels)
    panels[-1].set_xlabel("time [s]")
    panels[-1].set_xlim(validation.t[0], validation.t[-1])
    set_title(
        figure,
        f"{name}: measured and predicted efforts of the actuators below {validation.cut_off:.3g} Hz, and "
        "measured minus predicted effort",
    )
    add_legend(figure)
    save_figure(figure, path)


def _plot_residuals(path: Path, validation: DynamicValidation, predicted: NDArray[np.float64], name: str) -> None:
    """Plots residuals over position and velocity, with one row per actuator."""
    arm = validation.model.arm
    count = arm.num_joints
    figure, axes = plt.subplots(
        count, 2, figsize=(WIDTH, 1.9 * count + 1), sharey="row", layout="constrained", squeeze=False
    )
    residuals = validation.measured - predicted
    for i in range(count):
        length = position_unit(arm, i)
        extent = _RANGE * max(float(np.sqrt(np.mean(residuals[:, i] ** 2))), 1e-12)
        quantities = ((validation.q[:, i], f"position [{length}]"), (validation.v[:, i], f"velocity [{length}/s]"))
        for ax, (x, label) in zip(axes[i], quantities, strict=True):
            _draw_residuals(ax, x, residuals[:, i], extent)
            ax.set_xlabel(label)
            ax.set_title(joint_title(arm, i), loc="left")
        axes[i, 0].set_ylabel(f"error [{effort_unit(arm, i)}]")
        axes[i, 0].set_ylim(-extent, extent)
    set_title(
        figure,
        f"{name}: measured minus predicted effort over position and velocity\n"
        "A mean that differs from 0 is a systematic error of the model",
    )
    add_legend(figure, axes[0])
    save_figure(figure, path)


def _draw_residuals(ax: Axes, x: NDArray[np.float64], residual: NDArray[np.float64], extent: float) -> None:
    """Draws the density of residuals over x, and their mean and standard deviation in bins with equal widths."""
    edges = np.linspace(x.min(), x.max() + 1e-12, _BINS + 1)
    shown = np.clip(residual, -extent, extent)
    ax.hist2d(
        x, shown, bins=[np.linspace(edges[0], edges[-1], 3 * _BINS), np.linspace(-extent, extent, 40)], cmap="Greys",
        norm=LogNorm(0.5, len(x) / 50 + 1), cmin=1,
    )  # fmt: skip
    index = np.clip(np.digitize(x, edges) - 1, 0, _BINS - 1)
    members = [residual[index == k] for k in range(_BINS)]
    used = [k for k, values in enumerate(members) if len(values) >= _MIN_ROWS]
    centres = (edges[:-1] + edges[1:])[used] / 2
    mean, spread = (np.array([f(members[k]) for k in used]) for f in (np.mean, np.std))
    ax.fill_between(
        centres,
        mean - spread,
        mean + spread,
        color=SERIES[0],
        alpha=0.25,
        linewidth=0,
        label="mean ± standard deviation",
    )
    ax.plot(centres, mean, color=SERIES[0], linewidth=2.0, label="mean in a bin")
    ax.axhline(0.0, color=MEASURED, linewidth=0.6)
    ax.plot([], [], "s", color="0.6", label="density of the rows (errors outside the range at the edge)")


def _plot_budget(path: Path, validation: DynamicValidation, predicted: NDArray[np.float64], name: str) -> None:
    """Plots the relative error of each actuator, divided into shares of the squared error."""
    arm = validation.model.arm
    shares = np.array([[share or 0.0 for share in one] for one in validation.error_shares(predicted)])
    effort = np.mean(validation.measured**2, axis=0)
    error = np.mean((validation.measured - predicted) ** 2, axis=0)
    lengths = 100 * np.sqrt(np.divide(error, effort, out=np.zeros_like(error), where=effort > 0))
    figure, ax = plt.subplots(figsize=(WIDTH, 0.55 * arm.num_joints + 1.8), layout="constrained")
    y = list(range(arm.num_joints))
    left = np.zeros(len(y))
    for kind, label, colour in zip(shares.T, SHARE_LABELS, _SHARE_COLOURS, strict=True):
        ax.barh(y, lengths * kind, 0.65, left=left, color=colour, edgecolor="white", linewidth=0.6, label=label)
        left += lengths * kind
    floors = np.array([np.nan if a.repeatability is None else 100 * a.repeatability for a in validation.actuators])
    if np.any(np.isfinite(floors)):
        low, high = np.array(y) - 0.4, np.array(y) + 0.4
        ax.vlines(floors, low, high, color="white", linewidth=4)
        ax.vlines(floors, low, high, color=MEASURED, linewidth=2, label="repeatability of the effort")
    for yi, length, dominant in zip(y, lengths, np.argmax(shares, axis=1), strict=True):
        text = f"{length:.1f} %, most: {SHARE_LABELS[dominant]}"
        ax.annotate(
            text, (np.nanmax([length, floors[yi]]), yi), (8, 0), textcoords="offset points", va="center", fontsize=9
        )
    ax.set_yticks(y, [joint_title(arm, i) for i in y])
    ax.invert_yaxis()
    ax.grid(visible=False, axis="y")
    ax.margins(x=0.25)
    ax.set_xlim(left=0)
    ax.set_xlabel("relative RMS error of the effort [%], divided in proportion to the squared error")
    set_title(figure, f"{name}: size of the error of each actuator and its causes")
    add_legend(figure)
    save_figure(figure, path)
