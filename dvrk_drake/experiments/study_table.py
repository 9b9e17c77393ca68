"""Results of a study: file with one row per run, and summary. Interruptions do not damage the file."""

from __future__ import annotations

import csv
import fcntl
import io
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import IO

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.errors import RecordingError, StudyError
from dvrk_drake.experiments.study import Case, Study
from dvrk_drake.experiments.study_measures import Measure
from dvrk_drake.models.files import GrowingFile, atomic_write, read_input
from dvrk_drake.recordings.csv_files import column_names


@dataclass(frozen=True)
class Row:
    """Result of a run.

    Attributes:
        values: Values of the measures, by column; empty for a failed run.
        error: Error message in one line; empty unless the run failed.
    """

    values: Mapping[str, float | bool]
    error: str = ""


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
            StudyError: The file contains rows of another study, is not the table of a study, or is locked by another
                process.
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
        content, begin = read_input(self._path, RecordingError), _line(self._header)
        whole, tail = content[: content.rfind(b"\n") + 1], content[content.rfind(b"\n") + 1 :]
        if not whole and begin.startswith(tail):
            return {}  # new file, or interrupted while writing the header
        try:
            rows = list(csv.reader(io.StringIO(whole.decode(), newline=""), strict=True))
        except (UnicodeDecodeError, csv.Error):
            rows = []
        if not rows or rows[0][:2] != self._header[:2]:
            raise StudyError(
                f"{self._path}: the file exists and does not contain results of a study. Give another output."
            )
        header, *rows = rows
        found: dict[int, Row] = {}
        for line, cells in enumerate(rows, 2):
            where = f"{self._path}, line {line}"
            if header != self._header or cells[:1] != [self._study.fingerprint]:
                raise StudyError(
                    f"{where}: the results are from a different study, or the files of the study or "
                    "the installed versions have changed since then. Give another output."
                )
            if len(cells) != len(header) or not cells[1].isdigit() or int(cells[1]) >= len(self._study.cases):
                raise StudyError(f"{where}: the line is not a result of this study. Give another output.")
            if int(cells[1]) in found:
                raise StudyError(f"{where}: case {cells[1]} occurs twice. Give another output.")
            found[int(cells[1])] = self._row(cells, where)
        return found

    def _row(self, cells: list[str], where: str) -> Row:
        if cells[-1]:
            return Row({}, cells[-1])
        texts = cells[-1 - len(self._names) : -1]
        try:
            return Row({name: _value(text) for name, text in zip(self._names, texts, strict=True)})
        except ValueError as error:
            raise StudyError(f"{where}: {error}. Give another output.") from error


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


@dataclass(frozen=True)
class Share:
    """Share of runs in which a boolean measure is true.

    Attributes:
        count: Number of runs in which the measure is true.
        runs: Number of runs.
        lower, upper: Wilson's 95 % interval of the share, for independent runs.
    """

    count: int
    runs: int
    lower: float
    upper: float

    @classmethod
    def of(cls, count: int, runs: int) -> Share:
        """Computes the interval for `count` true values in `runs` runs."""
        from scipy.stats import binomtest  # takes 0.3 s

        interval = binomtest(count, runs).proportion_ci(method="wilson")
        return cls(count, runs, float(interval.low), float(interval.high))


@dataclass(frozen=True)
class Quantiles:
    """Median, 95th percentile and maximum of one measure over all runs. Failed runs count as infinite."""

    median: float
    percentile_95: float
    largest: float


@dataclass(frozen=True)
class Summary:
    """Summary of one variation.

    Attributes:
        variation: Name of the variation.
        runs, failed: Number of runs and of failed runs.
        measures: Summary of each measure, by column.
    """

    variation: str
    runs: int
    failed: int
    measures: dict[str, Share | Quantiles]


def summarise(study: Study, rows: Mapping[int, Row]) -> list[Summary]:
    """Returns one summary per variation that has cases in `rows`."""
    summaries = []
    for variation in study.variations:
        variation_rows = [rows[c.index] for c in study.cases if c.variation == variation.name and c.index in rows]
        if variation_rows:
            measures = {measure.column: _summary_of(measure, variation_rows) for measure in study.measures}
            summaries.append(
                Summary(variation.name, len(variation_rows), sum(bool(row.error) for row in variation_rows), measures)
            )
    return summaries


def values_of(measure: Measure, rows: list[Row]) -> NDArray[np.float64]:
    """Returns the value (m,) of each run; failed runs have the worst value."""
    return np.array([row.values.get(measure.column, measure.worst) for row in rows], float)


def _summary_of(measure: Measure, rows: list[Row]) -> Share | Quantiles:
    values = values_of(measure, rows)
    if measure.is_boolean:
        return Share.of(int(values.sum()), len(values))
    # Do not interpolate between runs, since values can be infinite.
    median, percentile_95 = np.quantile(values, [0.5, 0.95], method="inverted_cdf")
    return Quantiles(float(median), float(percentile_95), float(values.max()))
