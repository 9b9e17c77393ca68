"""HTML report of tuned gains: comparison, step responses and efforts."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import plotly.graph_objects as go

from dvrk_drake.experiments.tuning.bench import band
from dvrk_drake.experiments.tuning.tuning import Comparison, Tuning
from dvrk_drake.reports.figures.colours import LIMIT, REFERENCE
from dvrk_drake.reports.html.page import Block, Page, Plot, Section, Table
from dvrk_drake.reports.html.plot_style import joint_panels, series_colour
from dvrk_drake.reports.html.provenance import Provenance
from dvrk_drake.reports.html.terminal import printed_by
from dvrk_drake.reports.tuning import print_tuning


def tuning_page(tuning: Tuning, provenance: Provenance, gains_path: str | None = None) -> Page:
    """Returns the report of a tuning.

    Args:
        tuning: Result of `tune_arm`.
        provenance: Origin of the report.
        gains_path: Path of the written gains, for the suggested next command. None if they were not written.
    """
    printed = printed_by(print_tuning, tuning, gains_path=gains_path, verbose=True)
    first, *others = printed.blocks
    details = [replace(block, collapsed=True) if isinstance(block, Table) else block for block in others]
    plots: list[Block] = []
    if tuning.comparison.responses:
        plots = [_step_plot(tuning.comparison), _effort_plot(tuning.comparison)]
    return Page(
        f"Controller gains of {tuning.arm.name}, simulated",
        printed.answer,
        [
            Section("Comparison of the gains", [first]),
            *([Section("Step responses", plots)] if plots else []),
            Section("Tuning methods, joints and poses", details),
        ],
        provenance,
        printed.level,
        closing=printed.next_section,
    )


def _step_plot(comparison: Comparison) -> Plot:
    """Returns the displacements of all joints, with the goal and the settling band."""
    arm = comparison.arm
    figure = joint_panels(arm.joint_names, x_title="t [s]")
    for j in range(arm.num_joints):
        row, column = 1 + j // 2, 1 + j % 2
        goal = 0.0
        for i, (name, response) in enumerate(comparison.responses.items()):
            displacement = 1e3 * (response.q[:, j] - response.q[0, j])
            step = response.q_desired[j] - response.q[0, j]
            goal = 1e3 * abs(step)
            line = {"color": series_colour(i), "width": 1.6}
            figure.add_scatter(
                x=response.t,
                y=np.sign(step) * displacement,
                name=name,
                legendgroup=name,
                showlegend=j == 0,
                line=line,
                row=row,
                col=column,
            )
        half = 1e3 * band(arm)[j]
        figure.add_hrect(goal - half, goal + half, fillcolor=REFERENCE, opacity=0.25, line_width=0, row=row, col=column)
        # Limits the axis, so that an unstable response does not flatten the other curves.
        unit = "mm" if arm.prismatic[j] else "mrad"
        figure.update_yaxes(title=f"displacement [{unit}]", range=[-0.1 * goal, 1.6 * goal], row=row, col=column)
    return Plot(figure, "Simultaneous step of all joints from the first pose, with all effects; settling band shaded")


def _effort_plot(comparison: Comparison) -> Plot:
    """Returns the commanded efforts of all joints during the step, as shares of their limits."""
    arm = comparison.arm
    figure = joint_panels(arm.joint_names, x_title="t [s]")
    for j in range(arm.num_joints):
        row, column = 1 + j // 2, 1 + j % 2
        for i, (name, response) in enumerate(comparison.responses.items()):
            figure.add_trace(
                go.Scatter(
                    x=response.t,
                    y=100 * response.effort[:, j] / arm.effort_limits[j],
                    name=name,
                    legendgroup=name,
                    showlegend=j == 0,
                    line={"color": series_colour(i), "width": 1.2},
                ),
                row=row,
                col=column,
            )
        for limit in (-100, 100):
            figure.add_hline(limit, line={"color": LIMIT, "dash": "dash", "width": 1}, row=row, col=column)
        figure.update_yaxes(title="effort / limit [%]", row=row, col=column)
    return Plot(figure, "Commanded efforts during the step, as shares of the effort limits (dashed)")
