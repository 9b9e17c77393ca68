"""Makes recordings from arrays in MATLAB files (version 4 to 7.3) and NumPy archives (.npz).

The arrays q, qd, tau and t are named by the user or recognised by their names. The names also recognise the gravity
collection of JHU and CUHK (https://github.com/jhu-dvrk/dvrk-gravity-compensation): a folder of files with
`current_position` and `desired_effort`, each joint x pose x sample. An array of 8 x 2 x N contains static poses of WPI
(https://github.com/WPI-AIM/dvrk_gravity_comp).
"""

from __future__ import annotations

import io
import pickle
import subprocess
import sys
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.errors import RecordingError
from dvrk_drake.models.files import read_input
from dvrk_drake.recordings.csv_files import listed
from dvrk_drake.recordings.reader_options import WPI_JOINTS, FileOptions, sha256_of
from dvrk_drake.recordings.recording import Recording

_SUFFIXES = (".mat", ".npz")
_HDF5_MAGIC, _ZIP_MAGIC = b"\x89HDF\r\n\x1a\n", b"PK\x03\x04"
#: Program that reads a MATLAB file up to version 7 from its standard input. Damaged files can crash scipy (1.17), so it
#: runs in another process. "Returned data may be corrupt" becomes an error; scipy calls all objects of classes "None".
_LOADER = """
import io, pickle, sys, warnings, scipy.io
warnings.filterwarnings("error", category=UserWarning)
warnings.filterwarnings("ignore", 'Duplicate variable name "None"')
content = scipy.io.loadmat(io.BytesIO(sys.stdin.buffer.read()), simplify_cells=True)
sys.stdout.buffer.write(pickle.dumps({name: value for name, value in content.items() if name[:2] != "__"}))
"""
#: Recognised names of arrays, in lower case. The first names of q and tau are those of the public gravity collection.
_NAMES = {
    "q": ("current_position", "q", "position", "positions", "measured_position", "joint_position", "joint_positions"),
    "qd": ("qd", "dq", "v", "velocity", "velocities", "measured_velocity", "joint_velocity", "joint_velocities"),
    "tau": (
        *("desired_effort", "tau", "effort", "efforts", "torque", "torques", "measured_effort", "joint_effort"),
        *("joint_efforts", "joint_torque", "joint_torques"),
    ),
    "t": ("t", "time", "times", "timestamp", "timestamps"),
}
#: First dimensions (7 joints and gripper; position, effort) of an array of static poses. It is allocated before the
#: measurement, so a pose of only zeros was not recorded.
_POSE_SHAPE = WPI_JOINTS + 1, 2
#: Maximum number of arrays listed in a message.
_LISTED = 12


def is_array_file(path: Path) -> bool:
    """Returns whether a path is a MATLAB file, a NumPy archive, or a folder with such files."""
    if path.is_dir():
        return bool(_collection(path))
    if path.suffix.lower() in _SUFFIXES:
        return True
    with path.open("rb") as file:
        start = file.read(520)
    return start[126:128] in (b"IM", b"MI") or _is_hdf5(start)


