"""Option --report: checks of the path, and the HTML report with the command line in its provenance."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from dvrk_drake.cli.support import Steps, check_output, command_words, interrupt_ends_process, print_written
from dvrk_drake.errors import DvrkDrakeError

if TYPE_CHECKING:
    from dvrk_drake.reports.html.page import Page
    from dvrk_drake.reports.html.provenance import Provenance

Report = Annotated[
    str | None, Parameter(metavar="FILE.html", help="Write a report, one HTML file that needs no network.")
]


def check_report(path: str | None, *inputs: str, overwrite: bool) -> None:
    """Checks the path given with --report before work begins, and imports the page builder. None: does nothing.

    Args:
        path: Path of the report.
        inputs: Paths of the input files.
        overwrite: Accept an existing file, because of --overwrite.

    Raises:
        DvrkDrakeError: The path does not end in .html, or cannot be written.
    """
    if path is None:
        return
    if not path.lower().endswith((".html", ".htm")):
        raise DvrkDrakeError(f"{path}: --report writes HTML; the name of the file must end in .html")
    check_output(path, *inputs, overwrite=overwrite)
    with interrupt_ends_process():
        importlib.import_module("dvrk_drake.reports.html.page")


def write_page(path: str | None, make: Callable[[Provenance], Page], *inputs: str) -> None:
    """Writes the page that `make` returns for a provenance, shows progress, and prints the path. None: does nothing.

    Args:
        path: Path of the report.
        make: Function that returns the page.
        inputs: Paths of the input files.
    """
    from dvrk_drake.reports.html.provenance import Provenance

    if path is not None:
        with Steps("writing the report"):
            make(Provenance.of(inputs, command_words)).write(path)
        print_written(path, "report")
