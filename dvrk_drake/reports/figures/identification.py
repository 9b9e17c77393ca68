"""Plots identification and validation results for static poses and motions."""

from __future__ import annotations

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from numpy.typing import NDArray

from dvrk_drake.analysis.dynamic.dynamic_identification import DynamicIdentification
from dvrk_drake.analysis.dynamic.validation import DynamicValidation, validate_motion
from dvrk_drake.analysis.results import Identification, Validation
from dvrk_drake.analysis.static.excluded_measurements import ExcludedMeasurement, usable_measurements
from dvrk_drake.analysis.static.static_identification import StaticIdentification
from dvrk_drake.analysis.static.validation import StaticValidation
from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.models.arm import Arm
from dvrk_drake.recordings.recording import Recording
from dvrk_drake.reports.figures.style import MEASURED_COLOUR, MODEL_COLOUR, ZERO_COLOUR, save_figure


def plot_identification(folder: Path, result: Identification) -> None:
    """Plots measured and predicted efforts. See `plot_motion` and `plot_static_identification` for the files."""
    if isinstance(result, DynamicIdentification):
        fit = validate_motion(result.model, result.recording)
        arm = result.model.arm
        plot_motion(folder, arm, fit, f"{arm.name}, model fitted to {Path(result.recording.source).name}")
    elif isinstance(result, StaticIdentification):
        plot_static_identification(folder, result)


def plot_validation(folder: Path, validation: Validation) -> None:
    """Plots the errors of a model. See `plot_motion` and `plot_static_validation` for the files."""
    if isinstance(validation, DynamicValidation):
        arm = validation.model.arm
        plot_motion(folder, arm, validation, f"{arm.name}, {Path(validation.recording.source).name}")
    elif isinstance(validation, StaticValidation):
        plot_static_validation(folder, validation)


def plot_static_identification(folder: Path, result: StaticIdentification) -> None:
    """Writes torque_error.png and predicted.png of an identification."""
    recording = result.recording
    joints = result.model.joints
    plot_torque_error(
        folder / "torque_error.png",
        result.model.arm,
        np.array([j.rms_zero_torque_included for j in joints]),
        {
            "leave-one-out": np.array([j.rms_leave_one_out_included for j in joints]),
            "10-fold, effects selected anew": np.array([j.rms_cross_validation_included for j in joints]),
        },
        f"{result.model.arm.name}: RMS torque error in cross-validation, {Path(recording.source).name}, without "
        "excluded measurements",
    )
    plot_measured_against_predicted(folder / "predicted.png", result.model, recording, result.measured, result.excluded)


def plot_static_validation(folder: Path, validation: StaticValidation) -> None:
    """Writes torque_error.png and predicted.png of a validation."""
    model = validation.model
    arm = model.arm
    recording = validation.recording.in_joint_coordinates(arm)
    plot_torque_error(
        folder / "torque_error.png",
        arm,
        np.array([j.rms_torque for j in validation.joints]),
        {"model": np.array([j.rms_error for j in validation.joints])},
        f"{model.arm.name}: RMS torque error at all {validation.poses} poses of {Path(recording.source).name}",
    )
    plot_measured_against_predicted(
        folder / "predicted.png", model, recording, validation.measured, validation.excluded
    )


def plot_torque_error(
    path: Path,
    arm: Arm,
    rms_zero: NDArray[np.float64],
    rms_model: dict[str, NDArray[np.float64]],
    title: str,
) -> None:
    """Plots the RMS torque error of each joint for zero torque and for each model, on a logarithmic scale.

    Args:
        path: PNG file to write.
        arm: Arm of the joints.
        rms_zero: RMS errors (n,) of zero torque [N m; N].
        rms_model: RMS errors (n,) [N m; N] by name of the model.
        title: Title of the figure.
    """
    names = arm.joint_names
    figure, axes = plt.subplots(figsize=(11, 5), layout="constrained")
    bars = {"zero torque": rms_zero, **rms_model}
    colours = [ZERO_COLOUR, MODEL_COLOUR, MEASURED_COLOUR, "#edae49"]
    width = 0.8 / len(bars)
    for i, (label, values) in enumerate(bars.items()):
        x = np.arange(len(names)) + (i - (len(bars) - 1) / 2) * width
        drawn = axes.bar(x, values, width, label=label, color=colours[i % len(colours)])
        axes.bar_label(drawn, [f"{v:.2g}" for v in values], fontsize=7, padding=2, rotation=90)
    if any(np.any(values > 0) for values in bars.values()):
        axes.set_yscale("log")
    axes.set_xticks(range(len(names)), _labels(names), fontsize=8)
    forces = "".join(f"; J{j + 1}: N" for j in np.flatnonzero(arm.prismatic))
    axes.set_ylabel(f"RMS torque error [N m{forces}]")
    axes.set_title(title)
    axes.margins(y=0.25)
    axes.legend(fontsize=8)
    save_figure(figure, path)


