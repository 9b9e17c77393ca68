"""Recorders of the measurements of one arm, started by `dvrk-drake record`: common part, and statuses over LCM."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections import Counter, deque
from collections.abc import Callable
from pathlib import Path

import lcm
import numpy as np

from dvrk_drake.errors import RecordingError
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.lcm_messages import STATUS_PREFIX, MessageKey, StatusFilter, describe_state, status_channel
from dvrk_drake.recordings.reader_lcm import StatusStream
from dvrk_drake.recordings.writer_mcap import GrowingMcap
from dvrk_drake.recordings.writer_stream import (
    RecordingFile,
    check_stream_output,
    open_recording_file,
)
from dvrk_drake.systems.lcm.messages import handle_message

#: Longest time until the first status [s]. Time without a status after which the status line reports missing statuses
#: [s].
FIRST_STATUS, SILENCE = 10.0, 0.5
#: Time without a status of the session after which the statuses of a new session are recorded [s].
_RESTART = 1.0
#: Length of the queue of messages. If it is full, further messages are lost.
_QUEUE = 20_000
#: Reasons why messages do not belong to the arm's session.
_FOREIGN = (StatusFilter.OTHER_SESSION, StatusFilter.JUMP, StatusFilter.NOT_AUTHENTIC)
#: Number of messages whose median period is used, and number of intervals that are compared with it at once.
_PERIOD_WINDOW, _CHECKED_INTERVALS = 100, 20
#: Longest wait for a message between two checks for a stop [s].
_POLL = 0.1


class Rate:
    """Number of messages in the last second."""

    def __init__(self) -> None:
        """Creates a counter without messages."""
        self._arrivals: deque[float] = deque()

    def add(self, now: float) -> None:
        """Counts a message that arrives at the time `now` [s]."""
        self._arrivals.append(now)

    def per_second(self, now: float) -> int | None:
        """Returns the number of messages since `now` - 1 s, or None if the last message is older than `SILENCE`."""
        while self._arrivals and self._arrivals[0] < now - 1:
            self._arrivals.popleft()
        return len(self._arrivals) if self._arrivals and self._arrivals[-1] >= now - SILENCE else None


class MissingMessages:
    """Number of messages that are missing on a periodic topic, determined from the stamps of the received messages.

    DDS does not number messages for its users, and does not report messages that it overwrites.
    """

    def __init__(self) -> None:
        """Starts without messages."""
        self._count, self._longest = 0, 0
        self._stamps: deque[int] = deque(maxlen=_PERIOD_WINDOW)
        self._unchecked: list[int] = []

    def add(self, stamp: int) -> None:
        """Counts a message with a time stamp [ns] that is later than that of the previous message."""
        if self._stamps:
            interval = stamp - self._stamps[-1]
            if interval == 0:
                return  # the measurement was published twice
            if interval < 0:  # the clock was set back
                self._check()
                self._stamps.clear()
            else:
                self._unchecked.append(interval)
        self._stamps.append(stamp)
        if len(self._unchecked) >= _CHECKED_INTERVALS:
            self._check()

    @property
    def count(self) -> int:
        """Number of missing messages."""
        self._check()
        return max(self._count, 0)

    @property
    def longest(self) -> float:
        """Longest time between two messages [s]."""
        self._check()
        return 1e-9 * self._longest

    def _check(self) -> None:
        if len(self._stamps) < 3 or not self._unchecked:
            return
        # The stamps are times of an arm's own loop. If messages are published with a period that is no multiple of the
        # period of this loop, long and short intervals alternate. The sum of two intervals is nearly constant.
        stamps = np.array(self._stamps)
        period = float(np.median(stamps[2:] - stamps[:-2])) / 2
        # A message that was published late is followed by intervals that are shorter than half a period.
        self._count += int(np.sum(np.rint(np.array(self._unchecked) / period) - 1))
        self._longest = max(self._longest, *self._unchecked)
        self._unchecked.clear()


class ArmRecorder(ABC):
    """Writes the measurements of one arm to a new file while they arrive. A subclass receives and writes them.

    Attributes:
        arm: Recorded arm.
        path: Path of the new file, which is created at the first measurement.
        source: Network, for messages.
    """

    source: str

    def __init__(self, arm: Arm, path: str | Path) -> None:
        """Creates a recorder without a file."""
        self.arm, self.path = arm, path
        self._file: RecordingFile | GrowingMcap | None = None
        self._rate = Rate()

    @property
    @abstractmethod
    def num_rows(self) -> int:
        """Number of recorded measurements."""

    def run(self, duration: float, stopped: Callable[[], bool], show: Callable[[Callable[[], str]], None]) -> None:
        """Records until `stopped` returns true, or until `duration` has elapsed since the first measurement.

        Args:
            duration: Duration of the recording [s], which may be infinite.
            stopped: Function that returns whether to stop. It is called at least every 0.1 s.
            show: Function that is called after every message, and every 0.1 s without messages. Its argument is a
                function that returns the text of the status line.

        Raises:
            RecordingError: The arm was not found, no valid measurement arrived within 10 s, the recording ended before
                the first one, or the file cannot be written.
        """
        try:
            self.subscribe(stopped)
            end, has_begun = time.monotonic() + FIRST_STATUS, False
            while not stopped() and time.monotonic() < end:
                self._wait(_POLL)
                self.update()
                if not has_begun and self._file is not None:
                    end, has_begun = time.monotonic() + duration, True
                show(self.describe)
        finally:
            self.close()
        if self._file is None:
            raise RecordingError(self._no_measurement_reason(stopped()))

    @abstractmethod
    def subscribe(self, stopped: Callable[[], bool]) -> None:
        """Subscribes to the messages of the arm. `stopped` returns whether to end the search for the arm.

        Raises:
            RecordingError: The arm was not found.
        """

    @abstractmethod
    def update(self) -> None:
        """Records the messages that have arrived.

        Raises:
            RecordingError: The messages have other joints, or the file cannot be written.
        """

    def close(self) -> None:
        """Ends the file."""
        if self._file is not None:
            self._file.close()

    def describe(self) -> str:
        """Returns the text of the status line: the number of rows, the rate, and details of the transport."""
        rate = self._rate.per_second(time.monotonic())
        if self._file is None:
            return f"waiting for {self._awaited()}"
        if rate is None:
            return f"{self.arm.name}: no more messages; {self.num_rows} rows"
        return ", ".join([f"{self.arm.name}: {self.num_rows} rows", f"{rate} Hz", *self._details()])

    @abstractmethod
    def notes(self) -> list[str]:
        """Returns one line for each reason why messages were not recorded, and for missing messages."""

    @abstractmethod
    def _wait(self, seconds: float) -> None:
        """Waits for a message, at most `seconds` [s]."""

    @abstractmethod
    def _awaited(self) -> str:
        """Returns what the recorder waits for before the first measurement."""

    @abstractmethod
    def _details(self) -> list[str]:
        """Returns the end of the status line."""

    @abstractmethod
    def _no_measurement_reason(self, was_stopped: bool) -> str:
        """Returns the reason why there was no measurement."""


class LcmRecorder(ArmRecorder):
    """Appends every status of one arm over LCM to a new file in real time.

    Attributes:
        stream: Filter that counts accepted and rejected statuses.
        num_received: Number of messages on the arm's status channel.
        foreign: Number of messages that do not belong to the arm's session and were not recorded, for each reason.
    """

    def __init__(self, arm: Arm, path: str | Path, url: str, key: MessageKey | None = None) -> None:
        """Creates a recorder.

        Args:
            arm: Arm whose statuses are recorded.
            path: Path of the new file.
            url: URL of the LCM network.
            key: Key that must have signed the statuses. None: authentication codes are not verified.

        Raises:
            RecordingError: A new file cannot be created at `path`.
        """
        check_stream_output(path)
        super().__init__(arm, path)
        self.source = f"LCM {url}"
        self.stream = StatusStream(arm.name, arm.num_joints)
        self.num_received = 0
        self.foreign: Counter[str] = Counter()
        self._filter = StatusFilter(arm.name, arm.num_joints, key, follow_after=_RESTART)
        self._url, self._channel = url, status_channel(arm)
        self._other_channels: Counter[str] = Counter()
        self._lcm = lcm.LCM(url)
        # The subscription includes all arms, so that an error message can list the channels with messages.
        self._subscription = self._lcm.subscribe(f"{STATUS_PREFIX}.*", self._receive)
        self._subscription.set_queue_capacity(_QUEUE)

    @property
    def num_rows(self) -> int:
        """Number of recorded measurements."""
        return self.stream.num_used

    def subscribe(self, stopped: Callable[[], bool]) -> None:
        """Does nothing: the channels are open."""

    def update(self) -> None:
        """Does nothing: a status is recorded while the recorder waits."""

    def notes(self) -> list[str]:
        """Returns one line for each reason why messages were not recorded, and for lost messages."""
        left_out = [f"messages not recorded, {reason}: {count}" for reason, count in self.foreign.items()]
        return [*left_out, *self.stream.notes()]

    def _receive(self, channel: str, data: bytes) -> None:
        if channel != self._channel:
            self._other_channels[channel] += 1
            return
        self.num_received += 1
        now = time.monotonic()
        reason = self._filter.examine(data, now)
        if reason in _FOREIGN:
            self.foreign[reason] += 1
            return
        self._rate.add(now)
        status = self.stream.accept(data)
        if self._file is None:
            if self.stream.last is None:
                return
            self._file = open_recording_file(self.path, self.arm, self.stream)
        assert not isinstance(self._file, GrowingMcap)
        self._file.write(data, time.time_ns() // 1000, status)

    def _wait(self, seconds: float) -> None:
        handle_message(self._lcm, seconds)

    def _awaited(self) -> str:
        return self._channel

    def _details(self) -> list[str]:
        status = self.stream.last
        assert status is not None
        return [f"{self.stream.num_lost} lost", describe_state(status.guard_state, status.fault_text)]

    def _no_measurement_reason(self, was_stopped: bool) -> str:
        if was_stopped:
            return f"{self.path} was not written: the recording ended before the first status of {self.arm.name}"
        where = f"on channel {self._channel} of {self._url}"
        if self.num_received:
            reasons = "; ".join(self.notes())
            return f"no status of {self.arm.name} within {FIRST_STATUS:.0f} s {where}: {reasons}"
        if others := ", ".join(sorted(self._other_channels)):
            return f"no message within {FIRST_STATUS:.0f} s {where}. Channels with messages: {others}"
        return (
            f"no message within {FIRST_STATUS:.0f} s {where}. Check that the arm's process or bridge runs on this "
            "network. Between machines, the URL needs ?ttl=1 and each machine needs a multicast route "
            "(ip route add 239.255.0.0/16 dev DEVICE)"
        )