def read_array_file(path: Path, options: FileOptions) -> Recording:
    """Reads a recording from a MATLAB file, a NumPy archive, or all such files of a folder and its subfolders.

    An array is m x n, n x m or n x poses x samples, for m rows and n joints. Each sample is one row of the recording.
    Arrays without times contain static poses, unless `options.rate` is given.

    `options.arrays` maps "q", "qd", "tau" and "t" to the names of the arrays. A member of a structure is named with
    dots: "log.q". {"poses": NAME} names an array of 8 x 2 x N. Default of each quantity: the array with a recognised
    name. If no array is named or recognised, the only array of 8 x 2 x N is read.

    Args:
        path: Path of the file or of the folder.
        options: Arm (default: 7 joints), coordinates (default: "joint"), arrays, rate and `skip_invalid`. In an array
            of 8 x 2 x N, a pose of only zeros is also invalid.

    Raises:
        RecordingError: A file is damaged, an array is missing or has a wrong shape, several arrays of a quantity are
            recognised, a row is invalid, or a rate is given for arrays with times.
    """
    files = _collection(path) if path.is_dir() else [path]
    names = dict(options.arrays or {})
    if unknown := set(names) - {*_NAMES, "poses"}:
        raise RecordingError(f"unknown quantity {', '.join(sorted(unknown))}; allowed: {', '.join(_NAMES)}, poses")
    if options.rate is not None and len(files) > 1:
        raise RecordingError(f"{path}: --rate does not apply to a folder; read the motion of one file")
    parts = []
    for number, file in enumerate(files):
        options.progress(number / len(files))
        parts.append(_rows(file, _read_content(file), options.num_joints, names))
        if (parts[-1].blocks.keys(), parts[-1].label) != (parts[0].blocks.keys(), parts[0].label):
            raise RecordingError(
                f"{file}: {parts[-1].note}; {files[0]}: {parts[0].note}. All files of a folder must have the same "
                "arrays."
            )
    order, label = options.joint_order(path), parts[0].label
    blocks = {quantity: np.concatenate([part.blocks[quantity] for part in parts]) for quantity in parts[0].blocks}
    blocks = {quantity: block if quantity == "t" else block[:, order] for quantity, block in blocks.items()}
    notes = [parts[0].note if len(files) == 1 else f"{len(files)} files; {parts[0].note} of each file"]
    if "t" in blocks and len(files) > 1:
        del blocks["t"]
        notes.append("times are not used, because each file has its own times")
    valid = _valid_rows(path, blocks, label, options.skip_invalid)
    if not np.all(valid):
        omitted, reason = np.flatnonzero(~valid) + 1, "NaN or infinite" + (label == "pose") * ", or all zeros"
        notes.append(f"{len(omitted)} of {len(valid)} {label}s skipped ({reason}): {listed(omitted)}")
    rows = np.flatnonzero(valid)
    return options.recording(
        path,
        {quantity: block[rows] for quantity, block in blocks.items()},
        rows,
        notes=notes,
        lines=rows + 1,
        sha256=sha256_of(*files),
        line_label=label,
        times_from="array",
    )


def _collection(folder: Path) -> list[Path]:
    return sorted(
        file
        for file in folder.rglob("*")
        # macOS creates additional files whose names begin with a dot.
        if file.suffix.lower() in _SUFFIXES and file.is_file() and not file.name.startswith(".")
    )


def _is_hdf5(content: bytes) -> bool:
    # MATLAB writes a header of 512 bytes before the HDF5 signature.
    return any(content[start : start + 8] == _HDF5_MAGIC for start in (0, 512))


class _Content(NamedTuple):
    """Arrays of real numbers by name, and the names of the MATLAB classes of objects that are not read."""

    arrays: dict[str, NDArray]
    classes: set[str]

    def __str__(self) -> str:
        shapes = [f"{name} ({_shape(array)})" for name, array in self.arrays.items()]
        return ", ".join(shapes[:_LISTED]) + (", ..." if len(shapes) > _LISTED else "") or "none"

    @property
    def unreadable(self) -> str:
        """Text on the objects that are not read, or ""."""
        if not self.classes:
            return ""
        return (
            f"; objects of the MATLAB class {', '.join(sorted(self.classes))} are not read; save their numbers as "
            "arrays, e.g. q = data.Data; t = data.Time; save('log.mat', 'q', 't', '-v7')"
        )

    def add(self, name: str, value: Any) -> None:
        """Adds a variable. Members of structures have names with dots: "log.q"."""
        if isinstance(value, dict):
            for member, own in value.items():
                self.add(f"{name}.{member}", own)
        elif getattr(value, "dtype", np.dtype(bool)).names:
            # An object of a class. scipy 1.18 has changed the names of its members.
            label = value["_Class" if "_Class" in value.dtype.names else "s2"].item()
            self.classes.add(label if isinstance(label, str) else label.decode())
        elif isinstance(value, (list, _Class)) or getattr(value, "dtype", np.dtype(bool)).kind == "O":
            self.classes.add(value if isinstance(value, _Class) else "struct" if isinstance(value, list) else "cell")
        elif np.asarray(value).dtype.kind in "fiu":
            self.arrays[name] = np.asarray(value)


class _Class(str):
    """Name of the class of an object that is not read."""


