"""Runs a check in a forked process: with the state of this process, and if needed without root permissions."""

import os
import sys
import tempfile
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

NOBODY = 65534


@contextmanager
def public_folder() -> Iterator[Path]:
    """Yields a temporary folder that every user can access. Only root can access `tmp_path` of root."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        folder.chmod(0o777)
        yield folder


def run_forked(check: Callable[[], object]) -> None:
    """Calls `check` in a forked process, which has a copy of all objects. Fails if `check` fails."""

    def run() -> int:
        check()
        return 0

    code, printed = forked_program(run)
    print(printed)
    assert code == 0, printed


def forked_program(main: Callable[[], int]) -> tuple[int, str]:
    """Runs a program in a forked process, without the time for imports. Returns its exit code and its output."""
    with tempfile.TemporaryFile("w+") as output:
        pid = os.fork()
        if pid == 0:
            code = 1
            try:
                for number in (1, 2):
                    os.dup2(output.fileno(), number)
                sys.stdout = sys.stderr = output
                code = main()
            except SystemExit as error:
                code = error.code if isinstance(error.code, int) else 1
            except BaseException:
                traceback.print_exc()
            finally:
                with suppress(Exception):  # the program may have closed its output
                    output.flush()
                os._exit(code)
        code = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
        output.seek(0)
        return code, output.read()


def run_unprivileged(check: Callable[[], None]) -> None:
    """Calls `check` in a forked process, as user nobody if started by root. Fails if `check` fails."""

    def run() -> None:
        if os.geteuid() == 0:
            os.setgroups([])
            os.setgid(NOBODY)
            os.setuid(NOBODY)
        check()

    run_forked(run)
