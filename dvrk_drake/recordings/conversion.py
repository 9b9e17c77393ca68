"""Converts recordings of all supported formats to the CSV format of this project.

The public recordings are from the WPI AIM lab and have two layouts; `docs/public_recordings.md` explains how to obtain
them.

- "team-mat", https://github.com/WPI-AIM/dvrk_gravity_comp: a MATLAB array of 8 x 2 x N.
- "wpi-csv", https://github.com/WPI-AIM/dvrk_dynamics_identification: a CSV of 21 columns without a header.
"""

from __future__ import annotations

import csv
import dataclasses
import os
from pathlib import Path
from typing import Literal, get_args

import numpy as np

from dvrk_drake.errors import RecordingError
from dvrk_drake.models.arm import Arm
from dvrk_drake.recordings.csv_rows import read_bytes
from dvrk_drake.recordings.lcm_log_reader import is_lcm_log
from dvrk_drake.recordings.public_formats import (
    generated_times,
    looks_like_matlab,
    read_team_mat,
    read_wpi_csv,
    refuse_rate,
    time_notes,
    wpi_in_joint_coordinates,
)
from dvrk_drake.recordings.recording import Coordinates, Recording, column_names, read_recording, write_recording
from dvrk_drake.recordings.ros_bag import is_ros_bag

Format = Literal["csv", "team-mat", "wpi-csv", "lcm-log", "ros-bag"]

#: Mapping from a format to its coordinates. The format "csv" has no entry, because it does not define its coordinates.
DEFINED_COORDINATES: dict[str, Coordinates] = {
    "team-mat": "joint",
    "wpi-csv": "actuator",
    "lcm-log": "joint",
    "ros-bag": "joint",
}


def convert(
    path: str | Path,
    output: str | Path,
    *,
    format: Format | None = None,
    coordinates: Coordinates | None = None,
    variable: str | None = None,
    topic: str | None = None,
    rate: float | None = None,
    arm: Arm | None = None,
    skip_invalid: bool = False,
) -> Recording:
    """Converts a recording to a CSV for `read_recording`. The CSV is written atomically.

    Time stamps of the recording are kept unchanged.

    Args:
        path: Path of the recording.
        output: Path of the CSV to write; an existing file is replaced.
        format: Format of the recording; None to detect it.
        coordinates: Coordinates of q, qd and tau, required for "csv". Other formats define their coordinates.
        variable: For "team-mat": name of the MATLAB variable, required if several variables match.
        topic: For "ros-bag": JointState topic or its namespace, see `read_joint_states`.
        rate: Sampling rate [Hz] of a CSV without time stamps. If None, the rate is 200 Hz for "wpi-csv", and a "csv"
            gets no time stamps.
        arm: For "csv" and "wpi-csv": the data are written in the joint coordinates of this arm. If None, they are
            written in the coordinates of the input file. For "lcm-log" and "ros-bag": the measurements of this arm are
            read. The arm is required for a bag, and for a log with statuses of several arms.
        skip_invalid: Whether to omit invalid rows (or poses) and to count them in `notes`. If False, a file with
            invalid rows is refused.

    Returns:
        Written recording. Its `source`, `lines` and `notes` refer to the original file.

    Raises:
        RecordingError: The file does not have the layout of the format, its coordinates are unknown, or an argument
            does not apply to its format.
        DvrkDrakeError: The output cannot be written.
    """
    if format is not None and format not in get_args(Format):
        raise RecordingError(f'unknown format "{format}"; known formats: {", ".join(get_args(Format))}')
    if coordinates is not None and coordinates not in get_args(Coordinates):
        raise RecordingError(f'unknown coordinates "{coordinates}"; allowed: {", ".join(get_args(Coordinates))}')
    if os.path.exists(output) and os.path.exists(path) and os.path.samefile(path, output):
        raise RecordingError(f"{output} is the input recording. Choose another output file.")
    chosen = format or detect_format(path)
    defined = DEFINED_COORDINATES.get(chosen)
    if defined is not None and coordinates not in (None, defined):
        raise RecordingError(f"{path}: a {chosen} file is in {defined} coordinates, not in {coordinates} coordinates")
    if variable is not None and chosen != "team-mat":
        raise RecordingError(f"{path}: --variable does not apply to {chosen} files")
    if topic is not None and chosen != "ros-bag":
        raise RecordingError(f"{path}: --topic does not apply to {chosen} files")
    if chosen == "lcm-log":
        if rate is not None or skip_invalid:
            raise RecordingError(f"{path}: --rate and --skip-invalid do not apply to an LCM log")
        if not is_lcm_log(Path(path)):
            raise RecordingError(f"{path} is not an LCM log")
        recording = read_recording(path, arm)
    elif chosen == "ros-bag":
        if rate is not None:
            raise RecordingError(f"{path}: --rate does not apply to a ROS bag, whose messages have time stamps")
        if not is_ros_bag(path):
            raise RecordingError(f"{path} is not a ROS bag")
        recording = read_recording(path, arm, topic=topic, skip_invalid=skip_invalid)
    elif chosen == "team-mat":
        if rate is not None:
            raise RecordingError(f"{path}: --rate does not apply to team-mat files, which have no times")
        if arm is not None:
            raise RecordingError(f"{path}: --arm does not apply to team-mat files, which are in joint coordinates")
        recording = read_team_mat(path, variable=variable, skip_invalid=skip_invalid)
    elif chosen == "wpi-csv":
        recording = read_wpi_csv(path, rate, skip_invalid=skip_invalid)
        if arm is not None:
            recording = wpi_in_joint_coordinates(recording, arm)
    elif coordinates is None:
        raise RecordingError(
            f"{path}: a CSV file does not define its coordinates. Pass --coordinates joint or --coordinates actuator "
            "(coordinates= in Python)."
        )
    else:
        recording = _read_csv(Path(path), coordinates, rate, arm, skip_invalid)
    if recording.coordinates == "actuator":
        first, *others = recording.notes
        note = (
            "in actuator coordinates, but the CSV does not state this: pass --coordinates actuator to every command "
            "that reads the CSV, or convert with --arm"
        )
        if chosen == "wpi-csv":
            note += " (required for a PSM, whose roll is recorded at the joint)"
        recording = dataclasses.replace(recording, notes=(first, note, *others))
    write_recording(recording, output)
    return recording


