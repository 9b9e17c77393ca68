"""Runs a study, on the cores of this computer or on a Dask cluster; each result goes into the table as it comes."""

from __future__ import annotations

import logging
import multiprocessing
import os
import re
import signal
import sys
import sysconfig
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import BrokenExecutor, CancelledError, Executor, Future, ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from multiprocessing.connection import wait
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from dvrk_drake.errors import StudyError
from dvrk_drake.experiments.scenario import Scenario
from dvrk_drake.experiments.simulation import simulate
from dvrk_drake.experiments.study.measures import Measure
from dvrk_drake.experiments.study.study_file import Case, Study, versions
from dvrk_drake.experiments.study.table import ParquetStudyTable, Row, StudyTable

if TYPE_CHECKING:
    from distributed import Client

Result = TypeVar("Result")
#: Called with the number of rows that are there, and the number of all cases.
Progress = Callable[[int, int], None]


def run_study(
    study: Study, executor: Executor, output: str | Path, progress: Progress = lambda done, all_cases: None
) -> dict[int, Row]:
    """Runs the cases that `output` does not have yet; the results do not depend on the executor, nor on interruptions.

    Args:
        study: what to run.
        executor: of the standard interface: threads, processes, a Dask client's `get_executor(pure=False)`. Its workers
            need this package, and the files that the scenario names.
        output: CSV file, or `.parquet`. See `StudyTable`. What is there of the same study is kept.
        progress: called at the start and for each row.

    Returns:
        The rows by the number of their case, all of them.

    Raises:
        StudyError: the study or the output are refused, or some cases could not be run because workers were lost: those
            that were run are in the output, and the same call goes on with the rest. Then its cause is the first loss.
        ScenarioError, ArmError, ModelError: the scenario, or one of its variations, is refused.
    """
    study.check()
    table_type = ParquetStudyTable if Path(output).suffix == ".parquet" else StudyTable
    futures: dict[Future[Row], Case] = {}
    losses: list[tuple[Case, BaseException]] = []
    with table_type(output, study) as table:
        todo = [case for case in study.cases if case.index not in table.rows]
        progress(len(table.rows), len(study.cases))
        try:
            for case in todo:
                futures[executor.submit(run_case, study.scenario_of(case), study.measures)] = case
            for future in as_completed(list(futures)):
                case = futures.pop(future)
                if loss := _loss(future):
                    losses.append((case, loss))
                else:
                    table.append(case, future.result())
                    progress(len(table.rows), len(study.cases))
        except BrokenExecutor as broken:  # by submit
            losses.append((case, broken))
        finally:
            for future in futures:
                future.cancel()
        if losses:
            case, error = losses[0]
            raise StudyError(
                f"{len(study.cases) - len(table.rows)} of {len(study.cases)} cases are missing: case {case.index}: "
                f"{type(error).__name__}: {error}; the others are in {output}; the same command goes on"
            ) from error
        table.sort()
        return table.rows


def _loss(future: Future[Row]) -> BaseException | None:
    return CancelledError("the workers were lost") if future.cancelled() else future.exception()


def run_case(scenario: Scenario, measures: Sequence[Measure]) -> Row:
    """Simulates a scenario and measures it; a simulation that diverges is a row too, with its error."""
    try:
        simulation = simulate(scenario)
    except (RuntimeError, ArithmeticError, ValueError) as error:  # what Drake and numpy raise
        return Row({}, " ".join(f"{type(error).__name__}: {error}".split()))
    lost = ~np.all(np.isfinite(np.hstack([simulation.state_true, simulation.recording.measured_effort()])), axis=1)
    if np.any(lost):
        return Row({}, f"diverged: not finite from {simulation.time[np.argmax(lost)]:g} s on")
    return Row({measure.column: measure(scenario, simulation) for measure in measures})


#: How often a pool is made again whose worker was killed (by the system where memory ends, say).
MAX_POOLS = 3
#: Google's allocator, as Debian's and Ubuntu's package libtcmalloc-minimal4 and Fedora's gperftools-libs install it.
TCMALLOC = "libtcmalloc_minimal.so.4"
#: How long a scheduler may take to answer, and to have its first worker [s].
TIMEOUT = 10


def run_study_locally(study: Study, output: str | Path, workers: int | None, progress: Progress) -> dict[int, Row]:
    """As `run_study` on this computer; where a worker is killed, what it and its pool left is run by another pool.

    Raises:
        StudyError: as `run_study`, or `MAX_POOLS` pools lost a worker.
    """
    for pool in range(MAX_POOLS):
        try:
            with local_executor(workers) as executor:
                return run_study(study, executor, output, progress)
        except StudyError as error:
            if not isinstance(error.__cause__, BrokenExecutor) or pool == MAX_POOLS - 1:
                raise
    raise AssertionError("unreachable")


