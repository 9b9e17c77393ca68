"""Command line of dvrk_drake. Bad input gives one line on stderr and exit code 2.

This module imports nothing slow, so that Ctrl-C ends the program in order as early as possible.
"""

from __future__ import annotations

import os
import signal
from collections.abc import Sequence


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs one command and returns the exit code: 0, or 2 for bad input.

    Without `arguments`, the function uses the arguments of the process and installs a handler for Ctrl-C.
    """
    if arguments is None:
        signal.signal(signal.SIGINT, leave)
    from dvrk_drake.cli.program import run

    try:
        return run(arguments)
    finally:
        if arguments is None:
            signal.signal(signal.SIGINT, leave)


def leave(*_: object) -> None:
    """Signal handler that ends the process at once. It is installed only while no file is partly written."""
    os.write(2, b"dvrk-drake: interrupted\n")
    os._exit(130)
