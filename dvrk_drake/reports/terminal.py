"""Prints pages to a terminal: the answer, then texts and tables of at most 80 columns."""

from __future__ import annotations

import os
import re
import textwrap
from collections.abc import Mapping
from typing import Any

from rich import table as rich_table
from rich.console import Console
from rich.measure import Measurement
from rich.text import Text as RichText

from dvrk_drake.reports.page import Cell, Level, Page, Show, Table, Text, Verdict, cell_text

TABLE_WIDTH = 80
#: Colour of each level, as on a page.
_STYLES: Mapping[Level, str] = {"plain": "", "good": "green", "warning": "yellow", "bad": "red"}
#: Pattern for a space inside a unit in brackets or before a percent sign.
_IN_UNIT = re.compile(r" (?=[^\[]*\]|%)")
_NO_BREAK_SPACE = "\N{NO-BREAK SPACE}"


class TableConsole(Console):
    """Console that never cuts off digits in tables.

    In a narrow terminal, headings and names are broken into several lines. A table can be wider than the terminal.
    """

    def print(self, *objects: Any, **options: Any) -> None:
        """Prints objects like `rich.console.Console`."""
        width = self.width
        for table in (item for item in objects if isinstance(item, rich_table.Table)):
            headings = [str(column.header) for column in table.columns]
            for lines in range(2, 6):
                if self._width_of(table) <= width:
                    break
                for column, heading in zip(table.columns, headings, strict=True):
                    column.header = RichText(_stack(heading, lines))
            self.width = max(self.width, self._width_of(table, folded=True))
        try:
            super().print(*objects, **options)
        finally:
            self.width = width

    def on_broken_pipe(self) -> None:
        """Raises BrokenPipeError, which the program handles. The method of rich would end the process."""
        raise BrokenPipeError

    def _width_of(self, table: rich_table.Table, folded: bool = False) -> int:
        """Returns the width at which a table breaks no number. If `folded` is False, it breaks no name either."""
        free = self.options.update(max_width=10 * TABLE_WIDTH)
        width = 2 * (len(table.columns) - 1)
        for column in table.columns:
            sizes = [Measurement.get(self, free, cell) for cell in (column.header, *column.cells)]
            width += max(size.minimum if folded and not column.no_wrap else size.maximum for size in sizes)
        return width


def _stack(heading: str, lines: int) -> str:
    """Breaks a heading into at most `lines` lines if possible. A unit in brackets stays on one line."""
    text = _IN_UNIT.sub(_NO_BREAK_SPACE, heading)
    least = max(map(len, textwrap.wrap(text, 1, break_long_words=False)), default=1)
    stacked = (textwrap.wrap(text, width) for width in range(least, len(text) + 2))
    return "\n".join(next(rows for rows in stacked if len(rows) <= lines)).replace(_NO_BREAK_SPACE, " ")


def make_console() -> Console:
    """Returns a console on stdout. If stdout is not a terminal, the width of the console is `TABLE_WIDTH`."""
    console = TableConsole(highlight=False)
    if not console.is_terminal and "COLUMNS" not in os.environ:
        console.width = TABLE_WIDTH
    return console


def print_page(console: Console, page: Page, *, verbose: bool = False) -> None:
    """Prints the answer, then the texts and tables. A command prints the next step as its last line.

    Args:
        console: Console to print to.
        page: Page to print.
        verbose: Whether to print the details.
    """
    print_answer(console, page.answer, page.level)
    shown: tuple[Show, ...] = ("always", "details") if verbose else ("always", "brief")
    blocks = [block for block in page.blocks if isinstance(block, Text | Table) and block.show in shown]
    for before, block in zip([None, *blocks], blocks, strict=False):
        if (isinstance(before, Table) and not before.note) or (isinstance(before, Text) and isinstance(block, Table)):
            console.print()
        width = min(console.width, TABLE_WIDTH)
        if isinstance(block, Table):
            if block.caption:
                console.print(block.caption, style="bold", markup=False, width=width)
            console.print(_make_table(block))
            if block.note:
                console.print(f"{_plain(block.note)}\n", style="dim", markup=False, width=width)
        else:
            style = _STYLES[block.level] if block.level != "plain" or block.show == "always" else "dim"
            if block.unwrapped:
                console.print(block.text, style=style, markup=False, soft_wrap=True)
            else:
                console.print(_plain(block.text), style=style, markup=False, width=width)
    if blocks and not getattr(blocks[-1], "note", ""):
        console.print()


def print_answer(console: Console, answer: str, level: Level = "good") -> None:
    """Prints the result of a command, then an empty line.

    Args:
        console: Console to print to.
        answer: Result in one or two sentences.
        level: Level of the answer.
    """
    console.print(answer, style=_STYLES[level], markup=False)
    console.print()


def _make_table(block: Table) -> rich_table.Table:
    """Returns a table without its title. The first column may be folded, because it can contain long names."""
    table = rich_table.Table(box=None, pad_edge=False, expand=False)
    last = len(block.header) - 1
    for i, (heading, right) in enumerate(zip(block.header, block.aligned_right, strict=True)):
        text_at_end = i == last and not right
        table.add_column(
            RichText(heading), justify="right" if right else "left", no_wrap=i > 0 and not text_at_end, overflow="fold"
        )
    for row in block.rows:
        table.add_row(*map(_cell, row))
    return table


def _cell(cell: Cell) -> RichText:
    return RichText(cell_text(cell), style=_STYLES[cell.level] if isinstance(cell, Verdict) else "")


def _plain(text: str) -> str:
    """Returns a text without the markup of a page."""
    return re.sub(r"`([^`]+)`|\*\*(.+?)\*\*", lambda match: match[1] or match[2], text)
