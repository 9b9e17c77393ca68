"""Writes recordings as CSV files and MCAP bags, converts recordings, and writes the sample recordings."""

from __future__ import annotations

import dataclasses
import os
import shutil
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from dvrk_drake.errors import DvrkDrakeError, RecordingError
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.progress import Progress, step_progress
from dvrk_drake.recordings.csv_files import write_csv
from dvrk_drake.recordings.reading import read_recording
from dvrk_drake.recordings.recording import Recording, Setpoints
from dvrk_drake.recordings.writer_mcap import write_mcap


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
