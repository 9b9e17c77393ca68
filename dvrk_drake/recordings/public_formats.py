"""Reads public recordings of real arms: motions as CSVs of 21 columns, static poses as MATLAB arrays of 8 x 2 x N.

The recordings are from the WPI AIM lab, https://github.com/WPI-AIM/dvrk_dynamics_identification and
https://github.com/WPI-AIM/dvrk_gravity_comp; `docs/public_recordings.md` explains how to obtain them.
"""

from __future__ import annotations

import dataclasses
import hashlib
import io
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import numpy as np
import scipy.io
from numpy.typing import NDArray

from dvrk_drake.errors import RecordingError
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.linear_map import LinearMap
from dvrk_drake.recordings.csv_rows import (
    is_number,
    listed,
    parse_finite,
    parse_or_nan,
    read_bytes,
    read_rows,
    skipped_note,
)
from dvrk_drake.recordings.recording import Recording

#: Nominal sampling rate of the recordings [Hz].
WPI_RATE = 200.0

#: Joints that are recorded in joint coordinates instead of actuator coordinates.
WPI_DIRECT_JOINTS = ("roll",)

_NUM_JOINTS = 7
_WPI_COLUMNS = [f"{prefix}{i + 1}" for prefix in ("q", "qd", "tau") for i in range(_NUM_JOINTS)]
_WPI_LAYOUT = "21 numbers per row: q1..q7, qd1..qd7, tau1..tau7"


def read_wpi_csv(path: str | Path, rate: float | None = None, *, skip_invalid: bool = False) -> Recording:
    """Reads a motion from a CSV without a header: q1..q7, qd1..qd7, tau1..tau7, in actuator coordinates.

    Units are rad, rad/s and N m. For a PSM, axis 3 is in m, m/s and N, and axis 7 is the jaw. The file has no time
    stamps: t = row / rate. The CSV that `convert` wrote without an arm (header t, q1.., qd1.., tau1..) is also
    accepted. Its time stamps are kept.

    Format: https://github.com/WPI-AIM/dvrk_dynamics_identification, files
    `data/*/measured_trajectory/*_results.csv`.

    Args:
        path: Path of the CSV file.
        rate: Sampling rate [Hz]; None for `WPI_RATE`.
        skip_invalid: Whether to omit rows that contain an empty cell, a NaN or an infinity. The times of the other rows
            do not change. If False, a file with such rows is refused.

    Raises:
        RecordingError: The file does not have this layout, has fewer than two rows, or has a cell that is not a finite
            number, or `rate` is given for a file with time stamps.
    """
    path = Path(path)
    rows, sha256 = read_rows(path)
    if not rows:
        raise RecordingError(f"{path} is empty; needs {_WPI_LAYOUT}")
    first_line, first = rows[0]
    timed = first == ["t", *_WPI_COLUMNS]
    names = ["t", *_WPI_COLUMNS] if timed else _WPI_COLUMNS
    if timed:
        refuse_rate(path, rate)
        rows = rows[1:]
    elif not any(is_number(cell) for cell in first):
        raise RecordingError(
            f"{path}, line {first_line}: unexpected header; wpi-csv files have no header and {_WPI_LAYOUT}. "
            "A CSV with columns q1..q7 in its header needs no conversion."
        )
    values = np.empty((len(rows), len(names)))
    parse = parse_or_nan if skip_invalid else parse_finite
    for row, (line, cells) in enumerate(rows):
        if len(cells) != len(names):
            layout = f"the header has {len(names)}" if timed else f"wpi-csv files have {_WPI_LAYOUT}"
            raise RecordingError(f"{path}, line {line}: the row has {len(cells)} cells, {layout}")
        for column, cell in enumerate(cells):
            values[row, column] = parse(cell, f"{path}, line {line}: {names[column]} (column {column + 1})")
    valid = np.all(np.isfinite(values), axis=1)
    lines = np.array([line for line, _ in rows])
    kept = values[valid]
    if len(kept) < 2:
        raise RecordingError(f"{path} has {len(kept)} valid row{'s' * (len(kept) != 1)}; a motion needs at least 2")
    if timed:
        t, kept = kept[:, 0], kept[:, 1:]
        notes = time_notes(t, lines[valid])
    else:
        t, note = generated_times(np.flatnonzero(valid), WPI_RATE if rate is None else rate)
        notes = [note]
    if len(kept) < len(values):
        notes.append(skipped_note(lines[~valid], len(values)))
    repeats = int(np.sum(np.all(np.diff(kept, axis=0) == 0, axis=1)))
    if repeats:
        notes.append(
            f"{repeats} of {len(kept)} rows repeat the previous row (sampled faster than the arm measures); "
            "these rows are kept"
        )
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


