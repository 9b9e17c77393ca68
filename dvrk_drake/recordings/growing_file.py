"""Files that grow row by row: whatever ends the process, the file is whole up to its last row."""

from __future__ import annotations

import os
from pathlib import Path

from dvrk_drake.errors import RecordingError


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
