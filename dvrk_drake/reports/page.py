"""Blocks of a page: what a person reads about a result, independent of where it is shown.

For each kind of result, one module of this package has a function that returns its `Page`. Three renderers show a page:
`terminal.print_page`, `html_file.write_html` (one offline file with interactive plots and 3D views) and
`image_files.write_images` (one PNG per plot). No renderer contains anything about a kind of result, and no page
imports a plotting library:

    page = Page(
        title="MTML, 72 static poses",
        answer="Verdict: good.",
        level="good",
        next_step="dvrk-drake validate other_poses.csv --model model.yaml",
        sections=[
            Section("Verdict per joint", [Table(("joint", "verdict", "error [N m]"), rows)]),
            Section("Efforts", [Scene(view, "Recorded poses"), Plot("efforts", "Efforts", panels, time=True)]),
        ],
    )

Each text and each table states where it is shown (`Show`). Results do not import reports.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

from dvrk_drake.reports.plot import Panel

#: Meaning of an answer, a text or a verdict. The level selects the colour: green, amber, red or none.
Level = Literal["plain", "good", "warning", "bad"]
#: Where a block is shown. "always": everywhere. "details": in a terminal only with --verbose, on a page always.
#: "brief": only in a terminal without --verbose. "page": only on a page.
Show = Literal["always", "details", "brief", "page"]


@dataclass(frozen=True)
class Verdict:
    """Table cell with a coloured word. The word gives the meaning, so the colour is not needed to understand it.

    Attributes:
        word: Text of the label, e.g. "usable".
        level: Level of the verdict.
    """

    word: str
    level: Level

    def __str__(self) -> str:
        """Returns the word."""
        return self.word


#: Content of a table cell. A float is shown with 4 significant digits.
Cell = str | int | float | Verdict


def cell_text(cell: Cell) -> str:
    """Returns the content of a cell as text."""
    return f"{cell:.4g}" if isinstance(cell, float) else str(cell)


@dataclass(frozen=True)
class Text:
    """Paragraph of text.

    Attributes:
        text: The text. The only markup is **emphasis** and `code`.
        level: Level. On a page, all but "plain" are drawn in a box.
        show: Where the text is shown.
        unwrapped: Whether a terminal prints the text in one line, so that a user can search or copy it.
    """

    text: str
    level: Level = "plain"
    show: Show = "always"
    unwrapped: bool = False


@dataclass(frozen=True)
class Table:
    """Table with a heading row.

    Attributes:
        header: Headings, with units in brackets: "error [N m]".
        rows: Cells of each row.
        caption: Quantity, unit and condition. "" for no caption.
        note: Explanation below the table.
        show: Where the table is shown.
        folded: Whether a page shows only the caption until the reader opens the table.
        name: Name of the CSV file without suffix, if the page is written with its tables.
    """

    header: Sequence[str]
    rows: Sequence[Sequence[Cell]]
    caption: str = ""
    note: str = ""
    show: Show = "always"
    folded: bool = False
    name: str = ""

    def __post_init__(self) -> None:
        """Raises ValueError if a row has another number of cells than the header."""
        for row in self.rows:
            if len(row) != len(self.header):
                raise ValueError(f"a row has {len(row)} cells, the header has {len(self.header)}: {row}")

    @property
    def aligned_right(self) -> list[bool]:
        """True for each column that is aligned right: at least half of its filled cells are numbers."""
        columns = list(zip(*self.rows, strict=True)) or [() for _ in self.header]
        filled = [[cell for cell in column if str(cell) not in ("", "-")] for column in columns]
        return [2 * sum(map(_is_number, cells)) >= len(cells) > 0 for cells in filled]


@dataclass(frozen=True, eq=False)
class Plot:
    """Plot with one or several panels.

    Attributes:
        name: Name of the image file without suffix, unique on a page.
        caption: Sentence that says what the plot shows.
        panels: Panels in reading order.
        columns: Number of columns of panels.
        time: Whether all x axes are the time [s] of the 3D views on the page. The plot then has the time cursor.
        shared_x: Whether all panels have the same x axis. Its labels are then below the last panel only.
    """

    name: str
    caption: str
    panels: Sequence[Panel]
    columns: int = 1
    time: bool = False
    shared_x: bool = False

    @property
    def row_heights(self) -> list[int]:
        """Height of each row of panels [px]: that of its highest panel."""
        rows = range(0, len(self.panels), self.columns)
        return [max(panel.height for panel in self.panels[k : k + self.columns]) for k in rows]


@dataclass(frozen=True, eq=False)
class Scene:
    """3D view, only on a page.

    Attributes:
        html: Function that returns a page of `Meshcat.StaticHtml()`, with or without an animation. It is called when
            the page is written, because drawing takes seconds. It may raise a DvrkDrakeError.
        caption: Sentence above the view.
        start: Time [s] on the axes of the plots at which the animation starts.
        poses: Number of poses, if the animation shows one static pose per second. 0: a motion.
    """

    html: Callable[[], str]
    caption: str
    start: float = 0.0
    poses: int = 0


Block = Text | Table | Plot | Scene


@dataclass(frozen=True)
class Section:
    """Section of a page with an entry in the table of contents. A terminal shows its blocks without the title.

    Attributes:
        title: Heading.
        blocks: Content in order.
        note: Paragraph below the heading, only on a page.
        folded: Whether a page shows only the heading until the reader opens the section.
    """

    title: str
    blocks: Sequence[Block]
    note: str = ""
    folded: bool = False

    @property
    def finding(self) -> str:
        """First text of the section. "" if it does not begin with a text."""
        return self.blocks[0].text if self.blocks and isinstance(self.blocks[0], Text) else ""


@dataclass(frozen=True)
class Page:
    """Answer, next step and sections that a person reads about a result.

    Attributes:
        title: What was examined, e.g. the arm and the recording.
        answer: Result in one or two sentences.
        sections: Sections in order.
        level: Level of the answer.
        next_step: Suggested next step, usually a command. "" if there is none.
        next_purpose: What the suggested command does, in one sentence.
    """

    title: str
    answer: str
    sections: Sequence[Section]
    level: Level = "plain"
    next_step: str = ""
    next_purpose: str = ""

    @property
    def blocks(self) -> Iterator[Block]:
        """Blocks of all sections."""
        return (block for section in self.sections for block in section.blocks)


def warning_texts(findings: Iterable[object]) -> list[Text]:
    """Returns the warnings about a recording as texts that only a page shows, because commands print them on stderr."""
    found = [str(finding) for finding in findings]
    return [Text(one.removeprefix("warning: "), "warning", show="page") for one in found if one.startswith("warning: ")]


def _is_number(cell: Cell) -> bool:
    """Tells whether a cell is a number, a range or a number with a unit."""
    text = str(cell).strip()
    return text == "inf" or text[0].isdigit() or (text[0] in "+-−±<>≥~." and any(map(str.isdigit, text)))
