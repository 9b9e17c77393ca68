"""Main program of the command line: parses the arguments and runs a command.

Commands import modules when they run, because Drake and numba take seconds to import and `--help` must be fast.
"""

from __future__ import annotations

import gc
import inspect
import os
import re
import signal
import sys
import warnings
from collections.abc import Sequence

from cyclopts import (
    CoercionError,
    CycloptsError,
    MissingArgumentError,
    UnknownCommandError,
    UnusedCliTokensError,
    ValidationError,
)

from dvrk_drake.cli import (  # noqa: F401, these modules add their commands to the application
    collect,
    control,
    excite,
    identify,
    model,
    recordings,
    simulate,
)
from dvrk_drake.cli.options import app
from dvrk_drake.cli.support import (
    command_words,
    folders_only_for_results,
    import_interruptibly,
    print_next_step,
    print_warning,
    suggest,
)
from dvrk_drake.errors import DvrkDrakeError

# The matrices are small. Several BLAS threads would mostly wait for each other: minutes on a busy computer.
# The variable must be set before numpy is imported, which happens in the commands.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")


def reflow_help() -> None:
    """Joins the lines of each paragraph and each option in the docstrings, so that help text fits to the terminal."""
    apps = [app]
    for each in apps:
        apps += [each[name] for name in each if not name.startswith("-")]
        if (function := each.default_command) and function.__doc__:
            text = inspect.cleandoc(function.__doc__)
            head, args, options = text.partition("\nArgs:\n")
            head = re.sub(r"(?<=\S)\n(?=\S)", " ", head)
            function.__doc__ = head + args + re.sub(r"\n {8,}", " ", options)


reflow_help()


def run(arguments: Sequence[str] | None) -> int:
    """Runs one command and returns the exit code. See `dvrk_drake.cli.main` for `arguments`."""
    words = sys.argv[1:] if arguments is None else list(arguments)
    try:
        command, bound, _ = app.parse_args(words, print_error=False, exit_on_error=False)
    except CycloptsError as error:
        print(_usage_error(error, words), file=sys.stderr)
        return 2
    command_words[:] = words
    try:
        if arguments is None:
            gc.disable()  # modules are never freed, and garbage collection takes a tenth of the import time
        if command.__module__.startswith("dvrk_drake."):  # not for --help and --version
            import_interruptibly()
        if arguments is None:
            gc.freeze()
            gc.enable()
            signal.signal(signal.SIGINT, signal.default_int_handler)
        with folders_only_for_results(), warnings.catch_warnings():
            warnings.showwarning = lambda message, *_, **__: print_warning(str(message))
            suggest("")
            try:
                command(*bound.args, **bound.kwargs)
            finally:
                print_next_step()
    except DvrkDrakeError as error:
        print(f"dvrk-drake: error: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
    except BrokenPipeError:
        # The reader of the output (e.g. head) closed the pipe. The exit code must not be 0, because the command may
        # have ended before it checked --require.
        sys.stderr.close()
        return 128 + signal.SIGPIPE
    except OSError as error:  # for example a full disk
        print(f"dvrk-drake: error: {error.filename or 'output'}: {error.strerror}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("dvrk-drake: interrupted", file=sys.stderr)
        return 130
    return 0


def _usage_error(error: CycloptsError, words: Sequence[str]) -> str:
    """Returns a usage error in one line."""
    name = " ".join(error.command_chain or [])
    options = {word.partition("=")[0] for word in words if word.startswith("--")}
    message = " ".join(str(error).split()).rstrip(".")
    if isinstance(error, UnknownCommandError):
        message = message.partition(" Available commands")[0].rstrip(".")
    elif isinstance(error, CoercionError):
        message = re.sub(r': unable to convert (".*") into float$', r": must be a number, not \1", message)
    elif isinstance(error, ValidationError):
        message = error.exception_message if error.group else re.sub(r"\. [Mm]ust", ": must", message)
    elif isinstance(error, UnusedCliTokensError):
        message = f"Unexpected argument: {' '.join(error.unused_tokens or [])}"
    elif isinstance(error, MissingArgumentError) and error.argument and error.argument.name in options:
        count, given = error.argument.token_count()[0], len(error.tokens_so_far)
        message = f"{error.argument.name} needs {f'{count} values, got {given}' if count > 1 else 'a value'}"
    elif isinstance(error, MissingArgumentError) and error.argument:
        suggestion = re.search(r"Did you mean .*", message)
        message = f"{error.argument.name} is required"
        # These options accept all following words.
        if not error.argument.name.startswith("-") and (long := sorted(options & {"--locked", "--arrays"})):
            message += f", before {' and '.join(long)}"
        if suggestion:
            message += f". {suggestion[0]}"
        elif error.argument.parameter.help:
            message += f": {error.argument.parameter.help.rstrip('.')}"
    see = " See" if message.endswith("?") else "; see"
    return f"dvrk-drake: error: {message}{see} {f'dvrk-drake {name}'.rstrip()} --help"
