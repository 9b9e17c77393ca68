"""Reads, writes and converts recordings of all supported formats. `FORMATS` lists the formats with their readers."""

from __future__ import annotations

import dataclasses
import os
import shutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, get_args

import numpy as np

from dvrk_drake.errors import DvrkDrakeError, RecordingError
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.models.files import open_input
from dvrk_drake.progress import Progress, step_progress
from dvrk_drake.recordings.csv_files import write_csv
from dvrk_drake.recordings.reader_cisst import is_collector_file, read_collector
from dvrk_drake.recordings.reader_csv import read_csv
from dvrk_drake.recordings.reader_lcm import is_lcm_log, read_status_log
from dvrk_drake.recordings.reader_lerobot import is_lerobot, read_lerobot
from dvrk_drake.recordings.reader_matlab import is_array_file, read_array_file
from dvrk_drake.recordings.reader_options import FileOptions
from dvrk_drake.recordings.reader_rosbag import is_ros_bag, read_ros_bag
from dvrk_drake.recordings.recording import FileCoordinates, Recording, Setpoints
from dvrk_drake.recordings.writer_mcap import write_mcap

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


def write_recording(
    recording: Recording, path: str | Path, arm: Arm | None = None, setpoints: Setpoints | None = None
) -> None:
    """Writes a recording as a CSV, or as an MCAP bag for ROS 2 tools, Foxglove and Rerun.

    The file is written atomically and with full precision. A bag also contains the transforms of the links and a URDF.

    Args:
        recording: Recording to write. A CSV keeps its coordinates, and states them in the column `coordinates`. A bag
            is in joint coordinates and has other times, see `write_mcap`.
        path: Path of the file: .mcap (in any case) for a bag, anything else for a CSV. An existing file is replaced.
        arm: Arm of the recording. Required for a bag, which contains the joint names. A CSV then contains the name of
            the arm and the units.
        setpoints: Commands of the recording. They are written only to a bag.

    Raises:
        RecordingError: The recording cannot be written as a bag, see `write_mcap`, or `arm` is missing.
        DvrkDrakeError: The folder does not exist or cannot be written.

    Example:
        >>> import dvrk_drake as dvrk, numpy as np
        >>> dvrk.write_recording(dvrk.Recording(q=np.zeros((8, 7)), t=np.arange(8.0)), "positions.csv")
        >>> open("positions.csv").readline().rstrip()
        't,q1,q2,q3,q4,q5,q6,q7,coordinates'
    """
    if Path(path).suffix.lower() == ".mcap":
        if arm is None:
            raise RecordingError(
                f"{path}: an MCAP bag contains joint names, so the arm is required: --arm (arm= in Python)"
            )
        write_mcap(recording, path, arm, setpoints)
        return
    blocks = {"t": recording.t, "q": recording.q, "qd": recording.qd, "tau": recording.tau}
    write_csv(
        path,
        {prefix: block for prefix, block in blocks.items() if block is not None},
        arm,
        {"coordinates": recording.coordinates, "arm": arm.full_name if arm else recording.arm_name},
    )


def convert(
    path: str | Path, output: str | Path, *, arm: Arm | None = None, progress: Progress | None = None, **options: Any
) -> Recording:
    """Reads a recording and writes it as a CSV or an MCAP bag for `read_recording`, atomically and with full precision.

    Args:
        path: Path of the recording.
        output: Path of the file to write: .csv, or .mcap for a bag. An existing file is replaced.
        arm: The data are written in the joint coordinates of this arm. If None, they are written in the coordinates of
            the recording. Required to write a bag. To read a recording, see `read_recording`.
        progress, options: See `read_recording`.

    Returns:
        Written recording. Its `source`, `lines` and `notes` refer to the original file.

    Raises:
        RecordingError: See `read_recording` and `write_recording`; additionally if `output` is the input recording
            or has another suffix, or the arm cannot reach the poses.
        DvrkDrakeError: The output cannot be written.
    """
    if Path(output).suffix.lower() not in (".csv", ".mcap"):
        raise RecordingError(f"{output}: the name of the output must end in .csv or .mcap (MCAP bag)")
    if os.path.exists(output) and os.path.exists(path) and os.path.samefile(path, output):
        raise RecordingError(f"{output} is the input recording. Choose another output file.")
    recording = read_recording(path, arm, progress=progress, **options)
    if arm is not None:
        recording = recording.in_joint_coordinates(arm)
        recording.check_fits(arm)
    write_recording(recording, output, arm)
    assumed: tuple[str, ...] = ()
    if not recording.file_coordinates:
        assumed = ("coordinates were not stated, read as joint coordinates (default)",)
    return dataclasses.replace(recording, notes=(*recording.notes, *assumed, _times(recording)))