def _read_content(path: Path) -> _Content:
    content, found = read_input(path, RecordingError), _Content({}, set())
    read = _read_hdf5 if _is_hdf5(content) else _read_npz if content[:4] == _ZIP_MAGIC else _read_mat
    try:
        with warnings.catch_warnings(action="error", category=UserWarning):
            for name, value in read(content).items():
                found.add(name, value)
    except Exception as error:
        # For a damaged file the libraries raise errors of many types: ValueError, OSError, zlib.error, KeyError, ...
        text = " ".join(str(error).split())
        raise RecordingError(f"{path}: the file is damaged, or not a MATLAB file or NumPy archive ({text})") from error
    return found


def _read_mat(content: bytes) -> dict[str, Any]:
    """Returns the content of a file up to version 7. Dimensions of 1 are dropped."""
    run = subprocess.run([sys.executable, "-c", _LOADER], input=content, capture_output=True, check=False)
    if run.returncode:
        lines = run.stderr.decode(errors="replace").strip().splitlines()
        raise ValueError(lines[-1] if lines and run.returncode > 0 else "the reader crashed")
    loaded: dict[str, Any] = pickle.loads(run.stdout)
    return loaded


def _read_hdf5(content: bytes) -> dict[str, Any]:
    """Returns the content of a file of version 7.3."""
    # The import takes 0.2 s, and most commands read no file of version 7.3.
    import h5py

    def plain(item: Any) -> Any:
        if isinstance(item, h5py.Group):
            return {name: plain(member) for name, member in item.items()}
        kind = item.attrs.get("MATLAB_class", b"double" if item.dtype.kind != "O" else b"struct").decode()
        if kind == "char" or "MATLAB_empty" in item.attrs:
            return ""
        # MATLAB stores arrays by columns, HDF5 by rows.
        is_number = kind in ("double", "single", "logical") or "int" in kind
        return np.asarray(item).T if is_number else _Class(kind)

    with h5py.File(io.BytesIO(content), "r") as file:
        # MATLAB stores references under a name that begins with #.
        return {name: plain(item) for name, item in file.items() if not name.startswith("#")}


def _read_npz(content: bytes) -> dict[str, Any]:
    with np.load(io.BytesIO(content), allow_pickle=False) as archive:
        return {name: archive[name] for name in archive.files}


class _Rows(NamedTuple):
    """Rows of the blocks q, qd, tau (m, n) and t (m,) of one file.

    Attributes:
        blocks: Mapping from a quantity to its rows.
        note: Names of the arrays of the blocks.
        label: Name of a row, for messages: "row", or "pose" of an array of 8 x 2 x N.
    """

    blocks: dict[str, NDArray[np.float64]]
    note: str
    label: str = "row"


def _rows(path: Path, content: _Content, n: int, names: Mapping[str, str]) -> _Rows:
    """Returns the rows of the named and the recognised arrays."""
    arrays = content.arrays
    for quantity, name in names.items():
        if name not in arrays:
            raise RecordingError(
                f"{path}: has no array {name} for {quantity}. Arrays of real numbers: {content}{content.unreadable}."
            )
    chosen = _chosen(path, content, n, names)
    if "poses" in chosen:
        if len(chosen) > 1:
            raise RecordingError(f"{path}: poses contains positions and efforts; do not name other arrays")
        return _poses(path, chosen["poses"], arrays[chosen["poses"]], n)
    blocks = {}
    for quantity, name in chosen.items():
        array = np.asarray(arrays[name], float)
        is_time = quantity == "t"
        if array.size != max(array.shape, default=0) if is_time else not _is_joint_array(array, n):
            allowed = f"for {n} joints: m x {n}, {n} x m, or {n} x poses x samples"
            raise RecordingError(
                f"{path}: {name} is {_shape(array)}; allowed {'for t: a vector' if is_time else allowed}"
            )
        is_table = array.ndim == 2 and array.shape[1] == n
        blocks[quantity] = array.reshape(-1) if is_time else array if is_table else array.reshape(n, -1).T.copy()
        if len(blocks[quantity]) != len(blocks["q"]):
            raise RecordingError(
                f"{path}: {name} has {len(blocks[quantity])} rows, but {chosen['q']} has {len(blocks['q'])}; all "
                "arrays must have the same number of rows"
            )
    note = ", ".join(f"{quantity} from array {name}" for quantity, name in chosen.items())
    return _Rows(blocks, f"{note}{content.unreadable}")


