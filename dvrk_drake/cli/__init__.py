"""The command line. Bad input gives one line on stderr and exit code 2.

Nothing is imported here that takes time, so that Ctrl-C ends the program in order as early as possible.
"""

from __future__ import annotations

import os
import signal
from collections.abc import Sequence


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs one command; returns the exit code: 0, or 2 for bad input.

    Without `arguments` those of the process are taken, and its handling of Ctrl-C.
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
    """Handles a signal by ending the process at once: where nothing is half-written."""
    os.write(2, b"dvrk-drake: interrupted\n")
    os._exit(130)
