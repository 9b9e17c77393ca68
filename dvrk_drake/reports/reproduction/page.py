"""Results as people read them: a page with figures and tables, and each table as a CSV file."""

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
    """A table; `name` is that of its file without the ending, and unique on a page."""

    name: str
    title: str
    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]

    def markdown(self) -> str:
        """The table in Markdown, its title above it."""
        lines = [f"**{self.title}**", "", _line(self.header), _line(["---"] * len(self.header))]
        return "\n".join([*lines, *map(_line, self.rows)])

    def csv(self) -> str:
        """The table as a CSV file."""
        stream = io.StringIO()
        csv.writer(stream, lineterminator="\n").writerows([self.header, *self.rows])
        return stream.getvalue()


@dataclass(frozen=True)
class Section:
    """Result of reproducing one figure of the paper.

    Attributes:
        name: as the command line calls it.
        title: heading.
        remarks: what was done, what differs from the paper and why, a paragraph each.
        tables: numbers.
        figures: PNG in the page's folder -> what it shows.
    """

    name: str
    title: str
    remarks: tuple[str, ...]
    tables: tuple[ResultTable, ...] = ()
    figures: dict[str, str] = field(default_factory=dict)

    def markdown(self) -> str:
        """The section in Markdown."""
        parts = [f"## {self.title}", *self.remarks]
        for table in self.tables:
            parts += [table.markdown(), f"[{table.name}.csv]({table.name}.csv)"]
        parts += [f"![{shows}]({figure})\n\n*{shows}*" for figure, shows in self.figures.items()]
        return "\n\n".join(parts)


def write_page(folder: Path, sections: Sequence[Section], left_out: Sequence[str]) -> Path:
    """Writes index.md and a CSV file for each table.

    Args:
        folder: an existing one, in which the figures are.
        sections: in the page's order.
        left_out: what was asked for and could not be done, and why.

    Returns:
        The page.
    """
    for section in sections:
        for table in section.tables:
            with atomic_write(folder / f"{table.name}.csv") as stream:
                stream.write(table.csv())
    parts = ["# The paper redone", _PREFACE, "\n".join(f"- [{s.title}](#{_anchor(s.title)})" for s in sections)]
    parts += [f"**Left out:** {reason}" for reason in left_out]
    with atomic_write(folder / "index.md") as stream:
        stream.write("\n\n".join([*parts, *(section.markdown() for section in sections)]) + "\n")
    return folder / "index.md"


def numbers(values: ArrayLike, pattern: str) -> tuple[str, ...]:
    """Each number in a format such as "{:.3f}"."""
    return tuple(pattern.format(x) for x in np.asarray(values).tolist())


def share(held: int, of: int) -> str:
    """A share with its 95 % confidence interval (Wilson, 1927)."""
    interval = Share.of(held, of)
    low, high = 100 * interval.lower, 100 * interval.upper
    return f"{held} of {of} ({100 * held / of:.1f} %, 95 % interval {low:.1f}..{high:.1f} %)"


def _line(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cells)} |"


def _anchor(title: str) -> str:
    """Returns the anchor of a heading in Markdown."""
    kept = "".join(c for c in title.lower() if c.isalnum() or c in " -_")
    return kept.replace(" ", "-")


_PREFACE = (
    "*Gravity Compensation Control of da Vinci Robot* (Rutfield, Zia, Boos, Santoso, Sujumnong, WPI 2015), its figures "
    "and tables made again by `dvrk-drake reproduce` beside the published numbers. Angles in rad, torques in N m."
)
