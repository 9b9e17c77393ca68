"""Runs a study: each case on some executor, each result into the table as it comes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import BrokenExecutor, CancelledError, Executor, Future, as_completed
from pathlib import Path

import numpy as np

from dvrk_drake.errors import StudyError
from dvrk_drake.experiments.scenario import Scenario
from dvrk_drake.experiments.simulation import simulate
from dvrk_drake.experiments.study.measures import Measure
from dvrk_drake.experiments.study.study_file import Case, Study
from dvrk_drake.experiments.study.table import ParquetStudyTable, Row, StudyTable

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
