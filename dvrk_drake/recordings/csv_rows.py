"""Rows of CSV files: read with line numbers, and appended one by one to a file that stays whole."""

from __future__ import annotations

import codecs
import csv
import hashlib
import io
import os
import re
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.errors import RecordingError
from dvrk_drake.models.files import open_input, read_input

#: A CSV is read in blocks of this size, and its lines have at most so many characters.
_BLOCK, _MAX_LINE = 1 << 20, 1 << 20
#: Largest file whose rows are kept as text [bytes].
_MAX_ROWS = 64_000_000


def read_bytes(path: Path) -> bytes:
    """Everything in a file.

    Raises:
        RecordingError: there is no such file, it cannot be read, or it is too large.
    """
    return read_input(path, RecordingError)


class CsvReader:
    """The rows of a CSV file, block by block, so that a large file needs little memory.

    UTF-8 with or without a byte-order mark; lines end in LF, CRLF or CR. Each iteration goes on where the one before
    stopped, and gives (line number, cells as they stand in the file) of rows that are not blank.

    Attributes:
        has_underscore: whether an underscore was read so far, which Python takes as a part of numbers.
    """

    def __init__(self, path: Path, progress: Callable[[float], object] = lambda share: None) -> None:
        """Of the file at `path`; `progress` is called with the share 0..1 that was read.

        Raises:
            RecordingError: the file cannot be read.
        """
        self._path, self._progress = path, progress
        self._file = open_input(path, RecordingError)
        self._digest = hashlib.sha256()
        self._reader = csv.reader(self._lines(), strict=True)
        self._is_first = True
        self.has_underscore = False

    def __enter__(self) -> CsvReader:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def __iter__(self) -> Iterator[tuple[int, list[str]]]:
        """Raises RecordingError if the file is not text, or its cells are not separated by commas."""
        reader = self._reader
        try:
            for cells in reader:
                if not any(cells) or not any(cell.strip() for cell in cells):
                    continue
                if self._is_first:
                    self._check_commas(cells)
                yield reader.line_num, cells
        except csv.Error as error:
            raise RecordingError(f"{self._path}:{reader.line_num}: not CSV: {error}") from error

    def sha256(self) -> str:
        """Of the file's bytes, when all rows have been read."""
        return self._digest.hexdigest()

    def _check_commas(self, cells: list[str]) -> None:
        self._is_first = False
        if len(cells) == 1 and re.search(r"[;\s]", cells[0].strip()):
            raise RecordingError(
                f"{self._path}:{self._reader.line_num}: no comma in the first row; cells must be separated by commas, "
                "with a point as the decimal sign"
            )

    def _lines(self) -> Iterator[str]:
        size = max(1, os.fstat(self._file.fileno()).st_size)
        decoder = codecs.getincrementaldecoder("utf-8")()
        num_read, rest, is_start = 0, "", True
        while True:
            try:
                block = self._file.read(_BLOCK)
            except OSError as error:
                raise RecordingError(f"{self._path}: cannot be read: {error.strerror}") from error
            self._digest.update(block)
            undecoded = len(decoder.getstate()[0])
            try:
                text = decoder.decode(block, final=not block)
            except UnicodeDecodeError as error:
                at = num_read - undecoded + error.start
                raise RecordingError(
                    f"{self._path}: not a CSV text file in UTF-8: {error.reason} at byte {at}"
                ) from error
            if is_start and text:
                text, is_start = text.removeprefix("\ufeff"), False
            text = rest + text
            num_read += len(block)
            # Whole lines; a CR at the end may be half of a CRLF.
            end = max(text.rfind("\n"), text.rfind("\r", 0, -1)) + 1 if block else len(text)
            whole, rest = text[:end], text[end:]
            if len(rest) > _MAX_LINE:
                raise RecordingError(f"{self._path}: not CSV: has a line of more than {_MAX_LINE} characters")
            self.has_underscore = self.has_underscore or "_" in whole
            yield from io.StringIO(whole, newline="")
            self._progress(min(1.0, num_read / size))
            if not block:
                return