@contextmanager
def local_executor(workers: int | None = None) -> Iterator[Executor]:
    """Processes of this computer, one a core by default; they end with the block, at once if it is left by an error.

    They are spawned, not forked: a script that uses this needs `if __name__ == "__main__":`. They also end when this
    process is killed.
    """
    # All this is read by a worker when it starts. More threads of BLAS in it would only wait for those of the others.
    for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
        os.environ.setdefault(variable, "1")
    os.environ.update(_allocator_environment())
    others = set(multiprocessing.active_children())
    executor = _SpawningExecutor(workers, multiprocessing.get_context("spawn"), _end_with_parent)
    try:
        yield executor
    except BaseException:
        for worker in set(multiprocessing.active_children()) - others:
            worker.terminate()
        raise
    finally:
        executor.shutdown(cancel_futures=True)


def await_results(futures: Sequence[Future[Result]], progress: Callable[[float], object]) -> list[Result]:
    """The results of all futures in their order, or the first error; `progress` is called with the finished share."""
    for done, future in enumerate(as_completed(futures), start=1):
        future.result()
        progress(done / len(futures))
    return [future.result() for future in futures]


def _allocator_environment() -> dict[str, str]:
    """Variables that give a new process a faster memory allocator; none where one is set, or on another system.

    Drake's solver allocates some thousand small blocks in every step: with glibc's allocator a third of a step. With
    tcmalloc, or glibc's with caches of more than 7 blocks of a size, it takes less.
    """
    if sys.platform != "linux" or {"LD_PRELOAD", "GLIBC_TUNABLES"} & set(os.environ):
        return {}
    if any((folder / TCMALLOC).exists() for folder in _library_folders()):
        return {"LD_PRELOAD": TCMALLOC}
    return {"GLIBC_TUNABLES": "glibc.malloc.tcache_count=2000"}


def _library_folders() -> list[Path]:
    return [Path("/usr/lib", sysconfig.get_config_var("MULTIARCH") or ""), Path("/usr/lib64")]


@contextmanager
def dask_executor(address: str) -> Iterator[Executor]:
    """The workers of the Dask scheduler at `address`, e.g. "tcp://192.168.0.5:8786"; the extra `dask`.

    The workers need this package in the same versions, and the files that the scenario names at the same paths. One
    thread each is best (`dask worker --nthreads 1`): simulations of one process wait for each other. The log of the
    client is silenced: what matters becomes a StudyError.

    Raises:
        StudyError: distributed is not installed, no scheduler answers there, or it has no workers or unfit ones.
    """
    if not re.fullmatch(r"tcp://\S+:\d+", address):
        raise StudyError(f'"{address}" is no address of a scheduler; allowed: tcp://HOST:PORT')
    try:
        from distributed import Client
    except ImportError as error:
        raise StudyError("--scheduler needs distributed: pip install 'dvrk-drake[dask]'") from error
    for logger in ("distributed", "distributed.client"):
        logging.getLogger(logger).setLevel(logging.CRITICAL)
    try:
        client = Client(address, timeout=TIMEOUT, set_as_default=False)
    except (OSError, ValueError, TypeError) as error:
        raise StudyError(f"{address}: no Dask scheduler answers there: {error}") from error
    with client:
        try:
            client.wait_for_workers(1, timeout=TIMEOUT)
        except TimeoutError as error:
            raise StudyError(f"{address}: the scheduler has no workers; start some: dask worker {address}") from error
        _check_workers(client)
        # What is pure would be computed once for all studies of the cluster, and kept.
        yield client.get_executor(pure=False)


def _check_workers(client: Client) -> None:
    try:
        found = client.run(versions)
    except ImportError as error:
        raise StudyError(f"the Dask workers cannot import dvrk_drake: {error}") from error
    for worker, theirs in found.items():
        if theirs != versions():
            raise StudyError(f"{worker}: has {theirs}, here is {versions()}; results would differ: install the same")


class _SpawningExecutor(ProcessPoolExecutor):
    """Its workers do not hear Ctrl-C: the process that they work for ends them, without their tracebacks."""

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})  # a process keeps its parent's mask
        try:
            return super().submit(fn, *args, **kwargs)
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None

    def watch() -> None:
        wait([parent.sentinel])
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
