"""Helpers of all commands: checks of outputs before the work begins, progress, and a clean Ctrl-C."""

from __future__ import annotations

import importlib
import json
import logging
import os
import signal
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING

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
from dvrk_drake.cli import leave
from dvrk_drake.errors import DvrkDrakeError, ModelError

if TYPE_CHECKING:
    from pydrake.geometry import Meshcat

    from dvrk_drake.analysis.check.findings import Finding
    from dvrk_drake.dynamics.identified_model import IdentifiedModel
    from dvrk_drake.models.arm import Arm
    from dvrk_drake.models.lcm_messages import MessageKey


def import_interruptibly() -> None:
    """Imports what all commands need such that Ctrl-C ends the process at once.

    Extension modules turn it into tracebacks. Nothing is half-written at that time. Where signals are not ours
    (a thread, a test) they are left alone.
    """
    # Together these import what the others do.
    modules = ("dvrk_drake.reports.identification",)
    if threading.current_thread() is not threading.main_thread() or sys.modules.keys() >= set(modules):
        return

    with interrupt_ends_process():
        for module in modules:
            importlib.import_module(module)


@contextmanager
def interrupt_ends_process() -> Iterator[None]:
    """Lets Ctrl-C end the process at once while the block runs, in which nothing is half-written.

    As an exception it may be lost: numba's compiler and extension modules call Python where no exception is passed on.
    A handler that the block installs stays, so that there is no time in between. In a thread this does nothing.
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


def quiet_drake() -> None:
    """Keeps Drake's remarks (Meshcat's address) off the terminal; its import sets the level, so this comes after."""
    logging.getLogger("drake").setLevel(logging.WARNING)


def load_key(path: str | None) -> MessageKey | None:
    """Returns the key in the file that --key names, or None.

    Raises:
        KeyFileError: it cannot be used.
    """
    from dvrk_drake.models.lcm_messages import MessageKey

    return None if path is None else MessageKey.load(path)


def check_output(path: str, *inputs: str, overwrite: bool) -> None:
    """Refuses, before work begins, an output that cannot be written, is one of the inputs, or exists already.

    Args:
        path: of the output.
        inputs: paths that are read.
        overwrite: an existing file is replaced: the user said so, or the command goes on with its own output.
    """
    target = Path(os.path.realpath(path))
    _refuse_twice(path)
    if not target.parent.is_dir():
        raise DvrkDrakeError(f"{path}: cannot be written: its folder does not exist")
    if os.path.exists(target) and not target.is_file():
        raise DvrkDrakeError(f"{path}: is not a regular file, so it cannot be replaced; name a file")
    try:
        if os.path.exists(target):
            os.close(os.open(target, os.O_WRONLY))
        with tempfile.TemporaryFile(dir=target.parent):
            pass
    except OSError as error:
        raise DvrkDrakeError(f"{path}: cannot be written: {error.strerror}") from error
    for given in inputs:
        if str(target) == os.path.realpath(given):
            raise DvrkDrakeError(f"{path}: is an input; name another file to write")
    if os.path.exists(target) and not overwrite:
        raise DvrkDrakeError(f"{path}: exists already; name another file, or replace it with --overwrite")


def _refuse_twice(path: str) -> None:
    """Refuses a second output of this command with the same name."""
    if (target := Path(os.path.realpath(path))) in _outputs:
        raise DvrkDrakeError(f"{path}: is named for two outputs; name another file or folder for one")
    _outputs.add(target)


#: Bars on a terminal at most; finished steps give way.
MAX_BARS = 6

#: Outputs of this command.
_outputs: set[Path] = set()
#: Folders that were made, each before the one that it is in.
_made: list[Path] = []


def new_folder(path: str, *, overwrite: bool) -> Path:
    """Makes the folder at `path`, and refuses one that holds something already.

    Args:
        path: of the folder.
        overwrite: files that are there may be replaced: the user said so.
    """
    _refuse_twice(path)
    folder = Path(path).absolute()
    missing = [place for place in (folder, *folder.parents) if not os.path.exists(place)]
    try:
        folder.mkdir(parents=True, exist_ok=True)
        filled = any(folder.iterdir())
    except OSError as error:
        raise DvrkDrakeError(f"{path}: cannot be made a folder: {error.strerror}") from error
    if filled and not overwrite:
        raise DvrkDrakeError(f"{path}: holds files already; name another folder, or write into it with --overwrite")
    _made[:0] = missing
    return Path(path)


def plots_folder(path: str | None, *, overwrite: bool) -> Path | None:
    """Makes the folder of an option --plots, if given, and imports what draws."""
    if path is None:
        return None
    with interrupt_ends_process():
        importlib.import_module("dvrk_drake.reports.figures.style")
    return new_folder(path, overwrite=overwrite)


def print_written(path: str | Path, what: str = "") -> None:
    """Prints that a file or folder was written; `what` says more about it."""
    print(f"wrote {path}{what and ': '}{what}", flush=True)


@contextmanager
def folders_only_for_results() -> Iterator[None]:
    """Where the block is left by an error or by Ctrl-C, the folders that it made and that are empty are gone again."""
    _made.clear()
    _outputs.clear()
    try:
        yield
    except BaseException:
        for folder in _made:
            with suppress(OSError):  # what is not empty stays
                folder.rmdir()
        raise


def until_stopped(meshcat: Meshcat, meanwhile: Callable[[], object] = lambda: None) -> None:
    """Serves a Meshcat page until its Stop button, Escape or Ctrl-C is pressed; calls `meanwhile` all the time."""
    meshcat.AddButton("Stop", "Escape")
    with suppress(KeyboardInterrupt):
        while meshcat.GetButtonClicks("Stop") == 0:
            meanwhile()
            time.sleep(0.03)


def load_model(model: str | None, arm: str | None) -> IdentifiedModel:
    """Returns the model of the file --model, or what the SDF of --arm states; one of them is given."""
    from dvrk_drake.models.arm import known_arms

    if model in known_arms():
        raise ModelError(f"{model} is an arm, not a model; name it with --arm {model}")
    if model is not None:
        return dvrk.IdentifiedModel.load(model)
    assert arm is not None
    return dvrk.IdentifiedModel.from_arm(dvrk.load_arm(arm))


def print_warnings(console: Console, warnings: Sequence[Finding]) -> None:
    """Prints one line per warning; those of results that look better than they are go to stderr."""
    for warning in warnings:
        if warning.kind in ("low-speed segments", "same recording", "other link"):
            print(f"dvrk-drake: {warning}", file=sys.stderr, flush=True)
        else:
            console.print(str(warning), style="yellow", markup=False, soft_wrap=True)


def write_json(path: str, content: object) -> None:
    """Writes the file of an option --json."""
    from dvrk_drake.models.files import atomic_write

    with atomic_write(path) as stream:
        json.dump(content, stream, indent=2)
        stream.write("\n")


def print_notes(path: str, notes: Sequence[str]) -> None:
    """Says on stderr what a user must know of a recording, a line each."""
    for note in notes:
        print(f"dvrk-drake: note: {path}: {note}", file=sys.stderr)


def mounted(arm: Arm, gravity: Sequence[float] | None) -> Arm:
    """The arm as --gravity says that it is mounted."""
    if gravity is None:
        return arm
    return arm.with_gravity(gravity)


class Steps:
    """Shows on stderr which step of a command runs: bars with the time left on a terminal, elsewhere a line per step.

    It is a `dvrk_drake.progress.Progress`. A step "fig5: releasing" is a part of the step "fig5".

    Args:
        first: name of the step that begins with the block.
        names: of the other steps.
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
            speed_estimate_period=600,  # a run of a study may take a minute
        )

    def __enter__(self) -> Steps:
        self._progress.start()
        self(self._names[0], 0.0)
        return self

    def __call__(self, step: str, share: float) -> None:
        """Shows a step and its finished share, 0..1."""
        if step not in self._tasks:
            self._begin(step)
        task = next(task for task in self._progress.tasks if task.id == self._tasks[step])
        if share > task.completed:  # of a step that comes again, the clock goes on
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
        if len(self._progress.tasks) >= MAX_BARS:
            oldest = next(iter(self._tasks))
            self._progress.remove_task(self._tasks.pop(oldest))
        self._tasks[step] = self._progress.add_task(text, total=None)

    def __exit__(self, *_: object) -> None:
        self._progress.stop()
