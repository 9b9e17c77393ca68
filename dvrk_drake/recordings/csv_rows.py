"""Reads rows of CSV files with line numbers, and appends complete rows to a file."""

from __future__ import annotations

import codecs
import csv
import gzip
import hashlib
import io
import math
import os
import re
import zlib
from array import array
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from io import FileIO
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.errors import RecordingError
from dvrk_drake.models.files import open_input, read_input

#: Size of the blocks in which a CSV is read, and maximum number of characters of a line.
_BLOCK, _MAX_LINE = 1 << 20, 1 << 20
#: Beginning of a file that is compressed with gzip.
GZIP_MAGIC = b"\x1f\x8b"
#: Maximum size of a file whose rows are kept as text [bytes].
_MAX_ROWS = 64_000_000
#: Maximum number of rows of numbers, i.e. 15 min at 1 kHz. With this number of rows, `check` needs 1.5 GB of memory.
MAX_COUNT = 900_000


def read_bytes(path: Path) -> bytes:
    """Returns the content of a file.

    Raises:
        RecordingError: The file does not exist, cannot be read, or is too large.
    """
    return read_input(path, RecordingError)


class CsvReader:
    """Reads the rows of a CSV file in blocks, so that a large file needs little memory.

    The file is UTF-8 with or without a byte-order mark, or UTF-16 with one, and may be compressed with gzip. Lines end
    in LF, CRLF or CR. Iteration yields (line number, unmodified cells) of the rows that are not blank. A new iteration
    continues after the last row that was read.

    Attributes:
        path: Path of the file.
        has_underscore: Whether the text read so far contains an underscore. Python accepts underscores in numbers, but
            `is_number` does not.
    """

    def __init__(self, path: Path, progress: Callable[[float], object] = lambda share: None) -> None:
        """Opens the file at `path`. `progress` is called with the completed fraction (0 to 1).

        Raises:
            RecordingError: The file cannot be read.
        """
        self.path = path
        self._file = _HashedFile(open_input(path, RecordingError), progress)
        self._blocks, self._block, self._num_fast = self._read_blocks(), io.StringIO(), 0
        self._reader = csv.reader(self._lines(), strict=True)
        self._is_first = True
        self.has_underscore = False

    def __enter__(self) -> CsvReader:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def __iter__(self) -> Iterator[tuple[int, list[str]]]:
        """Iterates over rows. Raises RecordingError if the file is not text or cells are not separated by commas."""
        reader = self._reader
        try:
            for cells in reader:
                if not any(cells) or not any(cell.strip() for cell in cells):
                    continue
                if self._is_first and not is_comment(cells):
                    self._check_commas(cells)
                yield self._line, cells
        except csv.Error as error:
            raise RecordingError(f"{self.path}, line {self._line}: invalid CSV: {error}") from error

    def next_numbers(self, width: int, columns: Sequence[int]) -> tuple[int, NDArray[np.float64]] | None:
        """Reads the next rows if their format is simple, which is several times faster than the iteration.

        Args:
            width: Number of cells of each row.
            columns: Columns to read (k), without repetition.

        Returns:
            Line number of the first row, and numbers (m, k) of rows without blank lines. None at the end of the file,
            or if a row has quotes, another number of cells, or a selected cell that is not a finite number. The
            iteration then yields these rows.
        """
        text = self._block.read() or next(self._blocks, "")
        rows = text.replace("\r\n", "\n").removesuffix("\n").split("\n")
        table = None
        if not (text.isspace() or '"' in text or any(row.count(",") != width - 1 for row in rows)):
            # A carriage return without a line feed is not a number either.
            with suppress(ValueError):
                table = np.loadtxt(rows, delimiter=",", comments=None, usecols=columns, ndmin=2)
        if table is None or not np.all(np.isfinite(table)):
            self._block = io.StringIO(text, newline="")
            return None
        first = self._line + 1
        self._num_fast += len(rows)
        return first, table

    def sha256(self) -> str:
        """Returns the SHA-256 of the file; valid after all rows have been read."""
        return self._file.digest.hexdigest()

    @property
    def _line(self) -> int:
        """Number of the line that was read last."""
        return self._reader.line_num + self._num_fast

    def _check_commas(self, cells: list[str]) -> None:
        self._is_first = False
        if len(cells) == 1 and re.search(r"[;\s]", cells[0].strip()):
            raise RecordingError(
                f"{self.path}, line {self._line}: the first row has no comma. Separate cells by commas "
                "and use a point as the decimal separator."
            )

    def _lines(self) -> Iterator[str]:
        while True:
            while line := self._block.readline():
                yield line
            if not (block := next(self._blocks, "")):
                return
            self._block = io.StringIO(block, newline="")

    def _read_blocks(self) -> Iterator[str]:
        """Yields text of complete lines, which is not empty."""
        decoder, rest, num_read, is_start = None, "", 0, True
        while True:
            try:
                block = self._file.read(_BLOCK if decoder else max(_BLOCK, len(codecs.BOM_UTF16)))
            except (OSError, EOFError, zlib.error) as error:
                text = getattr(error, "strerror", None) or f"damaged or incomplete gzip file ({error})"
                raise RecordingError(f"{self.path} cannot be read: {text}") from error
            if decoder is None:
                encoding = "utf-16" if is_utf16(block) else "utf-8"
                decoder = codecs.getincrementaldecoder(encoding)()
            undecoded = len(decoder.getstate()[0])
            try:
                text = decoder.decode(block, final=not block)
            except UnicodeDecodeError as error:
                at = num_read - undecoded + error.start
                raise RecordingError(
                    f"{self.path} is not a {encoding.upper()} text file: {error.reason} at byte {at}"
                ) from error
            if is_start and text:
                text, is_start = text.removeprefix("\ufeff"), False
            text = rest + text
            num_read += len(block)
            # Use complete lines only; a CR at the end may be the first half of a CRLF.
            end = max(text.rfind("\n"), text.rfind("\r", 0, -1)) + 1 if block else len(text)
            whole, rest = text[:end], text[end:]
            if len(rest) > _MAX_LINE:
                raise RecordingError(f"{self.path}: invalid CSV: a line has more than {_MAX_LINE} characters")
            self.has_underscore = self.has_underscore or "_" in whole
            if whole:
                yield whole
            if not block:
                return


