"""Prints the summary of a study to a terminal."""

from __future__ import annotations

from collections.abc import Mapping

from rich.console import Console

from dvrk_drake.experiments.study.measures import Measure
from dvrk_drake.experiments.study.study_file import Study
from dvrk_drake.experiments.study.table import Row, Share, Summary, summarise
from dvrk_drake.models.arm import Arm
from dvrk_drake.reports.terminal_tables import make_table, print_answer, print_note

#: Maximum number of variations in the first sentence, and of failed runs that are printed without `verbose`.
_MAX_COUNT = 3


def print_study(
    console: Console, study: Study, rows: Mapping[int, Row], *, study_path: str | None = None, verbose: bool = False
) -> None:
    """Prints the values of the first measure, then those of all measures, and the error messages of failed runs.

    Args:
        console: Console to print to.
        study: Study to summarize.
        rows: Mapping from the number of a case to its results.
        study_path: Path of the study, for the suggested next command. None if the command has already written figures.
        verbose: Whether to print all failed runs.
    """
    summaries = summarise(study, rows)
    failed = [case for case in study.cases if case.index in rows and rows[case.index].error]
    first = study.measures[0]
    found = "; ".join(f"{s.variation}: {_headline(first, s, study.arm)}" for s in summaries[:_MAX_COUNT])
    answer = f"{first.column} {found}. {len(rows)} of {len(study.cases)} runs, {len(failed)} failed."
    command = study_path and f"dvrk-drake study {study_path} --output RESULTS.csv --plots FOLDER"
    print_answer(console, answer, command, "yellow" if failed else "green")
    table = make_table(
        f"{study.arm.name}, {len(rows)} runs",
        *("", "variation", "share or median", "95 % interval or percentile", "largest"),
    )
    table.columns[1].justify, table.columns[1].no_wrap = "left", False
    for measure in study.measures:
        for k, summary in enumerate(summaries):
            table.add_row(measure.column if k == 0 else "", summary.variation, *_cells(measure, summary, study.arm))
    console.print(table)
    console.print()
    if failed:
        print_note(console, "A run that failed counts as the worst result.")
    if verbose:
        print_note(
            console,
            "Yes-or-no measures: share of the runs, and the 95 % Wilson interval for independent runs. Other measures: "
            "median and 95th percentile of the runs.",
        )
    if len(study.seeds) > 1:
        print_note(
            console, "The intervals are too narrow, because runs with different seeds at one pose are not independent."
        )
    for case in failed if verbose else failed[:_MAX_COUNT]:
        text = f"case {case.index}, {case.variation}, pose {case.pose}, seed {case.seed}: {rows[case.index].error}"
        console.print(text, style="yellow", markup=False)
    if not verbose and len(failed) > _MAX_COUNT:
        console.print(f"{len(failed) - _MAX_COUNT} more runs failed. --verbose lists them.", style="yellow")


def _headline(measure: Measure, summary: Summary, arm: Arm) -> str:
    value = summary.measures[measure.column]
    if isinstance(value, Share):
        return f"{value.count} of {value.runs} runs"
    return f"median {value.median:.4g} {measure.unit(arm)}".strip()


def _cells(measure: Measure, summary: Summary, arm: Arm) -> list[str]:
    value = summary.measures[measure.column]
    if isinstance(value, Share):
        share = f"{100 * value.count / value.runs:.1f} %"
        return [share, f"{100 * value.lower:.1f}..{100 * value.upper:.1f} %", ""]
    return [
        f"{number:.4g} {measure.unit(arm)}".strip() for number in (value.median, value.percentile_95, value.largest)
    ]
