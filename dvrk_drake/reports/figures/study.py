"""Plots the results of a study."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from dvrk_drake.experiments.study.measures import Measure
from dvrk_drake.experiments.study.study_file import Study
from dvrk_drake.experiments.study.table import Row, Share, Summary, summarise, values_of
from dvrk_drake.reports.figures.style import MEASURED_COLOUR, MODEL_COLOUR, save_figure

COLOURS = (MODEL_COLOUR, MEASURED_COLOUR, "#edae49", "#66a182", "#2e4057", "#8d5a97")


def plot_study(path: Path, study: Study, rows: Mapping[int, Row]) -> None:
    """Plots yes-or-no measures as shares with confidence intervals, and all others as cumulative distributions."""
    summaries, count = summarise(study, rows), len(study.measures)
    columns = math.ceil(math.sqrt(count))
    figure, axes = plt.subplots(
        math.ceil(count / columns),
        columns,
        figsize=(4.4 * columns, 3.4 * math.ceil(count / columns)),
        layout="constrained",
        squeeze=False,
    )
    for ax, measure in zip(axes.flat, study.measures, strict=False):
        if measure.is_boolean:
            _draw_shares(ax, measure, summaries)
        else:
            _draw_distribution(ax, measure, study, rows)
    for ax in axes.flat[count:]:
        ax.axis("off")
    figure.suptitle(f"{study.arm.name}, {Path(study.scenario).name}: results of {len(rows)} runs")
    save_figure(figure, path)


def _draw_shares(ax: plt.Axes, measure: Measure, summaries: list[Summary]) -> None:
    for i, summary in enumerate(summaries):
        share = summary.measures[measure.column]
        assert isinstance(share, Share)
        y, low, high = (100 * value for value in (share.count / share.runs, share.lower, share.upper))
        error = [[max(0.0, y - low)], [max(0.0, high - y)]]
        ax.errorbar(i, y, error, fmt="o", capsize=6, color=COLOURS[i % len(COLOURS)])
    ax.set_xticks(range(len(summaries)), [summary.variation for summary in summaries], fontsize=8)
    ax.set(xlim=(-0.6, len(summaries) - 0.4), ylim=(-3, 103), ylabel="share of runs [%]")
    ax.set_title(f"{measure.column}, 95 % intervals", fontsize=10)
    ax.grid(alpha=0.3)


def _draw_distribution(ax: plt.Axes, measure: Measure, study: Study, rows: Mapping[int, Row]) -> None:
    smallest = np.inf
    for i, variation in enumerate(study.variations):
        variation_rows = [rows[c.index] for c in study.cases if c.variation == variation.name and c.index in rows]
        values = np.sort(values_of(measure, variation_rows))
        share = 100 * np.arange(1, len(values) + 1) / max(len(values), 1)
        finite = np.isfinite(values)
        colour = COLOURS[i % len(COLOURS)]
        smallest = min(smallest, values.min(initial=np.inf))
        # Infinite values are not drawn, so the line ends below 100 %.
        ax.step(
            values[finite], share[finite], where="post", marker=".", markersize=3, color=colour, label=variation.name
        )
    if measure.unit and smallest > 0:
        ax.set_xscale("log")
    ax.set(
        ylim=(-3, 103),
        ylabel="cumulative share of runs [%]",
        xlabel=f"[{measure.unit}]" if measure.unit else "share of limit",
    )
    ax.set_title(measure.column, fontsize=10)
    ax.grid(alpha=0.3)
    ax.legend(fontsize=7)
