"""Plots the step responses of tuned gains."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from dvrk_drake.experiments.tuning.bench import band
from dvrk_drake.experiments.tuning.tuning import Comparison
from dvrk_drake.reports.figures.colours import COMMANDED, REFERENCE, SERIES
from dvrk_drake.reports.figures.style import (
    add_legend,
    effort_unit,
    joint_title,
    panel_grid,
    position_unit,
    save_figure,
    set_title,
)


def plot_steps(path: Path, comparison: Comparison) -> None:
    """Plots the step response from the first pose for all gains: displacement and effort, one column per joint.

    The first and the third row show displacements, the rows below them the commanded efforts.
    """
    arm = comparison.arm
    columns = -(-arm.num_joints // 2)
    figure, panels = panel_grid(4 * columns, columns=columns, height=2.1)
    rows = np.array(panels).reshape(4, columns)
    for ax in rows[2:, arm.num_joints - columns :].flat:
        ax.remove()
    for j in range(arm.num_joints):
        row, column = 2 * (j // columns), j % columns
        position, effort = rows[row, column], rows[row + 1, column]
        goal = 0.0
        for i, (name, response) in enumerate(comparison.responses.items()):
            displacement = 1e3 * (response.q[:, j] - response.q[0, j])
            goal = 1e3 * abs(response.q_desired[j] - response.q[0, j])
            sign = np.sign(response.q_desired[j] - response.q[0, j])
            style: dict[str, Any] = {"color": SERIES[i % len(SERIES)], "linestyle": ("-", "--", "-.", ":")[i % 4]}
            position.plot(response.t, sign * displacement, label=name, **style)
            effort.plot(response.t, response.effort[:, j], **style)
        half = 1e3 * band(arm)[j]
        position.axhline(goal, color=COMMANDED, linestyle=":", label="target")
        position.axhspan(goal - half, goal + half, color=REFERENCE, alpha=0.3, linewidth=0, label="settling band")
        # Limits the axis, so that an unstable response does not flatten the other curves.
        position.set_ylim(-0.1 * goal, 1.6 * goal)
        position.set_title(joint_title(arm, j))
        position.set_ylabel(f"displacement [m{position_unit(arm, j)}]")
        effort.set_ylabel(f"effort [{effort_unit(arm, j)}]")
        effort.set_xlabel("time [s]")
    set_title(
        figure,
        f"{arm.name}, simulated with all effects: simultaneous step of all joints. Good gains reach the settling band "
        "early and stay in it",
    )
    add_legend(figure)
    save_figure(figure, path)
