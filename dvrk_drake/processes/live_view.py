"""Draws an arm as its status messages tell: `dvrk-drake view --live`, which `arm --meshcat` starts beside its loop."""

from __future__ import annotations

import contextlib
import ctypes
import signal
import subprocess
import sys
from collections.abc import Iterator

import numpy as np

from dvrk_drake.errors import ControllerError
from dvrk_drake.processes.control import ArmLink
from dvrk_drake.systems.arm_view import ArmView

#: Without a status for this long the last pose stays [s]: short enough for a page to close at once.
_TIMEOUT = 0.2


def show_status(view: ArmView, link: ArmLink) -> None:
    """Draws the pose of the newest status; where none comes, or it is not finite, the last one stays."""
    try:
        q = link.next_status(_TIMEOUT).position
    except ControllerError:
        return
    if np.all(np.isfinite(q)):
        view.show(q)


# Looked up before a fork, after which little is safe to do.
_prctl = getattr(ctypes.CDLL(None), "prctl", None)
_PR_SET_PDEATHSIG = 1


def _end_with_parent() -> None:
    if _prctl is not None:
        _prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)


@contextlib.contextmanager
def live_view(arm: str, url: str) -> Iterator[subprocess.Popen]:
    """`dvrk-drake view --live` of an arm (name or path), in a process that ends with the block.

    A process of its own, because a loop at 1 kHz that draws is late. On Linux it also ends if this one is killed.
    """
    command = [sys.executable, "-m", "dvrk_drake.cli", "view", "--arm", arm, "--live", "--lcm-url", url]
    viewer = subprocess.Popen(command, preexec_fn=_end_with_parent)  # noqa: PLW1509
    try:
        yield viewer
    finally:
        viewer.terminate()
        viewer.wait()
