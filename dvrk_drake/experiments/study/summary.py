"""What the runs of a study say together: shares with their intervals, medians and 95th percentiles."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import binomtest

from dvrk_drake.experiments.study.measures import Measure
from dvrk_drake.experiments.study.study_file import Study
from dvrk_drake.experiments.study.table import Row


@dataclass(frozen=True)
class Share:
    """How many of `runs` answered yes; `lower`..`upper`: Wilson's 95 % interval of the share, for independent runs."""

    yes: int
    runs: int
    lower: float
    upper: float


@dataclass(frozen=True)
class Quantiles:
    """Of one number of all runs, each the number of a run; a run that failed counts as infinite."""

    median: float
    percentile_95: float
    largest: float


@dataclass(frozen=True)
class Summary:
    """Of one variation: how many of its `runs` failed, and each measure by its column."""

    variation: str
    runs: int
    failed: int
    measures: dict[str, Share | Quantiles]


def summarise(study: Study, rows: Mapping[int, Row]) -> list[Summary]:
    """One a variation, over the cases that have a row in `rows`; variations without any are left out."""
    summaries = []
    for variation in study.variations:
        of_it = [rows[c.index] for c in study.cases if c.variation == variation.name and c.index in rows]
        if of_it:
            measures = {measure.column: _summary_of(measure, of_it) for measure in study.measures}
            summaries.append(Summary(variation.name, len(of_it), sum(bool(row.error) for row in of_it), measures))
    return summaries


def values_of(measure: Measure, rows: list[Row]) -> NDArray[np.float64]:
    """(m,) of each run; of one that failed, the worst."""
    return np.array([row.values.get(measure.column, measure.worst) for row in rows], float)


def _summary_of(measure: Measure, rows: list[Row]) -> Share | Quantiles:
    values = values_of(measure, rows)
    if measure.is_answer:
        yes = int(values.sum())
        interval = binomtest(yes, len(values)).proportion_ci(method="wilson")
        return Share(yes, len(values), float(interval.low), float(interval.high))
    # Values of runs, not between runs: infinite ones have no middle.
    median, percentile_95 = np.quantile(values, [0.5, 0.95], method="inverted_cdf")
    return Quantiles(float(median), float(percentile_95), float(values.max()))
