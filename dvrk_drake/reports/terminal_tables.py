"""Console and tables of the terminal: the answer, the next command, then tables of at most 80 columns."""

from __future__ import annotations

import os
import re
import textwrap
from typing import Any

from rich.console import Console
from rich.measure import Measurement
from rich.table import Table
from rich.text import Text

TABLE_WIDTH = 80
#: Of tables in a file, where names of base parameters are not broken.
WIDTH_OF_FILES = 120
#: A space inside of a unit in brackets, or before a unit.
_IN_UNIT = re.compile(r" (?=[^\[]*\]|%)")
_NO_BREAK_SPACE = "\N{NO-BREAK SPACE}"


class TableConsole(Console):
    """Prints a table as wide as the terminal, or as its numbers need.

    In a narrow one headings are stacked and names folded; digits are never lost.
    """

    def print(self, *objects: Any, **options: Any) -> None:
        """As rich's Console does."""
        width = self.width
        for table in (thing for thing in objects if isinstance(thing, Table)):
            headings = [str(column.header) for column in table.columns]
            for lines in range(2, 6):
                if self._width_of(table) <= width:
                    break
                for column, heading in zip(table.columns, headings, strict=True):
                    column.header = Text(_stack(heading, lines))
            self.width = max(self.width, self._width_of(table, folded=True))
        try:
            super().print(*objects, **options)
        finally:
            self.width = width

    def on_broken_pipe(self) -> None:
        """Leaves it to the program that the reader has seen enough; rich would end the process with an error."""
        raise BrokenPipeError

    def _width_of(self, table: Table, folded: bool = False) -> int:
        """With the numbers on one line each, and with names if not `folded`. Rich's own measure breaks numbers."""
        free = self.options.update(max_width=10 * TABLE_WIDTH)
        width = 2 * (len(table.columns) - 1)
        for column in table.columns:
            sizes = [Measurement.get(self, free, cell) for cell in (column.header, *column.cells)]
            width += max(size.minimum if folded and not column.no_wrap else size.maximum for size in sizes)
        return width


def _stack(heading: str, lines: int) -> str:
    """A heading on at most so many lines, if its words allow it; a unit in brackets stays on one line."""
    text = _IN_UNIT.sub(_NO_BREAK_SPACE, heading)
    least = max(map(len, textwrap.wrap(text, 1, break_long_words=False)), default=1)
    stacked = (textwrap.wrap(text, width) for width in range(least, len(text) + 2))
    return "\n".join(next(rows for rows in stacked if len(rows) <= lines)).replace(_NO_BREAK_SPACE, " ")


def make_console() -> Console:
    """A console on stdout, as wide as the terminal; where it is none, as wide as the tables."""
    console = TableConsole(highlight=False)
    if not console.is_terminal and "COLUMNS" not in os.environ:
        console.width = TABLE_WIDTH
    return console


def print_answer(console: Console, answer: str, next_step: str | None, style: str = "green") -> None:
    """Prints what a command found and what to do next; details follow below.

    Args:
        console: to print to.
        answer: one or two sentences.
        next_step: usually a command; it is not wrapped, so that it can be copied. None: nothing is left to do.
        style: of the answer.
    """
    console.print(answer, style=style, markup=False)
    if next_step is not None:
        console.print(f"Next: {next_step}", markup=False, soft_wrap=True)
    console.print()


def print_note(console: Console, text: str) -> None:
    """Prints an explanation of a table below it, then an empty line."""
    console.print(f"{text}\n", style="dim", markup=False, width=min(console.width, TABLE_WIDTH))


def make_table(title: str, *columns: str) -> Table:
    """An empty table with a bold title; the first column left, the others right."""
    # A title may be wider than its table, and would be wrapped.
    text = Text(title, style="bold", no_wrap=True, overflow="ignore")
    table = Table(title=text, title_justify="left", box=None, pad_edge=False, expand=False)
    for i, column in enumerate(columns):
        # The name of a base parameter may be long; numbers are never cut.
        # Units in brackets are no markup.
        table.add_column(Text(column), justify="left" if i == 0 else "right", no_wrap=i > 0, overflow="fold")
    return table