def read_rows(path: Path) -> tuple[list[tuple[int, list[str]]], str]:
    """(line number, stripped cells) of every row that is not blank, and the SHA-256 of the file's bytes.

    Needs about 15 times the file's size as memory; for files of numbers that may be large see `CsvReader`.

    Raises:
        RecordingError: the file cannot be read, is too large, is not text, or its cells are not separated by commas.
    """
    open_input(path, RecordingError, _MAX_ROWS).close()
    with CsvReader(path) as reader:
        rows = [(line, [cell.strip() for cell in cells]) for line, cells in reader]
        return rows, reader.sha256()


def listed(numbers: Iterable[int]) -> str:
    """The first ten of them, in words."""
    texts = list(map(str, numbers))
    return ", ".join(texts if len(texts) <= 10 else [*texts[:10], "..."])


def skipped_note(skipped: NDArray[np.int_], count: int) -> str:
    """The note on the lines that were left out of `count` rows."""
    return f"{len(skipped)} of {count} rows skipped (empty, NaN or infinite): lines {listed(skipped)}"


def is_number(cell: str) -> bool:
    """Whether `parse_number` reads `cell`."""
    # Python's float() also reads 1_000, which no other program writes or reads as a number.
    if "_" in cell:
        return False
    try:
        float(cell)
    except ValueError:
        return False
    return True


def parse_number(cell: str, where: str) -> float:
    """The number in `cell`, NaN and infinities included.

    Args:
        cell: text.
        where: `file:line: column`, the start of the message.

    Raises:
        RecordingError: it is not a number.
    """
    if not is_number(cell):
        raise RecordingError(f"{where} is empty" if not cell else f"{where} is not a number: {cell[:30]!r}")
    return float(cell)


def parse_or_nan(cell: str, where: str) -> float:
    """As `parse_number`, but an empty cell is NaN."""
    return parse_number(cell, where) if cell else float("nan")


def parse_finite(cell: str, where: str) -> float:
    """As `parse_number`, but NaN and infinities are errors too."""
    value = parse_number(cell, where)
    if not np.isfinite(value):
        raise RecordingError(f"{where} is {cell}; only finite numbers are allowed")
    return value


class GrowingFile:
    """A file whose rows are one write of the operating system each, on an unbuffered file.

    What was written survives a killed process; with `sync` it survives a power failure as well.
    """

    def __init__(self, path: str | Path, *, resume: bool = False, sync: bool = False) -> None:
        """A new file, or with `resume` an existing one, cut back to its last whole line.

        Args:
            path: the file.
            resume: whether it is there already.
            sync: wait for the disk after each row, which may take many milliseconds.

        Raises:
            RecordingError: it cannot be written, or is there although it must be new.
        """
        self._path, self._sync = path, sync
        try:
            self._file = open(path, "r+b" if resume else "xb", buffering=0)  # noqa: SIM115
            if resume:
                self._file.truncate(self._file.read().rfind(b"\n") + 1)
                self._file.seek(0, os.SEEK_END)
        except OSError as error:
            raise RecordingError(f"{path}: cannot be written: {error.strerror}") from error

    def append(self, row: bytes) -> None:
        """Writes one row.

        Raises:
            RecordingError: it cannot be written; the file ends with the row before.
        """
        end = self._file.tell()
        try:
            written = self._file.write(row)
            if self._sync:
                os.fsync(self._file.fileno())
        except OSError as error:
            raise RecordingError(f"{self._path}: cannot be written any more: {error.strerror}; ends here") from error
        if written != len(row):
            self._file.truncate(end)
            raise RecordingError(f"{self._path}: cannot be written any more: no space left; ends here")

    def close(self) -> None:
        """Ends the file."""
        self._file.close()
