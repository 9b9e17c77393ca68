"""Functions of all commands: checks of output paths, progress display, handling of Ctrl-C, and output of results."""

from __future__ import annotations

import importlib
import json
import logging
import math
import os
import shlex
import signal
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter
from rich.console import Console
from rich.progress import (
    BarColumn,
    Progress,
    TaskID,
    TaskProgressColumn,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

import dvrk_drake as dvrk
from dvrk_drake.cli import leave, options
from dvrk_drake.errors import DvrkDrakeError, ModelError

if TYPE_CHECKING:
    from pydrake.geometry import Meshcat

    from dvrk_drake.analysis.observations.finding import Finding
    from dvrk_drake.dynamics.identified_model import IdentifiedModel
    from dvrk_drake.models.arm import Arm
    from dvrk_drake.models.environment import Environment
    from dvrk_drake.models.lcm_messages import MessageKey
    from dvrk_drake.reports.page import Page
    from dvrk_drake.systems.driver import DvrkDriver


def import_interruptibly() -> None:
    """Imports the modules that all commands need, so that Ctrl-C during the import ends the process at once.

    Without this function, Ctrl-C prints a traceback while an extension module is imported. No file is partly written at
    that time.
    """
    with interrupt_ends_process():
        importlib.import_module("dvrk_drake.reports.identification")  # imports all slow modules
    # Importing Drake sets the log level.
    logging.getLogger("drake").setLevel(logging.WARNING)


@contextmanager
def interrupt_ends_process() -> Iterator[None]:
    """Context manager in which Ctrl-C ends the process at once. No file may be partly written in the block.

    A KeyboardInterrupt can be lost, because extension modules call Python code without propagating exceptions. A
    handler that the block installs is kept, so that signals are always handled. In a thread, the context manager has no
    effect.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, leave)
    try:
        yield
    finally:
        if signal.getsignal(signal.SIGINT) is leave:
            signal.signal(signal.SIGINT, before)


def load_key(path: str | None) -> MessageKey | None:
    """Returns the key from the file given with --key. Returns None without --key.

    Raises:
        KeyFileError: The key cannot be used.
    """
    from dvrk_drake.models.lcm_messages import MessageKey

    return None if path is None else MessageKey.load(path)


def check_output(path: str, *inputs: str, overwrite: bool, suffix: str = "") -> None:
    """Checks an output path before work begins. Rejects an existing file, an input file, and an unwritable path.

    Args:
        path: Path of the output.
        inputs: Paths of the inputs.
        overwrite: Accept an existing file, because of --overwrite or because the command continues its own output.
        suffix: Required end of the name. "": any.
    """
    target = Path(os.path.realpath(path))
    _refuse_twice(path)
    if not target.parent.is_dir():
        raise DvrkDrakeError(f"{path}: cannot be written: its folder does not exist")
    if os.path.exists(target) and not target.is_file():
        raise DvrkDrakeError(f"{path}: is not a regular file and cannot be replaced; give the path of a file")
    try:
        if os.path.exists(target):
            os.close(os.open(target, os.O_WRONLY))
        with tempfile.TemporaryFile(dir=target.parent):
            pass
    except OSError as error:
        raise DvrkDrakeError(f"{path}: cannot be written: {error.strerror}") from error
    for input_path in inputs:
        if str(target) == os.path.realpath(input_path):
            raise DvrkDrakeError(f"{path}: is an input file; choose another output file")
    if os.path.exists(target) and not overwrite:
        raise DvrkDrakeError(f"{path} already exists. Choose another file, or replace it with --overwrite.")
    if not path.lower().endswith(suffix):
        raise DvrkDrakeError(f"{path}: the name of the file must end in {suffix}")


def _refuse_twice(path: str) -> None:
    """Rejects a second output of the running command with the same path."""
    if (target := Path(os.path.realpath(path))) in _outputs:
        raise DvrkDrakeError(f"{path}: is given for two outputs; choose a different path for one of them")
    _outputs.add(target)


#: Words of the running command, without the name of the program.
command_words: list[str] = []
#: Paths of the outputs of the running command.
_outputs: set[Path] = set()
#: Next step after the running command.
_next_step = [""]
#: Folders that the running command created. Each folder precedes its parent.
_made: list[Path] = []


def new_folder(path: str, *, overwrite: bool) -> Path:
    """Creates the folder at `path`, and rejects a folder that is not empty.

    Args:
        path: Path of the folder.
        overwrite: Accept a folder with files, because of --overwrite.
    """
    _refuse_twice(path)
    folder = Path(path).absolute()
    missing = [parent for parent in (folder, *folder.parents) if not os.path.exists(parent)]
    try:
        folder.mkdir(parents=True, exist_ok=True)
        not_empty = any(folder.iterdir())
    except OSError as error:
        raise DvrkDrakeError(f"{path}: the folder cannot be created: {error.strerror}") from error
    if not_empty and not overwrite:
        raise DvrkDrakeError(f"{path}: folder is not empty; choose another folder, or write into it with --overwrite")
    _made[:0] = missing
    return Path(path)


def print_written(path: str | Path, what: str = "") -> None:
    """Prints the path of a file or folder that was written, followed by the description `what`."""
    print(f"wrote {path}{what and ': '}{what}", flush=True)


def command_again(*words: str) -> str:
    """Returns the command line of the running command with further words."""
    return shlex.join(["dvrk-drake", *command_words, *words])


def suggest(next_step: str) -> None:
    """Stores the next step, usually a command, which is printed after the command. "": there is none."""
    _next_step[0] = next_step


def print_next_step() -> None:
    """Prints the next step. The line is not wrapped, so that a user can copy it."""
    if _next_step[0]:
        print_line(f"Next: {_next_step[0]}")
    suggest("")


def show_page(page: Page, *, verbose: bool = False) -> None:
    """Prints a page, and stores its next step."""
    from dvrk_drake.reports.terminal import make_console, print_page

    print_page(make_console(), page, verbose=verbose)
    suggest(page.next_step)


def print_line(line: str) -> None:
    """Prints a line at once, also into a pipe."""
    print(line, flush=True)


@contextmanager
def folders_only_for_results() -> Iterator[None]:
    """Context manager that, after an error or Ctrl-C, removes the empty folders that were created in the block."""
    _made.clear()
    _outputs.clear()
    try:
        yield
    except BaseException:
        for folder in _made:
            with suppress(OSError):  # folders that are not empty are kept
                folder.rmdir()
        raise


def until_stopped(meshcat: Meshcat, update: Callable[[], object] = lambda: None) -> None:
    """Calls `update` repeatedly, and serves a Meshcat page until the Stop button, Escape or Ctrl-C is pressed."""
    meshcat.AddButton("Stop", "Escape")
    with suppress(KeyboardInterrupt):
        while meshcat.GetButtonClicks("Stop") == 0:
            update()
            time.sleep(0.03)


def load_model(model: str | None, arm: str | None) -> IdentifiedModel:
    """Returns the model of the file given with --model, or the nominal model of --arm."""
    from dvrk_drake.models.arm_files import known_arms

    if model in known_arms():
        raise ModelError(f"{model} is an arm, not a model; use --arm {model}")
    if model is not None:
        return dvrk.IdentifiedModel.load(model)
    assert arm is not None
    return dvrk.IdentifiedModel.from_arm(dvrk.load_arm(arm))


def print_warnings(console: Console, warnings: Sequence[Finding]) -> None:
    """Prints one line per warning. Warnings that concern the validity of the result are printed on stderr."""
    for warning in warnings:
        if warning.kind in ("same recording", "other link"):
            print(f"dvrk-drake: {warning}", file=sys.stderr, flush=True)
        else:
            console.print(str(warning), style="yellow", markup=False, soft_wrap=True)


def print_warning(text: str) -> None:
    """Prints a warning on standard error."""
    print(f"dvrk-drake: warning: {text}", file=sys.stderr, flush=True)


def driver_configuration(path: str | None, key: str | None, lcm_url: str) -> DvrkDriver:
    """Returns the configuration of a driver with the options of the command, and warns about a weaker guard.

    Args:
        path: File given with --driver. None: the default configuration.
        key: File given with --key, which replaces that of the configuration.
        lcm_url: URL given with --lcm-url, which replaces that of the configuration. "": LCM's default.

    Raises:
        DvrkDrakeError: The configuration is not valid, or the LCM network cannot be used.
    """
    from dvrk_drake.processes.simulated_arm import load_driver
    from dvrk_drake.systems.driver import DvrkDriver
    from dvrk_drake.systems.lcm.messages import usable_lcm_url

    driver = DvrkDriver() if path is None else load_driver(path)
    driver.key_file = key or driver.key_file
    for warning in driver.warnings():
        print_warning(warning)
    driver.lcm_url = usable_lcm_url(lcm_url or driver.lcm_url)
    return driver


def request_realtime(requested: bool) -> None:
    """Requests real-time scheduling because of --realtime, and prints what the system does not permit."""
    from dvrk_drake.processes.pace import make_realtime

    for warning in make_realtime() if requested else ():
        print_warning(warning)


def write_json(path: str, content: object) -> None:
    """Writes the file given with --json."""
    from dvrk_drake.models.files import atomic_write

    with atomic_write(path) as stream:
        json.dump(content, stream, indent=2)
        stream.write("\n")


def print_notes(path: str, notes: Sequence[str]) -> None:
    """Prints notes on a recording on stderr, one line per note."""
    for note in notes:
        print(f"dvrk-drake: note: {path}: {note}", file=sys.stderr)


def load_environment(table: float | None, path: str | None) -> Environment:
    """Returns the fixed objects given with --table and --environment.

    Raises:
        ExcitationError: The file cannot be read, or Drake cannot load it.
    """
    from dvrk_drake.models.environment import Environment

    return Environment(table) if path is None else Environment.load(path, table)


def mounted(arm: Arm, gravity: Sequence[float] | None, locked: Sequence[str] | None = None) -> Arm:
    """Returns the arm with the gravity vector given with --gravity and the locked joints given with --locked.

    Args:
        arm: Arm given with --arm.
        gravity: Gravity vector [m/s^2]. None: the vector in the arm file.
        locked: Arguments NAME=POSITION of --locked. None: no locked joints.

    Raises:
        DvrkDrakeError: The gravity vector or a locked joint is not valid.
    """
    if gravity is not None:
        arm = arm.with_gravity(gravity)
    form = f"NAME=POSITION [rad, m], e.g. {arm.joint_names[-1]}=0"
    return dvrk.lock_joints(arm, options.named("locked", locked or (), form, finite))


def finite(text: str) -> float:
    """Returns the number in a text. Raises ValueError if it is not finite."""
    if not math.isfinite(number := float(text)):
        raise ValueError
    return number


class Steps:
    """Shows the current step of a command on stderr.

    On a terminal, the class shows bars with the remaining time. Otherwise it prints one line per step.
    The class implements `dvrk_drake.progress.Progress`. A step "fig5: releasing" is part of the step "fig5".

    Args:
        first: Name of the first step, which starts at the beginning of the `with` block.
        names: Names of the other steps.
    """

    def __init__(self, first: str, *names: str):
        self._names, self._tasks = [first, *names], dict[str, TaskID]()
        console = Console(stderr=True)
        self._progress = Progress(
            TextColumn("{task.description}"),
            BarColumn(bar_width=20),
            TaskProgressColumn(),
            TimeElapsedColumn(),
            TextColumn("elapsed,"),
            TimeRemainingColumn(),
            TextColumn("left"),
            console=console,
            transient=True,
            disable=not console.is_terminal,
            speed_estimate_period=600,  # long, because one run of a study may take a minute
        )

    def __enter__(self) -> Steps:
        self._progress.start()
        self(self._names[0], 0.0)
        return self

    def __call__(self, step: str, share: float) -> None:
        """Shows a step and its finished share, 0 to 1."""
        if step not in self._tasks:
            self._begin(step)
        task = next(task for task in self._progress.tasks if task.id == self._tasks[step])
        if share > task.completed:  # a repeated step keeps its elapsed time
            self._progress.update(task.id, total=1.0, completed=share)

    def _begin(self, step: str) -> None:
        name = step.partition(": ")[0]
        if name not in self._names:
            self._names.append(name)
        count = len(self._names)
        text = f"{self._names.index(name) + 1} of {count}: {step}" if count > 1 else step
        if self._progress.disable:
            print(text, file=sys.stderr, flush=True)
        for task in self._progress.tasks:
            self._progress.update(task.id, total=1.0, completed=1.0)
        self._tasks[step] = self._progress.add_task(text, total=None)

    def __exit__(self, *_: object) -> None:
        self._progress.stop()


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
            check_output(path, *given, overwrite=self.overwrite)
        if self.report is not None:
            if not self.report.lower().endswith((".html", ".htm")):
                raise DvrkDrakeError(f"{self.report}: --report writes HTML; the name of the file must end in .html")
            check_output(self.report, *given, overwrite=self.overwrite)
        # Modules that the results need are imported before the work begins, so that Ctrl-C ends the import at once.
        with interrupt_ends_process():
            if self.report is not None:
                importlib.import_module("dvrk_drake.reports.html_file")
            if self.plots is not None:
                importlib.import_module("dvrk_drake.reports.image_files")
        if self.plots is not None:
            new_folder(self.plots, overwrite=self.overwrite)

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
        if self.plots is not None:
            from dvrk_drake.reports.image_files import write_images

            if write_images(page, Path(self.plots)):
                print_written(self.plots)
        if self.report is not None:
            from dvrk_drake.reports.html_file import write_html

            with Steps("writing the report"):
                write_html(page, self.report, list(filter(None, inputs)), command_words)
            print_written(self.report, "report")

    @property
    def _json(self) -> str | None:
        return getattr(self, "json", None)


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class ResultsAndJson(Results):
    """Options of the commands that also write their result as JSON."""

    json: Json = None
