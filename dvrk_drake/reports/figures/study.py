"""Plots the results of a study."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from dvrk_drake.experiments.study.measures import Measure
from dvrk_drake.experiments.study.study_file import Study
from dvrk_drake.experiments.study.table import Row, Share, Summary, summarise, values_of
from dvrk_drake.reports.figures.colours import SERIES
from dvrk_drake.reports.figures.style import add_legend, panel_grid, save_figure, set_title

_TITLE_LENGTH = 46  # characters of a panel title in one line


def plot_study(path: Path, study: Study, rows: Mapping[int, Row]) -> None:
    """Plots yes-or-no measures as shares with confidence intervals, and all others as cumulative distributions."""
    summaries, count = summarise(study, rows), len(study.measures)
    figure, panels = panel_grid(count, columns=min(count, 3), height=3.4)
    for ax, measure in zip(panels, study.measures, strict=True):
        if measure.is_boolean:
            _draw_shares(ax, measure, summaries)
        else:
            _draw_distribution(ax, measure, study, rows)
        title = measure.title[0].upper() + measure.title[1:]
        ax.set_title(textwrap.fill(title, _TITLE_LENGTH))
    set_title(
        figure,
        f"{study.arm.name}, {Path(study.scenario).name}: results of {len(rows)} runs. Cumulative shares are better if "
        "they rise further left",
    )
    add_legend(figure)
    save_figure(figure, path)


def _draw_shares(ax: Axes, measure: Measure, summaries: list[Summary]) -> None:
    for i, summary in enumerate(summaries):
        share = summary.measures[measure.column]
        assert isinstance(share, Share)
        x, low, high = (100 * value for value in (share.count / share.runs, share.lower, share.upper))
        error = [[max(0.0, x - low)], [max(0.0, high - x)]]
        colour, marker = SERIES[i % len(SERIES)], "os^Dv"[i % 5]
        ax.errorbar(x, i, xerr=error, fmt=marker, capsize=5, color=colour)
    ax.set_yticks(range(len(summaries)), [textwrap.fill(summary.variation, 16) for summary in summaries])
    ax.set(ylim=(len(summaries) - 0.4, -0.6), xlim=(-3, 103), xlabel="share of runs [%], 95 % interval")


def _draw_distribution(ax: Axes, measure: Measure, study: Study, rows: Mapping[int, Row]) -> None:
    smallest = np.inf
    for i, variation in enumerate(study.variations):
        variation_rows = [rows[c.index] for c in study.cases if c.variation == variation.name and c.index in rows]
        values = np.sort(values_of(measure, variation_rows))
        share = 100 * np.arange(1, len(values) + 1) / max(len(values), 1)
        finite = np.isfinite(values)
        smallest = min(smallest, values.min(initial=np.inf))
        style: dict[str, Any] = {"color": SERIES[i % len(SERIES)], "linestyle": ("-", "--", "-.", ":")[i % 4]}
        # Infinite values are not drawn, so the line ends below 100 %.
        ax.step(values[finite], share[finite], where="post", marker=".", markersize=4, label=variation.name, **style)
    if (unit := measure.unit(study.arm)) and smallest > 0:
        ax.set_xscale("log")
    quantity = measure.kind.replace("_", " ")
    ax.set(
        ylim=(-3, 103),
        ylabel="cumulative share of runs [%]",
        xlabel=f"{quantity} [{unit}]" if unit else "effort / effort limit [1]",
    )
