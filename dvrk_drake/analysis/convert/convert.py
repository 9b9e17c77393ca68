"""LCM logs, and public recordings of real arms, converted to the CSV of this project.

The public ones have two layouts, both of the WPI AIM lab; `docs/public_recordings.md` says how to obtain them.

- "team-mat", https://github.com/WPI-AIM/dvrk_gravity_comp: a MATLAB array of 8 x 2 x N.
- "wpi-csv", https://github.com/WPI-AIM/dvrk_dynamics_identification: a CSV of 21 columns without a header.
"""

from __future__ import annotations

import dataclasses
import os
from pathlib import Path
from typing import Literal, get_args

from dvrk_drake.analysis.convert.team_mat import looks_like_matlab, read_team_mat
from dvrk_drake.analysis.convert.wpi_csv import WPI_RATE, read_wpi_csv, wpi_in_joint_coordinates
from dvrk_drake.errors import RecordingError
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.csv_rows import read_bytes
from dvrk_drake.models.lcm_log import is_lcm_log
from dvrk_drake.models.recording import Recording, read_recording, write_recording

Format = Literal["team-mat", "wpi-csv", "lcm-log"]


def convert(
    path: str | Path,
    output: str | Path,
    *,
    format: Format | None = None,
    variable: str | None = None,
    rate: float = WPI_RATE,
    arm: Arm | None = None,
    skip_invalid: bool = False,
) -> Recording:
    """Reads a recording and writes it as the CSV that `read_recording` reads, at once or not at all.

    Args:
        path: the recording.
        output: the CSV to write; an existing file is replaced.
        format: None to look at the file.
        variable: "team-mat": which variable; needed if several fit.
        rate: "wpi-csv": samples a second [Hz].
        arm: "wpi-csv": write joint coordinates of this arm; otherwise the file's own, of the actuators.
            "lcm-log": the arm whose statuses are read; needed if there are several.
        skip_invalid: leave out invalid rows (or poses) and count them, instead of refusing the file.

    Returns:
        The recording as written; `source`, `lines` and `notes` are of the original.

    Raises:
        RecordingError: the file does not have the format's layout, or an option is not for its format.
        DvrkDrakeError: the output cannot be written.
    """
    if format is not None and format not in get_args(Format):
        raise RecordingError(f'unknown format "{format}"; known formats: {", ".join(get_args(Format))}')
    if os.path.exists(output) and os.path.exists(path) and os.path.samefile(path, output):
        raise RecordingError(f"{output}: is the recording itself; name another output")
    chosen = format or detect_format(path)
    if chosen == "lcm-log":
        if rate != WPI_RATE or variable is not None or skip_invalid:
            raise RecordingError(f"{path}: --rate, --variable and --skip-invalid do not apply to an LCM log")
        if not is_lcm_log(Path(path)):
            raise RecordingError(f"{path}: is not an LCM log")
        recording = read_recording(path, arm)
    elif chosen == "team-mat":
        if rate != WPI_RATE:
            raise RecordingError(f"{path}: --rate does not apply to team-mat, whose poses have no time")
        if arm is not None:
            raise RecordingError(f"{path}: --arm does not apply to team-mat, which is in joint coordinates")
        recording = read_team_mat(path, variable=variable, skip_invalid=skip_invalid)
    else:
        if variable is not None:
            raise RecordingError(f"{path}: --variable does not apply to wpi-csv, which has no variables")
        recording = read_wpi_csv(path, rate, skip_invalid=skip_invalid)
        if arm is not None:
            recording = wpi_in_joint_coordinates(recording, arm)
    if recording.coordinates == "actuator":
        first, *others = recording.notes
        note = (
            "in actuator coordinates, which a CSV cannot say: pass --coordinates actuator to every command that reads "
            "it, or convert with --arm (of a PSM always: its roll is not the dVRK's actuator)"
        )
        recording = dataclasses.replace(recording, notes=(first, note, *others))
    write_recording(recording, output)
    return recording


def detect_format(path: str | Path) -> Format:
    """The format a file seems to have, from its first bytes: LCM, MATLAB or text. The reader judges the rest.

    Raises:
        RecordingError: no such file, or it is neither.
    """
    path = Path(path)
    if is_lcm_log(path):
        return "lcm-log"
    content = read_bytes(path)
    if looks_like_matlab(path, content):
        return "team-mat"
    if b"\0" not in content[:4096]:
        return "wpi-csv"
    raise RecordingError(f"{path}: neither an LCM log, a MATLAB file (team-mat) nor a text file in UTF-8 (wpi-csv)")
