"""Writes the results to an HTML page with figures and tables, and each table to a CSV file."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from dvrk_drake.experiments.study.table import Share
from dvrk_drake.models.files import atomic_write
from dvrk_drake.reports import page as blocks
from dvrk_drake.reports.html_file import write_html
from dvrk_drake.reports.image_files import write_images
from dvrk_drake.reports.page import Page, Plot, Table, Text
from dvrk_drake.reports.provenance import Provenance


@dataclass(frozen=True)
class ResultTable:
    """Table of results.

    Attributes:
        name: Name of the CSV file without suffix, unique on a page.
        title: Caption.
        header: Column headings.
        rows: Cells of each row.
    """

    name: str
    title: str
    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]

    @property
    def block(self) -> Table:
        """The table for the page."""
        return Table(self.header, self.rows, self.title, note=f"File: {self.name}.csv")

    def csv(self) -> str:
        """Returns the content of the CSV file."""
        stream = io.StringIO()
        csv.writer(stream, lineterminator="\n").writerows([self.header, *self.rows])
        return stream.getvalue()


@dataclass(frozen=True)
class Section:
    """Section of the results page for one figure, table or experiment.

    Attributes:
        name: Name of the section on the command line.
        title: Heading.
        finding: Result in one sentence.
        remarks: Paragraphs about the experiment and the differences from the paper.
        tables: Tables of results.
        plots: Plots.
    """

    name: str
    title: str
    finding: str
    remarks: tuple[str, ...]
    tables: tuple[ResultTable, ...] = ()
    plots: tuple[Plot, ...] = ()

    @property
    def blocks(self) -> blocks.Section:
        """The section of the page."""
        tables = (table.block for table in self.tables)
        return blocks.Section(self.title, [Text(self.finding), *tables, *self.plots, *map(Text, self.remarks)])


def write_page(folder: Path, sections: Sequence[Section], left_out: Sequence[str], origin: Provenance) -> Path:
    """Writes index.html, a CSV file for each table and a PNG file for each plot.

    Args:
        folder: Existing folder.
        sections: Sections of the page, in order.
        left_out: Requested results that could not be computed, with the reason for each.
        origin: Provenance of the page.

    Returns:
        Path of index.html.
    """
    for section in sections:
        for table in section.tables:
            with atomic_write(folder / f"{table.name}.csv") as stream:
                stream.write(table.csv())
    missing = [Text(f"Missing: {reason}", "warning") for reason in left_out]
    findings = Table(("result", "finding"), [(section.title, section.finding) for section in sections])
    page = Page(
        "Reproduction of the paper",
        f"{len(sections)} of {len(sections) + len(left_out)} requested results were computed.",
        [blocks.Section("Findings", [*missing, findings], _PREFACE), *(section.blocks for section in sections)],
        "warning" if left_out else "good",
        *(_NEXT_DATA if left_out else _NEXT_STUDY),
    )
    write_images(page, folder)
    write_html(page, folder / "index.html", origin)
    return folder / "index.html"


def numbers(values: ArrayLike, pattern: str) -> tuple[str, ...]:
    """Returns each number as text, formatted with a pattern such as "{:.3f}"."""
    return tuple(pattern.format(x) for x in np.asarray(values).tolist())


def share(held: int, total: int) -> str:
    """Returns the share held / total, with its 95 % confidence interval (Wilson, 1927), as text."""
    interval = Share.of(held, total)
    low, high = 100 * interval.lower, 100 * interval.upper
    return f"{held} of {total} ({100 * held / total:.1f} %, 95 % interval {low:.1f}..{high:.1f} %)"


_PREFACE = (
    "This page compares published figures and tables of Gravity Compensation Control of da Vinci Robot (Rutfield, "
    "Zia, Boos, Santoso, Sujumnong, WPI 2015) with results of `dvrk-drake reproduce`. Angles are in rad, torques in "
    "N m. "
    '"The paper\'s" denotes the method or parameters of the paper, "ours" denotes the method or model of this project.'
)
_NEXT_DATA = (
    "dvrk-drake reproduce all --folder reproduction --data FOLDER",
    "Computes all results. FOLDER contains the recording of the paper (docs/reproduction.md).",
)
_NEXT_STUDY = (
    "dvrk-drake simulate study examples/release_study.yaml --output release.csv --report release.html",
    "Repeats releases with your own poses, seeds and variations.",
)
