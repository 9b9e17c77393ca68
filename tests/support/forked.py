"""Runs a check in a forked process: with the state of this process, and if needed without root permissions."""

import os
import tempfile
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

NOBODY = 65534


@contextmanager
def public_folder() -> Iterator[Path]:
    """Yields a temporary folder that every user can access. Only root can access `tmp_path` of root."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        folder.chmod(0o777)
        yield folder


def run_forked(check: Callable[[], None]) -> None:
    """Calls `check` in a forked process, which has a copy of all objects. Fails if `check` fails."""
    pid = os.fork()
    if pid == 0:
        try:
            check()
        except BaseException:
            traceback.print_exc()
            os._exit(1)
        os._exit(0)
    assert os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == 0


def run_unprivileged(check: Callable[[], None]) -> None:
    """Calls `check` in a forked process, as user nobody if started by root. Fails if `check` fails."""

    def run() -> None:
        if os.geteuid() == 0:
            os.setgroups([])
            os.setgid(NOBODY)
            os.setuid(NOBODY)
        check()

    run_forked(run)
