"""Reads the rows of CSV files with their line numbers, and writes tables of numbers as CSV files."""

from __future__ import annotations

import codecs
import csv
import gzip
import io
import itertools
import math
import re
import zlib
from array import array
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.errors import RecordingError
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.files import atomic_write, open_input

#: Size of the blocks in which a file is read [bytes], and maximum number of characters of a line.
_BLOCK, _MAX_LINE = 1 << 20, 1 << 20
#: Number of bytes at the beginning of a text that must not contain a null byte.
_HEAD = 4096
#: Beginning of a file that is compressed with gzip.
_GZIP_MAGIC = b"\x1f\x8b"
#: Maximum size of a file whose rows are kept as text [bytes].
_MAX_ROWS = 64_000_000
#: Maximum number of rows of numbers, i.e. 15 min at 1 kHz. With this number of rows, `check` needs 1.5 GB of memory.
MAX_COUNT = 900_000
#: Number of lines between two reports of progress, and number of rows that are parsed at once.
_REPORT, _CHUNK = 1000, 2000


class CsvFile(NamedTuple):
    """CSV file: UTF-8 with or without a byte-order mark, or UTF-16 with one; it may be compressed with gzip.

    Lines end in LF, CRLF or CR. Each iteration reads the file from its beginning in blocks, so that a large file needs
    little memory.

    Attributes:
        path: Path of the file.
        progress: Callback that receives the completed fraction (0 to 1).
    """

    path: Path
    progress: Callable[[float], object] = lambda share: None

    def rows(self, after: int = 0) -> Iterator[tuple[int, list[str]]]:
        """Iterates over line number and unmodified cells of the rows that are not blank and end after a line.

        Raises:
            RecordingError: The file cannot be read, is not text, or its cells are not separated by commas.
        """
        reader, is_first = csv.reader(self.lines(), strict=True), after == 0
        try:
            for cells in reader:
                if reader.line_num <= after or not any(cell.strip() for cell in cells):
                    continue
                if is_first and not is_comment(cells):
                    self._check_commas(reader.line_num, cells)
                    is_first = False
                yield reader.line_num, cells
        except csv.Error as error:
            raise RecordingError(f"{self.path}, line {reader.line_num}: invalid CSV: {error}") from error

    def lines(self) -> Iterator[str]:
        """Iterates over the lines, which end in LF.

        Raises:
            RecordingError: The file cannot be read, is not text, or a line is too long.
        """
        with open_input(self.path, RecordingError) as file:
            size = max(1, file.seek(0, io.SEEK_END))
            file.seek(0)
            try:
                is_compressed = file.read(len(_GZIP_MAGIC)) == _GZIP_MAGIC
                file.seek(0)
                content = io.BufferedReader(gzip.GzipFile(fileobj=file) if is_compressed else file, _BLOCK)
                start = content.peek(_HEAD)[:_HEAD]
                is_utf16 = start.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
                if b"\0" in start and not is_utf16:
                    raise RecordingError(
                        f"{self.path}: unknown format; allowed: CSV (also compressed with gzip), ROS bag, MATLAB file, "
                        "NumPy archive, cisst collector, LCM log"
                    )
                encoding = "utf-16" if is_utf16 else "utf-8-sig"
                text = io.TextIOWrapper(content, encoding)
                for number, line in enumerate(iter(partial(text.readline, _MAX_LINE + 1), "")):
                    if len(line) > _MAX_LINE:
                        raise RecordingError(f"{self.path}: invalid CSV: a line has more than {_MAX_LINE} characters")
                    if number % _REPORT == _REPORT - 1:
                        self.progress(file.tell() / size)
                    yield line
                self.progress(1.0)
            except UnicodeDecodeError as error:
                at = content.tell() - len(error.object) + error.start
                name = encoding.removesuffix("-sig").upper()
                raise RecordingError(f"{self.path} is not a {name} text file: {error.reason} at byte {at}") from error
            except (OSError, EOFError, zlib.error) as error:
                reason = getattr(error, "strerror", None) or f"damaged or incomplete gzip file ({error})"
                raise RecordingError(f"{self.path} cannot be read: {reason}") from error

    def _check_commas(self, line: int, cells: list[str]) -> None:
        if len(cells) == 1 and re.search(r"[;\s]", cells[0].strip()):
            raise RecordingError(
                f"{self.path}, line {line}: the first row has no comma. Separate cells by commas and use a point as "
                "the decimal separator."
            )


