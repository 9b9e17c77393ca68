"""Reads recordings of all supported formats. `FORMATS` lists the formats with their readers."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, get_args

import numpy as np

from dvrk_drake.errors import RecordingError
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.files import open_input
from dvrk_drake.progress import Progress, step_progress
from dvrk_drake.recordings.reader_cisst import is_collector_file, read_collector
from dvrk_drake.recordings.reader_csv import read_csv
from dvrk_drake.recordings.reader_lcm import is_lcm_log, read_status_log
from dvrk_drake.recordings.reader_lerobot import is_lerobot, read_lerobot
from dvrk_drake.recordings.reader_matlab import is_array_file, read_array_file
from dvrk_drake.recordings.reader_options import FileOptions
from dvrk_drake.recordings.reader_rosbag import is_ros_bag, read_ros_bag
from dvrk_drake.recordings.recording import FileCoordinates, Recording

#: Number of bytes at the beginning of a file that are searched for content.
_HEAD = 4096


@dataclass(frozen=True)
class Format:
    """Format of a recording.

    Attributes:
        name: Name of the format with its article.
        matches: Function that returns whether an existing file or folder has this format, from its content and name.
        read: Function that reads the file.
        options: Names of the options that apply to this format, besides `arm`, `skip_invalid` and `progress`.
    """

    name: str
    matches: Callable[[Path], bool]
    read: Callable[[Path, FileOptions], Recording]
    options: frozenset[str]


#: Formats in the order in which they are tried. A file of no other format is a CSV.
FORMATS = (
    Format("an LCM log", is_lcm_log, read_status_log, frozenset()),
    Format("a LeRobot data set", is_lerobot, read_lerobot, frozenset({"joints"})),
    Format("a ROS bag", is_ros_bag, read_ros_bag, frozenset({"topic", "joints"})),
    Format(
        "a file of the cisst collector",
        is_collector_file,
        read_collector,
        frozenset({"topic", "joints", "coordinates"}),
    ),
    Format(
        "a MATLAB file or NumPy archive",
        is_array_file,
        read_array_file,
        frozenset({"arrays", "joints", "rate", "coordinates"}),
    ),
    Format("a CSV", lambda path: not path.is_dir(), read_csv, frozenset({"joints", "rate", "coordinates"})),
)


def read_recording(
    path: str | Path,
    arm: Arm | None = None,
    coordinates: FileCoordinates | None = None,
    *,
    topic: str | None = None,
    joints: Mapping[str, str] | None = None,
    arrays: Mapping[str, str] | None = None,
    rate: float | None = None,
    effort_scale: Mapping[str, float] | float | None = None,
    skip_invalid: bool = False,
    progress: Progress | None = None,
) -> Recording:
    """Reads a recording: CSV, ROS bag, MATLAB file, NumPy archive, LeRobot data set, cisst collector or LCM log.

    The content of the file selects the format. docs/recordings.md describes the formats with their units, coordinates
    and times.

    Args:
        path: Path of the file. A ROS 2 bag and a collection of MATLAB files may also be folders.
        arm: Arm that defines the number and the names of the joints. From a bag or a log, only the measurements of this
            arm are read. Required for a bag, for a LeRobot data set and for the cisst collector. If None, other files
            must have 7 joints, and a log must have statuses of only one arm.
        coordinates: Coordinates of q, qd and tau in a file that does not state them: "joint", "actuator", or "wpi" for
            the motions of WPI, which are in actuator coordinates except for the roll of a PSM. Default: the coordinates
            that the file states, "wpi" for a CSV of an arm of this package with 21 columns and no header, or else
            "joint".
        topic: Topic of a bag or its namespace, see `read_ros_bag`. For the cisst collector: name of the signal.
        joints: Mapping from the arm's name of a joint to its name in the file, e.g. {"yaw": "outer_yaw"}. In a CSV with
            a header, the latter is the end of the names of its columns: {"yaw": "2"} selects q2, qd2 and tau2. In other
            files without joint names, it is the number of the joint, from 1.
        arrays: Mapping from "q", "qd", "tau" and "t" to the names of arrays, see `read_array_file`.
        rate: Sampling rate [Hz] of a motion in a file without times. Default: 200 Hz for a CSV with 21 columns and no
            header; all other files without times contain static poses.
        effort_scale: Factor of the recorded efforts, e.g. torque constant times gear ratio for currents: one for all
            joints, or a mapping from names of joints to factors. The efforts of other joints are not changed.
        skip_invalid: Whether to omit rows and messages that contain an empty cell, a NaN or an infinity, and to list
            them in `notes`. If False, a file with such rows is refused.
        progress: Callback that receives the name of the step ("reading") and the completed fraction (0 to 1).

    Returns:
        Recording with SHA-256 and line numbers. Its attribute `notes` describes assumptions and omitted rows.

    Raises:
        RecordingError: The file cannot be read as a recording, or an option does not apply to its format. The message
            names the file and the line or message.

    Example:
        >>> import dvrk_drake as dvrk, numpy as np
        >>> arm = dvrk.load_arm("mtmr")
        >>> dvrk.write_recording(dvrk.Recording(q=np.zeros((8, 7)), tau=np.ones((8, 7))), "poses.csv")
        >>> recording = dvrk.read_recording("poses.csv", arm)
        >>> len(recording), recording.coordinates, recording.where(0)
        (8, 'joint', 'poses.csv, line 2')
    """
    if coordinates is not None and coordinates not in get_args(FileCoordinates):
        allowed = ", ".join(get_args(FileCoordinates))
        raise RecordingError(f'unknown coordinates "{coordinates}"; allowed: {allowed}')
    path = Path(path)
    file_format = detect_format(path)
    if coordinates not in (None, "joint") and "coordinates" not in file_format.options:
        raise RecordingError(f"{path}: {file_format.name} is in joint coordinates, not in {coordinates} coordinates")
    some: dict[str, Any] = {"topic": topic, "joints": joints, "arrays": arrays, "rate": rate}
    for option, value in some.items():
        if value is not None and option not in file_format.options:
            raise RecordingError(f"{path}: --{option} does not apply to {file_format.name}")
    report = step_progress(progress, "reading")
    options = FileOptions(arm=arm, coordinates=coordinates, skip_invalid=skip_invalid, progress=report, **some)
    options.check_joints(path)
    recording = file_format.read(path, options)
    return recording if effort_scale is None else _scaled(recording, arm, effort_scale)


def _scaled(recording: Recording, arm: Arm | None, scale: Mapping[str, float] | float) -> Recording:
    """Returns the recording with scaled efforts, see `effort_scale` of `read_recording`."""
    where = f"{recording.source}: --effort-scale"
    if recording.tau is None:
        raise RecordingError(f"{where} does not apply, because the file has no efforts")
    if recording.file_coordinates == "wpi":
        raise RecordingError(f"{where} does not apply to wpi coordinates, because the efforts are converted to joints")
    factors, names = np.ones(recording.tau.shape[1]), arm.joint_names if arm else []
    if not isinstance(scale, Mapping):
        factors[:] = scale
    elif unknown := [name for name in scale if name not in names]:
        allowed = ", ".join(names) or "none without an arm"
        raise RecordingError(f"{where}: unknown joint {unknown[0]}; allowed: {allowed}")
    else:
        factors[[names.index(name) for name in scale]] = list(scale.values())
    if wrong := [factor for factor in factors if not np.isfinite(factor) or factor == 0]:
        raise RecordingError(f"{where} is {wrong[0]:g}; allowed: finite numbers except 0")
    note = f"efforts multiplied by ({', '.join(f'{factor:g}' for factor in factors)})"
    return replace(recording, tau=recording.tau * factors, notes=(*recording.notes, note))


def detect_format(path: Path) -> Format:
    """Returns the format of a file or folder. The reader of the format checks the content later.

    Raises:
        RecordingError: The path does not exist, cannot be read, or has none of the formats.
    """
    head = b""
    # Unlike pathlib, os.path returns False for a path that is not valid.
    if not os.path.isdir(path):
        with open_input(path, RecordingError) as file:
            try:
                head = file.read(_HEAD)
            except OSError as error:
                raise RecordingError(f"{path} cannot be read: {error.strerror}") from error
        if not head.strip() and path.suffix.lower() != ".csv":
            raise RecordingError(f"{path} is empty")
    found = next((known for known in FORMATS if known.matches(path)), None)
    if found is None:
        raise RecordingError(
            f"{path} is a folder without a recording; allowed: ROS bag (.mcap, .db3, .bag), MATLAB files (.mat), NumPy "
            "archives (.npz), LeRobot data set"
        )
    return found
