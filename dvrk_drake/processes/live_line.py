"""One line on a terminal that is written over and over; where nobody watches, nothing."""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable
from typing import TextIO


class LiveLine:
    """A line that says how things are, four times a second at most."""

    def __init__(self, stream: TextIO, period: float = 0.25, clock: Callable[[], float] = time.monotonic) -> None:
        """On `stream`, if it is a terminal; `period` [s] and `clock` are for tests."""
        self._stream, self._period, self._clock = stream, period, clock
        self._next = clock()

    def show(self, text: Callable[[], str]) -> None:
        """Writes the line anew if it is time to; only then is `text` called."""
        now = self._clock()
        if not self._stream.isatty() or now < self._next:
            return
        self._next = now + self._period
        columns = shutil.get_terminal_size().columns
        self._write(text()[: columns - 1])

    def clear(self) -> None:
        """Leaves an empty line for what is printed next."""
        if self._stream.isatty():
            self._write("")

    def _write(self, text: str) -> None:
        # Escape sequence: erase the line from the cursor on.
        self._stream.write(f"\r\x1b[K{text}")
        self._stream.flush()
