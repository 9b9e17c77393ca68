"""Public recordings of motions as CSVs of 21 columns without a header.

Of the WPI AIM lab, https://github.com/WPI-AIM/dvrk_dynamics_identification; `docs/public_recordings.md` says how to
obtain them.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.errors import RecordingError
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.linear_map import LinearMap
from dvrk_drake.recordings.csv_rows import is_number, parse_finite, parse_or_nan, read_rows, skipped_note
from dvrk_drake.recordings.recording import Recording

#: Nominal rate of the recordings [Hz].
WPI_RATE = 200.0

#: Joints that are counted at the joint itself, although a disc drives them.
WPI_DIRECT_JOINTS = ("roll",)

_NUM_JOINTS = 7
_WPI_COLUMNS = [f"{prefix}{i + 1}" for prefix in ("q", "qd", "tau") for i in range(_NUM_JOINTS)]
_WPI_LAYOUT = "21 numbers a row: q1..q7, qd1..qd7, tau1..tau7"


def read_wpi_csv(path: str | Path, rate: float | None = None, *, skip_invalid: bool = False) -> Recording:
    """A motion from a CSV without a header: q1..q7, qd1..qd7, tau1..tau7, in actuator coordinates.

    Units are rad, rad/s and N m. Of a PSM, axis 3 is in m, m/s and N, and axis 7 is the jaw. The file has
    no time stamps: t = row / rate. The CSV that `convert` wrote without an arm (header t, q1.., qd1.., tau1..) is
    read as well. It keeps its time stamps.

    Format: https://github.com/WPI-AIM/dvrk_dynamics_identification, files
    `data/*/measured_trajectory/*_results.csv`.

    Args:
        path: the CSV file.
        rate: samples a second [Hz]; default: `WPI_RATE`.
        skip_invalid: leave out rows with an empty cell, a NaN or an infinity instead of refusing the file; the other
            rows keep their t.

    Raises:
        RecordingError: not such a file, fewer than two rows, a cell that is no finite number, or a rate for a file that
            has time stamps.
    """
    path = Path(path)
    rows, sha256 = read_rows(path)
    if not rows:
        raise RecordingError(f"{path}: is empty; needs {_WPI_LAYOUT}")
    first_line, first = rows[0]
    timed = first == ["t", *_WPI_COLUMNS]
    names = ["t", *_WPI_COLUMNS] if timed else _WPI_COLUMNS
    if timed:
        refuse_rate(path, rate)
        rows = rows[1:]
    elif not any(is_number(cell) for cell in first):
        raise RecordingError(
            f"{path}:{first_line}: has a header, which wpi-csv has not ({_WPI_LAYOUT}); "
            "a CSV whose header names q1..q7 needs no conversion"
        )
    values = np.empty((len(rows), len(names)))
    parse = parse_or_nan if skip_invalid else parse_finite
    for row, (line, cells) in enumerate(rows):
        if len(cells) != len(names):
            layout = f"its header names {len(names)} columns" if timed else f"wpi-csv has {_WPI_LAYOUT}"
            raise RecordingError(f"{path}:{line}: has {len(cells)} cells; {layout}")
        for column, cell in enumerate(cells):
            values[row, column] = parse(cell, f"{path}:{line}: {names[column]} (column {column + 1})")
    valid = np.all(np.isfinite(values), axis=1)
    lines = np.array([line for line, _ in rows])
    kept = values[valid]
    if len(kept) < 2:
        raise RecordingError(f"{path}: has {len(kept)} valid row{'s' * (len(kept) != 1)}; a motion needs at least 2")
    if timed:
        t, kept = kept[:, 0], kept[:, 1:]
        notes = time_notes(t, lines[valid])
    else:
        t, note = made_times(np.flatnonzero(valid), WPI_RATE if rate is None else rate)
        notes = [note]
    if len(kept) < len(values):
        notes.append(skipped_note(lines[~valid], len(values)))
    repeats = int(np.sum(np.all(np.diff(kept, axis=0) == 0, axis=1)))
    if repeats:
        notes.append(f"{repeats} of {len(kept)} rows repeat the row before them (polled too fast); they are kept")
    q, qd, tau = np.split(kept, 3, axis=1)
    return Recording(
        q=q,
        tau=tau,
        qd=qd,
        t=t,
        coordinates="actuator",
        source=str(path),
        lines=lines[valid],
        notes=tuple(notes),
        sha256=sha256,
    )


def refuse_rate(path: Path, rate: float | None) -> None:
    """Raises RecordingError if a rate is given for a file that has time stamps."""
    if rate is not None:
        raise RecordingError(f"{path}: --rate does not apply: the file has time stamps (column t), which are kept")


def made_times(rows: NDArray[np.intp], rate: float) -> tuple[NDArray[np.float64], str]:
    """Times [s] for the numbers of rows of a file without time stamps, and the note that says so.

    Raises:
        RecordingError: the rate is no positive number.
    """
    if not (np.isfinite(rate) and rate > 0):
        raise RecordingError(f"rate must be a positive number of Hz, not {rate}")
    return rows / rate, f"{len(rows)} samples; the file has no time stamps, so t = row / {rate:g} Hz"


def time_notes(t: NDArray[np.float64], lines: NDArray[np.int_]) -> list[str]:
    """What a user must know of time stamps (m,) that are kept; `lines` (m,) are those of the file."""
    steps = np.diff(t)
    interval = f", median interval {1e3 * np.median(steps):.4g} ms" if len(steps) else ""
    notes = [f"{len(t)} rows, t from {t[0]:g} to {t[-1]:g} s as in the file{interval}"]
    if np.any(steps <= 0):
        repeated, back = int(np.sum(steps == 0)), int(np.sum(steps < 0))
        notes.append(
            f"t does not always increase: {repeated} row{'s repeat' if repeated != 1 else ' repeats'} the t before "
            f"{'them' if repeated != 1 else 'it'}, {back} go{'es' * (back == 1)} back, first at line "
            f"{lines[1:][steps <= 0][0]}; kept, but a motion with such times is refused by identify"
        )
    return notes


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
