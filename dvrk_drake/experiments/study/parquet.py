"""The results of a study as a Parquet file, with pyarrow: the extra `parquet`."""

from __future__ import annotations

import dataclasses
from pathlib import Path

from dvrk_drake.errors import StudyError
from dvrk_drake.experiments.study.study_file import Study
from dvrk_drake.experiments.study.table import Row, StudyTable
from dvrk_drake.models.files import atomic_write

try:
    import pyarrow
    import pyarrow.parquet
except ImportError:
    pyarrow = None


class ParquetStudyTable(StudyTable):
    """A `StudyTable` whose end is a Parquet file with the same columns.

    A Parquet file cannot be read before its end is written. So rows go, as they come, into a CSV file beside it, whose
    name is the Parquet file's and `.rows.csv`; when all are there they become the Parquet file, and that one goes.
    """

    def __init__(self, path: str | Path, study: Study) -> None:
        """At `path`, which is new or was made by the same study.

        Raises:
            StudyError: as of a `StudyTable`, or pyarrow is not installed.
            RecordingError: it cannot be read or written.
        """
        if pyarrow is None:
            raise StudyError(f"{path}: Parquet needs pyarrow: pip install 'dvrk-drake[parquet]', or name a .csv")
        self._parquet = Path(path)
        finished = _finished_rows(self._parquet, study) if self._parquet.exists() else {}
        super().__init__(f"{path}.rows.csv", study)
        self.rows.update(finished)

    def sort(self) -> None:
        """Writes the Parquet file, in the order of the cases, at once or not at all."""
        content = []
        for case in self._study.cases:
            key = {"study": self._study.fingerprint, **dataclasses.asdict(case), "case": case.index}
            starts = {name: q for name, q in zip(self._starts, case.start, strict=True)}
            row = self.rows[case.index]
            content.append({**key, **starts, **row.values, "error": row.error or None})
        with atomic_write(self._parquet, "wb") as stream:
            pyarrow.parquet.write_table(pyarrow.Table.from_pylist(content, self._schema()), stream)
        self._path.unlink()

    def _schema(self) -> pyarrow.Schema:
        text, whole, number = pyarrow.string(), pyarrow.int64(), pyarrow.float64()
        types = {"study": text, "case": whole, "variation": text, "pose": whole, "seed": whole, "error": text}
        types |= {measure.column: pyarrow.bool_() if measure.is_answer else number for measure in self._study.measures}
        return pyarrow.schema([(name, types.get(name, number)) for name in self._header])


def _finished_rows(path: Path, study: Study) -> dict[int, Row]:
    """The rows of a finished study."""
    try:
        content = pyarrow.parquet.read_table(path).to_pylist()
    except (OSError, pyarrow.ArrowException) as error:
        raise StudyError(f"{path}: is there and is no table of a study; name another output") from error
    if {row.get("study") for row in content} != {study.fingerprint}:
        raise StudyError(f"{path}: was made by another study; name another output")
    names = [measure.column for measure in study.measures]
    return {row["case"]: Row({} if row["error"] else {n: row[n] for n in names}, row["error"] or "") for row in content}