def _read_csv(
    path: Path, coordinates: Coordinates, rate: float | None, arm: Arm | None, skip_invalid: bool
) -> Recording:
    """Reads a CSV with a header, and adds notes on times and ignored columns."""
    recording = read_recording(path, arm, coordinates, skip_invalid=skip_invalid)
    if recording.t is not None:
        refuse_rate(path, rate)
        assert recording.lines is not None
        notes = time_notes(recording.t, recording.lines)
    elif rate is not None:
        assert recording.lines is not None
        t, note = generated_times(np.arange(len(recording)), rate)
        recording, notes = dataclasses.replace(recording, t=t), [note]
    else:
        notes = [
            f"{len(recording)} rows without time stamps (no column t), read as static poses; --rate HZ adds time stamps"
        ]
    kept = [name for prefix in ("t", "q", "qd", "tau") for name in column_names(prefix, recording.q.shape[1])]
    if other := [name for name in _header(read_bytes(path)) if name and name not in kept]:
        notes.append(f"ignored columns: {', '.join(other)}")
    if arm is not None:
        recording = recording.in_joint_coordinates(arm)
        recording.check_fits(arm)
    return dataclasses.replace(recording, notes=(*notes, *recording.notes))


def detect_format(path: str | Path) -> Format:
    """Returns the format of a file, detected from its first bytes and its name.

    A text file is a "csv" if its header contains q1, and a "wpi-csv" otherwise. The reader of the format checks the
    content later.

    Raises:
        RecordingError: The file does not exist, is empty, or has none of the formats.
    """
    path = Path(path)
    if is_lcm_log(path):
        return "lcm-log"
    if is_ros_bag(path):
        return "ros-bag"
    content = read_bytes(path)
    if not content.strip():
        raise RecordingError(f"{path} is empty")
    if looks_like_matlab(path, content):
        return "team-mat"
    if b"\0" in content[:_HEAD]:
        raise RecordingError(
            f"{path}: unknown format; allowed: ROS bag, LCM log, MATLAB file (team-mat), UTF-8 text file (CSV)"
        )
    return "csv" if "q1" in _header(content) else "wpi-csv"


#: Number of bytes that are examined for a header.
_HEAD = 4096


def _header(content: bytes) -> list[str]:
    """Returns the cells of the first line that is not blank."""
    text = content[:_HEAD].decode("utf-8-sig", errors="replace")
    line = next((line for line in text.splitlines() if line.strip(" ,")), "")
    return [cell.strip() for cell in next(csv.reader([line]), [])]