class _HashedFile:
    """File whose content is decompressed if it is a gzip file. The digest is that of the compressed content."""

    def __init__(self, file: FileIO, progress: Callable[[float], object]) -> None:
        self.digest = hashlib.sha256()
        self._file, self._progress = file, progress
        self._size, self._num_read = max(1, os.fstat(file.fileno()).st_size), 0
        try:
            is_compressed = file.read(len(GZIP_MAGIC)) == GZIP_MAGIC
        except OSError:  # `read` reports the same error
            is_compressed = False
        file.seek(0)
        self.read: Callable[[int], bytes] = self._read_raw
        if is_compressed:
            self.read = gzip.GzipFile(fileobj=_Source(self._read_raw)).read  # type: ignore[call-overload]

    def _read_raw(self, size: int = -1) -> bytes:
        block = self._file.read(size)
        self.digest.update(block)
        self._num_read += len(block)
        self._progress(min(1.0, self._num_read / self._size))
        return block

    def close(self) -> None:
        self._file.close()


class _Source(NamedTuple):
    """Object with the method of a file that `gzip` needs."""

    read: Callable[[int], bytes]


def is_utf16(start: bytes) -> bool:
    """Returns whether a text begins with the byte-order mark of UTF-16."""
    return start.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))


def is_comment(cells: Sequence[str]) -> bool:
    """Returns whether a row is a comment, i.e. its first character is #."""
    return cells[0].lstrip().startswith("#")


def read_rows(path: Path) -> tuple[list[tuple[int, list[str]]], str]:
    """Returns (line number, stripped cells) of all rows that are not blank, and the SHA-256 of the file.

    The required memory is about 15 times the file size. Use `CsvReader` for large files of numbers.

    Raises:
        RecordingError: The file cannot be read, is too large, is not text, or its cells are not separated by commas.
    """
    open_input(path, RecordingError, _MAX_ROWS).close()
    with CsvReader(path) as reader:
        rows = [(line, [cell.strip() for cell in cells]) for line, cells in reader]
        return rows, reader.sha256()


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
    reader: CsvReader,
    header: Sequence[str],
    blocks: Mapping[str, Sequence[int]],
    *,
    skip_invalid: bool = False,
    first: Iterable[tuple[int, list[str]]] = (),
    header_name: str = "the header",
) -> NumberRows:
    """Reads the numbers of selected columns in all remaining rows.

    Args:
        reader: Open file, after its header.
        header: Name of each column.
        blocks: Mapping from the name of a block to the indices of its columns.
        skip_invalid: Whether to skip and note rows with an empty cell, a NaN or an infinity.
        first: Rows (line number, cells) that were already read.
        header_name: Source of `header`, for messages.

    Raises:
        RecordingError: A row has another number of cells than the header, a cell is not a finite number, there is no
            row, or there are too many rows.
    """
    path = reader.path
    skipped, values, lines = array("q"), {name: array("d") for name in blocks}, array("q")
    parts = [(values[name], columns) for name, columns in blocks.items()]
    width, used = len(header), sorted({column for columns in blocks.values() for column in columns})

    def too_long(line: int) -> RecordingError:
        return RecordingError(f"{path}, line {line}: the file has more than {MAX_COUNT} rows. Split the recording.")

    def append(rows: Iterable[tuple[int, list[str]]]) -> None:
        for line, cells in rows:
            if len(cells) != width:
                raise RecordingError(f"{path}, line {line}: the row has {len(cells)} cells, {header_name} has {width}")
            if len(lines) == MAX_COUNT:
                raise too_long(line)
            if skip_invalid and not all(
                math.isfinite(parse_or_nan(cells[column].strip(), f"{path}, line {line}: {header[column]}"))
                for column in used
            ):
                skipped.append(line)
                continue
            lines.append(line)
            has_underscore = reader.has_underscore and any("_" in cells[column] for column in used)
            for part, columns in parts:
                try:
                    numbers = [float(cells[column]) for column in columns]
                    valid = math.isfinite(sum(numbers)) and not has_underscore
                except ValueError:
                    valid = False
                if not valid:
                    numbers = [
                        parse_finite(cells[column].strip(), f"{path}, line {line}: {header[column]}")
                        for column in columns
                    ]
                part.extend(numbers)

    append(first)
    while (found := reader.next_numbers(width, used)) is not None:
        begin, table = found
        if len(lines) + len(table) > MAX_COUNT:
            raise too_long(begin + MAX_COUNT - len(lines))
        lines.extend(range(begin, begin + len(table)))
        for part, columns in parts:
            part.frombytes(table[:, np.searchsorted(used, columns)].tobytes())
    append(reader)
    if not lines:
        raise RecordingError(f"{path} has " + ("no row of finite numbers" if skipped else "a header but no rows"))
    kept, left_out = np.frombuffer(lines, np.int64), np.frombuffer(skipped, np.int64)
    return NumberRows(
        {name: np.frombuffer(part).reshape(len(lines), len(blocks[name])) for name, part in values.items()},
        kept,
        np.searchsorted(np.union1d(kept, left_out), kept),
        (skipped_note(left_out, len(lines) + len(skipped)),) if skipped else (),
    )


