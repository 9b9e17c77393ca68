"""Opens input files with clear errors, writes complete output files, and base class of results with a report."""

from __future__ import annotations

import errno
import json
import os
import re
import secrets
import stat
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from io import FileIO
from pathlib import Path
from typing import IO, Any

from dvrk_drake.errors import DvrkDrakeError, RecordingError

#: Maximum size of a settings or model file [bytes]. A PSM model with dynamics has 60 kB.
MAX_TEXT = 4_000_000
#: Maximum size of a file of any other format, if it is read completely into memory [bytes].
MAX_BINARY = 256_000_000


def open_input(path: str | Path, error: type[DvrkDrakeError], largest: int | None = None) -> FileIO:
    """Opens a regular file for reading, unbuffered.

    A FIFO or a device is refused without waiting for data.

    Args:
        path: Path of the file, or of a link to it.
        error: Type of error to raise.
        largest: Maximum accepted size [bytes]; None for any size.

    Raises:
        DvrkDrakeError: The file does not exist, is not a regular file, is too large, or cannot be read. The exception
            has the type `error`.
    """
    try:
        # Without O_NONBLOCK, opening a FIFO would block until a writer opens it.
        file = open(os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC), "rb", buffering=0)  # noqa: SIM115
    except FileNotFoundError as cause:
        raise error(f"{path}: no such file") from cause
    except IsADirectoryError as cause:
        raise error(f"{path} is not a file but a folder") from cause
    except OSError as cause:
        raise error(f"{path} cannot be read: {cause.strerror}") from cause
    except ValueError as cause:  # null character in the path
        raise error(f"{str(path)!r} is not a valid file name: {cause}") from cause
    status = os.fstat(file.fileno())
    if not stat.S_ISREG(status.st_mode):
        file.close()
        raise error(f"{path} is not a regular file; copy its content to a file first")
    if largest is not None and status.st_size > largest:
        file.close()
        raise error(f"{path} has {status.st_size / 1e6:.1f} MB; allowed: at most {largest / 1e6:g} MB")
    return file


def read_input(path: str | Path, error: type[DvrkDrakeError], largest: int = MAX_BINARY) -> bytes:
    """Returns the content of a file.

    Raises:
        DvrkDrakeError: See `open_input`.
    """
    with open_input(path, error, largest) as file:
        try:
            content = file.read(largest + 1)
        except OSError as cause:
            raise error(f"{path} cannot be read: {cause.strerror}") from cause
    if len(content) > largest:  # file grew after opening, or its size was unknown
        raise error(f"{path} is too large; allowed: at most {largest / 1e6:g} MB")
    return content


def read_text_input(path: str | Path, error: type[DvrkDrakeError], largest: int = MAX_TEXT) -> str:
    """Returns the text of a UTF-8 file, with or without a byte-order mark.

    Raises:
        DvrkDrakeError: See `open_input`; additionally if the content is not UTF-8 text.
    """
    content = read_input(path, error, largest)
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as cause:
        raise error(f"{path} is not a UTF-8 text file: {cause.reason} at byte {cause.start}") from cause


#: A text or a comment in JSON. The dVRK's own files contain comments.
_TEXT_OR_COMMENT = re.compile(r'("(?:\\.|[^"\\])*")|//[^\n]*|/\*.*?\*/', re.DOTALL)


def read_json_input(path: str | Path, error: type[DvrkDrakeError], largest: int = MAX_TEXT) -> Any:
    """Returns the content of a JSON file, which may contain comments (// and /* */).

    Raises:
        DvrkDrakeError: See `read_text_input`; additionally if the text is not JSON.
    """
    try:
        text = read_text_input(path, error, largest)
        try:
            return json.loads(text)
        except ValueError:
            return json.loads(_TEXT_OR_COMMENT.sub(_without_comment, text))
    except RecursionError as cause:
        raise error(f"{path}: invalid JSON: arrays and objects are nested too deeply") from cause
    except ValueError as cause:
        raise error(f"{path}: invalid JSON: {cause}") from cause


