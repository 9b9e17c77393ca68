"""Public recordings of static poses as MATLAB arrays of 8 x 2 x N.

Of the WPI AIM lab, https://github.com/WPI-AIM/dvrk_gravity_comp; `docs/public_recordings.md` says how to obtain them.
"""

from __future__ import annotations

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
from dvrk_drake.recordings.csv_rows import listed, read_bytes
from dvrk_drake.recordings.recording import Recording

_MTM_JOINTS = 7
_MATLAB_REAL = {"double", "single", *(f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64))}
_HDF5_MAGIC = b"\x89HDF\r\n\x1a\n"
_MATLAB_73 = (b"\x00\x02IM", b"\x02\x00MI")

_T = TypeVar("_T")


def looks_like_matlab(path: Path, content: bytes) -> bool:
    """Whether a file with this content is one of MATLAB's, by its first bytes or its name."""
    return content[126:128] in (b"IM", b"MI") or content[:8] == _HDF5_MAGIC or path.suffix.lower() == ".mat"


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
    path = Path(path)
    content = read_bytes(path)
    name, array = _team_array(path, content, variable)
    count = array.shape[2]
    joints = array[:_MTM_JOINTS]
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
        poses = listed(np.flatnonzero(invalid) + 1)
        notes.append(f"{np.sum(invalid)} of {count} poses skipped (NaN, infinite or all zeros): {poses}")
    return Recording(
        q=kept[:, 0].T.copy(),
        tau=kept[:, 1].T.copy(),
        source=str(path),
        lines=np.flatnonzero(~invalid) + 1,
        notes=tuple(notes),
        sha256=hashlib.sha256(content).hexdigest(),
    )


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
        with warnings.catch_warnings():
            # "returned data may be corrupt"
            warnings.simplefilter("error", UserWarning)
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
