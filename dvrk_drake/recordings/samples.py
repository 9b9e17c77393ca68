"""Writes the sample recordings of the package. `tools/make_samples.py` makes them with simulated arms."""

from __future__ import annotations

import os
import shutil
from pathlib import Path
from tempfile import TemporaryDirectory

from dvrk_drake.errors import DvrkDrakeError
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.progress import Progress, step_progress
from dvrk_drake.recordings.reading import read_recording
from dvrk_drake.recordings.writing import write_recording

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
