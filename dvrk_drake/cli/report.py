"""Options of all commands that show a result: checks of the paths, printing, and the files."""

from __future__ import annotations

import importlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from dvrk_drake.cli import options, support
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
    overwrite: options.Overwrite = False
    verbose: options.Verbose = False

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
            support.check_output(path, *given, overwrite=self.overwrite)
        if self.report is not None:
            if not self.report.lower().endswith((".html", ".htm")):
                raise DvrkDrakeError(f"{self.report}: --report writes HTML; the name of the file must end in .html")
            support.check_output(self.report, *given, overwrite=self.overwrite)
        # Modules that the results need are imported before the work begins, so that Ctrl-C ends the import at once.
        with support.interrupt_ends_process():
            if self.report is not None:
                importlib.import_module("dvrk_drake.reports.html_file")
            if self.plots is not None:
                importlib.import_module("dvrk_drake.reports.image_files")
        if self.plots is not None:
            support.new_folder(self.plots, overwrite=self.overwrite)

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
            support.write_json(self._json, content)
        support.show_page(page, verbose=self.verbose)
        console = make_console()
        if note:
            console.print(note)
        support.print_warnings(console, warnings)
        for path in filter(None, (saved, self._json)):
            support.print_written(path)
        if self.plots is not None:
            from dvrk_drake.reports.image_files import write_images

            if write_images(page, Path(self.plots)):
                support.print_written(self.plots)
        if self.report is not None:
            from dvrk_drake.reports.html_file import write_html

            with support.Steps("writing the report"):
                write_html(page, self.report, list(filter(None, inputs)), support.command_words)
            support.print_written(self.report, "report")

    @property
    def _json(self) -> str | None:
        return getattr(self, "json", None)


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class ResultsAndJson(Results):
    """Options of the commands that also write their result as JSON."""

    json: Json = None