def _times(recording: Recording) -> str:
    """Returns a note on the times. `check` reports faults of the times and repeated rows."""
    t = recording.t
    if t is None:
        return "without times, read as static poses; for a motion, give its sampling rate with --rate HZ"
    interval = f", median interval {1e3 * np.median(np.diff(t)):.4g} ms" if len(t) > 1 else ""
    return f"t from {t[0]:g} to {t[-1]:g} s{interval}"


#: Folder of the CSV files.
SAMPLES_FOLDER = Path(__file__).resolve().parent.parent / "samples"
#: Mapping from the name of a sample to its arm.
SAMPLES = {"mtm_poses": "mtmr", "mtm_other_poses": "mtmr", "mtm_motion": "mtmr", "psm_motion": "psm"}


def write_samples(folder: str | Path, *, overwrite: bool = False, progress: Progress | None = None) -> list[Path]:
    """Writes the sample recordings of simulated arms, each as a CSV and as an MCAP bag.

    The samples are two sets of 60 static poses of an MTMR, a motion of the same MTMR (30 s), and a motion of a PSM
    (30 s).

    Args:
        folder: Folder to write to. It is created if it does not exist.
        overwrite: Whether to write to a folder that is not empty, and replace files in it.
        progress: Callback that receives the name of the step ("writing") and the completed fraction (0 to 1).

    Returns:
        Paths of the files.

    Raises:
        DvrkDrakeError: The folder is not empty and `overwrite` is False, or a file cannot be written.

    Example:
        >>> import dvrk_drake as dvrk
        >>> files = dvrk.write_samples("samples")
        >>> [file.name for file in files if file.suffix == ".csv"]
        ['mtm_poses.csv', 'mtm_other_poses.csv', 'mtm_motion.csv', 'psm_motion.csv']
        >>> dvrk.check(dvrk.read_recording("samples/mtm_poses.csv"), dvrk.load_arm("mtmr")).warnings
        ()
    """
    folder, report = Path(folder), step_progress(progress, "writing")
    report(0.0)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if not overwrite and any(folder.iterdir()):
            raise DvrkDrakeError(f"{folder}: folder is not empty; choose another folder, or give overwrite=True")
        # Files are moved into the folder only after all of them have been written.
        with TemporaryDirectory(prefix=".samples-", dir=folder) as temporary:
            for i, (name, arm_name) in enumerate(SAMPLES.items()):
                arm, csv = load_arm(arm_name), Path(temporary, f"{name}.csv")
                shutil.copyfile(SAMPLES_FOLDER / csv.name, csv)
                write_recording(read_recording(csv, arm), csv.with_suffix(".mcap"), arm)
                report((i + 1) / len(SAMPLES))
            files = [folder / f"{name}{suffix}" for name in SAMPLES for suffix in (".csv", ".mcap")]
            if taken := [file for file in files if file.is_dir()]:
                raise DvrkDrakeError(f"{taken[0]}: is a folder and cannot be replaced; choose another folder")
            for file in files:
                os.replace(Path(temporary, file.name), file)
    except OSError as error:
        raise DvrkDrakeError(f"{folder}: the samples cannot be written: {error.strerror}") from error
    return files
