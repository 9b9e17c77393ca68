"""Plots the positions, position errors and efforts of a simulation over time."""

from __future__ import annotations

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes

from dvrk_drake.experiments.scenario import Scenario
from dvrk_drake.experiments.simulation import Simulation
from dvrk_drake.reports.figures.colours import COMMANDED, LIMIT, MEASURED, NEUTRAL, REFERENCE
from dvrk_drake.reports.figures.style import (
    WIDTH,
    add_legend,
    effort_unit,
    joint_title,
    position_unit,
    save_figure,
    set_title,
)

#: Smallest range of a position axis and of an error axis [rad]; a tenth of it in m. Smaller ranges would magnify the
#: noise of a joint at rest.
_SMALLEST_RANGE, _SMALLEST_ERROR_RANGE = 0.02, 0.004
#: Efforts above this share of the effort limit are drawn together with the limit.
_NEAR_LIMIT = 0.5


def plot_simulation(path: Path, simulation: Simulation, scenario: Scenario) -> None:
    """Writes a PNG with one row per joint: position, position error if there are desired positions, and effort.

    Times at which the hand acts on the arm are shaded.
    """
    arm, t = scenario.mounted_arm, simulation.time
    q, tau, desired = simulation.recording.q, simulation.recording.measured_effort(), simulation.desired
    columns, size = 2 if desired is None else 3, (WIDTH, 1.75 * arm.num_joints + 1)
    figure, rows = plt.subplots(arm.num_joints, columns, figsize=size, sharex=True, layout="constrained", squeeze=False)
    for j, panels in enumerate(rows):
        position, effort = panels[0], panels[-1]
        unit = position_unit(arm, j)
        scale = 0.1 if arm.prismatic[j] else 1.0
        position.plot(t, q[:, j], color=MEASURED, label="measured position and effort")
        if desired is not None:
            error = panels[1]
            position.plot(t, desired[:, j], "--", color=COMMANDED, label="desired position")
            error.plot(t, 1e3 * (q[:, j] - desired[:, j]), color=MEASURED)
            error.axhline(0.0, color=NEUTRAL, linewidth=0.8)
            error.set_ylabel(f"error [m{unit}]")
            _widen(error, 1e3 * _SMALLEST_ERROR_RANGE * scale)
        position.set_ylabel(f"position [{unit}]")
        _widen(position, _SMALLEST_RANGE * scale)
        limit = float(arm.effort_limits[j])
        effort.plot(t, tau[:, j], color=MEASURED)
        effort.set_ylabel(f"effort [{effort_unit(arm, j)}]")
        _widen(effort, 0.02 * limit)
        largest = np.abs(tau[:, j]).max()
        if largest > _NEAR_LIMIT * limit:
            for sign in (-1, 1):
                effort.axhline(sign * limit, color=LIMIT, linestyle="--", label="effort limit")
        position.set_title(joint_title(arm, j), loc="left")
        effort.set_title(
            f"largest {100 * largest / limit:.0f} % of the limit {limit:.3g} {effort_unit(arm, j)}", loc="left"
        )
    acts = np.any(simulation.hand != 0, axis=1)
    if np.any(acts):
        for ax in rows.flat:
            span = ax.get_ylim()
            ax.fill_between(
                t, *span, where=acts, color=REFERENCE, alpha=0.15, linewidth=0, label="disturbance: the hand acts"
            )
            ax.set_ylim(span)
    for ax in rows[-1]:
        ax.set_xlabel("time [s]")
        ax.set_xlim(t[0], t[-1])
    figure.align_ylabels(rows)
    quantities = "position and effort" if desired is None else "position, position error and effort"
    set_title(figure, f"{arm.name}, simulated, controller mode {scenario.controller.mode}: {quantities} of each joint")
    add_legend(figure)
    save_figure(figure, path)


def _widen(ax: Axes, smallest: float) -> None:
    """Widens the range of the y axis to at least `smallest`, and has no offset in its labels."""
    low, high = ax.get_ylim()
    missing = max(smallest - (high - low), 0.0)
    ax.set_ylim(low - missing / 2, high + missing / 2)
    ax.ticklabel_format(axis="y", useOffset=False)
