"""Plots a gravity-compensation file of the dVRK and a model for comparison."""

from __future__ import annotations

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from numpy.typing import NDArray

from dvrk_drake.export.dvrk_mtm_gravity_compensation_comparison import CompensationComparison
from dvrk_drake.reports.figures.colours import FITTED, LIMIT, NEUTRAL, REFERENCE, SERIES
from dvrk_drake.reports.figures.style import WIDTH, add_legend, save_figure, set_title

#: Mapping from a problem to the colour of the curve that shows the share of poses with this problem.
PROBLEM_COLOURS = dict(zip(("torque limit active", "opposite sign", "runaway"), SERIES, strict=False))

_BINS = 60

#: Number of panels. The file has no torque for joint 7.
NUM_PANELS = 6


def plot_compensation(path: str | Path, comparison: CompensationComparison, title: str) -> None:
    """Plots the torques of file and model over the position of each joint, and the share of poses with each problem.

    Each band shows the range of the torque over the positions of all other joints. The torque of the file is drawn
    without clipping. Dashed lines show the torque limits of the file. The grey area shows the positions of the joint in
    the recording from which the file was computed. The attributes `clipped`, `opposed` and `runaway` of
    `JointComparison` define the problems.

    Args:
        path: PNG file to write.
        comparison: Comparison of the file with the model.
        title: Title of the figure.

    Raises:
        DvrkDrakeError: The file cannot be written.
    """
    figure = plt.figure(figsize=(WIDTH, 9.5), layout="constrained")
    grid = figure.add_gridspec(4, 3, height_ratios=[3, 1, 3, 1])
    for j in range(NUM_PANELS):
        row, column = 2 * (j // 3), j % 3
        torque_axes = figure.add_subplot(grid[row, column])
        share_axes = figure.add_subplot(grid[row + 1, column], sharex=torque_axes)
        _draw_torque(torque_axes, comparison, j)
        _draw_shares(share_axes, comparison, j)
    set_title(figure, title)
    add_legend(figure)
    save_figure(figure, Path(path))


def _draw_torque(axes: Axes, comparison: CompensationComparison, j: int) -> None:
    joint, file = comparison.joints[j], comparison.file
    edges, centres, members = position_bins(comparison, j)
    if file.sweep is not None:
        span = np.clip(file.sweep[:, j], edges[0], edges[-1])
        axes.axvspan(*span, color=NEUTRAL, alpha=0.35, linewidth=0, label="positions in the recording of the file")
    for torque, colour, label in (
        (comparison.file_torque, REFERENCE, "file, without torque limits"),
        (comparison.model_torque, FITTED, "model"),
    ):
        low, middle, high = (np.array([f(torque[m, j]) for m in members]) for f in (np.min, np.mean, np.max))
        axes.fill_between(centres, low, high, color=colour, alpha=0.3, label=f"{label} (range)")
        axes.plot(centres, middle, color=colour, linewidth=1.2)
    for limit in (joint.clip_lower, joint.clip_upper):
        axes.axhline(limit, color=LIMIT, linestyle="--", linewidth=1.2, label="torque limits of the file")
    axes.set_title(f"J{j + 1} {joint.name}")
    axes.set_ylabel("torque [N m]")
    axes.tick_params(labelbottom=False)
    axes.set_xlim(edges[0], edges[-1])


def _draw_shares(axes: Axes, comparison: CompensationComparison, j: int) -> None:
    _, centres, members = position_bins(comparison, j)
    flags = (comparison.clipped, comparison.opposed, comparison.runaway)
    for k, ((label, colour), flag) in enumerate(zip(PROBLEM_COLOURS.items(), flags, strict=True)):
        axes.plot(
            centres,
            [100 * flag[m, j].mean() for m in members],
            color=colour,
            label=f"{label} (share of poses)",
            linestyle=("-", "--", ":")[k],
        )
    axes.set_ylim(-3, 103)
    axes.set_ylabel("poses [%]")
    axes.set_xlabel(f"q{j + 1} [rad]")


def position_bins(
    comparison: CompensationComparison, j: int
) -> tuple[NDArray[np.float64], NDArray[np.float64], list[NDArray[np.int_]]]:
    """Returns the edges of all bins of q_j, the centres of the bins that contain poses, and the poses in each bin."""
    q = comparison.q[:, j]
    edges = np.linspace(q.min(), q.max(), _BINS + 1)
    index = np.clip(np.digitize(q, edges) - 1, 0, _BINS - 1)
    members = [np.flatnonzero(index == i) for i in range(_BINS)]
    used = [i for i, m in enumerate(members) if len(m)]
    return edges, (edges[:-1] + edges[1:])[used] / 2, [members[i] for i in used]
