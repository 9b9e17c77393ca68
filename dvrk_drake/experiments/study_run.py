"""Execution of a study on the local cores or on a Dask cluster. Each result is written to the table immediately."""

from __future__ import annotations

import logging
import re
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import BrokenExecutor, CancelledError, Executor, Future, as_completed
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from dvrk_drake.errors import SimulationError, StudyError
from dvrk_drake.experiments.scenario import Scenario
from dvrk_drake.experiments.simulation import simulate
from dvrk_drake.experiments.study import Case, Study, versions
from dvrk_drake.experiments.study_measures import Measure
from dvrk_drake.experiments.study_table import Row, StudyTable
from dvrk_drake.workers import local_executor

if TYPE_CHECKING:
    from distributed import Client

#: Function called with the number of finished cases and the number of all cases.
Progress = Callable[[int, int], None]


def run_study(
    study: Study, executor: Executor, output: str | Path, progress: Progress = lambda done, all_cases: None
) -> dict[int, Row]:
    """Runs the cases that are not yet in `output`. The results depend neither on the executor nor on interruptions.

    Args:
        study: Study to run.
        executor: Executor of threads or processes, or a Dask client's `get_executor(pure=False)`. Its workers need
            this package and the files of the scenario.
        output: Path of a CSV file, see `StudyTable`. Existing rows of the same study are kept.
        progress: Function called at the start and after each run.

    Returns:
        All rows, by the number of the case.

    Raises:
        StudyError: The study or the output is invalid, or workers were lost. After a loss, the output contains the
            finished cases, and a repeated call runs the missing cases. The `__cause__` of the error is the exception of
            the first loss.
        ScenarioError, ArmError, ModelError: The scenario or one of its variations is invalid.
    """
    study.check()
    futures: dict[Future[Row], Case] = {}
    losses: list[tuple[Case, BaseException]] = []
    with StudyTable(output, study) as table:
        missing = [case for case in study.cases if case.index not in table.rows]
        progress(len(table.rows), len(study.cases))
        try:
            for case in missing:
                futures[executor.submit(run_case, study.scenario_of(case), study.measures)] = case
            for future in as_completed(list(futures)):
                case = futures.pop(future)
                if loss := _loss(future):
                    losses.append((case, loss))
                else:
                    table.append(case, future.result())
                    progress(len(table.rows), len(study.cases))
        except BrokenExecutor as broken:  # raised by submit
            losses.append((case, broken))
        finally:
            for future in futures:
                future.cancel()
        if losses:
            case, error = losses[0]
            raise StudyError(
                f"{len(study.cases) - len(table.rows)} of {len(study.cases)} cases are missing (case {case.index}: "
                f"{type(error).__name__}: {error}). {output} contains the finished cases. Repeat the command to run "
                "the missing ones."
            ) from error
        table.sort()
        return table.rows


def _loss(future: Future[Row]) -> BaseException | None:
    return CancelledError("the workers were lost") if future.cancelled() else future.exception()


def run_case(scenario: Scenario, measures: Sequence[Measure]) -> Row:
    """Simulates a scenario and computes its measures. If the simulation diverges, the row contains the error."""
    try:
        simulation = simulate(scenario)
    except SimulationError as error:
        return Row({}, str(error))
    not_finite = ~np.all(
        np.isfinite(np.hstack([simulation.state_true, simulation.recording.measured_effort()])), axis=1
    )
    if np.any(not_finite):
        return Row({}, f"diverged: not finite from {simulation.time[np.argmax(not_finite)]:g} s on")
    return Row({measure.column: measure(scenario, simulation) for measure in measures})


#: Maximum number of process pools. A pool is replaced if a worker was killed, e.g. for lack of memory.
MAX_POOLS = 3
#: Timeout of the connection to a scheduler, and of waiting for its first worker [s].
TIMEOUT = 10


def run_study_locally(study: Study, output: str | Path, workers: int | None, progress: Progress) -> dict[int, Row]:
    """Runs a study on this computer, see `run_study`. If a worker is killed, a new pool runs the missing cases.

    Raises:
        StudyError: See `run_study`. For killed workers, it is raised only if `MAX_POOLS` pools lost a worker.
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
def dask_executor(address: str) -> Iterator[Executor]:
    """Connects to the workers of a Dask scheduler, e.g. "tcp://192.168.0.5:8786". Requires the extra `dask`.

    The workers need the same software versions, and the files of the scenario at the same paths. Use one thread per
    worker (`dask worker --nthreads 1`), since simulations in one process block each other. The log of the client is
    disabled.

    Raises:
        StudyError: The package distributed is not installed, the scheduler cannot be reached, or it has no
            workers with the same software versions.
    """
    if not re.fullmatch(r"tcp://\S+:\d+", address):
        raise StudyError(f'"{address}" is not the address of a scheduler; allowed: tcp://HOST:PORT')
    try:
        from distributed import Client
    except ImportError as error:
        raise StudyError("--scheduler requires the package distributed. Run: pip install 'dvrk-drake[dask]'") from error
    for logger in ("distributed", "distributed.client"):
        logging.getLogger(logger).setLevel(logging.CRITICAL)
    try:
        client = Client(address, timeout=TIMEOUT, set_as_default=False)
    except (OSError, ValueError, TypeError) as error:
        raise StudyError(f"{address}: no Dask scheduler answers at this address: {error}") from error
    with client:
        try:
            client.wait_for_workers(1, timeout=TIMEOUT)
        except TimeoutError as error:
            raise StudyError(
                f"{address}: the scheduler has no workers. Start workers: dask worker {address}"
            ) from error
        _check_workers(client)
        # Dask would cache the results of pure functions and share them between studies.
        yield client.get_executor(pure=False)


def _check_workers(client: Client) -> None:
    try:
        found = client.run(versions)
    except ImportError as error:
        raise StudyError(f"the Dask workers cannot import dvrk_drake: {error}") from error
    for worker, worker_versions in found.items():
        if worker_versions != versions():
            raise StudyError(
                f"{worker}: the worker has {worker_versions}, this computer has {versions()}. Install the same "
                "versions."
            )
