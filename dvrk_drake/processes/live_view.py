"""Draws an arm as its status messages tell: `dvrk-drake view --live`, which `arm --meshcat` starts beside its loop."""

from __future__ import annotations

import contextlib
import subprocess
import sys
from collections.abc import Iterator

import numpy as np

from dvrk_drake.errors import ControllerError
from dvrk_drake.processes.control import ArmLink
from dvrk_drake.systems.arm_view import ArmView

#: Without a status for this long the last pose stays [s]: short enough for a page to close at once.
_PATIENCE = 0.2


def show_status(view: ArmView, link: ArmLink) -> None:
    """Draws the pose of the newest status; where none comes, or it is not finite, the last one stays."""
    try:
        q = link.next_status(_PATIENCE).position
    except ControllerError:
        return
    if np.all(np.isfinite(q)):
        view.show(q)


@contextlib.contextmanager
def live_view(arm: str, url: str) -> Iterator[None]:
    """`dvrk-drake view --live` of an arm (name or path), in a process that ends with the block.

    A process of its own, because a loop at 1 kHz that draws is late.
    """
    command = [sys.executable, "-m", "dvrk_drake.cli", "view", arm, "--live", "--lcm-url", url]
    viewer = subprocess.Popen(command)
    try:
        yield
    finally:
        viewer.terminate()
        viewer.wait()
