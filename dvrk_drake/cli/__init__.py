"""Command line of dvrk_drake. For invalid input, a command prints one line on stderr and returns exit code 2.

The imports of this module are fast, so that Ctrl-C prints one line instead of a traceback even during the start.
"""

from __future__ import annotations

import os
import signal
from collections.abc import Sequence


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs one command and returns the exit code, e.g. 0 for success and 2 for invalid input.

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
    """Signal handler that ends the process immediately. It is installed only while no file is partly written."""
    os.write(2, b"dvrk-drake: interrupted\n")
    os._exit(130)
