"""Writes files that are complete up to their last row at any time."""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path

from dvrk_drake.errors import RecordingError


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

    def close(self) -> None:
        """Closes the file."""
        self._file.close()


def csv_line(cells: Iterable[object]) -> bytes:
    """Returns one row of a CSV. Numbers have full precision; texts must not contain commas or quotes."""
    return (",".join(map(str, cells)) + "\n").encode()