def plot_measured_against_predicted(
    path: Path,
    model: IdentifiedModel,
    recording: Recording,
    measured_joints: NDArray[np.bool_],
    excluded: list[ExcludedMeasurement],
) -> None:
    """Plots predicted against measured torque, with one point per pose and one panel per joint.

    Args:
        path: PNG file to write.
        model: Model that predicts the torques.
        recording: Recording in joint coordinates.
        measured_joints: Mask (m, n), True for measured holding torques. Only these torques are drawn.
        excluded: Excluded measurements, drawn as crosses. They do not affect the limits of the axes.
    """
    usable = usable_measurements(recording.q.shape, excluded) & measured_joints
    arm = model.arm
    names = arm.joint_names
    measured, predicted = recording.measured_effort(), model.holding_torque(recording.q)
    figure, axes = plt.subplots(2, -(-len(names) // 2), figsize=(13, 6.5), layout="constrained")
    for j, (name, ax) in enumerate(zip(names, axes.flat, strict=False)):
        use, left_out = usable[:, j], measured_joints[:, j] & ~usable[:, j]
        if not np.any(use):
            ax.set_title(f"J{j + 1} {name}: no measurements", fontsize=10)
            ax.set(xticks=[], yticks=[])
            continue
        shown = np.concatenate([measured[use, j], predicted[use, j], [0.0]])
        pad = 0.05 * max(float(np.ptp(shown)), 1e-6)
        limits = np.array([shown.min() - pad, shown.max() + pad])
        ax.plot(limits, limits, color="black", linewidth=0.8, label="measured = predicted")
        ax.plot(measured[use, j], predicted[use, j], ".", color=MODEL_COLOUR, label="one pose")
        ax.plot(
            np.clip(measured[left_out, j], *limits),
            np.clip(predicted[left_out, j], *limits),
            "x",
            color=MEASURED_COLOUR,
            label="excluded (at the edge: outside the axes)",
        )
        ax.set(xlim=limits, ylim=limits)
        ax.locator_params(nbins=5)
        ax.set_title(f"J{j + 1} {name}", fontsize=10)
        unit = "N" if arm.prismatic[j] else "N m"
        ax.set_xlabel(f"measured [{unit}]", fontsize=8)
        ax.set_ylabel(f"predicted [{unit}]", fontsize=8)
        ax.tick_params(labelsize=7)
    for ax in axes.flat[len(names) :]:
        ax.axis("off")
    key = next((ax.get_legend_handles_labels() for ax in axes.flat if ax.has_data()), None)
    if key:
        figure.legend(*key, loc="lower right", fontsize=8)
    figure.suptitle(
        f"{model.arm.name}: predicted and measured torque, {len(recording)} rows of {Path(recording.source).name}"
    )
    save_figure(figure, path)


def plot_motion(folder: Path, arm: Arm, validation: DynamicValidation, title: str) -> None:
    """Writes efforts.png, residuals.png and error_budget.png of a motion into `folder`."""
    _plot_efforts(folder / "efforts.png", arm, validation, title)
    _plot_residuals(folder / "residuals.png", arm, validation, title)
    _plot_budget(folder / "error_budget.png", validation, title)


def _plot_efforts(path: Path, arm: Arm, validation: DynamicValidation, title: str) -> None:
    """Plots measured and predicted efforts and residuals over time, with one panel per actuator."""
    count = arm.num_joints
    figure, axes = plt.subplots(count, 1, figsize=(13, 1.9 * count), sharex=True, layout="constrained")
    for i, (actuator, ax) in enumerate(zip(validation.actuators, axes, strict=True)):
        measured, predicted = validation.measured[:, i], validation.predicted[:, i]
        ax.plot(validation.t, measured - predicted, color=ZERO_COLOUR, linewidth=0.8, label="measured - predicted")
        ax.plot(validation.t, measured, color=MEASURED_COLOUR, linewidth=1.0, label="measured")
        ax.plot(validation.t, predicted, color=MODEL_COLOUR, linewidth=1.0, label="predicted")
        relative = (
            "" if actuator.relative_error is None else f", relative RMS error {100 * actuator.relative_error:.1f} %"
        )
        ax.set_title(f"actuator {i + 1} {actuator.name}{relative}", fontsize=9)
        ax.set_ylabel(f"effort [{'N' if arm.prismatic[i] else 'N m'}]", fontsize=8)
        ax.tick_params(labelsize=7)
    axes[-1].set_xlabel("time [s]", fontsize=8)
    axes[0].legend(fontsize=7, loc="upper right", ncols=3)
    figure.suptitle(f"{title}: efforts of the actuators, after low-pass filtering at {validation.cut_off:g} Hz")
    save_figure(figure, path)


def _plot_residuals(path: Path, arm: Arm, validation: DynamicValidation, title: str) -> None:
    """Plots residuals over position, velocity and time, with one column per actuator."""
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
    figure.suptitle(f"{title}: residuals (measured - predicted effort) of the actuators")
    save_figure(figure, path)


def _plot_budget(path: Path, validation: DynamicValidation, title: str) -> None:
    """Plots the relative error of each actuator, divided into shares of the squared error."""
    kinds = ("bias", "friction_like", "position_dependent", "other")
    colours = ("#edae49", MEASURED_COLOUR, MODEL_COLOUR, ZERO_COLOUR)
    figure, ax = plt.subplots(figsize=(11, 5), layout="constrained")
    heights = np.array([100 * (a.relative_error or 0.0) for a in validation.actuators])
    bottom = np.zeros(len(heights))
    for kind, colour in zip(kinds, colours, strict=True):
        part = heights * np.array([getattr(a, kind) for a in validation.actuators])
        ax.bar(range(len(heights)), part, 0.6, bottom=bottom, color=colour, label=kind.replace("_", "-"))
        bottom += part
    for i, actuator in enumerate(validation.actuators):
        if actuator.repeatability is not None:
            floor = 100 * actuator.repeatability
            ax.plot(
                [i - 0.35, i + 0.35], [floor, floor], color="black", linewidth=1.2, label="_" if i else "repeatability"
            )
    ax.set_xticks(range(len(heights)), [a.name.replace("_", "\n") for a in validation.actuators], fontsize=8)
    ax.set_ylabel("relative RMS error [%]")
    ax.set_title(f"{title}: relative RMS error of the actuators, divided by shares of the squared error")
    ax.legend(fontsize=8)
    save_figure(figure, path)


def _labels(names: tuple[str, ...]) -> list[str]:
    return [f"J{i + 1}\n{name.replace('_', chr(10))}" for i, name in enumerate(names)]
