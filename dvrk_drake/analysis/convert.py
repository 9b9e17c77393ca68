"""LCM logs, and public recordings of real arms, converted to the CSV of this project.

The public ones have two layouts, both of the WPI AIM lab; `docs/public_recordings.md` says how to obtain them.

- "team-mat", https://github.com/WPI-AIM/dvrk_gravity_comp: a MATLAB array of 8 x 2 x N.
- "wpi-csv", https://github.com/WPI-AIM/dvrk_dynamics_identification: a CSV of 21 columns without a header.
"""

from __future__ import annotations

import dataclasses
import hashlib
import io
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal, NamedTuple, TypeVar, get_args

import numpy as np
import scipy.io
from numpy.typing import NDArray

from dvrk_drake.errors import RecordingError
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.csv_rows import is_number, parse_finite, parse_number, read_bytes, read_rows
from dvrk_drake.models.lcm_log import is_lcm_log
from dvrk_drake.models.linear_map import LinearMap
from dvrk_drake.models.recording import Recording, read_recording, write_recording

Format = Literal["team-mat", "wpi-csv", "lcm-log"]

#: Nominal rate of the "wpi-csv" recordings [Hz].
WPI_RATE = 200.0

#: Joints that "wpi-csv" counts at the joint itself, although a disc drives them.
WPI_DIRECT_JOINTS = ("roll",)

_NUM_JOINTS = 7
_WPI_COLUMNS = [f"{prefix}{i + 1}" for prefix in ("q", "qd", "tau") for i in range(_NUM_JOINTS)]
_WPI_LAYOUT = "21 numbers a row: q1..q7, qd1..qd7, tau1..tau7"
_MATLAB_REAL = {"double", "single", *(f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64))}
_HDF5_MAGIC = b"\x89HDF\r\n\x1a\n"
_MATLAB_73 = (b"\x00\x02IM", b"\x02\x00MI")

_T = TypeVar("_T")


class Conversion(NamedTuple):
    """What `convert` did.

    Attributes:
        recording: as written; `source` and `lines` are those of the original.
        notes: what a user must know about it, one line each.
    """

    recording: Recording
    notes: list[str]


def convert(
    path: str | Path,
    output: str | Path,
    *,
    format: Format | None = None,
    variable: str | None = None,
    rate: float = WPI_RATE,
    arm: Arm | None = None,
    skip_invalid: bool = False,
) -> Conversion:
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
        conversion = _read_lcm_log(Path(path), arm)
    elif chosen == "team-mat":
        if rate != WPI_RATE:
            raise RecordingError(f"{path}: --rate does not apply to team-mat, whose poses have no time")
        if arm is not None:
            raise RecordingError(f"{path}: --arm does not apply to team-mat, which is in joint coordinates")
        conversion = _read_team_mat(Path(path), variable, skip_invalid)
    else:
        if variable is not None:
            raise RecordingError(f"{path}: --variable does not apply to wpi-csv, which has no variables")
        conversion = _read_wpi_csv(Path(path), rate, skip_invalid)
        if arm is not None:
            conversion = Conversion(wpi_in_joint_coordinates(conversion.recording, arm), conversion.notes)
    if conversion.recording.coordinates == "actuator":
        conversion.notes.insert(
            1,
            "in actuator coordinates, which a CSV cannot say: pass --coordinates actuator to every command that reads "
            "it, or convert with --arm (of a PSM always: its roll is not the dVRK's actuator)",
        )
    write_recording(conversion.recording, output)
    return conversion


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


def detect_format(path: str | Path) -> Format:
    """The format a file seems to have, from its first bytes: LCM, MATLAB or text. The reader judges the rest.

    Raises:
        RecordingError: no such file, or it is neither.
    """
    path = Path(path)
    if is_lcm_log(path):
        return "lcm-log"
    content = read_bytes(path)
    if content[126:128] in (b"IM", b"MI") or content[:8] == _HDF5_MAGIC or path.suffix.lower() == ".mat":
        return "team-mat"
    if b"\0" not in content[:4096]:
        return "wpi-csv"
    raise RecordingError(f"{path}: neither an LCM log, a MATLAB file (team-mat) nor a text file in UTF-8 (wpi-csv)")


def read_team_mat(path: str | Path, *, variable: str | None = None, skip_invalid: bool = False) -> Recording:
    """Static poses from a MATLAB array of 8 x 2 x N: joint, position (first) or effort (second), pose.

    The first seven rows are the joints in the dVRK's order [rad, N m], in joint coordinates; the eighth, the
    gripper, is not actuated and dropped. 8 x 2 is one pose, because MATLAB drops trailing dimensions of 1. A
    pose is invalid if it has a NaN or an infinity in its first seven rows, or only zeros: the arrays are
    allocated before they are filled. In messages and in `Recording.lines`, poses count from 1 as in MATLAB.

    Format: https://github.com/WPI-AIM/dvrk_gravity_comp, `GettingTorques/GetData.m`. MATLAB files up to
    version 7; version 7.3 (HDF5) is not supported.

    Args:
        path: the `.mat` file.
        variable: the array's name; None if the file has only one that fits.
        skip_invalid: leave out invalid poses instead of refusing the file.

    Raises:
        RecordingError: not such a file, no or several variables fit, or a pose is invalid.
    """
    return _read_team_mat(Path(path), variable, skip_invalid).recording


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
    return _read_wpi_csv(Path(path), rate, skip_invalid).recording


