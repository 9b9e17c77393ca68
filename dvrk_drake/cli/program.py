"""The program behind the command line: parses the arguments and runs a verb.

Verbs import what they need when they run: drake and numba take seconds, `--help` should not.
"""

from __future__ import annotations

import argparse
import os
import signal
import sys
from collections.abc import Sequence
from importlib.metadata import version
from typing import NoReturn

from dvrk_drake.cli import collect, demo, export, identify, lcm, model, recordings, simulate
from dvrk_drake.cli.support import folders_only_for_results, import_interruptibly
from dvrk_drake.errors import DvrkDrakeError

# Matrices are small here: more threads of BLAS only wait for each other, for minutes where the cores are busy. Said
# before numpy is imported, which the verbs do.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")


def run(arguments: Sequence[str] | None) -> int:
    """Runs one verb; returns the exit code. Without `arguments` those of the process, which is then the verb's own."""
    options = _parser().parse_args(arguments)
    try:
        import_interruptibly()
        if arguments is None:
            signal.signal(signal.SIGINT, signal.default_int_handler)
        with folders_only_for_results():
            options.run(options)
    except DvrkDrakeError as error:
        _print_findings(error)
        print(f"dvrk-drake: error: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
    except BrokenPipeError:
        # The reader (head, less) has seen enough.
        sys.stderr.close()
        return 0
    except KeyboardInterrupt:
        print("dvrk-drake: interrupted", file=sys.stderr)
        return 130
    return 0


def _print_findings(error: DvrkDrakeError) -> None:
    """What `check` found in the recording that the error is about, on stdout."""
    if error.findings:
        from dvrk_drake.reports.terminal_tables import make_console

        console = make_console()
        for finding in error.findings:
            console.print(str(finding), style="yellow", markup=False, soft_wrap=True)


class _Parser(argparse.ArgumentParser):
    """Says what is wrong in one line, as everything else here does; usage is what --help is for."""

    def error(self, message: str) -> NoReturn:
        self.exit(2, f"{self.prog}: error: {message}; see {self.prog} --help\n")


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(
        prog="dvrk-drake", description="Model, identify, compensate and simulate da Vinci Research Kit arms with Drake."
    )
    parser.add_argument("--version", action="version", version=version("dvrk-drake"))
    verbs = parser.add_subparsers(required=True, metavar="VERB")
    for module in (model, recordings, identify, export, simulate, demo, lcm, collect):
        module.add_verbs(verbs)
    return parser
