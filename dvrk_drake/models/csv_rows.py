"""Rows of a CSV file with line numbers, and numbers out of cells: shared by all readers of recordings."""

from __future__ import annotations

import csv
import hashlib
import io
import re
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.errors import RecordingError


def read_bytes(path: Path) -> bytes:
    """Everything in a file.

    Raises:
        RecordingError: there is no such file, or it cannot be read.
    """
    if not path.is_file():
        raise RecordingError(f"{path}: {'is not a file' if path.exists() else 'no such file'}")
    try:
        return path.read_bytes()
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read: {error.strerror}") from error


def read_rows(path: Path) -> tuple[list[tuple[int, list[str]]], str]:
    """(line number, stripped cells) of every row that is not blank, and the SHA-256 of the file's bytes.

    UTF-8 with or without a byte-order mark; lines end in LF, CRLF or CR.

    Raises:
        RecordingError: the file cannot be read, is not text, or its cells are not separated by commas.
    """
    content = read_bytes(path)
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise RecordingError(f"{path}: not a CSV text file in UTF-8: {error.reason} at byte {error.start}") from error
    reader = csv.reader(io.StringIO(text, newline=""), strict=True)
    rows: list[tuple[int, list[str]]] = []
    try:
        for row in reader:
            cells = [cell.strip() for cell in row]
            if any(cells):
                rows.append((reader.line_num, cells))
    except csv.Error as error:
        raise RecordingError(f"{path}:{reader.line_num}: not CSV: {error}") from error
    if rows and len(rows[0][1]) == 1 and re.search(r"[;\s]", rows[0][1][0]):
        raise RecordingError(
            f"{path}:{rows[0][0]}: no comma in the first row; cells must be separated by commas, "
            "with a point as the decimal sign"
        )
    return rows, hashlib.sha256(content).hexdigest()


def listed(numbers: Iterable[int]) -> str:
    """The first ten of them, in words."""
    texts = list(map(str, numbers))
    return ", ".join(texts if len(texts) <= 10 else [*texts[:10], "..."])


def skipped_note(skipped: NDArray[np.int_], count: int) -> str:
    """The note on the lines that were left out of `count` rows."""
    return f"{len(skipped)} of {count} rows skipped (NaN or infinite): lines {listed(skipped)}"


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


def parse_finite(cell: str, where: str) -> float:
    """As `parse_number`, but NaN and infinities are errors too."""
    value = parse_number(cell, where)
    if not np.isfinite(value):
        raise RecordingError(f"{where} is {cell}; only finite numbers are allowed")
    return value