def _read_lcm_log(path: Path, arm: Arm | None) -> Conversion:
    if not is_lcm_log(path):
        raise RecordingError(f"{path}: is not an LCM log")
    recording = read_recording(path, arm)
    return Conversion(recording, list(recording.notes))


def _read_team_mat(path: Path, variable: str | None, skip_invalid: bool) -> Conversion:
    content = read_bytes(path)
    name, array = _team_array(path, content, variable)
    count = array.shape[2]
    joints = array[:_NUM_JOINTS]
    invalid = ~np.all(np.isfinite(joints), axis=(0, 1)) | ~np.any(joints, axis=(0, 1))
    if np.any(invalid) and not skip_invalid:
        raise RecordingError(_first_invalid_pose(path, joints, invalid))
    if np.all(invalid):
        raise RecordingError(f"{path}: variable {name} has no valid pose among its {count}")
    kept = joints[:, :, ~invalid]
    notes = [
        f"{kept.shape[2]} static poses from variable {name}, in joint coordinates",
        "the eighth row (gripper, not actuated) is dropped",
    ]
    if np.any(invalid):
        poses = _listed(np.flatnonzero(invalid) + 1)
        notes.append(f"{np.sum(invalid)} of {count} poses skipped (NaN, infinite or all zeros): {poses}")
    recording = Recording(
        q=kept[:, 0].T.copy(),
        tau=kept[:, 1].T.copy(),
        source=str(path),
        lines=np.flatnonzero(~invalid) + 1,
        sha256=hashlib.sha256(content).hexdigest(),
    )
    return Conversion(recording, notes)


def _team_array(path: Path, content: bytes, variable: str | None) -> tuple[str, NDArray[np.float64]]:
    """The chosen variable and its name, always as (8, 2, N)."""
    if content[:8] == _HDF5_MAGIC or content[124:128] in _MATLAB_73:
        raise RecordingError(
            f"{path}: is a MATLAB v7.3 (HDF5) file, which is not supported; load it in MATLAB and save it with '-v7'"
        )
    listed = _matlab(path, lambda: scipy.io.whosmat(io.BytesIO(content)))
    found = ", ".join(f"{n} ({' x '.join(map(str, s))} {kind})" for n, s, kind in listed) or "no variables"
    fitting = [n for n, s, kind in listed if s[:2] == (8, 2) and len(s) <= 3 and kind in _MATLAB_REAL]
    layout = "8 x 2 x N real numbers (joint; position or effort; pose)"
    if variable is not None:
        if variable not in (n for n, _, _ in listed):
            raise RecordingError(f"{path}: has no variable {variable}; it has: {found}")
        if variable not in fitting:
            raise RecordingError(f"{path}: variable {variable} must be {layout}; the file has: {found}")
    elif not fitting:
        raise RecordingError(f"{path}: no variable is {layout}; it has: {found}")
    elif len(fitting) > 1:
        raise RecordingError(
            f"{path}: several variables fit: {', '.join(fitting)}; "
            "choose one with --variable NAME (variable= in Python)"
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
        return read()
    except Exception as error:
        # A damaged file makes scipy raise anything: ValueError, OSError, MatReadError, zlib.error, ...
        text = " ".join(str(error).split())
        raise RecordingError(f"{path}: not a MATLAB file that can be read: {text}") from error


def _first_invalid_pose(path: Path, joints: NDArray[np.float64], invalid: NDArray[np.bool_]) -> str:
    pose = int(np.flatnonzero(invalid)[0])
    bad = np.argwhere(~np.isfinite(joints[:, :, pose]))
    problem = "pose has only zeros, so it was never recorded"
    if len(bad):
        joint, which = bad[0]
        name, value = f"{('q', 'tau')[which]}{joint + 1}", joints[joint, which, pose]
        problem = f"{name} is {value}; only finite numbers are allowed"
    count = f"{np.sum(invalid)} of {len(invalid)} poses"
    return f"{path}:{pose + 1}: {problem}; {count} are invalid (--skip-invalid leaves them out)"


def _read_wpi_csv(path: Path, rate: float, skip_invalid: bool) -> Conversion:
    if not (np.isfinite(rate) and rate > 0):
        raise RecordingError(f"rate must be a positive number of Hz, not {rate}")
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
        skipped = _listed(lines[~valid])
        notes.append(f"{len(values) - len(kept)} of {len(values)} rows skipped (NaN or infinite): lines {skipped}")
    if repeats:
        notes.append(f"{repeats} of {len(kept)} rows repeat the row before them (polled too fast); they are kept")
    q, qd, tau = np.split(kept, 3, axis=1)
    recording = Recording(
        q=q,
        tau=tau,
        qd=qd,
        t=np.flatnonzero(valid) / rate,
        coordinates="actuator",
        source=str(path),
        lines=lines[valid],
        sha256=sha256,
    )
    return Conversion(recording, notes)


def _listed(numbers: NDArray[Any]) -> str:
    shown = ", ".join(map(str, numbers[:10]))
    return shown if len(numbers) <= 10 else f"{shown}, ..."
