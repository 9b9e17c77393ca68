"""HTML report of the interaction force at the handle."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import plotly.graph_objects as go
from plotly.subplots import make_subplots

from dvrk_drake.experiments.transparency import GRASP_TIME, OperatorForces
from dvrk_drake.models.arm import Arm
from dvrk_drake.reports.html.page import Page, Plot, Section
from dvrk_drake.reports.html.plot_style import series_colour
from dvrk_drake.reports.html.provenance import Provenance
from dvrk_drake.reports.html.terminal import printed_by
from dvrk_drake.reports.transparency import print_transparency


def transparency_page(arm: Arm, forces: Sequence[OperatorForces], provenance: Provenance) -> Page:
    """Returns the report of simulated interaction forces.

    Args:
        arm: Simulated arm.
        forces: One result per compensation. The first is without compensation.
        provenance: Origin of the report.
    """
    printed = printed_by(print_transparency, arm, forces, verbose=True)
    return Page(
        f"Transparency of {arm.name}, simulated",
        printed.answer,
        [
            Section("Interaction force and torque", [*printed.blocks, summary_plot(forces)]),
            Section("Over time", [time_plot(forces)]),
        ],
        provenance,
        printed.level,
        closing=printed.next_section,
    )


def summary_plot(forces: Sequence[OperatorForces]) -> Plot:
    """Returns RMS (dot) and 95th percentile (end of the line) of force and torque for each compensation."""
    titles = ("force [N]", "torque [N m]")
    figure = make_subplots(rows=1, cols=2, shared_yaxes=True, horizontal_spacing=0.06)
    for i, one in enumerate(forces):
        pairs = zip((one.rms_force, one.rms_torque), one.peak(), titles, strict=True)
        for column, (rms, peak, title) in enumerate(pairs, 1):
            figure.add_scatter(
                x=[rms],
                y=[_name(one, forces)],
                error_x={"array": [peak - rms], "arrayminus": [0.0], "thickness": 2, "width": 6},
                mode="markers",
                marker={"size": 10, "color": series_colour(i)},
                showlegend=False,
                hovertemplate=f"RMS %{{x:.3g}}, 95 %: {peak:.3g}<extra></extra>",
                row=1,
                col=column,
            )
            figure.update_xaxes(title=title, rangemode="tozero", row=1, col=column)
    figure.update_yaxes(autorange="reversed", type="category")
    figure.update_layout(height=120 + 36 * len(forces), margin={"t": 16})
    return Plot(figure, "RMS over time (dot) and 95th percentile (end of the line) at the handle")


def time_plot(forces: Sequence[OperatorForces]) -> Plot:
    """Returns the magnitudes of force and torque over time, after the initial transient of the grasp."""
    figure = make_subplots(rows=2, cols=1, shared_xaxes=True, vertical_spacing=0.06)
    for i, one in enumerate(forces):
        late = one.time >= GRASP_TIME
        for row, vectors in enumerate((one.force, one.torque), 1):
            figure.add_trace(
                go.Scatter(
                    x=one.time[late],
                    y=np.linalg.norm(vectors[late], axis=1),
                    name=_name(one, forces),
                    legendgroup=one.name,
                    showlegend=row == 1,
                    line={"color": series_colour(i), "width": 1.5},
                ),
                row=row,
                col=1,
            )
    figure.update_yaxes(title="force [N]", rangemode="tozero", row=1)
    figure.update_yaxes(title="torque [N m]", rangemode="tozero", row=2)
    figure.update_xaxes(title="t [s]", row=2)
    figure.update_layout(height=560)
    return Plot(figure, f"Magnitude of interaction force and torque at the handle, from {GRASP_TIME:g} s on")


def _name(one: OperatorForces, forces: Sequence[OperatorForces]) -> str:
    return "no compensation" if one is forces[0] else one.name
