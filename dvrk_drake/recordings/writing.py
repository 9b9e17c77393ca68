"""Writes recordings as CSV files and as MCAP bags."""

from __future__ import annotations

import csv
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.errors import RecordingError
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.files import atomic_write
from dvrk_drake.recordings.arm_bag import write_mcap
from dvrk_drake.recordings.recording import Recording, Setpoints

#: Units of the quantities in a CSV, for a revolute and for a prismatic joint.
UNITS = {
    "t": ("s", "s"),
    **dict.fromkeys(("q", "pose"), ("rad", "m")),
    "qd": ("rad/s", "m/s"),
    **dict.fromkeys(("tau", "lower", "upper", "lower_other_day", "upper_other_day", "friction"), ("N m", "N")),
}


def column_names(prefix: str, num_joints: int, arm: Arm | None = None) -> list[str]:
    """Returns the column names of a quantity in a CSV, e.g. "q1". With `arm`, they contain the units, e.g. "q1 [rad]".

    Args:
        prefix: Name of the quantity, a key of `UNITS` if `arm` is given.
        num_joints: Number of columns, except for the time t.
        arm: Arm that defines which joints are prismatic.
    """
    names = ["t"] if prefix == "t" else [f"{prefix}{i + 1}" for i in range(num_joints)]
    if arm is None:
        return names
    return [f"{name} [{UNITS[prefix][bool(arm.prismatic[i])]}]" for i, name in enumerate(names)]


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
        {"coordinates": recording.coordinates, "arm": arm.name if arm else recording.arm_name},
    )


def write_csv(
    path: str | Path, blocks: Mapping[str, NDArray[np.float64]], arm: Arm | None, stated: Mapping[str, str]
) -> None:
    """Writes a table of numbers atomically and with full precision.

    Args:
        path: Path of the file. An existing file is replaced.
        blocks: Mapping from the prefix of the columns (key of `UNITS`) to their numbers (m, n), or (m,) for the time t.
        arm: Arm that defines the units of the columns. None: the names of the columns have no units.
        stated: Mapping from the names of further columns to the text in each of their rows. Empty texts are omitted.

    Raises:
        DvrkDrakeError: The folder does not exist or cannot be written.
    """
    tables = {prefix: block if block.ndim == 2 else block[:, None] for prefix, block in blocks.items()}
    stated = {name: text for name, text in stated.items() if text}
    header = [name for prefix, table in tables.items() for name in column_names(prefix, table.shape[1], arm)]
    with atomic_write(path) as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow([*header, *stated])
        writer.writerows([*map(repr, row), *stated.values()] for row in np.hstack(list(tables.values())).tolist())
