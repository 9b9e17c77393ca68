"""Execution of a study in worker processes, and the table of its results, which interruptions do not damage."""

from __future__ import annotations

import csv
import fcntl
import io
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import BrokenExecutor, Executor, Future, as_completed
from dataclasses import dataclass
from pathlib import Path
from typing import IO

import numpy as np

from dvrk_drake.errors import RecordingError, SimulationError, StudyError
from dvrk_drake.experiments.scenario import Scenario
from dvrk_drake.experiments.simulation import simulate
from dvrk_drake.experiments.study import Case, Study
from dvrk_drake.experiments.study_measures import Measure
from dvrk_drake.models.files import GrowingFile, atomic_write, read_input
from dvrk_drake.recordings.csv_files import column_names
from dvrk_drake.workers import local_executor

#: Function called with the number of finished cases and the number of all cases.
Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class Row:
    """Result of a run.

    Attributes:
        values: Values of the measures, by column; empty for a failed run.
        error: Error message in one line; empty unless the run failed.
    """

    values: Mapping[str, float | bool]
    error: str = ""


def run_study(
    study: Study, executor: Executor, output: str | Path, progress: Progress = lambda done, all_cases: None
) -> dict[int, Row]:
    """Runs the cases that are not yet in `output`. The results depend neither on the executor nor on interruptions.

    Args:
        study: Study to run.
        executor: Executor of threads or processes.
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
            for future in as_completed(futures):
                if loss := future.exception():
                    losses.append((futures[future], loss))
                else:
                    table.append(futures[future], future.result())
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


class StudyTable:
    """Results of one study in a CSV file with a header and one row per run.

    Columns: study (fingerprint), case (number of the run), variation, pose (number of the start pose), seed (of the
    scenario), q1..qn (start pose [rad, m]), one column per measure (a number, inf, true or false), and error. The error
    is empty unless the run failed. The measures of a failed run are empty. Numbers have full precision.

    The table is a context manager. It locks the file against other processes.
    """

    def __init__(self, path: str | Path, study: Study) -> None:
        """Opens the table at `path`. The file is new or contains rows of the same study.

        Raises:
            StudyError: The file contains anything but rows of this study, or is locked by another process.
            RecordingError: The file cannot be read or written.
        """
        self._path, self._study = Path(path), study
        self._names = [measure.column for measure in study.measures]
        self._starts = column_names("q", study.arm.num_joints)
        self._header = ["study", "case", "variation", "pose", "seed", *self._starts, *self._names, "error"]
        self._lock = _lock(self._path)
        try:
            self.rows = self._read()
            self._file = GrowingFile(self._path, resume=True)
        except BaseException:
            self._lock.close()
            raise
        if not self._path.stat().st_size:
            self._file.append(_line(self._header))

    def __enter__(self) -> StudyTable:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()
        self._lock.close()

    def append(self, case: Case, row: Row) -> None:
        """Appends the row of a case that is not yet in the table.

        Raises:
            RecordingError: The row cannot be written. The earlier rows remain complete.
        """
        self._file.append(_line(self._cells(case, row)))
        self.rows[case.index] = row

    def sort(self) -> None:
        """Sorts the rows by the number of the case and replaces the file atomically."""
        with atomic_write(self._path, "wb") as stream:
            stream.write(_line(self._header))
            stream.writelines(_line(self._cells(case, self.rows[case.index])) for case in self._study.cases)

    def _cells(self, case: Case, row: Row) -> list[str]:
        key = [self._study.fingerprint, str(case.index), case.variation, str(case.pose), str(case.seed)]
        values = [_text(row.values[name]) if name in row.values else "" for name in self._names]
        return [*key, *map(repr, case.start), *values, row.error]

    def _read(self) -> dict[int, Row]:
        """Reads the complete rows of the file, by the number of the case."""
        content, header = read_input(self._path, RecordingError), _line(self._header)
        complete, line, rows = content[: content.rfind(b"\n") + 1], 1, dict[int, Row]()
        if not complete and header.startswith(content):
            return {}  # new file, or interrupted while writing the header
        try:
            if not complete.startswith(header):
                raise ValueError("another header")
            lines = csv.reader(io.StringIO(complete.decode(), newline=""), strict=True)
            for line, cells in enumerate(lines, 1):
                if line == 1:
                    continue  # header
                case, row = self._study.cases[int(cells[1])], self._row(cells)
                if cells != self._cells(case, row) or case.index in rows:
                    raise ValueError("no row of this case, or the second one")
                rows[case.index] = row
        except (ValueError, IndexError, csv.Error) as error:
            raise StudyError(
                f"{self._path}, line {line}: the file exists, and this line is not a result of this study with the "
                "present files and software versions. Give another output."
            ) from error
        return rows

    def _row(self, cells: list[str]) -> Row:
        if cells[-1]:
            return Row({}, cells[-1])
        texts = cells[-1 - len(self._names) : -1]
        return Row({name: _value(text) for name, text in zip(self._names, texts, strict=True)})


def _line(cells: list[str]) -> bytes:
    stream = io.StringIO()
    csv.writer(stream, lineterminator="\n").writerow(cells)
    return stream.getvalue().encode()


def _text(value: float | bool) -> str:
    return str(value).lower() if isinstance(value, bool) else repr(value)


def _value(text: str) -> float | bool:
    return text == "true" if text in ("true", "false") else float(text)


def _lock(path: Path) -> IO[bytes]:
    """Locks the file `path` until the returned stream is closed; creates the file if it does not exist."""
    try:
        file = open(path, "ab")  # noqa: SIM115
    except OSError as error:
        raise StudyError(f"{path}: cannot be written: {error.strerror}") from error
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        file.close()
        raise StudyError(
            f"{path}: another process is writing this file. Wait for it, or give another output."
        ) from error
    return file


def wilson_interval(count: int, runs: int) -> tuple[float, float]:
    """Returns Wilson's 95 % interval of the share count / runs, for independent runs."""
    from scipy.stats import binomtest  # takes 0.3 s

    interval = binomtest(count, runs).proportion_ci(method="wilson")
    return float(interval.low), float(interval.high)
