"""Builds a self-contained HTML page from text, tables, interactive plots and 3D animations.

A report is a `Page` of `Section`s, and a section is a sequence of blocks. `Page.write` writes one file with all scripts
embedded, which needs no network. Plotly, plots and 3D views are compressed:

    page = Page(
        title="MTML, 72 static poses",
        subtitle="7 of 7 joints are usable.",
        sections=[
            Section("Verdict per joint", [Table(("joint", "error [N m]", "verdict"), rows)]),
            Section("Efforts", [Meshcat(meshcat.StaticHtml()), Plot(figure, "Measured and fitted efforts", time=True)]),
            Section("Next step", [Command("dvrk-drake validate model.yaml other_poses.csv")]),
        ],
        provenance=Provenance.of(["poses.csv"], command=sys.argv[1:]),
    )
    page.write("report.html")

In a section with a `Meshcat` block, the 3D view stays visible beside the other blocks of the section. All plots with
`time=True` have a cursor. Moving the cursor, or a click in such a plot, moves the animation to this time, and a playing
animation moves the cursor.

Results do not import reports. For each kind of result, one module of this package has a function that returns the page.
The command with `--report` calls this function, and `dvrk_drake.write_report(result, path)` finds it by the type of the
result (`dvrk_drake.reports.html.write`).
"""

from __future__ import annotations

import gzip
import re
from base64 import b64encode
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import ClassVar

import plotly.graph_objects as go
from jinja2 import Environment, FunctionLoader, StrictUndefined
from markupsafe import Markup, escape
from plotly.offline import get_plotlyjs

from dvrk_drake.models.files import atomic_write
from dvrk_drake.reports.html.plot_style import DEFAULT_HEIGHT, TEMPLATE
from dvrk_drake.reports.provenance import Provenance


@dataclass(frozen=True)
class Verdict:
    """Table cell with a coloured label. The word gives the meaning, so the colour is not needed to understand it.

    Attributes:
        word: Text of the label, e.g. "usable".
        level: "good", "warning", "bad" or "neutral"; selects the colour.
        reason: Text behind the label.
    """

    word: str
    level: str
    reason: str = ""


#: Content of a table cell. A float is shown with 4 significant digits.
Cell = str | int | float | Verdict


@dataclass(frozen=True)
class Text:
    """Paragraph of text.

    Attributes:
        text: The text. The only markup is **emphasis** and `code`.
        level: "plain", "result", "good", "warning" or "bad". All but "plain" are drawn in a box.
    """

    text: str
    level: str = "plain"
    kind: ClassVar[str] = "text"


@dataclass(frozen=True)
class Table:
    """Table with a heading row.

    Attributes:
        header: Headings, with units in brackets: "error [N m]".
        rows: Cells of each row.
        caption: Quantity, unit and condition. "" for no caption.
        note: Explanation below the table.
        collapsed: Whether only the caption is visible until the reader opens the table.
        right: Whether each column is aligned right. None: columns in which all cells are numbers are.
    """

    header: Sequence[str]
    rows: Sequence[Sequence[Cell]]
    caption: str = ""
    note: str = ""
    collapsed: bool = False
    right: Sequence[bool] | None = None
    kind: ClassVar[str] = "table"

    def __post_init__(self) -> None:
        """Raises ValueError if a row has another number of cells than the header."""
        for row in self.rows:
            if len(row) != len(self.header):
                raise ValueError(f"a row has {len(row)} cells, the header has {len(self.header)}: {row}")

    @property
    def alignment(self) -> list[str]:
        """Class of each column: "number" if it is aligned right, else "name"."""
        right = self.right
        if right is None:
            columns = map(list, zip(*self.rows, strict=True)) if self.rows else ([] for _ in self.header)
            right = [bool(cells) and all(map(_is_number, cells)) for cells in columns]
        return ["number" if is_right else "name" for is_right in right]


@dataclass(frozen=True)
class Plot:
    """Interactive plot.

    Attributes:
        figure: Plotly figure. The page applies its own template. The height of the layout is kept.
        caption: Sentence above the plot that says what to see.
        time: Whether all x axes are the time [s] of the animations on the page. The plot then has the time cursor.
        half: Whether two plots are beside each other on wide screens.
    """

    figure: go.Figure
    caption: str
    time: bool = False
    half: bool = False
    kind: ClassVar[str] = "plot"

    def json(self) -> str:
        """Returns the figure with the template of the page as JSON."""
        height = self.figure.layout.height or DEFAULT_HEIGHT  # Plotly ignores the height of a template
        return str(go.Figure(self.figure).update_layout(template=TEMPLATE, height=height).to_json())


