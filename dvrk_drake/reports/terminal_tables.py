"""Prints results to a terminal: a summary, the next command, then tables of at most 80 columns."""

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
        for table in (item for item in objects if isinstance(item, Table)):
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
        """Raises BrokenPipeError, which the program handles. The method of rich would end the process."""
        raise BrokenPipeError

    def _width_of(self, table: Table, folded: bool = False) -> int:
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


def print_answer(console: Console, answer: str, next_step: str | None, style: str = "green") -> None:
    """Prints the result of a command and the suggested next step.

    Args:
        console: Console to print to.
        answer: Result in one or two sentences.
        next_step: Next step, usually a command. The line is not wrapped, so that a user can copy the command. None if
            there is no next step.
        style: Style of the answer.
    """
    console.print(answer, style=style, markup=False)
    if next_step is not None:
        console.print(f"Next: {next_step}", markup=False, soft_wrap=True)
    console.print()


def print_note(console: Console, text: str) -> None:
    """Prints an explanation below a table, then an empty line."""
    console.print(f"{text}\n", style="dim", markup=False, width=min(console.width, TABLE_WIDTH))


def make_table(title: str, *columns: str) -> Table:
    """Returns an empty table with a bold title. The first column is left-aligned, all others are right-aligned."""
    # Without these options, a title that is wider than the table would be wrapped.
    text = Text(title, style="bold", no_wrap=True, overflow="ignore")
    table = Table(title=text, title_justify="left", box=None, pad_edge=False, expand=False)
    for i, column in enumerate(columns):
        # Only the first column, which can contain long names, is folded. Text() prevents markup in [units].
        table.add_column(Text(column), justify="left" if i == 0 else "right", no_wrap=i > 0, overflow="fold")
    return table
