"""Reproduces the requested figures and tables, and writes them to an HTML page, PNG and CSV files."""

from __future__ import annotations

import csv
from collections.abc import Callable, Sequence
from pathlib import Path

from dvrk_drake.errors import DvrkDrakeError
from dvrk_drake.experiments.paper import PaperRecordings, ReproductionSession, SampleSizes
from dvrk_drake.models.files import atomic_write
from dvrk_drake.progress import Progress
from dvrk_drake.reports.html_file import write_html
from dvrk_drake.reports.image_files import write_images
from dvrk_drake.reports.page import Page, Section, Table, Text
from dvrk_drake.reports.reproduction_drift import reproduce_figure_5, reproduce_figure_6, reproduce_psm
from dvrk_drake.reports.reproduction_figures import (
    reproduce_figure_4,
    reproduce_figure_7,
    reproduce_table_1,
    reproduce_transparency,
)
from dvrk_drake.workers import local_executor

_MAKERS: dict[str, Callable[[ReproductionSession], Section]] = {
    "table1": reproduce_table_1,
    "fig4": reproduce_figure_4,
    "fig5": reproduce_figure_5,
    "fig6": reproduce_figure_6,
    "fig7": reproduce_figure_7,
    "psm": reproduce_psm,
    "transparency": reproduce_transparency,
}
#: Names of all sections, in the order of the page.
NAMES = tuple(_MAKERS)


def reproduce(
    names: Sequence[str],
    folder: Path,
    recordings: PaperRecordings,
    progress: Progress = lambda step, share: None,
    sample_sizes: SampleSizes | None = None,
    seed: int = 0,
    command: Sequence[str] = (),
) -> Page:
    """Writes figures, tables and index.html. The function writes index.html again after each finished section.

    Args:
        names: Sections to reproduce, from `NAMES`.
        folder: Existing folder for the results.
        recordings: Recordings of the paper. Without them, Fig. 4 is omitted if other sections are requested, and
            Fig. 5 and 6 use a different arm.
        progress: Function called with a step, for example "fig5: releasing", and the finished share of this step (0
            to 1).
        sample_sizes: Numbers of poses and releases. None: the default numbers.
        seed: Seed of simulated arms, poses and noise.
        command: Words of the command line, for the provenance.

    Returns:
        Page that was written, without the sections that could not be computed.

    Raises:
        DvrkDrakeError: A name is not in `NAMES`.
        RecordingError: A recording cannot be read, or only Fig. 4 is requested and its recording is missing.
    """
    if unknown := sorted(set(names) - set(NAMES)):
        raise DvrkDrakeError(f"{', '.join(unknown)} cannot be reproduced; allowed: {', '.join(NAMES)}")
    wanted = [name for name in NAMES if name in names]
    left_out = []
    if recordings.folder is None and "fig4" in wanted and len(wanted) > 1:
        wanted.remove("fig4")
        left_out.append("Fig. 4 requires the recording of the paper. Give its folder with --data.")
    sections: list[Section] = []
    with local_executor() as executor:
        session = ReproductionSession(
            folder, recordings, executor, sample_sizes=sample_sizes or SampleSizes(), seed=seed
        )
        for name in wanted:
            progress(name, 0.0)
            session.progress = _within(progress, name)
            sections.append(_MAKERS[name](session))
            unfinished = [f"{later} was not finished." for later in wanted[len(sections) :]]
            page = write_page(folder, sections, [*left_out, *unfinished], recordings.files, command)
    return page


def _within(progress: Progress, name: str) -> Progress:
    return lambda step, share: progress(f"{name}: {step}", share)


def write_page(
    folder: Path,
    sections: Sequence[Section],
    left_out: Sequence[str],
    inputs: Sequence[Path] = (),
    command: Sequence[str] = (),
) -> Page:
    """Writes index.html, a CSV file for each table with a name, and a PNG file for each plot.

    Args:
        folder: Existing folder.
        sections: Sections of the page, in order. Each begins with the finding.
        left_out: Requested results that could not be computed, with the reason for each.
        inputs, command: Provenance of the page.
    """
    findings = [(section.title, section.finding) for section in sections]
    missing = [Text(f"Missing: {reason}", "warning") for reason in left_out]
    page = Page(
        "Reproduction of the paper",
        f"{len(sections)} of {len(sections) + len(left_out)} requested results were computed.",
        [Section("Findings", [*missing, Table(("result", "finding"), findings)], _PREFACE), *sections],
        "warning" if left_out else "good",
        *(_NEXT_DATA if left_out else _NEXT_STUDY),
    )
    for table in page.blocks:
        if isinstance(table, Table) and table.name:
            with atomic_write(folder / f"{table.name}.csv") as stream:
                csv.writer(stream, lineterminator="\n").writerows([table.header, *table.rows])
    write_images(page, folder)
    write_html(page, folder / "index.html", inputs, command)
    return page


_PREFACE = (
    "This page compares published figures and tables of Gravity Compensation Control of da Vinci Robot (Rutfield, "
    "Zia, Boos, Santoso, Sujumnong, WPI 2015) with results of `dvrk-drake reproduce`. Each table is also a CSV file. "
    "Angles are in rad, torques in N m. docs/public_recordings.md describes the simulated arms. "
    '"The paper\'s" denotes the method or parameters of the paper, "ours" denotes the method or model of this project.'
)
_NEXT_DATA = (
    "dvrk-drake reproduce all --folder reproduction --data FOLDER",
    "Computes all results. FOLDER contains the recording of the paper (docs/public_recordings.md).",
)
_NEXT_STUDY = (
    "dvrk-drake simulate study examples/release_study.yaml --output release.csv --report release.html",
    "Repeats releases with your own poses, seeds and variations.",
)