def is_comment(cells: Sequence[str]) -> bool:
    """Returns whether a row is a comment, i.e. its first character is #."""
    return cells[0].lstrip().startswith("#")


def read_rows(path: Path) -> list[tuple[int, list[str]]]:
    """Returns (line number, stripped cells) of all rows that are not blank.

    The required memory is about 15 times the file size. Use `read_numbers` for large files of numbers.

    Raises:
        RecordingError: The file cannot be read, is too large, is not text, or its cells are not separated by commas.
    """
    open_input(path, RecordingError, _MAX_ROWS).close()
    return [(line, [cell.strip() for cell in cells]) for line, cells in CsvFile(path).rows()]


class NumberRows(NamedTuple):
    """Numbers of selected columns.

    Attributes:
        blocks: Mapping from the name of a block to its numbers (m, k).
        lines: Line number (m,) of each row.
        rows: Index (m,) of each row among all rows, including the skipped rows.
        notes: Note on skipped rows, or ().
    """

    blocks: dict[str, NDArray[np.float64]]
    lines: NDArray[np.int_]
    rows: NDArray[np.int_]
    notes: tuple[str, ...]


def read_numbers(
    file: CsvFile,
    header: Sequence[str],
    blocks: Mapping[str, Sequence[int]],
    *,
    after: int = 0,
    skip_invalid: bool = False,
    header_name: str = "the header",
) -> NumberRows:
    """Reads the numbers of selected columns.

    Args:
        file: File with the numbers.
        header: Name of each column.
        blocks: Mapping from the name of a block to the indices of its columns.
        after: Number of the last line of the header.
        skip_invalid: Whether to skip and note rows with an empty cell, a NaN or an infinity.
        header_name: Source of `header`, for messages.

    Raises:
        RecordingError: A row has another number of cells than the header, a cell is not a finite number, there is no
            row, or there are too many rows.
    """
    columns = sorted({column for block in blocks.values() for column in block})
    lines, table = _read_table(file, header, columns, after, skip_invalid, header_name)
    rows = np.flatnonzero(np.all(np.isfinite(table), axis=1))
    if not len(rows):
        raise RecordingError(
            f"{file.path} has " + ("no row of finite numbers" if len(lines) else "a header but no rows")
        )
    skipped, notes = np.delete(lines, rows), tuple[str, ...]()
    if len(skipped):
        numbers = f"{len(skipped)} of {len(lines)} rows skipped (empty, NaN or infinite)"
        notes = (f"{numbers}: lines {listed(skipped)}",)
    return NumberRows(
        {name: table[np.ix_(rows, np.searchsorted(columns, block))] for name, block in blocks.items()},
        lines[rows],
        rows,
        notes,
    )


def _read_table(
    file: CsvFile, header: Sequence[str], columns: Sequence[int], after: int, skip_invalid: bool, header_name: str
) -> tuple[NDArray[np.int_], NDArray[np.float64]]:
    """Returns the line numbers (m,) and the numbers (m, k) of the rows of a file, see `read_numbers`.

    If `skip_invalid` is True, the numbers may be NaN or infinite, and an empty cell is NaN.

    Raises:
        RecordingError: See `read_numbers`.
    """
    lines, numbers = array("q"), array("d")

    def check_count() -> None:
        if len(lines) > MAX_COUNT:
            raise RecordingError(
                f"{file.path}, line {lines[MAX_COUNT]}: the file has more than {MAX_COUNT} rows. Split the recording."
            )

    def plain_rows() -> Iterator[tuple[int, str]]:
        for line, text in enumerate(file.lines(), 1):
            if line > after and not text.isspace():
                if text.count(",") != len(header) - 1 or '"' in text:
                    raise ValueError
                yield line, text

    rows, rest = plain_rows(), iter(list[tuple[int, list[str]]]())
    try:
        while chunk := list(itertools.islice(rows, _CHUNK)):
            texts = [text for _, text in chunk]
            part = np.loadtxt(texts, delimiter=",", comments=None, usecols=columns, ndmin=2)
            if not (skip_invalid or np.all(np.isfinite(part))):
                raise ValueError
            lines.extend(line for line, _ in chunk)
            numbers.frombytes(part.tobytes())
            check_count()
    except ValueError:
        rest = file.rows(lines[-1] if lines else after)
    # This loop takes four times as long. It explains a fault, and reads rows with quotes.
    parse = parse_or_nan if skip_invalid else parse_finite
    for line, cells in rest:
        where = f"{file.path}, line {line}"
        if len(cells) != len(header):
            raise RecordingError(f"{where}: the row has {len(cells)} cells, {header_name} has {len(header)}")
        lines.append(line)
        check_count()
        numbers.extend(parse(cells[column].strip(), f"{where}: {header[column]}") for column in columns)
    return np.frombuffer(lines, np.int64), np.frombuffer(numbers).reshape(len(lines), len(columns))


