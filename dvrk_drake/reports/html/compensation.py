"""HTML report of the comparison of a gravity-compensation file of the dVRK with a model."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import plotly.graph_objects as go

from dvrk_drake.export.dvrk_mtm_gravity_compensation_comparison import CompensationComparison
from dvrk_drake.reports.export import print_comparison
from dvrk_drake.reports.figures.colours import FITTED, LIMIT, NEUTRAL, REFERENCE
from dvrk_drake.reports.figures.export import NUM_PANELS, PROBLEM_COLOURS, position_bins
from dvrk_drake.reports.html.page import Page, Plot, Section, Text
from dvrk_drake.reports.html.plot_style import joint_panels, transparent
from dvrk_drake.reports.html.provenance import Provenance
from dvrk_drake.reports.html.terminal import printed_by


def compensation_page(
    comparison: CompensationComparison, provenance: Provenance, file_name: str = "", model_name: str = ""
) -> Page:
    """Returns the report of a comparison.

    Args:
        comparison: Comparison of the file with the model.
        provenance: Origin of the report.
        file_name: Path of the file. "": name of the arm in the file.
        model_name: Path of the model, or name of the arm of a nominal model. "": source of the arm of the model.
    """
    file_name = file_name or f"file of {comparison.file.arm_name}"
    model_name = model_name or comparison.model.arm.source
    printed = printed_by(print_comparison, file_name, model_name, comparison, verbose=True)
    warnings = [Text(f"{file_name}: {warning}.", "warning") for warning in comparison.warnings]
    return Page(
        f"{Path(file_name).name} compared with {model_name}",
        printed.answer,
        [
            Section("Differences per joint", [*warnings, *printed.blocks]),
            Section("Torque over position", [_torque_plot(comparison), _problem_plot(comparison)]),
        ],
        provenance,
        printed.level,
        closing=printed.next_section,
    )


def _torque_plot(comparison: CompensationComparison) -> Plot:
    names = [joint.name for joint in comparison.joints[:NUM_PANELS]]
    figure = joint_panels(names, x_titles=[f"q{j + 1} [rad]" for j in range(NUM_PANELS)])
    for j, joint in enumerate(comparison.joints[:NUM_PANELS]):
        place = {"row": 1 + j // 2, "col": 1 + j % 2}
        edges, centres, members = position_bins(comparison, j)
        if comparison.file.sweep is not None:
            low, high = np.clip(comparison.file.sweep[:, j], edges[0], edges[-1])
            figure.add_vrect(low, high, fillcolor=NEUTRAL, opacity=0.35, line_width=0, layer="below", **place)
        for torque, colour, label in (
            (comparison.file_torque, REFERENCE, "file, without torque limits"),
            (comparison.model_torque, FITTED, "model"),
        ):
            low, middle, high = (np.array([f(torque[m, j]) for m in members]) for f in (np.min, np.mean, np.max))
            shared = {"legendgroup": label, "hoverinfo": "skip"}
            figure.add_trace(go.Scatter(x=centres, y=low, line={"width": 0}, showlegend=False, **shared), **place)
            area = {"fill": "tonexty", "fillcolor": transparent(colour, 0.25), "line": {"width": 0}}
            figure.add_trace(go.Scatter(x=centres, y=high, showlegend=False, **area, **shared), **place)
            figure.add_trace(
                go.Scatter(
                    x=centres, y=middle, name=label, legendgroup=label, showlegend=j == 0, line={"color": colour}
                ),
                **place,
            )
        for limit in (joint.clip_lower, joint.clip_upper):
            figure.add_hline(limit, line={"color": LIMIT, "dash": "dash", "width": 1}, **place)
        figure.update_yaxes(title="torque [N m]", **place)
    sweep = "; grey: positions in the recording of the file" if comparison.file.sweep is not None else ""
    return Plot(
        figure,
        "Static torque: mean (line) and range (band) over the positions of the other joints; dashed: torque limits of "
        f"the file{sweep}",
    )


def _problem_plot(comparison: CompensationComparison) -> Plot:
    names = [joint.name for joint in comparison.joints[:NUM_PANELS]]
    figure = joint_panels(names, x_titles=[f"q{j + 1} [rad]" for j in range(NUM_PANELS)])
    flags = (comparison.clipped, comparison.opposed, comparison.runaway)
    for j in range(NUM_PANELS):
        _, centres, members = position_bins(comparison, j)
        for (label, colour), flag in zip(PROBLEM_COLOURS.items(), flags, strict=True):
            figure.add_scatter(
                x=centres,
                y=[100 * flag[m, j].mean() for m in members],
                name=label,
                legendgroup=label,
                showlegend=j == 0,
                line={"color": colour},
                row=1 + j // 2,
                col=1 + j % 2,
            )
    figure.update_yaxes(title="poses [%]", range=[-3, 103])
    return Plot(figure, "Share of the poses with each problem over the position of the joint")