def generated_times(rows: NDArray[np.intp], rate: float) -> tuple[NDArray[np.float64], str]:
    """Returns times [s] for the row numbers of a file without time stamps, and a note on the times.

    Raises:
        RecordingError: The rate is not a positive number.
    """
    if not (np.isfinite(rate) and rate > 0):
        raise RecordingError(f"rate is {rate:g} Hz; allowed: a positive number")
    return rows / rate, f"{len(rows)} samples; the file has no time stamps, so t = row / {rate:g} Hz"


def time_notes(t: NDArray[np.float64], lines: NDArray[np.int_]) -> list[str]:
    """Returns notes for the user on recorded time stamps `t` (m,), which are on the `lines` (m,) of the file."""
    steps = np.diff(t)
    interval = f", median interval {1e3 * np.median(steps):.4g} ms" if len(steps) else ""
    notes = [f"{len(t)} rows, t from {t[0]:g} to {t[-1]:g} s as in the file{interval}"]
    if np.any(steps <= 0):
        repeated, back = int(np.sum(steps == 0)), int(np.sum(steps < 0))
        notes.append(
            f"t does not increase in all rows ({repeated} equal, {back} smaller than the previous t; first at line "
            f"{lines[1:][steps <= 0][0]}). The rows are kept, but identify refuses a motion with such times."
        )
    return notes


def wpi_in_joint_coordinates(recording: Recording, arm: Arm) -> Recording:
    """Converts a "wpi-csv" recording of `arm` from actuator to joint coordinates.

    The recorded coordinates are those of the actuators of the dVRK. The exception is the roll of a PSM, which is
    recorded at the joint (Wang et al. 2019, table of the PSM).

    Raises:
        RecordingError: The number of joints is wrong, or the arm cannot reach the poses.
    """
    J = arm.transmission.matrix.copy()
    for joint in set(WPI_DIRECT_JOINTS) & set(arm.joint_names):
        row = arm.joint_names.index(joint)
        J[row] = np.eye(arm.num_joints)[row]
    converted = recording.in_joint_coordinates(dataclasses.replace(arm, transmission=LinearMap(J, np.zeros(len(J)))))
    converted.check_fits(arm)
    return converted


_MTM_JOINTS = 7
_MATLAB_REAL = {"double", "single", *(f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64))}
_HDF5_MAGIC = b"\x89HDF\r\n\x1a\n"
_MATLAB_73 = (b"\x00\x02IM", b"\x02\x00MI")

_T = TypeVar("_T")


def looks_like_matlab(path: Path, content: bytes) -> bool:
    """Returns whether a file is a MATLAB file, according to its first bytes or its name."""
    return content[126:128] in (b"IM", b"MI") or content[:8] == _HDF5_MAGIC or path.suffix.lower() == ".mat"


def read_team_mat(path: str | Path, *, variable: str | None = None, skip_invalid: bool = False) -> Recording:
    """Reads static poses from a MATLAB array of 8 x 2 x N. The indices are joint, quantity (position, effort) and pose.

    The first seven rows are the joints in the dVRK's order [rad, N m], in joint coordinates. The eighth row is the
    gripper, which has no actuator. It is omitted. An array of 8 x 2 is one pose, because MATLAB drops trailing
    dimensions of 1. A pose is invalid if its first seven rows contain a NaN or an infinity, or only zeros. Zeros mean
    that the pose was not recorded, because the arrays are allocated before they are filled. In messages and in
    `Recording.lines`, poses are counted from 1 as in MATLAB.

    Format: https://github.com/WPI-AIM/dvrk_gravity_comp, `GettingTorques/GetData.m`. MATLAB files up to
    version 7 are supported; version 7.3 (HDF5) is not.

    Args:
        path: Path of the `.mat` file.
        variable: Name of the array; None if only one array of the file matches.
        skip_invalid: Whether to omit invalid poses. If False, a file with invalid poses is refused.

    Raises:
        RecordingError: The file does not have this layout, no variable or several variables match, or a pose is
            invalid.
    """
    path = Path(path)
    content = read_bytes(path)
    name, array = _team_array(path, content, variable)
    count = array.shape[2]
    joints = array[:_MTM_JOINTS]
    invalid = ~np.all(np.isfinite(joints), axis=(0, 1)) | ~np.any(joints, axis=(0, 1))
    if np.any(invalid) and not skip_invalid:
        raise RecordingError(_first_invalid_pose(path, joints, invalid))
    if np.all(invalid):
        raise RecordingError(f"{path}: variable {name} has {count} poses, but none is valid")
    kept = joints[:, :, ~invalid]
    notes = [
        f"{kept.shape[2]} static poses from variable {name}, in joint coordinates",
        "the eighth row (gripper, not actuated) is dropped",
    ]
    if np.any(invalid):
        poses = listed(np.flatnonzero(invalid) + 1)
        notes.append(f"{np.sum(invalid)} of {count} poses skipped (NaN, infinite or all zeros): {poses}")
    return Recording(
        q=kept[:, 0].T.copy(),
        tau=kept[:, 1].T.copy(),
        source=str(path),
        lines=np.flatnonzero(~invalid) + 1,
        line_label="pose",
        notes=tuple(notes),
        sha256=hashlib.sha256(content).hexdigest(),
    )


