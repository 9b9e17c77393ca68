"""Runs commands in the background of a notebook and ends them with the notebook."""

from __future__ import annotations

import atexit
import ctypes
import os
import re
import shlex
import signal
import socket
import subprocess
import tempfile
import textwrap
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

#: Time limit for a condition [s]. A busy computer needs a multiple of the usual time.
LIMIT = 120.0
#: Width of printed lines, in characters.
WIDTH = 88
#: Rates and delays in a line of a process. They depend on the load of the computer that builds the page.
_FIGURES = re.compile(r"; \d+ (Hz, round trip|of \d+ steps) .*")
_PR_SET_PDEATHSIG = 1
_LIBC = ctypes.CDLL(None)


class Background:
    """Command that runs in the background.

    It ends with the Python process that started it: at the exit of Python, and also if Python is killed (Linux).
    """

    def __init__(self, command: str) -> None:
        """Starts a command, for example "dvrk-drake sim-arm --arm mtml"."""
        self.command = command
        self._folder = tempfile.TemporaryDirectory()
        self._log, self._shown = Path(self._folder.name) / "output", 0
        with self._log.open("w") as output:
            self._process = subprocess.Popen(
                shlex.split(command),
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
                start_new_session=True,
                preexec_fn=_end_with_parent,  # noqa: PLW1509 - it calls only prctl
            )
        atexit.register(self._kill)

    @property
    def pid(self) -> int:
        """Number of the process."""
        return self._process.pid

    def is_running(self) -> bool:
        """Returns whether the process is running."""
        return self._process.poll() is None

    def show(self) -> None:
        """Prints the output since the last call, without rates and delays."""
        output = self._log.read_text()
        for line in output[self._shown :].splitlines():
            line = _FIGURES.sub("; ...", line)  # noqa: PLW2901
            print(textwrap.fill(line, WIDTH, subsequent_indent="    ", drop_whitespace=False, break_on_hyphens=False))
        self._shown = len(output)

    def wait_for(self, text: str, show: bool = True) -> None:
        """Waits until the output since the last call of `show` contains `text`. Prints this output if `show` is True.

        Raises:
            RuntimeError: The process ended before, or the time limit expired.
        """
        wait_until(lambda: text in self._log.read_text()[self._shown :] or not self.is_running(), text)
        found = text in self._log.read_text()[self._shown :]
        if show:
            self.show()
        if not found:
            raise RuntimeError(f"{self.command} ended with exit code {self._process.returncode}")

    def end(self, number: int = signal.SIGINT) -> int:
        """Sends a signal, waits for the end of the process, prints its output, and returns its exit code."""
        if self.is_running():
            os.kill(self.pid, number)
        try:
            code = self._process.wait(LIMIT)
        finally:
            self._kill()
        self.show()
        return code

    def _kill(self) -> None:
        if self.is_running():
            with suppress(ProcessLookupError):
                os.killpg(self.pid, signal.SIGKILL)
            self._process.wait(LIMIT)


def own_network() -> None:
    """Selects a free port for the LCM messages of this notebook, which stay on this computer."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("", 0))
        port = free.getsockname()[1]
    os.environ["LCM_DEFAULT_URL"] = f"udpm://239.255.76.67:{port}?ttl=0"


def start_controller(command: str) -> Background:
    """Starts a controller, waits until its efforts act, and prints its output.

    On a busy computer, the guard may stop it. Then this function tries again.
    """
    for _ in range(20):
        controller = Background(command)
        try:
            controller.wait_for("effort;", show=False)
        except RuntimeError:
            command = command.removesuffix(" --reset") + " --reset"
        else:
            controller.show()
            return controller
    raise RuntimeError(f"{command} does not reach the state effort")


def wait_until(condition: Callable[[], bool], what: str) -> None:
    """Waits until a condition holds.

    Raises:
        TimeoutError: The time limit expired.
    """
    end = time.monotonic() + LIMIT
    while not condition():
        if time.monotonic() > end:
            raise TimeoutError(f"not within {LIMIT:g} s: {what}")
        time.sleep(0.02)


def _end_with_parent() -> None:
    """Makes the kernel kill this process when the thread that started it ends."""
    _LIBC.prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
