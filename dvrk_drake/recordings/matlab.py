"""Reads positions and efforts from MATLAB files (v5, v7, v7.3) and NumPy archives with named arrays.

Two public layouts are recognised:

- the static poses of https://github.com/WPI-AIM/dvrk_gravity_comp: one array of 8 x 2 x N (`read_pose_array`);
- the gravity collection of https://github.com/jhu-dvrk/dvrk-gravity-compensation: `current_position` and
  `desired_effort`, each 7 x poses x samples, as `.mat` or `.npz`.

All other files need arrays named q and tau (and optionally qd and t), or the names of the arrays.
"""

from __future__ import annotations

import io
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
import scipy.io
from numpy.typing import NDArray

from dvrk_drake.errors import RecordingError

_HDF5_MAGIC = b"\x89HDF\r\n\x1a\n"
_ZIP_MAGIC = b"PK\x03\x04"
#: Names of arrays that are recognised, in lower case; the names of the public gravity collection come first.
_NAMES = {
    "q": ("current_position", "q", "position", "positions", "measured_position", "joint_position", "joint_positions"),
    "qd": ("qd", "dq", "v", "velocity", "velocities", "measured_velocity", "joint_velocity", "joint_velocities"),
    "tau": (
        "desired_effort", "tau", "effort", "efforts", "torque", "torques", "measured_effort", "joint_effort",
        "joint_torque", "joint_torques",
    ),
    "t": ("t", "time", "times", "timestamp", "timestamps"),
}  # fmt: skip


class NamedArrays(NamedTuple):
    """Rows of q, qd, tau (m, n) and t (m,); None for those that the file does not have, and notes for the user."""

    q: NDArray[np.float64]
    qd: NDArray[np.float64] | None
    tau: NDArray[np.float64] | None
    t: NDArray[np.float64] | None
    notes: tuple[str, ...]


def looks_like_arrays(path: Path, content: bytes) -> bool:
    """Returns whether a file with this content is a MATLAB file or a NumPy archive, from its first bytes or its name."""
    is_matlab = content[126:128] in (b"IM", b"MI") or _is_hdf5(content)
    return is_matlab or path.suffix.lower() == ".mat" or (content[:4] == _ZIP_MAGIC and path.suffix.lower() == ".npz")


def _is_hdf5(content: bytes) -> bool:
    # MATLAB writes a header of 512 bytes before the HDF5 signature.
    return any(content[start : start + 8] == _HDF5_MAGIC for start in (0, 512))


def read_arrays(path: Path, content: bytes) -> dict[str, NDArray]:
    """Returns all arrays of real numbers in a file by name. Members of structures have names with dots: "data.q".

    Raises:
        RecordingError: The file cannot be read.
    """
    read = _read_hdf5 if _is_hdf5(content) else _read_npz if content[:4] == _ZIP_MAGIC else _read_mat
    try:
        with warnings.catch_warnings():
            # "returned data may be corrupt"
            warnings.simplefilter("error", UserWarning)
            found = read(content)
    except Exception as error:
        # For a damaged file the libraries raise errors of many types: ValueError, OSError, zlib.error, KeyError, ...
        text = " ".join(str(error).split())
        raise RecordingError(f"{path}: the file is damaged or not a MATLAB or NumPy file ({text})") from error
    return {name: value for name, value in found.items() if isinstance(value, np.ndarray) and value.dtype.kind in "fiu"}