def _team_array(path: Path, content: bytes, variable: str | None) -> tuple[str, NDArray[np.float64]]:
    """Returns the name and the array (8, 2, N) of the selected variable."""
    if content[:8] == _HDF5_MAGIC or content[124:128] in _MATLAB_73:
        raise RecordingError(
            f"{path} is a MATLAB v7.3 (HDF5) file, which is not supported. Load it in MATLAB and save it with '-v7'."
        )
    listed = _matlab(path, lambda: scipy.io.whosmat(io.BytesIO(content)))
    found = ", ".join(f"{n} ({' x '.join(map(str, s))} {kind})" for n, s, kind in listed) or "no variables"
    fitting = [n for n, s, kind in listed if s[:2] == (8, 2) and len(s) <= 3 and kind in _MATLAB_REAL]
    layout = "8 x 2 x N real numbers (joint; position or effort; pose)"
    if variable is not None:
        if variable not in (n for n, _, _ in listed):
            raise RecordingError(f"{path} has no variable {variable}. Variables in the file: {found}.")
        if variable not in fitting:
            raise RecordingError(f"{path}: variable {variable} must be {layout}. Variables in the file: {found}.")
    elif not fitting:
        raise RecordingError(f"{path}: no variable has the layout {layout}. Variables in the file: {found}.")
    elif len(fitting) > 1:
        raise RecordingError(
            f"{path}: several variables have the layout {layout}: {', '.join(fitting)}. "
            "Choose one with --variable NAME (variable= in Python)."
        )
    name = variable or fitting[0]
    array = _matlab(path, lambda: scipy.io.loadmat(io.BytesIO(content), variable_names=[name])[name])
    if np.iscomplexobj(array):
        raise RecordingError(f"{path}: variable {name} is complex; it must be {layout}")
    if array.size == 0:
        raise RecordingError(f"{path}: variable {name} has no poses")
    return name, array.astype(float).reshape(8, 2, -1)


def _matlab(path: Path, read: Callable[[], _T]) -> _T:
    try:
        with warnings.catch_warnings():
            # Raises the warning "returned data may be corrupt" as an error.
            warnings.simplefilter("error", UserWarning)
            return read()
    except Exception as error:
        # For a damaged file scipy may raise any error: ValueError, OSError, MatReadError, zlib.error, ...
        text = " ".join(str(error).split())
        raise RecordingError(f"{path}: invalid MATLAB file: {text}") from error


def _first_invalid_pose(path: Path, joints: NDArray[np.float64], invalid: NDArray[np.bool_]) -> str:
    pose = int(np.flatnonzero(invalid)[0])
    bad = np.argwhere(~np.isfinite(joints[:, :, pose]))
    problem = "all numbers are zero, so the pose was not recorded"
    if len(bad):
        joint, which = bad[0]
        name, value = f"{('q', 'tau')[which]}{joint + 1}", joints[joint, which, pose]
        problem = f"{name} is {value}; only finite numbers are allowed"
    count = f"{np.sum(invalid)} of {len(invalid)} poses"
    return f"{path}, pose {pose + 1}: {problem}. Use --skip-invalid to omit invalid poses ({count})."