@dataclass(frozen=True)
class Image:
    """Picture.

    Attributes:
        png: Content of a PNG file.
        caption: Sentence above the picture that says what to see.
    """

    png: bytes
    caption: str
    kind: ClassVar[str] = "image"

    @property
    def base64(self) -> str:
        """Content of the file as Base64."""
        return b64encode(self.png).decode()


@dataclass(frozen=True)
class Meshcat:
    """3D view.

    Attributes:
        html: Page of `Meshcat.StaticHtml()`, with or without an animation.
        caption: Sentence above the view.
        start: Time [s] on the axes of the plots at which the animation starts.
    """

    html: str
    caption: str = "3D view. Drag to rotate, scroll to zoom."
    start: float = 0.0
    kind: ClassVar[str] = "meshcat"


@dataclass(frozen=True)
class Command:
    """Command to type, with a button that copies it.

    Attributes:
        command: Command line.
        purpose: What the command does, in one sentence.
    """

    command: str
    purpose: str = ""
    kind: ClassVar[str] = "command"


Block = Text | Table | Plot | Image | Meshcat | Command


@dataclass(frozen=True)
class Section:
    """Section of a page with an entry in the table of contents.

    Attributes:
        title: Heading.
        blocks: Content in order.
        note: Paragraph below the heading.
    """

    title: str
    blocks: Sequence[Block]
    note: str = ""

    @property
    def views(self) -> list[Block]:
        """3D views, which stay visible beside the other blocks."""
        return [block for block in self.blocks if isinstance(block, Meshcat)]

    @property
    def others(self) -> list[Block]:
        """All blocks except the 3D views."""
        return [block for block in self.blocks if not isinstance(block, Meshcat)]


@dataclass(frozen=True)
class Page:
    """Report.

    Attributes:
        title: What was examined, e.g. the arm and the recording.
        subtitle: The answer in one or two sentences.
        sections: Sections in order.
        provenance: Files, versions and command of the report.
        level: Level of the answer, see `Text`.
        closing: Sections after the provenance, e.g. the next step.
    """

    title: str
    subtitle: str
    sections: Sequence[Section]
    provenance: Provenance
    level: str = "plain"
    closing: Sequence[Section] = ()

    def html(self) -> str:
        """Returns the page. It contains all scripts and styles."""
        return _environment().get_template("page.html").render(page=self)

    def write(self, path: str | Path) -> None:
        """Writes the page atomically.

        Raises:
            DvrkDrakeError: The file cannot be written.
        """
        html = self.html()
        with atomic_write(path) as stream:
            stream.write(html)


def _is_number(cell: Cell) -> bool:
    """Tells whether a cell is a number, a range, a number with a unit or empty."""
    if isinstance(cell, Verdict):
        return False
    text = str(cell).strip()
    return not text or text[0].isdigit() or (len(text) > 1 and text[0] in "+-−±<>≥~." and any(map(str.isdigit, text)))


def _show(cell: Cell) -> str:
    return f"{cell:.4g}" if isinstance(cell, float) else str(cell)


def _packed(text: str) -> str:
    """Returns text as Base64 of gzip, which page.js unpacks. Plotly's script shrinks from 4.8 MB to 2 MB."""
    return b64encode(gzip.compress(text.encode(), mtime=0)).decode()


def _heading(text: str) -> str:
    """Returns a heading whose units in brackets are not broken into lines."""
    return re.sub(r"\[[^]]*\]", lambda unit: unit[0].replace(" ", "\N{NO-BREAK SPACE}"), text)


def _emphasis(text: str) -> Markup:
    """Escapes text and converts **emphasis** and `code` to HTML."""
    marked = re.sub(r"\*\*(.+?)\*\*", r"<strong>\1</strong>", str(escape(text)), flags=re.DOTALL)
    return Markup(re.sub(r"`([^`]+)`", r"<code>\1</code>", marked))


@cache
def _plotly_script() -> str:
    return _packed(get_plotlyjs())


def _template(name: str) -> str:
    return files("dvrk_drake.reports.html").joinpath("templates", name).read_text(encoding="utf-8")


@cache
def _environment() -> Environment:
    environment = Environment(
        loader=FunctionLoader(_template),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.globals["file"] = lambda name: Markup(_template(name))
    environment.globals["plotly"] = _plotly_script
    environment.filters |= {"show": _show, "heading": _heading, "emphasis": _emphasis, "packed": _packed}
    environment.tests["verdict"] = lambda cell: isinstance(cell, Verdict)
    return environment
