"""Options of all commands that show a result: checks of the paths, printing, and the files."""

from __future__ import annotations

import importlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from dvrk_drake.cli.app import Overwrite, Verbose
from dvrk_drake.cli.support import (
    Steps,
    check_output,
    command_words,
    interrupt_ends_process,
    plots_folder,
    print_warnings,
    print_written,
    show_page,
    write_json,
)
from dvrk_drake.errors import DvrkDrakeError

if TYPE_CHECKING:
    from dvrk_drake.analysis.observations.finding import Finding
    from dvrk_drake.reports.page import Page

Report = Annotated[
    str | None, Parameter(metavar="FILE.html", help="Write a report, one HTML file that needs no network.")
]
Plots = Annotated[
    str | None, Parameter(metavar="FOLDER", help="Write figures into this folder, which must be new or empty.")
]
Json = Annotated[str | None, Parameter(metavar="FILE", help="Write the results as JSON.")]


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class Results:
    """Options of all commands that show a result on a page."""

    plots: Plots = None
    report: Report = None
    overwrite: Overwrite = False
    verbose: Verbose = False

    def check(self, *inputs: str | None, output: str | None = None) -> None:
        """Checks all output paths before work begins, and creates the folder of the plots.

        Args:
            inputs: Paths of the input files. None or "": there is none.
            output: Path of a further output. None: there is none.

        Raises:
            DvrkDrakeError: A path cannot be written, or is that of an input or of another output.
        """
        given = list(filter(None, inputs))
        for path in filter(None, (output, self._json)):
            check_output(path, *given, overwrite=self.overwrite)
        check_report(self.report, *given, overwrite=self.overwrite)
        plots_folder(self.plots, overwrite=self.overwrite)

    def show(
        self,
        page: Page,
        *inputs: str | None,
        content: object = None,
        note: str = "",
        warnings: Sequence[Finding] = (),
        saved: str | None = None,
    ) -> None:
        """Writes the JSON file, prints the page and the warnings, and writes the plots and the report.

        Args:
            page: Page of the result.
            inputs: Paths of the input files. None or "": there is none.
            content: Content of the JSON file.
            note: Note on the result to print. "": there is none.
            warnings: Warnings to print.
            saved: Path of an output that was written already. None: there is none.
        """
        from dvrk_drake.reports.terminal import make_console

        # Results are saved before printing, because the reader of the output (e.g. head) may close the pipe.
        if self._json is not None:
            write_json(self._json, content)
        show_page(page, verbose=self.verbose)
        console = make_console()
        if note:
            console.print(note)
        print_warnings(console, warnings)
        for path in filter(None, (saved, self._json)):
            print_written(path)
        write_page(page, self.plots, self.report, *filter(None, inputs))

    @property
    def _json(self) -> str | None:
        return getattr(self, "json", None)


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class ResultsAndJson(Results):
    """Options of the commands that also write their result as JSON."""

    json: Json = None


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


def write_page(page: Page, folder: Path | str | None, path: str | None, *inputs: str) -> None:
    """Writes the plots and the report of a page, and prints their paths.

    Args:
        page: Page of the result.
        folder: Folder of the plots, see `plots_folder`. None: no plots.
        path: Path of the report. None: no report.
        inputs: Paths of the input files.
    """
    if folder is not None:
        from dvrk_drake.reports.image_files import write_images

        if write_images(page, Path(folder)):
            print_written(folder)
    if path is not None:
        from dvrk_drake.reports.html_file import write_html

        with Steps("writing the report"):
            write_html(page, path, inputs, command_words)
        print_written(path, "report")
