"""What the verbs of the command line share: output that is checked first, a progress bar, a clean Ctrl-C."""

from __future__ import annotations

import argparse
import importlib
import json
import logging
import math
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
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from dvrk_drake.cli import leave
from dvrk_drake.errors import DvrkDrakeError

if TYPE_CHECKING:
    from pydrake.geometry import Meshcat

    from dvrk_drake.analysis.check.findings import Finding
    from dvrk_drake.dynamics.identified_model import IdentifiedModel
    from dvrk_drake.models.arm import Arm
    from dvrk_drake.models.lcm_messages import MessageKey


def import_interruptibly() -> None:
    """Imports what all verbs need such that Ctrl-C ends the process at once: extension modules turn it into tracebacks.

    Nothing is half-written at that time. Where signals are not ours (a thread, a test) they are left alone.
    """
    # Together these import what the others do.
    modules = ("dvrk_drake.reports.figures.demo", "dvrk_drake.reports.identification")
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


def add_key(verb: argparse.ArgumentParser) -> None:
    """Adds the option --key, for `load_key`."""
    verb.add_argument("--key", metavar="FILE", help="from dvrk-drake key, one for both sides: authenticates messages")


def load_key(path: str | None) -> MessageKey | None:
    """Returns the key in the file that --key names, or None.

    Raises:
        KeyFileError: it cannot be used.
    """
    from dvrk_drake.models.lcm_messages import MessageKey

    return None if path is None else MessageKey.load(path)


def add_overwrite(verb: argparse.ArgumentParser) -> None:
    """Adds the option --overwrite, for `check_output`."""
    verb.add_argument("--overwrite", action="store_true", help="replace output files that exist; default: refuse")


def check_output(path: str, *inputs: str, overwrite: bool) -> None:
    """Refuses, before work begins, an output that cannot be written, is one of the inputs, or exists already.

    Args:
        path: of the output.
        inputs: paths that are read.
        overwrite: an existing file is replaced: the user said so, or the command goes on with its own output.
    """
    target = Path(os.path.realpath(path))
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


#: Folders that were made, each before the one that it is in.
_made: list[Path] = []


def made_folder(path: str) -> Path:
    """The folder at `path`, made if it was not there."""
    folder = Path(path).absolute()
    missing = [place for place in (folder, *folder.parents) if not os.path.exists(place)]
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise DvrkDrakeError(f"{path}: cannot be made a folder: {error.strerror}") from error
    _made[:0] = missing
    return Path(path)


@contextmanager
def folders_only_for_results() -> Iterator[None]:
    """Where the block is left by an error or by Ctrl-C, the folders that it made and that are empty are gone again."""
    _made.clear()
    try:
        yield
    except BaseException:
        for folder in _made:
            with suppress(OSError):  # what is not empty stays
                folder.rmdir()
        raise


def until_stopped(meshcat: Meshcat, meanwhile: Callable[[], object] = lambda: None) -> None:
    """Serves a Meshcat page until its Stop button or Escape is pressed; `meanwhile` is called all the time."""
    meshcat.AddButton("Stop", "Escape")
    while meshcat.GetButtonClicks("Stop") == 0:
        meanwhile()
        time.sleep(0.03)


def seed(text: str) -> int:
    """A whole number from 0, for argparse."""
    if not text.isdigit():
        raise argparse.ArgumentTypeError(f'"{text}" is not a whole number from 0')
    return int(text)


def seconds(text: str) -> float:
    """A time above 0, for argparse."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not (math.isfinite(value) and value > 0):
        raise argparse.ArgumentTypeError(f'"{text}" is not a number of seconds above 0')
    return value


def load_model(name: str) -> IdentifiedModel:
    """Returns the model of a file, or what the SDF of an arm states; the arm by name or by its own file."""
    from dvrk_drake.dynamics.identified_model import IdentifiedModel
    from dvrk_drake.models.arm import known_arms, load_arm

    if name.lower() in known_arms() or _is_arm_file(name):
        return IdentifiedModel.from_arm(load_arm(name))
    return IdentifiedModel.load(name)


def _is_arm_file(name: str) -> bool:
    """An arm's YAML names its mechanism; a model's has no such field."""
    from dvrk_drake.models.files import read_text_input

    try:
        return any(line.startswith("mechanism:") for line in read_text_input(name, DvrkDrakeError).splitlines())
    except DvrkDrakeError:
        return False


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


def write_tables(path: str, print_to: Callable[[Console], object]) -> None:
    """Writes what `print_to` prints into a text file."""
    from dvrk_drake.models.files import atomic_write
    from dvrk_drake.reports.terminal_tables import WIDTH_OF_FILES, TableConsole

    with atomic_write(path) as stream:
        print_to(TableConsole(file=stream, highlight=False, width=WIDTH_OF_FILES))


def add_recording(verb: argparse.ArgumentParser) -> None:
    """Adds RECORDING and the option --coordinates."""
    verb.add_argument(
        "recording", metavar="RECORDING", help="CSV with header q1..qn, tau1..taun; t, qd1.. optional; or an LCM log"
    )
    verb.add_argument(
        "--coordinates", choices=("joint", "actuator"), default="joint", help="what q and tau are of; default: joint"
    )


def add_gravity(verb: argparse.ArgumentParser) -> None:
    """Adds the option --gravity."""
    verb.add_argument(
        "--gravity",
        nargs=3,
        type=float,
        metavar=("X", "Y", "Z"),
        help="gravity in the arm's base frame [m/s^2], for other mountings; default: the arm's file, 0 0 -9.81",
    )


def mounted(arm: Arm, gravity: list[float] | None) -> Arm:
    """The arm as --gravity says that it is mounted."""
    if gravity is None:
        return arm
    return arm.with_gravity(gravity)


class ProgressBar:
    """A progress bar of 0..100 on stderr, gone when the work is done; silent where stderr is no terminal."""

    def __init__(self, what: str):
        console = Console(stderr=True)
        self._progress = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
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
        self._task = self._progress.add_task(what, total=100)

    def __enter__(self) -> ProgressBar:
        self._progress.start()
        return self

    def __call__(self, step: str, share: float) -> None:
        """Shows a step and its finished share, 0..1; see `dvrk_drake.progress`."""
        self._progress.update(self._task, description=step, completed=100 * share)

    def share(self, share: float) -> None:
        """Shows the finished share of the step that is shown."""
        self._progress.update(self._task, completed=100 * share)

    def __exit__(self, *_: object) -> None:
        self._progress.stop()