def listed(numbers: Iterable[int]) -> str:
    """Returns a text with the first ten numbers, separated by commas."""
    texts = list(map(str, numbers))
    return ", ".join(texts if len(texts) <= 10 else [*texts[:10], "..."])


def is_number(cell: str) -> bool:
    """Returns whether a cell is a number, which may be NaN or infinite."""
    # Python's float() also accepts 1_000, which no other program writes or reads as a number.
    if "_" in cell:
        return False
    try:
        float(cell)
    except ValueError:
        return False
    return True


def parse_or_nan(cell: str, where: str) -> float:
    """Returns the number in a cell, which may be NaN or infinite, or NaN for an empty cell.

    Args:
        cell: Text of the cell.
        where: Beginning of the error message, e.g. "file, line 2: column".

    Raises:
        RecordingError: The cell is not a number.
    """
    if cell and not is_number(cell):
        raise RecordingError(f"{where} is not a number: {cell[:30]!r}")
    return float(cell or "nan")


def parse_finite(cell: str, where: str) -> float:
    """Returns the number in a cell as `parse_or_nan` does; NaN, infinity and an empty cell are errors."""
    value = parse_or_nan(cell, where)
    if not math.isfinite(value):
        raise RecordingError(f"{where} is {cell}; only finite numbers are allowed" if cell else f"{where} is empty")
    return value


#: Units of the quantities in a CSV, for a revolute and for a prismatic joint.
UNITS = {
    "t": ("s", "s"),
    **dict.fromkeys(("q", "pose"), ("rad", "m")),
    "qd": ("rad/s", "m/s"),
    **dict.fromkeys(("force", "force_lower", "force_upper"), ("N", "N")),
    **dict.fromkeys(("tau", "lower", "upper", "lower_other_day", "upper_other_day", "friction"), ("N m", "N")),
}


def column_names(prefix: str, num_joints: int, arm: Arm | None = None) -> list[str]:
    """Returns the column names of a quantity in a CSV, e.g. "q1". With `arm`, they contain the units, e.g. "q1 [rad]".

    Args:
        prefix: Name of the quantity, a key of `UNITS` if `arm` is given.
        num_joints: Number of columns, except for the time t.
        arm: Arm that defines which joints are prismatic.
    """
    names = ["t"] if prefix == "t" else [f"{prefix}{i + 1}" for i in range(num_joints)]
    if arm is None:
        return names
    return [f"{name} [{UNITS[prefix][bool(arm.prismatic[i])]}]" for i, name in enumerate(names)]


def write_csv(
    path: str | Path, blocks: Mapping[str, NDArray[np.float64]], arm: Arm | None, stated: Mapping[str, str]
) -> None:
    """Writes a table of numbers atomically and with full precision.

    Args:
        path: Path of the file. An existing file is replaced.
        blocks: Mapping from the prefix of the columns (key of `UNITS`) to their numbers (m, n), or (m,) for the time t.
        arm: Arm that defines the units of the columns. None: the names of the columns have no units.
        stated: Mapping from the names of further columns to the text in each of their rows. Empty texts are omitted.

    Raises:
        DvrkDrakeError: The folder does not exist or cannot be written.
    """
    tables = {prefix: block if block.ndim == 2 else block[:, None] for prefix, block in blocks.items()}
    stated = {name: text for name, text in stated.items() if text}
    header = [name for prefix, table in tables.items() for name in column_names(prefix, table.shape[1], arm)]
    with atomic_write(path) as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow([*header, *stated])
        writer.writerows([*map(repr, row), *stated.values()] for row in np.hstack(list(tables.values())).tolist())