def _without_comment(match: re.Match[str]) -> str:
    """Returns a text unchanged, and the newlines of a comment, so that the line numbers of faults stay correct."""
    return match[1] or " " + "\n" * match[0].count("\n")


#: Error codes of write operations for which the disk is the cause, not the code of the caller.
_DISK_ERRORS = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO)


def refuse_existing(path: str | Path, overwrite: bool) -> None:
    """Raises DvrkDrakeError if a file exists at `path` and `overwrite` is False."""
    if os.path.exists(path) and not overwrite:
        raise DvrkDrakeError(f"{path} already exists. Choose another file, or replace this one with overwrite=True.")


@contextmanager
def atomic_write(path: str | Path, mode: str = "w") -> Iterator[IO]:
    """Opens a temporary file. It replaces `path` if the `with` block succeeds, and is deleted otherwise.

    If `path` is a link, its target is replaced. An existing file keeps its permissions, and a new file gets those of
    the umask. The content is on the disk before the file is replaced.

    Args:
        path: Path of the output file.
        mode: "w" for text in UTF-8 without newline translation, or "wb".

    Raises:
        DvrkDrakeError: The folder does not exist, the file cannot be written, or `path` is not a regular file (e.g.
            /dev/null).
    """
    target = Path(os.path.realpath(path))
    exists = os.path.exists(target)
    if exists and not target.is_file():
        raise DvrkDrakeError(
            f"{path} is not a regular file and cannot be replaced. Give the path of a regular or a new file."
        )
    if exists and not os.access(target, os.W_OK):
        raise DvrkDrakeError(f"{path} cannot be written: the file is read-only")
    temporary = target.with_name(f".{target.name[:100]}.{secrets.token_hex(8)}")
    try:
        # The system applies the umask to a new file. The umask belongs to the process, so a thread must not change it.
        flags, permissions = os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600 if exists else 0o666
        handle = os.open(temporary, flags, permissions)
    except OSError as error:
        raise DvrkDrakeError(f"{path} cannot be written: {error.strerror}") from error
    text: dict[str, Any] = {} if "b" in mode else {"encoding": "utf-8", "newline": ""}
    try:
        with os.fdopen(handle, mode, **text) as stream:
            if exists:
                os.fchmod(handle, target.stat().st_mode & 0o777)
            yield stream
            # Without fsync, a power failure after the replacement may leave an empty file.
            stream.flush()
            os.fsync(handle)
        try:
            os.replace(temporary, target)
        except OSError as error:
            raise DvrkDrakeError(f"{path} cannot be written: {error.strerror}") from error
        _sync_folder(target.parent)
    except BaseException as error:
        with suppress(FileNotFoundError):
            os.unlink(temporary)
        if isinstance(error, OSError) and error.errno in _DISK_ERRORS:
            raise DvrkDrakeError(f"{path} cannot be written: {error.strerror}") from error
        raise


def _sync_folder(folder: Path) -> None:
    """Waits until the names of the files in a folder are on the disk. Some file systems do not support this."""
    with suppress(OSError):
        handle = os.open(folder, os.O_RDONLY | os.O_CLOEXEC)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)


class Reportable:
    """Base class of results that have an HTML report.

    Packages of results must not import `dvrk_drake.reports`, which imports all of them. Therefore `report` calls the
    public function `dvrk_drake.write_report`, which is imported when it is used.
    """

    def report(self, path: str | Path, *, inputs: Iterable[str | Path] = ()) -> None:
        """Writes the HTML report of this result. The arguments are those of `dvrk_drake.write_report`.

        Args:
            path: File to write, e.g. "report.html". An existing file is replaced.
            inputs: Input files. The report states their names and SHA-256.

        Raises:
            DvrkDrakeError: The file cannot be written.
        """
        import dvrk_drake

        dvrk_drake.write_report(self, path, inputs=inputs)


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
