"""Worker processes on this computer, for computations that take minutes."""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import sysconfig
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import BrokenExecutor, Executor, Future, ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from multiprocessing.connection import wait
from multiprocessing.reduction import ForkingPickler
from pathlib import Path
from types import ModuleType
from typing import Any, TypeVar

from dvrk_drake.errors import DvrkDrakeError

Result = TypeVar("Result")
#: Faster memory allocator, from the package libtcmalloc-minimal4 (Debian, Ubuntu) or gperftools-libs (Fedora).
TCMALLOC = "libtcmalloc_minimal.so.4"
_MAIN = "__main__"


@contextmanager
def local_executor(workers: int | None = None) -> Iterator[Executor]:
    """Provides worker processes on this computer, by default one per core.

    The workers end at the end of the `with` block. After an error, they end immediately. They also end if this process
    is killed. They do not import the main script, so the script needs no `if __name__ == "__main__":`. Submitted
    functions and arguments must therefore be defined in modules.

    Raises:
        DvrkDrakeError: A worker was killed. `submit` also raises this error for a function or an argument that is
            defined in the main script.
    """
    others = set(multiprocessing.active_children())
    executor = _SpawningExecutor(workers, multiprocessing.get_context("spawn"), _end_with_parent)
    try:
        yield executor
    except BrokenExecutor as error:
        raise DvrkDrakeError(
            "a worker process ended unexpectedly, e.g. for lack of memory. Close other programs and try again"
        ) from error
    except BaseException:
        for worker in set(multiprocessing.active_children()) - others:
            worker.terminate()
        raise
    finally:
        executor.shutdown(cancel_futures=True)


def await_results(futures: Sequence[Future[Result]], progress: Callable[[float], object]) -> list[Result]:
    """Returns the results of all futures in order, or raises the first error; reports the finished share."""
    for done, future in enumerate(as_completed(futures), start=1):
        future.result()
        progress(done / len(futures))
    return [future.result() for future in futures]


class _SpawningExecutor(ProcessPoolExecutor):
    """Process pool whose workers ignore Ctrl-C. Only the parent process ends them, so they print no tracebacks."""

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        if _MAIN.encode() in bytes(ForkingPickler.dumps((fn, args, kwargs))):
            raise DvrkDrakeError(
                f"{fn.__qualname__}: the function or an argument is defined in the main script, which worker processes "
                "do not import. Define it in a module"
            )
        with _start_of_workers():
            return super().submit(fn, *args, **kwargs)


@contextmanager
def _start_of_workers() -> Iterator[None]:
    """Sets what new processes inherit: the mask of signals, environment variables, and the main module."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    # Workers read these variables at their start. More BLAS threads per worker would compete for the cores.
    wanted = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", **_allocator_environment()}
    added = {name: value for name, value in wanted.items() if name not in os.environ}
    os.environ.update(added)
    # A spawned process runs the file of the module `__main__` again. Without `if __name__ == "__main__":`, this run
    # would try to start workers itself.
    main, sys.modules[_MAIN] = sys.modules[_MAIN], ModuleType(_MAIN)
    try:
        yield
    finally:
        sys.modules[_MAIN] = main
        for name in added:
            del os.environ[name]
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _allocator_environment() -> dict[str, str]:
    """Returns environment variables that select a faster memory allocator for new processes.

    The dict is empty if the user has already selected an allocator, or on systems other than Linux. Drake's solver
    allocates thousands of small blocks per step. tcmalloc or a larger cache of glibc makes the allocations faster.
    """
    if sys.platform != "linux" or {"LD_PRELOAD", "GLIBC_TUNABLES"} & set(os.environ):
        return {}
    if any((folder / TCMALLOC).exists() for folder in _library_folders()):
        return {"LD_PRELOAD": TCMALLOC}
    return {"GLIBC_TUNABLES": "glibc.malloc.tcache_count=2000"}


def _library_folders() -> list[Path]:
    return [Path("/usr/lib", sysconfig.get_config_var("MULTIARCH") or ""), Path("/usr/lib64")]


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None

    def watch() -> None:
        wait([parent.sentinel])
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
