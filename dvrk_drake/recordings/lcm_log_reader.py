"""LCM logs: reading what is left of one, and the bytes of an event to append.

The format, https://lcm-proj.github.io/lcm/content/log-file-format.html: events one after the other, each big-endian
with a magic number, its number, a time, two lengths, the channel and the data. The `lcm` package's own `EventLog` ends
the process on a damaged length (a segmentation fault in lcm 1.5.3), and keeps the last events in memory until it is
closed.
"""

from __future__ import annotations

import hashlib
import mmap
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from dvrk_drake.errors import RecordingError
from dvrk_drake.models.files import open_input

_MAGIC = bytes.fromhex("EDA1DA01")
_HEADER = struct.Struct(">4sqqII")
_LONGEST_CHANNEL = 1000


class LcmEvent(NamedTuple):
    """One message: its number in the log, when it arrived [us since 1970], its channel and its bytes."""

    number: int
    utime: int
    channel: str
    data: bytes


class LcmLogReader:
    """The events of a log, in its order; what is damaged is skipped.

    Attributes:
        path: of the log.
        notes: what was damaged, complete when the iteration is.
    """

    def __init__(self, path: str | Path) -> None:
        """Of the log at `path`, which begins with an event.

        Raises:
            RecordingError: the file cannot be read, or does not begin as an LCM log does.
        """
        if not is_lcm_log(path):
            raise RecordingError(f"{path}: is not an LCM log")
        self.path = path
        self.notes: list[str] = []

    def __iter__(self) -> Iterator[LcmEvent]:
        self.notes.clear()
        with (
            open_input(self.path, RecordingError) as file,
            mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content,
        ):
            position = 0
            while position < len(content):
                end = _end_of_event(content, position)
                if end:
                    yield _event(content, position)
                    position = end
                else:
                    position = self._skip(content, position)

    def sha256(self) -> str:
        """Of the file's bytes."""
        with open_input(self.path, RecordingError) as file:
            return hashlib.file_digest(file, "sha256").hexdigest()

    def _skip(self, content: mmap.mmap, damaged: int) -> int:
        """The position of the next whole event after a damaged one, or the end of the file."""
        position = damaged
        while (position := content.find(_MAGIC, position + 1)) >= 0:
            if _end_of_event(content, position):
                self.notes.append(f"{position - damaged} bytes from byte {damaged} on are damaged and are left out")
                return position
        self.notes.append(
            f"the last {len(content) - damaged} bytes are no whole message, as after a kill: read up to there"
        )
        return len(content)


def is_lcm_log(path: str | Path) -> bool:
    """Whether the file begins as an LCM log does; False where there is no file to read."""
    try:
        with open_input(path, RecordingError) as file:
            return file.read(len(_MAGIC)) == _MAGIC
    except (RecordingError, OSError):
        return False


def event_bytes(event: LcmEvent) -> bytes:
    """An event as a log holds it; a log is nothing but these, numbered from 0."""
    channel = event.channel.encode()
    return _HEADER.pack(_MAGIC, event.number, event.utime, len(channel), len(event.data)) + channel + event.data


def _end_of_event(content: mmap.mmap, start: int) -> int:
    """Where the event that begins at `start` ends; 0 if none does, or if something else than an event follows."""
    if start + _HEADER.size > len(content):
        return 0
    magic, _, _, channel_length, data_length = _HEADER.unpack_from(content, start)
    end = start + _HEADER.size + channel_length + data_length
    if magic != _MAGIC or not 0 < channel_length <= _LONGEST_CHANNEL or end > len(content):
        return 0
    following = content[end : end + len(_MAGIC)]
    return end if _MAGIC.startswith(following) else 0


def _event(content: mmap.mmap, start: int) -> LcmEvent:
    _, number, utime, channel_length, data_length = _HEADER.unpack_from(content, start)
    channel = start + _HEADER.size
    data = channel + channel_length
    # A channel that is no UTF-8 is nobody's here; it must not stop the reading of others.
    name = content[channel:data].decode("utf-8", "replace")
    return LcmEvent(number, utime, name, content[data : data + data_length])
