"""Page of a study: shares with intervals, and distributions of the measures."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.experiments.study import Study
from dvrk_drake.experiments.study_measures import Measure
from dvrk_drake.experiments.study_run import Row, wilson_interval
from dvrk_drake.models.arm import Arm
from dvrk_drake.reports.colours import SERIES
from dvrk_drake.reports.page import Block, Page, Plot, Section, Table, Text
from dvrk_drake.reports.plot import Curve, Panel

#: Maximum number of variations in the answer, and of failed runs that a terminal lists without --verbose.
_MAX_COUNT = 3


def study_page(study: Study, rows: Mapping[int, Row], *, study_path: str | None = None) -> Page:
    """Returns the page of a study.

    Args:
        study: Study.
        rows: Mapping from the number of a case to its results.
        study_path: Path of the study, for the suggested next command. None if the figures were already written.
    """
    failed = [(c.index, c.variation, c.pose, c.seed, rows[c.index].error) for c in study.cases if _error(c.index, rows)]
    first = study.measures[0]
    found = "; ".join(
        f"{variation}: {_headline(first, values, study.arm)}"
        for variation, values in list(_values(first, study, rows).items())[:_MAX_COUNT]
    )
    blocks: list[Block] = [_summary_table(study, rows)]
    if failed:
        blocks.append(Text("A run that failed counts as the worst result."))
    blocks.append(
        Text(
            "Yes-or-no measures: share of the runs, and the 95 % Wilson interval for independent runs. Other measures: "
            "median and 95th percentile of the runs.",
            show="details",
        )
    )
    if len(study.seeds) > 1:
        blocks.append(
            Text("The intervals are too narrow, because runs with different seeds at one pose are not independent.")
        )
    for k, (index, variation, pose, seed, error) in enumerate(failed):
        text = f"case {index}, {variation}, pose {pose}, seed {seed}: {error}"
        blocks.append(Text(text, "warning", show="details" if k >= _MAX_COUNT else "always", unwrapped=True))
    if len(failed) > _MAX_COUNT:
        blocks.append(Text(f"{len(failed)} runs failed. --verbose lists all.", "warning", show="brief"))
    panels = [_panel(measure, study, rows) for measure in study.measures if not measure.is_boolean]
    caption = f"Results of {len(rows)} runs. Cumulative shares are better if they rise further left"
    return Page(
        f"Study of {study.arm.name}, scenario {study.scenario}",
        f"{first.column} {found}. {len(rows)} of {len(study.cases)} runs, {len(failed)} failed.",
        [
            Section("Results", blocks),
            *([Section("Distributions", [Plot("study", caption, panels, min(2, len(panels)))])] if panels else []),
        ],
        "warning" if failed else "good",
        f"dvrk-drake simulate study {study_path} --output RESULTS.csv --plots FOLDER" if study_path else "",
    )


def _error(index: int, rows: Mapping[int, Row]) -> str:
    return rows[index].error if index in rows else ""


def _values(measure: Measure, study: Study, rows: Mapping[int, Row]) -> dict[str, NDArray[np.float64]]:
    """Returns the value of each run by variation. Failed runs have the worst value."""
    found = {
        variation.name: [rows[c.index] for c in study.cases if c.variation == variation.name and c.index in rows]
        for variation in study.variations
    }
    return {
        name: np.array([row.values.get(measure.column, measure.worst) for row in own], float)
        for name, own in found.items()
        if own
    }


def _summary_table(study: Study, rows: Mapping[int, Row]) -> Table:
    cells = [
        (measure.column if k == 0 else "", variation, *_summary(measure, values, study.arm))
        for measure in study.measures
        for k, (variation, values) in enumerate(_values(measure, study, rows).items())
    ]
    header = ("measure", "variation", "share or median", "95 % interval or percentile", "largest")
    return Table(header, cells, f"{study.arm.name}, {len(rows)} runs")


def _headline(measure: Measure, values: NDArray[np.float64], arm: Arm) -> str:
    if measure.is_boolean:
        return f"{values.sum():.0f} of {len(values)} runs"
    return f"median {_summary(measure, values, arm)[0]}"


def _summary(measure: Measure, values: NDArray[np.float64], arm: Arm) -> list[str]:
    """Returns share and interval, or median, 95th percentile and maximum."""
    if measure.is_boolean:
        low, high = wilson_interval(int(values.sum()), len(values))
        return [f"{100 * values.mean():.1f} %", f"{100 * low:.1f}..{100 * high:.1f} %", ""]
    # Do not interpolate between runs, since values can be infinite.
    numbers = (*np.quantile(values, [0.5, 0.95], method="inverted_cdf"), values.max())
    return [f"{number:.4g} {measure.unit(arm)}".strip() for number in numbers]


def _panel(measure: Measure, study: Study, rows: Mapping[int, Row]) -> Panel:
    curves, smallest, infinite = [], math.inf, 0
    for i, (variation, values) in enumerate(_values(measure, study, rows).items()):
        cases = [c for c in study.cases if c.variation == variation and c.index in rows]
        order = np.argsort(values)
        share = 100 * np.arange(1, len(values) + 1) / len(values)
        finite = np.isfinite(values[order])  # the curve ends below 100 % if values are infinite
        infinite += int(np.count_nonzero(~finite))
        smallest = min(smallest, values.min(initial=math.inf))
        x, y = values[order][finite], share[finite]
        texts = [
            f"{a:.4g}, {b:.1f} % of the runs, case {cases[k].index}, pose {cases[k].pose}"
            for a, b, k in zip(x, y, order[finite], strict=True)
        ]
        curves.append(Curve(variation, x, y, SERIES[i % len(SERIES)], "step", texts))
    unit = measure.unit(study.arm)
    return Panel(
        measure.title[0].upper()
        + measure.title[1:]
        + (f", {infinite} of {len(rows)} are infinite" if infinite else ""),
        curves,
        f"{measure.kind.replace('_', ' ')} [{unit}]" if unit else "effort / effort limit [1]",
        "cumulative share of runs [%]",
        y_range=(-3.0, 103.0),
        log_x=bool(unit) and 0 < smallest < math.inf,
        height=240,
    )
