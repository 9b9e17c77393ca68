"""One arm's statuses out of an LCM log."""

from __future__ import annotations

from array import array
from collections import Counter
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.errors import RecordingError
from dvrk_drake.lcmtypes import lcmt_dvrk_status
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.lcm_messages import STATUS_PREFIX, decode, status_channel
from dvrk_drake.recordings.lcm_log_reader import LcmLogReader
from dvrk_drake.recordings.status_stream import StatusStream, measurements

#: Most channels that a message lists.
_LISTED = 8


class StatusLog(NamedTuple):
    """The measurements of one arm, in joint coordinates; SI.

    Attributes:
        t: (m,) the arm's own clock since the first row [s].
        q, qd, tau: (m, n) measured positions, velocities and efforts.
        events: (m,) number of each row's event in the log.
        notes: what is damaged, missing or left out, a line each.
        sha256: of the log's bytes.
    """

    t: NDArray[np.float64]
    q: NDArray[np.float64]
    qd: NDArray[np.float64]
    tau: NDArray[np.float64]
    events: NDArray[np.int_]
    notes: tuple[str, ...]
    sha256: str


def read_status_log(path: str | Path, arm: Arm | None = None) -> StatusLog:
    """Reads an LCM log as lcm-logger or `dvrk-drake record` writes it; other channels in it do not matter.

    Left out and noted are messages that cannot be read or are not of the arm, that are not later than the one before,
    whose numbers are not finite, or that were sent with the motors off.

    Args:
        path: the log.
        arm: whose statuses; None if the log has only one arm's.

    Raises:
        RecordingError: no LCM log, none or (without `arm`) several arms' statuses, or none that can be used.
    """
    log = LcmLogReader(path)
    channel = status_channel(arm) if arm else _only_status_channel(log)
    stream = StatusStream(arm.name, arm.num_joints) if arm else None
    rows, times, events = array("d"), array("d"), array("q")
    channels: Counter[str] = Counter()
    for event in log:
        channels[event.channel] += 1
        if event.channel != channel:
            continue
        if stream is None and (first := decode(lcmt_dvrk_status, event.data)):
            stream = StatusStream(first.arm_name, first.num_joints)
        try:
            status = stream.take(event.data) if stream else None
        except RecordingError as error:
            raise RecordingError(f"{path}: event {event.number}: {error}") from error
        if status is not None and stream is not None:
            rows.extend(measurements(status))
            times.append(stream.time(status))
            events.append(event.number)
    notes = [*log.notes, *(stream.notes() if stream else [])]
    if not events:
        raise RecordingError(f"{path}: {_why_nothing(channel, arm, channels, notes)}")
    q, qd, tau = np.array(rows).reshape(len(events), 3, -1).transpose(1, 0, 2)
    return StatusLog(np.array(times), q, qd, tau, np.array(events), tuple(notes), log.sha256())


def _only_status_channel(log: LcmLogReader) -> str:
    channels = sorted({event.channel for event in log if event.channel.startswith(STATUS_PREFIX)})
    if len(channels) > 1:
        raise RecordingError(f"{log.path}: has statuses of several arms, {', '.join(channels)}: name one")
    return channels[0] if channels else STATUS_PREFIX


def _why_nothing(channel: str, arm: Arm | None, channels: Counter[str], notes: list[str]) -> str:
    if count := channels[channel]:
        reasons = "; ".join(notes) or "no lcmt_dvrk_status, or one of another version"
        return f"none of its {count} messages on channel {channel} can be used: {reasons}"
    listed = [f"{name} ({number})" for name, number in channels.most_common(_LISTED)]
    more = [f"{len(channels) - _LISTED} more"] if len(channels) > _LISTED else []
    has = ", ".join([*listed, *more]) or "nothing that can be read"
    return f"has no status of {arm.name if arm else 'any arm'} (channel {channel}); it has {has}"