def select_arrays(
    path: Path, arrays: Mapping[str, NDArray], num_joints: int, names: Mapping[str, str] | None = None
) -> NamedArrays:
    """Returns the rows of q, qd, tau and t.

    An array may be m x n, n x m, or n x poses x samples, where n is the number of joints. Each sample is one row.

    Args:
        path: Path of the file, for messages.
        arrays: All arrays of the file, by name.
        num_joints: Number of joints n.
        names: Names of the arrays of "q", "qd", "tau" and "t". Default: recognised names.

    Raises:
        RecordingError: An array is missing, several arrays are candidates, or an array has the wrong shape.
    """
    listed = ", ".join(f"{name} ({' x '.join(map(str, a.shape))})" for name, a in arrays.items()) or "none"
    chosen = dict(names or {})
    if unknown := set(chosen) - set(_NAMES):
        raise RecordingError(f"unknown quantity {', '.join(sorted(unknown))}; allowed: {', '.join(_NAMES)}")
    for quantity, name in chosen.items():
        if name not in arrays:
            raise RecordingError(f"{path}: has no array {name} for {quantity}. Its arrays: {listed}.")
    if not names:
        for quantity in _NAMES:
            if name := _recognised(path, arrays, quantity, num_joints):
                chosen[quantity] = name
    if "q" not in chosen:
        raise RecordingError(
            f"{path}: no array of {num_joints} joints has a recognised name. Name the arrays with --arrays q=NAME tau=NAME "
            f"(arrays= in Python). Its arrays: {listed}."
        )
    blocks = {
        quantity: _rows(path, name, arrays[name], num_joints) for quantity, name in chosen.items() if quantity != "t"
    }
    if "t" in chosen:
        blocks["t"] = np.asarray(arrays[chosen["t"]], float).reshape(-1)
    rows = len(blocks["q"])
    for quantity, block in blocks.items():
        if len(block) != rows:
            raise RecordingError(
                f"{path}: {chosen[quantity]} has {len(block)} rows, but {chosen['q']} has {rows}; all arrays need the same"
            )
    note = "read " + ", ".join(f"{quantity} from {name}" for quantity, name in chosen.items())
    return NamedArrays(blocks["q"], blocks.get("qd"), blocks.get("tau"), blocks.get("t"), (note,))


def _recognised(path: Path, arrays: Mapping[str, NDArray], quantity: str, num_joints: int) -> str:
    """Returns the name of the only array with a recognised name and a fitting shape, or ""."""
    found = [
        name
        for name, value in arrays.items()
        if name.rpartition(".")[2].lower() in _NAMES[quantity]
        and (value.size == max(value.shape) if quantity == "t" else num_joints in value.shape)
    ]
    if len(found) > 1:
        raise RecordingError(
            f"{path}: several arrays may be {quantity}: {', '.join(found)}. Name one with --arrays {quantity}=NAME "
            "(arrays= in Python)."
        )
    return found[0] if found else ""


def _rows(path: Path, name: str, array: NDArray, num_joints: int) -> NDArray[np.float64]:
    values = np.asarray(array, float)
    if values.ndim == 3 and values.shape[0] == num_joints:
        return values.reshape(num_joints, -1).T.copy()
    if values.ndim == 2 and values.shape[1] == num_joints:
        return values
    if values.ndim == 2 and values.shape[0] == num_joints:
        return values.T.copy()
    shape = " x ".join(map(str, values.shape))
    n = num_joints
    raise RecordingError(f"{path}: {name} is {shape}; allowed: m x {n}, {n} x m, or {n} x poses x samples")


def _read_mat(content: bytes) -> dict[str, object]:
    loaded = scipy.io.loadmat(io.BytesIO(content), simplify_cells=True)
    return _flattened({name: value for name, value in loaded.items() if not name.startswith("__")})


def _flattened(values: dict, prefix: str = "") -> dict[str, object]:
    """Returns the members of nested structures by names with dots."""
    flat: dict[str, object] = {}
    for name, value in values.items():
        if isinstance(value, dict):
            flat |= _flattened(value, f"{prefix}{name}.")
        else:
            flat[prefix + name] = value
    return flat


def _read_hdf5(content: bytes) -> dict[str, object]:
    import h5py

    found: dict[str, object] = {}

    def visit(name: str, item: object) -> None:
        # Names that begin with # hold MATLAB's references.
        if isinstance(item, h5py.Dataset) and not name.startswith("#"):
            # MATLAB stores arrays by columns, HDF5 by rows.
            found[name.replace("/", ".")] = np.asarray(item).T

    with h5py.File(io.BytesIO(content), "r") as file:
        file.visititems(visit)
    return found


def _read_npz(content: bytes) -> dict[str, object]:
    with np.load(io.BytesIO(content), allow_pickle=False) as archive:
        return {name: archive[name] for name in archive.files if archive[name].dtype.kind in "fiu"}
