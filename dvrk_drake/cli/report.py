"""Options --plots and --report: checks of the path, and the files, with the command line in the provenance."""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from dvrk_drake.cli.support import Steps, check_output, command_words, interrupt_ends_process, print_written
from dvrk_drake.errors import DvrkDrakeError

if TYPE_CHECKING:
    from dvrk_drake.reports.page import Page

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
        importlib.import_module("dvrk_drake.reports.html_file")


def write_page(page: Page, folder: Path | None, path: str | None, *inputs: str) -> None:
    """Writes the plots and the report of a page, and prints their paths.

    Args:
        page: Page of the result.
        folder: Folder of the plots, see `plots_folder`. None: no plots.
        path: Path of the report. None: no report.
        inputs: Paths of the input files.
    """
    from dvrk_drake.reports.provenance import Provenance

    if folder is not None:
        from dvrk_drake.reports.image_files import write_images

        write_images(page, folder)
        print_written(folder)
    if path is not None:
        from dvrk_drake.reports.html_file import write_html

        with Steps("writing the report"):
            write_html(page, path, Provenance.of(inputs, command_words))
        print_written(path, "report")
