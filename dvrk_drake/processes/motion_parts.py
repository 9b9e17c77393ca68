"""Files of `collect motion`: the parts of a recorded motion (CSV), and the rehearsal of a motion (YAML)."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Iterable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import NamedTuple

import yaml

from dvrk_drake.analysis.excitation.periodic_motion import PeriodicMotion
from dvrk_drake.errors import CollectionError, RecordingError
from dvrk_drake.lcmtypes import lcmt_dvrk_status
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.files import GrowingFile, atomic_write, csv_line, open_input
from dvrk_drake.models.ranges import within
from dvrk_drake.models.typed_yaml import load_typed_yaml
from dvrk_drake.recordings.csv_files import parse_finite
from dvrk_drake.recordings.reader_lcm import measurements
from dvrk_drake.recordings.writer_stream import status_cells, status_columns

#: Shortest part that `identify` can use, with a margin [s].
MIN_PART = 12.0
#: Time by which a new part overlaps the previous part [s]. The first second of a part begins at rest and is slower.
OVERLAP = 2.0
#: Number of bytes that are read from both ends of a part. A row has at most 1000 bytes.
_ENDS = 10_000


class MotionPart(NamedTuple):
    """Recorded part of a motion.

    Attributes:
        path: CSV file of the part.
        begin, end: Times of the motion at the first and last row [s].
    """

    path: Path
    begin: float
    end: float


class MotionPartFile:
    """New CSV file for a part of a motion. If the process is terminated, the file ends with a complete row.

    The columns are t, q1..qn, qd1..qdn and tau1..taun, as in every Recording, and:

    - utime, sequence, guard_state: those of the status of the arm.
    - motion_time: time of the motion [s]. It advances more slowly than t while the motion starts, stops or is paused.
    - coordinates, arm, motion: "joint", name of the arm, and `PeriodicMotion.digest`.
    """

    def __init__(self, path: Path, arm: Arm, motion: PeriodicMotion) -> None:
        """Creates the file.

        Raises:
            RecordingError: The file exists or cannot be written.
        """
        self._end = "joint", arm.name, motion.digest()
        self._first_utime, self._last_utime = 0, 0
        self._file = GrowingFile(path)
        self._file.append(csv_line(_header(arm)))
        self._blocks: list[tuple[int, int]] = []

    def append(self, rows: Iterable[tuple[lcmt_dvrk_status, float]]) -> None:
        """Writes rows of statuses and times of the motion [s].

        Repeated statuses, statuses with a number that is not finite, and statuses of an arm without power are omitted.

        Raises:
            RecordingError: The rows cannot be written; the previous rows are complete.
        """
        lines: list[bytes] = []
        for status, motion_time in rows:
            is_off = status.guard_state == lcmt_dvrk_status.STATE_OFF
            if is_off or status.utime <= self._last_utime or not all(map(math.isfinite, measurements(status))):
                continue
            if not lines:
                self._blocks.append((status.utime, self._file.size))
            self._first_utime, self._last_utime = self._first_utime or status.utime, status.utime
            t = 1e-6 * (status.utime - self._first_utime)
            lines.append(csv_line([*status_cells(t, status), motion_time, *self._end]))
        if lines:
            self._file.append(b"".join(lines))

    def remove_end(self, seconds: float) -> None:
        """Removes the rows of the last `seconds`, in whole blocks of `append`."""
        late = [size for utime, size in self._blocks if utime > self._last_utime - 1e6 * seconds]
        if late:
            self._file.truncate(late[0])

    def close(self) -> None:
        """Closes the file."""
        self._file.close()


def recorded_parts(output: str | Path, arm: Arm, motion: PeriodicMotion) -> list[MotionPart]:
    """Returns the recorded parts of a motion: FILE.csv, FILE_2.csv, FILE_3.csv, ...

    Args:
        output: Path of the first part.
        arm: Arm that was moved.
        motion: Motion of the arm.

    Raises:
        CollectionError: The file name does not end in .csv, a file is not a recording of this motion by `collect`, or
            an earlier part is missing.
        RecordingError: A file cannot be read.
    """
    if Path(output).suffix.lower() != ".csv":
        raise CollectionError(f"{output}: a recorded motion is a table; the file name must end in .csv")
    parts: list[MotionPart] = []
    while os.path.lexists(path := next_part(output, parts)):
        parts.append(_read_part(path, arm, motion))
    later = path.with_name(f"{Path(output).stem}_{len(parts) + 2}.csv")
    if os.path.lexists(later):
        raise CollectionError(f"{later} exists, but {path} does not. Delete {later}, or choose another output file.")
    return parts


def next_part(output: str | Path, parts: list[MotionPart]) -> Path:
    """Returns the path of the next part."""
    output = Path(output)
    return output if not parts else output.with_name(f"{output.stem}_{len(parts) + 1}.csv")


def _read_part(path: Path, arm: Arm, motion: PeriodicMotion) -> MotionPart:
    with open_input(path, RecordingError) as file:
        start = file.read(_ENDS)
        file.seek(max(os.fstat(file.fileno()).st_size - _ENDS, 0))
        end = file.read(_ENDS)
    # Without an incomplete last row.
    lines = [*start.decode(errors="replace").split("\n")[:2], *end.decode(errors="replace").split("\n")[-2:-1]]
    header = _header(arm)
    if b"\n" not in start and ",".join(header).startswith(start.decode(errors="replace")):
        return MotionPart(path, 0.0, 0.0)
    if lines[0].split(",") != header:
        raise CollectionError(
            f"{path} already exists and is not a motion of {arm.name} recorded by collect. Choose another output file."
        )
    if b"\n" not in start[start.index(b"\n") + 1 :]:
        return MotionPart(path, 0.0, 0.0)
    column, times = header.index("motion_time"), []
    for line in (lines[1], lines[-1]):
        cells = line.split(",")
        if len(cells) != len(header) or cells[-2:] != [arm.name, motion.digest()]:
            raise CollectionError(
                f"{path} is a recording of another motion. Choose another output file, or the motion file from which "
                "this recording was made."
            )
        times.append(parse_finite(cells[column], f"{path}: motion_time"))
    return MotionPart(path, *times)


def begin_of_rest(parts: list[MotionPart], duration: float) -> float | None:
    """Returns the time [s] at which the missing part of a motion begins, or None if no part is missing.

    A new part begins `OVERLAP` before the end of the previous part. Parts shorter than `MIN_PART` count as missing.
    """
    end = 0.0
    for part in useful(parts, duration):
        if part.begin <= end:
            end = max(end, part.end)
    if end >= duration - 1e-9:
        return None
    return max(0.0, min(end - OVERLAP, duration - MIN_PART))


def useful(parts: list[MotionPart], duration: float) -> list[MotionPart]:
    """Returns the parts of a motion with this duration [s] that are not too short for `identify`."""
    return [part for part in parts if part.end - part.begin >= min(MIN_PART, duration) - 1e-9]


def _header(arm: Arm) -> list[str]:
    return [*status_columns(arm), "motion_time", "coordinates", "arm", "motion"]


@dataclass
class Rehearsal:
    """Successful rehearsal of a motion.

    Attributes:
        format: Format of the file.
        arm: Name of the arm.
        motion: `PeriodicMotion.digest` of the motion.
        speed: Speed relative to that of the motion.
        tracking_error: Largest tracking error of each joint (n,) [rad, m].
        utime: Time of the end of the rehearsal [us since 1970].
    """

    format: str = "dvrk_drake rehearsal 1"
    arm: str = ""
    motion: str = ""
    speed: float = field(default=0.0, metadata=within(0.0, 1.0))
    tracking_error: list[float] = field(default_factory=list, metadata=within(0.0, 100.0, "rad or m"))
    utime: int = 0

    def save(self, motion_path: str | Path) -> Path:
        """Writes the file of the rehearsal beside the motion file and returns its path."""
        path = rehearsal_path(motion_path)
        self.utime = time.time_ns() // 1000
        with atomic_write(path) as stream:
            yaml.safe_dump(asdict(self), stream, sort_keys=False, default_flow_style=None, width=1000)
        return path


def rehearsal_path(motion_path: str | Path) -> Path:
    """Returns the path of the rehearsal of a motion: MOTION_rehearsal.yaml beside MOTION.yaml."""
    path = Path(motion_path)
    return path.with_name(f"{path.stem}_rehearsal.yaml")


def is_rehearsed(motion_path: str | Path, arm: Arm, motion: PeriodicMotion) -> bool:
    """Returns whether the motion was rehearsed on this arm and has not changed since.

    Raises:
        CollectionError: The file of the rehearsal cannot be read.
    """
    path = rehearsal_path(motion_path)
    if not os.path.lexists(path):
        return False
    rehearsal = load_typed_yaml(Rehearsal, path, CollectionError, "a rehearsal")
    is_complete = len(rehearsal.tracking_error) == arm.num_joints
    return is_complete and rehearsal.speed > 0 and (rehearsal.arm, rehearsal.motion) == (arm.name, motion.digest())
