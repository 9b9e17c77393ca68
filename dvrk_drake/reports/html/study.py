"""HTML report of a study: shares with intervals, and distributions of the measures."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import plotly.graph_objects as go

from dvrk_drake.experiments.study.measures import Measure
from dvrk_drake.experiments.study.study_file import Case, Study
from dvrk_drake.experiments.study.table import Row, Share, Summary, summarise, values_of
from dvrk_drake.reports.html.page import Page, Plot, Section, Table
from dvrk_drake.reports.html.plot_style import series_colour
from dvrk_drake.reports.html.provenance import Provenance
from dvrk_drake.reports.html.terminal import printed_by
from dvrk_drake.reports.study import print_study


def study_page(study: Study, rows: Mapping[int, Row], provenance: Provenance, study_path: str = "STUDY.yaml") -> Page:
    """Returns the report of a study.

    Args:
        study: Study.
        rows: Mapping from the number of a case to its results.
        provenance: Origin of the report.
        study_path: Path of the study, for the suggested next command.
    """
    printed = printed_by(print_study, study, rows, study_path=study_path, verbose=True)
    summaries = summarise(study, rows)
    boolean = [m for m in study.measures if m.is_boolean]
    plots = [_share_plot(m, summaries) for m in boolean]
    plots += [_distribution_plot(m, study, rows) for m in study.measures if not m.is_boolean]
    failed = [(c.index, c.variation, c.pose, c.seed, rows[c.index].error) for c in study.cases if _failed(c, rows)]
    table = Table(("case", "variation", "pose", "seed", "error"), failed)
    failed_runs = [Section(f"Failed runs ({len(failed)})", [table])] if failed else []
    return Page(
        f"Study of {study.arm.name}, scenario {study.scenario}",
        printed.answer,
        [
            Section("Results", [block for block in printed.blocks if getattr(block, "level", "") != "warning"]),
            Section("Distributions", plots),
            *failed_runs,
        ],
        provenance,
        printed.level,
        closing=printed.next_section,
    )


def _failed(case: Case, rows: Mapping[int, Row]) -> bool:
    return case.index in rows and bool(rows[case.index].error)


def _share_plot(measure: Measure, summaries: list[Summary]) -> Plot:
    figure = go.Figure()
    for i, summary in enumerate(summaries):
        share = summary.measures[measure.column]
        assert isinstance(share, Share)
        value, low, high = (100 * x for x in (share.count / share.runs, share.lower, share.upper))
        figure.add_scatter(
            x=[value],
            y=[summary.variation],
            error_x={
                "array": [max(0.0, high - value)],
                "arrayminus": [max(0.0, value - low)],
                "thickness": 2,
                "width": 6,
            },
            mode="markers",
            marker={"size": 10, "color": series_colour(i)},
            name=summary.variation,
            hovertemplate=f"{share.count} of {share.runs} runs: %{{x:.1f}} % [{low:.1f}, {high:.1f}]<extra></extra>",
        )
    figure.update_layout(height=130 + 36 * len(summaries), showlegend=False, margin={"t": 16})
    figure.update_xaxes(title="share of runs [%]", range=[-3, 103])
    figure.update_yaxes(autorange="reversed", type="category")
    return Plot(figure, f"{measure.column}: share of the runs with 95 % Wilson interval", half=True)


def _distribution_plot(measure: Measure, study: Study, rows: Mapping[int, Row]) -> Plot:
    figure, smallest, infinite = go.Figure(), np.inf, 0
    for i, variation in enumerate(study.variations):
        cases = [c for c in study.cases if c.variation == variation.name and c.index in rows]
        values = values_of(measure, [rows[c.index] for c in cases])
        order = np.argsort(values)
        share = 100 * np.arange(1, len(values) + 1) / max(len(values), 1)
        finite = np.isfinite(values[order])
        infinite += int(np.count_nonzero(~finite))
        smallest = min(smallest, values.min(initial=np.inf))
        figure.add_scatter(
            x=values[order][finite],
            y=share[finite],
            customdata=[[cases[k].index, cases[k].pose] for k in order[finite]],
            mode="lines+markers",
            line={"shape": "hv", "color": series_colour(i)},
            marker={"size": 4},
            name=variation.name,
            hovertemplate="%{x:.4g}, %{y:.1f} % of the runs<br>case %{customdata[0]}, pose %{customdata[1]}",
        )
    unit = measure.unit(study.arm)
    is_log = bool(unit) and 0 < smallest < np.inf
    figure.update_xaxes(
        title=f"{measure.column} {f'[{unit}]' if unit else 'as a share of the limit'}",
        type="log" if is_log else "linear",
    )
    figure.update_yaxes(title="cumulative share of runs [%]", range=[-3, 103])
    text = f"{measure.column}: cumulative distribution over the runs"
    if infinite:
        text += f"; {infinite} of {len(rows)} are infinite"
    return Plot(figure, text, half=True)
