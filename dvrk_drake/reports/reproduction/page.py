"""Writes the results to a page with figures and tables, and each table to a CSV file."""

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

    def markdown(self) -> str:
        """Returns the title and the table in Markdown."""
        lines = [f"**{self.title}**", "", _line(self.header), _line(["---"] * len(self.header))]
        return "\n".join([*lines, *map(_line, self.rows)])

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
        remarks: Paragraphs about the experiment and the differences from the paper.
        tables: Tables of results.
        figures: Mapping from the PNG file in the folder of the page to its caption.
    """

    name: str
    title: str
    remarks: tuple[str, ...]
    tables: tuple[ResultTable, ...] = ()
    figures: dict[str, str] = field(default_factory=dict)

    def markdown(self) -> str:
        """Returns the section in Markdown."""
        parts = [f"## {self.title}", *self.remarks]
        for table in self.tables:
            parts += [table.markdown(), f"[{table.name}.csv]({table.name}.csv)"]
        parts += [f"![{caption}]({figure})\n\n*{caption}*" for figure, caption in self.figures.items()]
        return "\n\n".join(parts)


def write_page(folder: Path, sections: Sequence[Section], left_out: Sequence[str]) -> Path:
    """Writes index.md and a CSV file for each table.

    Args:
        folder: Existing folder that contains the figures.
        sections: Sections of the page, in order.
        left_out: Requested results that could not be computed, with the reason for each.

    Returns:
        Path of index.md.
    """
    for section in sections:
        for table in section.tables:
            with atomic_write(folder / f"{table.name}.csv") as stream:
                stream.write(table.csv())
    parts = [
        "# Reproduction of the paper",
        _PREFACE,
        "\n".join(f"- [{s.title}](#{_anchor(s.title)})" for s in sections),
    ]
    parts += [f"**Missing:** {reason}" for reason in left_out]
    with atomic_write(folder / "index.md") as stream:
        stream.write("\n\n".join([*parts, *(section.markdown() for section in sections)]) + "\n")
    return folder / "index.md"


def numbers(values: ArrayLike, pattern: str) -> tuple[str, ...]:
    """Returns each number as text, formatted with a pattern such as "{:.3f}"."""
    return tuple(pattern.format(x) for x in np.asarray(values).tolist())


def share(held: int, total: int) -> str:
    """Returns the share held / total, with its 95 % confidence interval (Wilson, 1927), as text."""
    interval = Share.of(held, total)
    low, high = 100 * interval.lower, 100 * interval.upper
    return f"{held} of {total} ({100 * held / total:.1f} %, 95 % interval {low:.1f}..{high:.1f} %)"


def _line(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cells)} |"


def _anchor(title: str) -> str:
    """Returns the anchor of a heading in Markdown."""
    kept = "".join(c for c in title.lower() if c.isalnum() or c in " -_")
    return kept.replace(" ", "-")


_PREFACE = (
    "This page compares published figures and tables of *Gravity Compensation Control of da Vinci Robot* (Rutfield, "
    "Zia, Boos, Santoso, Sujumnong, WPI 2015) with results of `dvrk-drake reproduce`. Angles are in rad, torques in "
    "N m. "
    '"The paper\'s" denotes the method or parameters of the paper, "ours" denotes the method or model of this project.'
)
