"""Recordings that are written while they are made: whatever ends the process, the file is whole up to its last row.

What was written survives a killed process; the last moments before a power failure are the disk's.
"""

from __future__ import annotations

import os
import tempfile
from pathlib import Path
from typing import Protocol

from dvrk_drake.errors import RecordingError
from dvrk_drake.lcmtypes import lcmt_dvrk_status
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.lcm_messages import status_channel
from dvrk_drake.recordings.csv_rows import GrowingFile
from dvrk_drake.recordings.lcm_log_reader import LcmEvent, StatusStream, event_bytes, measurements
from dvrk_drake.recordings.recording import column_names

#: Columns of a CSV behind those of a Recording, to find a row again elsewhere.
_ORIGIN = ("utime", "sequence", "guard_state")


class RecordingFile(Protocol):
    """A new file that grows message by message."""

    def write(self, data: bytes, utime: int, status: lcmt_dvrk_status | None) -> None:
        """Takes a message of the status channel that arrived at `utime` [us since 1970].

        Args:
            data: the message.
            utime: when it came.
            status: what it says, None if that cannot be used.

        Raises:
            RecordingError: the file cannot be written any more; it ends with its last whole row.
        """

    def close(self) -> None:
        """Ends the file."""


def check_stream_output(path: str | Path) -> None:
    """Refuses a path that a recording cannot be made at.

    Raises:
        RecordingError: it exists, its folder does not or is not to be written in, or it ends in neither .csv nor .log.
    """
    path = Path(path)
    if path.suffix not in (".csv", ".log"):
        raise RecordingError(f"{path}: must end in .csv or .log (LCM log)")
    if os.path.lexists(path):
        raise RecordingError(f"{path}: exists already, and a recording is not overwritten; name another file")
    if not path.parent.is_dir():
        raise RecordingError(f"{path}: cannot be written: its folder does not exist")
    try:
        with tempfile.TemporaryFile(dir=path.parent):
            pass
    except OSError as error:
        raise RecordingError(f"{path}: cannot be written: {error.strerror}") from error


def open_recording_file(path: str | Path, arm: Arm, stream: StatusStream) -> RecordingFile:
    """Makes the file at `path`: .csv for the statuses that `stream` takes, .log for every message as it came.

    Raises:
        RecordingError: as `check_stream_output`, or it cannot be written.
    """
    check_stream_output(path)
    return _CsvFile(path, stream) if Path(path).suffix == ".csv" else _LogFile(path, status_channel(arm))


class _CsvFile(GrowingFile):
    def __init__(self, path: str | Path, stream: StatusStream) -> None:
        super().__init__(path)
        self._stream = stream
        header = [name for prefix in ("t", "q", "qd", "tau") for name in column_names(prefix, stream.num_joints)]
        self.append((",".join((*header, *_ORIGIN)) + "\n").encode())

    def write(self, data: bytes, utime: int, status: lcmt_dvrk_status | None) -> None:
        if status is not None:
            self.append(self._row(status))

    def _row(self, status: lcmt_dvrk_status) -> bytes:
        numbers = (self._stream.time(status), *measurements(status))
        origin = (getattr(status, name) for name in _ORIGIN)
        return (",".join([*map(repr, numbers), *map(str, origin)]) + "\n").encode()


class _LogFile(GrowingFile):
    def __init__(self, path: str | Path, channel: str) -> None:
        super().__init__(path)
        self._channel, self._number = channel, 0

    def write(self, data: bytes, utime: int, status: lcmt_dvrk_status | None) -> None:
        self.append(event_bytes(LcmEvent(self._number, utime, self._channel, data)))
        self._number += 1
