"""Plots the results of an identification or a validation. Motions are plotted by `figures.motion`."""

from __future__ import annotations

from collections.abc import Mapping
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
from dvrk_drake.models.arm import Arm
from dvrk_drake.reports.colours import FITTED, HELD_OUT, LIMIT, MEASURED, NEUTRAL, REFERENCE
from dvrk_drake.reports.figures.motion import plot_motion
from dvrk_drake.reports.figures.style import (
    WIDTH,
    add_legend,
    effort_unit,
    joint_title,
    panel_grid,
    save_figure,
    set_title,
)

#: Colours and markers of the errors in `plot_torque_error`, by label. Other labels are drawn as held out.
_ERROR_STYLES = {
    "zero torque": (MEASURED, "o"),
    "leave-one-out": (FITTED, "s"),
    "least squares of the paper": (REFERENCE, "D"),
    "model of the SDF": (REFERENCE, "D"),
    "model, with excluded measurements": (LIMIT, "x"),
}
#: Number of random samples for a bootstrap interval.
_SAMPLES = 1000
#: Quantile of the values that determine the range of a panel, and the margin on both sides as a share of their range.
_QUANTILE, _MARGIN = 0.02, 0.25


def plot_identification(folder: Path, result: Identification) -> None:
    """Plots measured and predicted efforts. See `plot_motion` and `plot_static_identification` for the files."""
    if isinstance(result, DynamicIdentification):
        for k, motion in enumerate(result.motions):
            # Each recording after the first one has its own folder.
            own = folder if k == 0 else folder / str(k + 1)
            own.mkdir(exist_ok=True)
            plot_motion(own, validate_motion(result.model, motion.observations), held_out=motion.held_out)
    elif isinstance(result, StaticIdentification):
        plot_static_identification(folder, result)


def plot_validation(folder: Path, validation: Validation) -> None:
    """Plots the errors of a model. See `plot_motion` and `plot_static_validation` for the files."""
    if isinstance(validation, DynamicValidation):
        plot_motion(folder, validation)
    elif isinstance(validation, StaticValidation):
        plot_static_validation(folder, validation)


def plot_static_identification(folder: Path, result: StaticIdentification) -> None:
    """Writes torque_error.png and predicted.png of an identification."""
    recording, arm = result.recording, result.model.arm
    tau = recording.measured_effort()
    usable = usable_measurements(tau.shape, result.excluded)
    errors = {
        "zero torque": tau,
        "leave-one-out": result.leave_one_out_residuals,
        "10-fold cross-validation, effects selected again": result.cross_validation_residuals,
    }
    rms, intervals = _errors_and_intervals(errors, usable)
    name = Path(recording.source).name
    plot_torque_error(
        folder / "torque_error.png",
        arm,
        rms.pop("zero torque"),
        rms,
        f"{arm.name}: RMS torque error at poses that were not used to fit, {name}, without excluded measurements",
        intervals,
    )
    predictions = {
        "fitted (the pose was used to fit)": (FITTED, tau - result.residuals),
        "held out (10-fold cross-validation)": (HELD_OUT, tau - result.cross_validation_residuals),
    }
    title = f"{arm.name}: predicted and measured torque at {len(recording)} poses of {name}"
    plot_measured_against_predicted(folder / "predicted.png", arm, tau, predictions, result.excluded, title)


def plot_static_validation(folder: Path, validation: StaticValidation) -> None:
    """Writes torque_error.png and predicted.png of a validation."""
    model = validation.model
    arm = model.arm
    recording = validation.recording.in_joint_coordinates(arm)
    tau, predicted = recording.measured_effort(), model.holding_torque(recording.q)
    usable = usable_measurements(tau.shape, validation.excluded)
    is_held_out = not validation.of_same_recording
    role = "held out (the recording was not used to fit)" if is_held_out else "fitted (the recording was used to fit)"
    label = f"model, {role}"
    rms, intervals = _errors_and_intervals({"zero torque": tau, label: tau - predicted}, usable)
    if validation.excluded:
        every = _rms_of_squares((tau - predicted) ** 2)
        rms["model, with excluded measurements"] = np.where(np.all(usable, axis=0), np.nan, every)
    name = Path(recording.source).name
    plot_torque_error(
        folder / "torque_error.png",
        arm,
        rms.pop("zero torque"),
        rms,
        f"{arm.name}: RMS torque error at {validation.poses} poses of {name}, without excluded measurements",
        intervals,
    )
    plot_measured_against_predicted(
        folder / "predicted.png",
        arm,
        tau,
        {role: (HELD_OUT if is_held_out else FITTED, predicted)},
        validation.excluded,
        f"{arm.name}: predicted and measured torque at {validation.poses} poses of {name}",
    )


