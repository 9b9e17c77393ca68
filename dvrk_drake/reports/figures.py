"""Figures of identifications, motions and the demo."""

from __future__ import annotations

from pathlib import Path

import matplotlib
import matplotlib.pyplot as plt
import numpy as np
from numpy.typing import NDArray

from dvrk_drake.analysis.static.doubts import Doubt, usable_measurements
from dvrk_drake.analysis.static.static_identification import StaticIdentification
from dvrk_drake.analysis.static.validation import StaticValidation
from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.experiments.demo.demo import (
    HELD_UNTIL,
    NO_DRY_FRICTION,
    PLANS,
    RELEASED_UNTIL,
    DemoResult,
)
from dvrk_drake.experiments.scenario import Scenario
from dvrk_drake.experiments.simulation import Simulation
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.files import atomic_write
from dvrk_drake.recordings.recording import Recording

matplotlib.use("Agg")


MODEL_COLOUR, ZERO_COLOUR, MEASURED_COLOUR = "#1f6f8b", "#c9c9c9", "#d1495b"


def _labels(names: tuple[str, ...]) -> list[str]:
    return [f"J{i + 1}\n{name.replace('_', chr(10))}" for i, name in enumerate(names)]


def plot_torque_error(
    path: Path,
    arm: Arm,
    rms_zero: NDArray[np.float64],
    rms_model: dict[str, NDArray[np.float64]],
    title: str,
) -> None:
    """RMS torque error per joint (n,) [N m, N], zero torque beside each model; log scale: joints differ by decades."""
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
    doubts: list[Doubt],
) -> None:
    """One panel a joint: predicted over measured torque of every pose.

    Args:
        path: PNG to write.
        model: what predicts.
        recording: in joint coordinates.
        measured_joints: (m, n); what is no holding torque is not drawn.
        doubts: what is doubted is drawn as a cross, and does not stretch the axes.
    """
    usable = usable_measurements(recording.q.shape, doubts) & measured_joints
    arm = model.arm
    names = arm.joint_names
    measured, predicted = recording.measured_effort(), model.holding_torque(recording.q)
    figure, axes = plt.subplots(2, -(-len(names) // 2), figsize=(13, 6.5), layout="constrained")
    for j, (name, ax) in enumerate(zip(names, axes.flat, strict=False)):
        use, doubted = usable[:, j], measured_joints[:, j] & ~usable[:, j]
        if not np.any(use):
            ax.set_title(f"J{j + 1} {name}: nothing measured", fontsize=10)
            ax.set(xticks=[], yticks=[])
            continue
        shown = np.concatenate([measured[use, j], predicted[use, j], [0.0]])
        pad = 0.05 * max(float(np.ptp(shown)), 1e-6)
        limits = np.array([shown.min() - pad, shown.max() + pad])
        ax.plot(limits, limits, color="black", linewidth=0.8, label="measured = predicted")
        ax.plot(measured[use, j], predicted[use, j], ".", color=MODEL_COLOUR, label="one pose")
        ax.plot(
            np.clip(measured[doubted, j], *limits),
            np.clip(predicted[doubted, j], *limits),
            "x",
            color=MEASURED_COLOUR,
            label="doubted (at the edge: outside)",
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
    figure.suptitle(f"{model.arm.name}: holding torque, {len(recording)} rows of {Path(recording.source).name}")
    save_figure(figure, path)


def plot_static_identification(folder: Path, result: StaticIdentification) -> None:
    """Writes torque_error.png and predicted.png of an identification."""
    recording = result.recording
    joints = result.model.joints
    plot_torque_error(
        folder / "torque_error.png",
        result.model.arm,
        np.array([j.rms_zero_torque_undoubted for j in joints]),
        {
            "leave-one-out": np.array([j.rms_leave_one_out_undoubted for j in joints]),
            "ten-fold, effects chosen anew": np.array([j.rms_cross_validation_undoubted for j in joints]),
        },
        f"{result.model.arm.name}: poses not used for fitting ({Path(recording.source).name}, without doubted ones)",
    )
    plot_measured_against_predicted(folder / "predicted.png", result.model, recording, result.measured, result.doubts)


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
        f"{model.arm.name}: all {validation.poses} poses of {Path(recording.source).name}",
    )
    plot_measured_against_predicted(folder / "predicted.png", model, recording, validation.measured, validation.doubts)


def plot_positions(
    path: Path, arm: Arm, t: NDArray[np.float64], curves: dict[str, NDArray[np.float64]], title: str
) -> None:
    """One panel a joint of positions over time: `curves` label -> (samples, n) [rad, m]; dashed from the second on."""
    names = arm.joint_names
    figure, axes = plt.subplots(2, -(-len(names) // 2), figsize=(13, 6.5), layout="constrained")
    colours = [MODEL_COLOUR, MEASURED_COLOUR, "#edae49"]
    for j, (name, ax) in enumerate(zip(names, axes.flat, strict=False)):
        for i, (label, q) in enumerate(curves.items()):
            ax.plot(t, q[:, j], "-" if i == 0 else "--", color=colours[i % 3], linewidth=1.2, label=label)
        low, high = ax.get_ylim()
        if high - low < 2e-3:  # A joint that stands still should look still.
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


def plot_simulation(path: Path, simulation: Simulation, scenario: Scenario) -> None:
    """Writes a PNG of the simulated positions, beside the desired ones if there are any."""
    curves = {"simulated": simulation.recording.q}
    if simulation.desired is not None:
        curves["desired"] = simulation.desired
    arm = scenario.mounted_arm
    plot_positions(path, arm, simulation.time, curves, f"{arm.name}, simulated, mode {scenario.controller.mode}")


def save_figure(figure: plt.Figure, path: Path) -> None:
    """Writes a PNG at once or not at all, and closes the figure."""
    with atomic_write(path, "wb") as stream:
        figure.savefig(stream, dpi=110, format="png")
    plt.close(figure)


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
            "the paper's least squares": np.array([j.rms_error for j in result.fresh_paper.joints]),
        },
        f"{arm.name} (simulated): {result.fresh.poses} fresh poses",
    )
    plot_positions(
        output / "release.png",
        arm,
        result.release_time,
        {"identified model": result.released, "model as drawn (SDF)": result.released_as_drawn},
        f"{arm.name} (simulated without dry friction): held until {HELD_UNTIL} s, released under gravity compensation "
        f"until {RELEASED_UNTIL} s, then driven home\n{NO_DRY_FRICTION}",
    )
    title = PLANS[arm.name.lower()].step_title
    plot_positions(output / "step.png", arm, result.step_time, {"identified model": result.step}, title)
