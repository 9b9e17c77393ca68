"""Writes the statuses of an arm to a CSV, an MCAP bag or an LCM log while they are received.

If the process is terminated, the file ends with the last complete row, and a bag with its last complete chunk. The last
rows before a power failure may be lost.
"""

from __future__ import annotations

import heapq
import os
import tempfile
from pathlib import Path
from typing import Protocol

import numpy as np

from dvrk_drake.errors import RecordingError
from dvrk_drake.lcmtypes import lcmt_dvrk_status
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.files import GrowingFile, atomic_write, csv_line
from dvrk_drake.models.lcm_messages import status_channel
from dvrk_drake.recordings.csv_files import column_names
from dvrk_drake.recordings.joint_states import MAX_LATE
from dvrk_drake.recordings.reader_lcm import LcmEvent, StatusStream, event_bytes, measurements
from dvrk_drake.recordings.writer_mcap import ArmMessages, GrowingMcap

#: Ending of the file name of an LCM log.
LCM_LOG = ".log"
#: Columns of a CSV after the columns of a Recording. They identify the status of each row.
_ORIGIN = ("utime", "sequence", "guard_state")


class RecordingFile(Protocol):
    """New file to which messages are written one by one."""

    def write(self, data: bytes, utime: int, status: lcmt_dvrk_status | None) -> None:
        """Processes a message of the status channel that arrived at `utime` [us since 1970].

        Args:
            data: Received message.
            utime: Time of arrival.
            status: Decoded status, None if it cannot be used.

        Raises:
            RecordingError: The file can no longer be written; it ends with its last complete row.
        """

    def close(self) -> None:
        """Completes and closes the file."""


def check_stream_output(path: str | Path, accepted: tuple[str, ...] = (".csv", ".mcap", LCM_LOG)) -> None:
    """Checks that a recording can be created at a path.

    Args:
        path: Path of the recording.
        accepted: Accepted endings of the file name.

    Raises:
        RecordingError: The file exists, its folder does not exist or is not writable, or the ending of the file name is
            not accepted.
    """
    path = Path(path)
    if path.suffix.lower() not in accepted:
        raise RecordingError(f"{path}: the file name must end in {' or '.join(accepted)}")
    if os.path.lexists(path):
        raise RecordingError(f"{path} already exists, and a recording is never overwritten. Choose another file.")
    if not path.parent.is_dir():
        raise RecordingError(f"{path} cannot be written: its folder does not exist")
    try:
        with tempfile.TemporaryFile(dir=path.parent):
            pass
    except OSError as error:
        raise RecordingError(f"{path} cannot be written: {error.strerror}") from error


def open_recording_file(path: str | Path, arm: Arm, stream: StatusStream) -> RecordingFile:
    """Creates the file at `path`.

    A CSV and a bag contain the statuses that `stream` accepts. An LCM log contains all messages.

    Raises:
        RecordingError: See `check_stream_output`; additionally if the file cannot be written.
    """
    check_stream_output(path)
    suffix = Path(path).suffix.lower()
    if suffix == LCM_LOG:
        return _LogFile(path, status_channel(arm))
    return _CsvFile(path, stream, arm) if suffix == ".csv" else _McapFile(path, arm)


def status_columns(arm: Arm) -> list[str]:
    """Returns the names of the columns of `status_cells`."""
    return [
        *(name for prefix in ("t", "q", "qd", "tau") for name in column_names(prefix, arm.num_joints, arm)),
        *_ORIGIN,
    ]


def status_cells(t: float, status: lcmt_dvrk_status) -> list[float]:
    """Returns the numbers of a status in a CSV. `t` is its time in the recording [s]."""
    return [t, *measurements(status), *(getattr(status, name) for name in _ORIGIN)]


class _CsvFile(GrowingFile):
    """CSV with rows in the order of arrival. At the end, the rows are sorted by their times if a status was late."""

    def __init__(self, path: str | Path, stream: StatusStream, arm: Arm) -> None:
        super().__init__(path)
        self._stream, self._arm = stream, arm
        self.append(csv_line([*status_columns(arm), "coordinates", "arm"]))

    def write(self, data: bytes, utime: int, status: lcmt_dvrk_status | None) -> None:
        if status is not None:
            self.append(csv_line([*status_cells(self._stream.time(status), status), "joint", self._arm.full_name]))

    def close(self) -> None:
        super().close()
        if self._stream.num_late:
            with open(self._path, "rb") as rows, atomic_write(self._path, "wb") as ordered:
                ordered.write(next(rows))
                waiting: list[tuple[float, bytes]] = []
                for row in rows:
                    t = float(row.partition(b",")[0])
                    heapq.heappush(waiting, (t, row))
                    # A later row of the file is at most MAX_LATE earlier.
                    while waiting[0][0] < t - MAX_LATE:
                        ordered.write(heapq.heappop(waiting)[1])
                ordered.writelines(row for _, row in sorted(waiting))


class _LogFile(GrowingFile):
    def __init__(self, path: str | Path, channel: str) -> None:
        super().__init__(path)
        self._channel, self._number = channel, 0

    def write(self, data: bytes, utime: int, status: lcmt_dvrk_status | None) -> None:
        self.append(event_bytes(LcmEvent(self._number, utime, self._channel, data)))
        self._number += 1


class _McapFile:
    """Bag with the messages of a dVRK and the transforms of its links. The header stamps are those of the statuses."""

    def __init__(self, path: str | Path, arm: Arm) -> None:
        self._messages = ArmMessages(arm, has_setpoints=True)
        self._bag = GrowingMcap(path, self._messages.topics)

    def write(self, data: bytes, utime: int, status: lcmt_dvrk_status | None) -> None:
        if status is not None:
            measured = np.array(measurements(status)).reshape(3, -1)
            commanded = np.array(status.position_commanded), None, np.array(status.effort_commanded)
            self._messages.write(self._bag, 1000 * status.utime, list(measured), commanded, 1000 * utime)

    def close(self) -> None:
        self._bag.close()