def _rms_of_squares(squares: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns the RMS (n,) of squared errors (m, n). nan marks missing values. A joint without values has nan."""
    count = np.sum(np.isfinite(squares), axis=0)
    return np.asarray(np.sqrt(np.where(count, np.nansum(squares, axis=0), np.nan) / np.maximum(count, 1)))


def _errors_and_intervals(
    errors: Mapping[str, NDArray[np.float64]], usable: NDArray[np.bool_]
) -> tuple[dict[str, NDArray[np.float64]], dict[str, NDArray[np.float64]]]:
    """Returns RMS errors (n,) and their 95 % intervals (2, n) by label, from errors (m, n).

    The intervals are percentiles of RMS errors of poses drawn with replacement (bootstrap).
    """
    rng = np.random.default_rng(0)
    rms, intervals = {}, {}
    for label, values in errors.items():
        squares = np.where(usable, values**2, np.nan)
        rms[label] = _rms_of_squares(squares)
        drawn = rng.integers(len(squares), size=(_SAMPLES, len(squares)))
        resampled = np.array([_rms_of_squares(squares[rows]) for rows in drawn])
        known = np.where(np.isfinite(resampled), resampled, rms[label])
        intervals[label] = np.quantile(known, [0.025, 0.975], axis=0)
    return rms, intervals


def plot_torque_error(
    path: Path,
    arm: Arm,
    rms_zero: NDArray[np.float64],
    rms_model: Mapping[str, NDArray[np.float64]],
    title: str,
    intervals: Mapping[str, NDArray[np.float64]] | None = None,
) -> None:
    """Plots the RMS torque error of each joint as dots with intervals, on a logarithmic scale.

    Args:
        path: PNG file to write.
        arm: Arm of the joints.
        rms_zero: RMS errors (n,) of zero torque [N m; N]. nan: no value.
        rms_model: RMS errors (n,) [N m; N] by label.
        title: Title of the figure.
        intervals: 95 % intervals (2, n) [N m; N] by label, "zero torque" for zero torque. Labels may be missing.
    """
    rms = {"zero torque": rms_zero, **rms_model}
    intervals = intervals or {}
    height = (0.16 + 0.22 * len(rms)) * arm.num_joints + 1.6
    figure, axes = plt.subplots(figsize=(WIDTH, height), layout="constrained")
    rows = np.arange(arm.num_joints)
    for j in rows[1::2]:
        axes.axhspan(j - 0.5, j + 0.5, color=NEUTRAL, alpha=0.2, linewidth=0)
    for i, (label, values) in enumerate(rms.items()):
        colour, marker = _ERROR_STYLES.get(label, (HELD_OUT, "o"))
        y = rows + 0.8 * ((i + 0.5) / len(rms) - 0.5)
        shown = np.where(values > 0, values, np.nan)
        lower, upper = intervals.get(label, np.array([values, values]))
        bars = np.abs(np.array([np.minimum(lower, values), np.maximum(upper, values)]) - values)
        axes.errorbar(
            shown,
            y,
            xerr=bars if label in intervals else None,
            fmt=marker,
            color=colour,
            capsize=3,
            markersize=6,
            label=label,
        )
        for value, bar, yi in zip(shown, bars[1], y, strict=True):
            if np.isfinite(value):
                axes.annotate(
                    f"{value:.2g}", (value + bar, yi), (8, 0), textcoords="offset points", va="center", fontsize=9
                )
    if any(np.any(values > 0) for values in rms.values()):
        axes.set_xscale("log")
    axes.set_yticks(rows, [joint_title(arm, j) for j in range(arm.num_joints)])
    axes.set_ylim(arm.num_joints - 0.5, -0.5)
    axes.margins(x=0.08)
    axes.grid(visible=False, axis="y")
    forces = "".join(f"; J{j + 1}: N" for j in np.flatnonzero(arm.prismatic))
    bars_label = ", with 95 % intervals (bootstrap over the poses)" if intervals else ""
    axes.set_xlabel(f"RMS torque error [N m{forces}]{bars_label}")
    set_title(figure, title)
    add_legend(figure)
    save_figure(figure, path)


def plot_measured_against_predicted(
    path: Path,
    arm: Arm,
    measured: NDArray[np.float64],
    predictions: Mapping[str, tuple[str, NDArray[np.float64]]],
    excluded: list[ExcludedMeasurement],
    title: str,
) -> None:
    """Plots predicted against measured torque, with one point per pose and one panel per joint.

    The range of a panel is that of the central values. Values outside the range are drawn in the hatched margin.

    Args:
        path: PNG file to write.
        arm: Arm of the joints.
        measured: Measured torques (m, n) of the joints [N m, N].
        predictions: Mapping from a label to a colour and predicted torques (m, n) of the joints [N m, N].
        excluded: Excluded measurements, drawn as crosses. They do not affect the range of the panels.
        title: Title of the figure.
    """
    usable = usable_measurements(measured.shape, excluded)
    shown_joints = np.flatnonzero(np.any(usable, axis=0)).tolist()
    figure, panels = panel_grid(max(len(shown_joints), 1), height=3.0)
    for j, ax in zip(shown_joints, panels, strict=False):
        use, left_out = usable[:, j], ~usable[:, j]
        everything = np.concatenate([measured[use, j], *(tau[use, j] for _, tau in predictions.values())])
        inner, outer = _ranges(np.append(everything, 0.0))
        ax.plot(outer, outer, color=MEASURED, linewidth=0.8, label="predicted = measured")
        for k, (label, (colour, predicted)) in enumerate(predictions.items()):
            x, y = _at_edge(measured[use, j], inner, outer), _at_edge(predicted[use, j], inner, outer)
            face = "none" if k else colour
            ax.plot(x, y, "os"[k % 2], color=colour, markersize=4.5, markerfacecolor=face, label=label)
        _, predicted = next(iter(predictions.values()))
        x, y = _at_edge(measured[left_out, j], inner, outer), _at_edge(predicted[left_out, j], inner, outer)
        if len(x):
            ax.plot(x, y, "x", color=LIMIT, markersize=5, label="excluded measurement")
        if everything.min() < inner[0] or everything.max() > inner[1] or np.any(left_out):
            _hatch_margin(ax, inner, outer)
        ax.set(xlim=outer, ylim=outer)
        ax.locator_params(nbins=5)
        ax.set_title(joint_title(arm, j))
        ax.set_xlabel(f"measured [{effort_unit(arm, j)}]")
        ax.set_ylabel(f"predicted [{effort_unit(arm, j)}]")
    missing = [joint_title(arm, j) for j in range(arm.num_joints) if j not in shown_joints]
    if missing:
        title += f"\nNo measurements: {', '.join(missing)}"
    set_title(figure, title)
    add_legend(figure)
    save_figure(figure, path)


def _ranges(values: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Returns the range (2,) of the drawn values, and the limits (2,) of the axis with the margin for outliers."""
    low, high = np.quantile(values, [_QUANTILE, 1 - _QUANTILE])
    pad = _MARGIN * max(float(high - low), 1e-6)
    inner = np.array([max(low - pad, values.min()), min(high + pad, values.max())])
    width = max(float(np.ptp(inner)), 1e-6)
    return inner + np.array([-0.03, 0.03]) * width, inner + np.array([-0.13, 0.13]) * width


def _at_edge(
    values: NDArray[np.float64], inner: NDArray[np.float64], outer: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Moves values outside the inner range into the middle of the margin."""
    low, high = (inner + outer) / 2
    return np.where(values < inner[0], low, np.where(values > inner[1], high, values))


def _hatch_margin(ax: plt.Axes, inner: NDArray[np.float64], outer: NDArray[np.float64]) -> None:
    label = "margin: values outside the range"
    for low, high in ((outer[0], inner[0]), (inner[1], outer[1])):
        for span in (ax.axvspan, ax.axhspan):
            span(low, high, facecolor="none", edgecolor=NEUTRAL, hatch="////", linewidth=0, zorder=0.5, label=label)
