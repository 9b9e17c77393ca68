"""Public recordings of motions as CSVs of 21 columns without a header.

Of the WPI AIM lab, https://github.com/WPI-AIM/dvrk_dynamics_identification; `docs/public_recordings.md` says how to
obtain them.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np

from dvrk_drake.errors import RecordingError
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.csv_rows import is_number, listed, parse_finite, parse_number, read_rows
from dvrk_drake.models.linear_map import LinearMap
from dvrk_drake.models.recording import Recording

#: Nominal rate of the recordings [Hz].
WPI_RATE = 200.0

#: Joints that are counted at the joint itself, although a disc drives them.
WPI_DIRECT_JOINTS = ("roll",)

_NUM_JOINTS = 7
_WPI_COLUMNS = [f"{prefix}{i + 1}" for prefix in ("q", "qd", "tau") for i in range(_NUM_JOINTS)]
_WPI_LAYOUT = "21 numbers a row: q1..q7, qd1..qd7, tau1..tau7"


def read_wpi_csv(path: str | Path, rate: float = WPI_RATE, *, skip_invalid: bool = False) -> Recording:
    """A motion from a CSV without a header: q1..q7, qd1..qd7, tau1..tau7, in actuator coordinates.

    Units are rad, rad/s and N m. Of a PSM, axis 3 is in m, m/s and N, and axis 7 is the jaw. The file has
    no time stamps: t = row / rate.

    Format: https://github.com/WPI-AIM/dvrk_dynamics_identification, files
    `data/*/measured_trajectory/*_results.csv`.

    Args:
        path: the CSV file.
        rate: samples a second [Hz].
        skip_invalid: leave out rows with a NaN or an infinity instead of refusing the file; the other rows
            keep their t.

    Raises:
        RecordingError: not such a file, fewer than two rows, or a cell that is no finite number.
    """
    if not (np.isfinite(rate) and rate > 0):
        raise RecordingError(f"rate must be a positive number of Hz, not {rate}")
    path = Path(path)
    rows, sha256 = read_rows(path)
    if not rows:
        raise RecordingError(f"{path}: is empty; needs {_WPI_LAYOUT}")
    first_line, first = rows[0]
    if [cell.strip() for cell in first] == ["t", *_WPI_COLUMNS]:
        # Ours already, from an earlier conversion: its times are made anew.
        rows = [(line, cells[1:]) for line, cells in rows[1:]]
    elif not any(is_number(cell) for cell in first):
        raise RecordingError(
            f"{path}:{first_line}: has a header, which wpi-csv has not ({_WPI_LAYOUT}); "
            "a CSV whose header names q1..q7 needs no conversion"
        )
    values = np.empty((len(rows), len(_WPI_COLUMNS)))
    parse = parse_number if skip_invalid else parse_finite
    for row, (line, cells) in enumerate(rows):
        if len(cells) != len(_WPI_COLUMNS):
            raise RecordingError(f"{path}:{line}: has {len(cells)} cells; wpi-csv has {_WPI_LAYOUT}")
        for column, cell in enumerate(cells):
            values[row, column] = parse(cell, f"{path}:{line}: {_WPI_COLUMNS[column]} (column {column + 1})")
    valid = np.all(np.isfinite(values), axis=1)
    lines = np.array([line for line, _ in rows])
    kept = values[valid]
    if len(kept) < 2:
        raise RecordingError(f"{path}: has {len(kept)} valid row{'s' * (len(kept) != 1)}; a motion needs at least 2")
    repeats = int(np.sum(np.all(np.diff(kept, axis=0) == 0, axis=1)))
    notes = [
        f"{len(kept)} samples; the file has no time stamps, so t = row / {rate:g} Hz",
    ]
    if len(kept) < len(values):
        skipped = listed(lines[~valid])
        notes.append(f"{len(values) - len(kept)} of {len(values)} rows skipped (NaN or infinite): lines {skipped}")
    if repeats:
        notes.append(f"{repeats} of {len(kept)} rows repeat the row before them (polled too fast); they are kept")
    q, qd, tau = np.split(kept, 3, axis=1)
    return Recording(
        q=q,
        tau=tau,
        qd=qd,
        t=np.flatnonzero(valid) / rate,
        coordinates="actuator",
        source=str(path),
        lines=lines[valid],
        notes=tuple(notes),
        sha256=sha256,
    )


def wpi_in_joint_coordinates(recording: Recording, arm: Arm) -> Recording:
    """A "wpi-csv" recording of `arm`, in actuator coordinates, in joint coordinates.

    Its actuators are the dVRK's but for the roll of a PSM, which is the joint's own (Wang et al. 2019, PSM's table).

    Raises:
        RecordingError: wrong number of joints, or poses that the arm cannot have taken.
    """
    J = arm.transmission.matrix.copy()
    for joint in set(WPI_DIRECT_JOINTS) & set(arm.joint_names):
        row = arm.joint_names.index(joint)
        J[row] = np.eye(arm.num_joints)[row]
    converted = recording.in_joint_coordinates(dataclasses.replace(arm, transmission=LinearMap(J, np.zeros(len(J)))))
    converted.check_fits(arm)
    return converted