def _chosen(path: Path, content: _Content, n: int, names: Mapping[str, str]) -> dict[str, str]:
    """Returns the name of the array of each quantity, q first: the named one, or the only recognised one."""
    chosen: dict[str, str] = {}
    if "poses" in names:
        return dict(names)
    for quantity, known in _NAMES.items():
        fitting = [
            name
            for name, array in content.arrays.items()
            if name.rpartition(".")[2].lower() in known
            and (array.size > 1 if quantity == "t" else _is_joint_array(array, n))
        ]
        if quantity in names:
            fitting = [names[quantity]]
        if len(fitting) > 1:
            raise RecordingError(
                f"{path}: several arrays may be {quantity}: {', '.join(fitting)}. Choose one with --arrays "
                f"{quantity}=NAME (arrays= in Python)."
            )
        if fitting:
            chosen[quantity] = fitting[0]
    if "q" in chosen:
        return chosen
    poses = [name for name, array in content.arrays.items() if _is_pose_array(array) and n == WPI_JOINTS]
    if names or not poses:
        raise RecordingError(
            f"{path}: no array of {n} joints has a recognised name. Name the arrays with --arrays q=NAME tau=NAME "
            f"(arrays= in Python). Arrays of real numbers: {content}{content.unreadable}."
        )
    if len(poses) > 1:
        raise RecordingError(
            f"{path}: several arrays have the shape 8 x 2 x N of static poses: {', '.join(poses)}. Choose one with "
            "--arrays poses=NAME (arrays= in Python)."
        )
    return {"poses": poses[0]}


def _shape(array: NDArray) -> str:
    return " x ".join(map(str, array.shape)) or "one number"


def _is_joint_array(array: NDArray, n: int) -> bool:
    # One row, or one joint, is a vector without the dimensions of 1.
    is_vector = array.ndim == 1 and array.size > 0 and n in (1, array.size)
    return is_vector or (array.ndim == 2 and n in array.shape) or (array.ndim == 3 and array.shape[0] == n)


def _is_pose_array(array: NDArray) -> bool:
    # One pose is 8 x 2 without its dimension of 1.
    return array.ndim in (2, 3) and array.shape[:2] == _POSE_SHAPE


def _poses(path: Path, name: str, array: NDArray, n: int) -> _Rows:
    if n != WPI_JOINTS:
        raise RecordingError(f"{path}: an array of poses contains {WPI_JOINTS} joints, but the arm has {n}")
    if not _is_pose_array(array):
        raise RecordingError(f"{path}: {name} is {_shape(array)}; allowed: 8 x 2 x N (joint; position, effort; pose)")
    q, tau = np.asarray(array, float).reshape(*_POSE_SHAPE, -1).transpose(1, 2, 0)[..., :n]
    return _Rows({"q": q, "tau": tau}, f"static poses from array {name}; its eighth row (gripper) is ignored", "pose")


def _valid_rows(path: Path, blocks: Mapping[str, NDArray], label: str, skip_invalid: bool) -> NDArray[np.bool_]:
    """Returns a mask (m,) of the rows that contain only finite numbers, and of the poses that were recorded."""
    if len(blocks["q"]) == 0:
        raise RecordingError(f"{path}: the arrays have no rows")
    table = np.column_stack([block.reshape(len(blocks["q"]), -1) for block in blocks.values()])
    finite = np.all(np.isfinite(table), axis=1)
    valid = finite & np.any(table, axis=1) if label == "pose" else finite
    if not np.any(valid):
        raise RecordingError(f"{path} has {len(valid)} {label}s, but none is valid")
    if np.all(valid) or skip_invalid:
        return valid
    row = int(np.argmin(valid))
    problem = "all numbers are zero, so the pose was not recorded"
    for quantity, block in blocks.items():
        if len(bad := np.flatnonzero(~np.isfinite(np.atleast_1d(block[row])))):
            name = quantity if quantity == "t" else f"{quantity}{bad[0] + 1}"
            problem = f"{name} is {np.atleast_1d(block[row])[bad[0]]}; only finite numbers are allowed"
            break
    raise RecordingError(
        f"{path}, {label} {row + 1}: {problem}. Use --skip-invalid to omit invalid {label}s "
        f"({np.sum(~valid)} of {len(valid)} {label}s)."
    )
