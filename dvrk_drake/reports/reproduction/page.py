"""Writes the results to an HTML page with figures and tables, and each table to a CSV file."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from dvrk_drake.experiments.study.table import Share
from dvrk_drake.models.files import atomic_write
from dvrk_drake.reports.html import page as html_page
from dvrk_drake.reports.html.page import Block, Command, Image, Page, Plot, Table, Text
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
        figures: Mapping from the PNG file in the folder of the page to its caption.
        plots: Interactive plots.
    """

    name: str
    title: str
    finding: str
    remarks: tuple[str, ...]
    tables: tuple[ResultTable, ...] = ()
    figures: dict[str, str] = field(default_factory=dict)
    plots: tuple[Plot, ...] = ()

    def html(self, folder: Path) -> html_page.Section:
        """Returns the section of the page. The figures are in `folder`."""
        blocks: list[Block] = [Text(self.finding, "result"), *(table.block for table in self.tables)]
        blocks += [Image((folder / figure).read_bytes(), caption) for figure, caption in self.figures.items()]
        return html_page.Section(self.title, [*blocks, *self.plots, *map(Text, self.remarks)])


def write_page(folder: Path, sections: Sequence[Section], left_out: Sequence[str], origin: Provenance) -> Path:
    """Writes index.html and a CSV file for each table.

    Args:
        folder: Existing folder that contains the figures.
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
        [
            html_page.Section("Findings", [*missing, findings], _PREFACE),
            *(section.html(folder) for section in sections),
            html_page.Section("Next step", [_NEXT_DATA if left_out else _NEXT_STUDY]),
        ],
        origin,
        "warning" if left_out else "good",
    )
    page.write(folder / "index.html")
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
_NEXT_DATA = Command(
    "dvrk-drake reproduce all --folder reproduction --data FOLDER",
    "Computes all results. FOLDER contains the recording of the paper (docs/reproduction.md).",
)
_NEXT_STUDY = Command(
    "dvrk-drake simulate study examples/release_study.yaml --output release.csv --report release.html",
    "Repeats releases with your own poses, seeds and variations.",
)
