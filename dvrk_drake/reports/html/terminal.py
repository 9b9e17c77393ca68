"""Collects what a terminal report prints as blocks of a page, so that each answer, table and note exists once."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

from rich import table as rich_table
from rich.text import Text as RichText

from dvrk_drake.reports.html.page import Block, Command, Section, Table, Text
from dvrk_drake.reports.terminal_tables import TableConsole

#: Level of a text by its style in the terminal.
_LEVELS = {"green": "good", "yellow": "warning", "red": "bad"}
_NEXT = "Next: "


@dataclass
class Printed:
    """Content of a terminal report.

    Attributes:
        answer: Result in one or two sentences.
        level: Level of the answer, see `Text`.
        next_step: Suggested next step, usually a command. "" if there is none.
        blocks: Tables with their notes, and texts.
    """

    answer: str = ""
    level: str = "plain"
    next_step: str = ""
    blocks: list[Block] = field(default_factory=list)

    @property
    def next_section(self) -> list[Section]:
        """Section with the next step, or nothing."""
        if not self.next_step:
            return []
        is_command = self.next_step.startswith("dvrk-drake ")
        return [Section("Next step", [Command(self.next_step) if is_command else Text(self.next_step)])]


class PageConsole(TableConsole):
    """Console that collects the output of one terminal report instead of printing it."""

    def __init__(self) -> None:
        super().__init__(highlight=False)
        self.printed = Printed()

    def print(self, *objects: Any, **options: Any) -> None:
        """Collects objects. The first text is the answer, and a dim text below a table is the note of this table."""
        for item in objects:
            if isinstance(item, rich_table.Table):
                self.printed.blocks.append(table_block(item))
            elif text := str(item).strip():
                self._add_text(text, options.get("style"))

    def _add_text(self, text: str, style: str | None) -> None:
        printed, level = self.printed, _LEVELS.get(style or "", "plain")
        last = printed.blocks[-1] if printed.blocks else None
        if not printed.answer:
            printed.answer, printed.level = text, level
        elif text.startswith(_NEXT):
            printed.next_step = text.removeprefix(_NEXT)
        elif style == "dim" and isinstance(last, Table) and not last.note:
            printed.blocks[-1] = replace(last, note=text)
        else:
            printed.blocks.append(Text(text, level))


def table_block(table: rich_table.Table) -> Table:
    """Converts a table for the terminal."""
    columns = [[RichText.from_markup(str(cell)).plain for cell in column.cells] for column in table.columns]
    return Table(
        [str(column.header) for column in table.columns],
        list(zip(*columns, strict=True)),
        caption=str(table.title or ""),
        right=[column.justify == "right" for column in table.columns],
    )


def printed_by(print_report: Callable[..., None], *arguments: Any, **options: Any) -> Printed:
    """Returns what a function `print_report(console, *arguments, **options)` prints."""
    console = PageConsole()
    print_report(console, *arguments, **options)
    return console.printed