def listed(numbers: Iterable[int]) -> str:
    """Returns a text with the first ten numbers, separated by commas."""
    texts = list(map(str, numbers))
    return ", ".join(texts if len(texts) <= 10 else [*texts[:10], "..."])


def skipped_note(skipped: NDArray[np.int_], count: int) -> str:
    """Returns a note on the skipped lines of a file with `count` rows."""
    return f"{len(skipped)} of {count} rows skipped (empty, NaN or infinite): lines {listed(skipped)}"


def is_number(cell: str) -> bool:
    """Returns whether `parse_number` accepts `cell`."""
    # Python's float() also accepts 1_000, which no other program writes or reads as a number.
    if "_" in cell:
        return False
    try:
        float(cell)
    except ValueError:
        return False
    return True


def parse_number(cell: str, where: str) -> float:
    """Returns the number in `cell`, which may be NaN or infinite.

    Args:
        cell: Text of the cell.
        where: Beginning of the error message, e.g. "file, line 2: column".

    Raises:
        RecordingError: The cell is not a number.
    """
    if not is_number(cell):
        raise RecordingError(f"{where} is empty" if not cell else f"{where} is not a number: {cell[:30]!r}")
    return float(cell)


def parse_or_nan(cell: str, where: str) -> float:
    """Returns the number in `cell` as `parse_number` does, or NaN for an empty cell."""
    return parse_number(cell, where) if cell else float("nan")


def parse_finite(cell: str, where: str) -> float:
    """Returns the number in `cell` as `parse_number` does; NaN and infinity are errors."""
    value = parse_number(cell, where)
    if not np.isfinite(value):
        raise RecordingError(f"{where} is {cell}; only finite numbers are allowed")
    return value


class GrowingFile:
    """File to which rows are appended, each by one unbuffered write.

    Written rows survive the termination of the process. With `sync` they also survive a power failure.
    """

    def __init__(self, path: str | Path, *, resume: bool = False, sync: bool = False) -> None:
        """Creates a new file. With `resume`, opens an existing file and removes an incomplete last line.

        Args:
            path: Path of the file.
            resume: Whether to continue an existing file.
            sync: Whether to wait for the disk after each row, which may take many milliseconds.

        Raises:
            RecordingError: The file cannot be written, or it exists although `resume` is False.
        """
        self._path, self._sync = path, sync
        try:
            self._file = open(path, "r+b" if resume else "xb", buffering=0)  # noqa: SIM115
            if resume:
                self._file.truncate(self._file.read().rfind(b"\n") + 1)
                self._file.seek(0, os.SEEK_END)
        except OSError as error:
            raise RecordingError(f"{path} cannot be written: {error.strerror}") from error

    def append(self, row: bytes) -> None:
        """Writes one row.

        Raises:
            RecordingError: The row cannot be written; the file ends with the previous row.
        """
        end = self._file.tell()
        try:
            written = self._file.write(row)
            if self._sync:
                os.fsync(self._file.fileno())
        except OSError as error:
            raise RecordingError(
                f"{self._path} cannot be written: {error.strerror}. The file ends with its last complete row."
            ) from error
        if written != len(row):
            self._file.truncate(end)
            self._file.seek(end)
            raise RecordingError(
                f"{self._path} cannot be written: no space left. The file ends with its last complete row."
            )

    @property
    def size(self) -> int:
        """Size of the file [bytes]."""
        return self._file.tell()

    def truncate(self, size: int) -> None:
        """Removes all rows after the first `size` bytes."""
        self._file.truncate(size)
        self._file.seek(size)

    def close(self, progress: Callable[[float], object] = lambda share: None) -> None:
        """Closes the file. `progress` is not called, because the file is already complete."""
        self._file.close()
