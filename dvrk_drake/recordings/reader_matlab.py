"""Makes recordings from arrays in MATLAB files (version 4 to 7.3) and NumPy archives (.npz).

The arrays q, qd, tau and t are named by the user or recognised by their names. Two public layouts are recognised:

- static poses of WPI (https://github.com/WPI-AIM/dvrk_gravity_comp): one array of 8 x 2 x N. Its dimensions are joint
  (the eighth is the gripper), quantity (position, effort) and pose;
- the gravity collection of JHU and CUHK (https://github.com/jhu-dvrk/dvrk-gravity-compensation): a folder of files with
  `current_position` and `desired_effort`, each joint x pose x sample.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.errors import RecordingError
from dvrk_drake.models.files import read_input
from dvrk_drake.recordings.csv_rows import listed
from dvrk_drake.recordings.joint_states import JointState, collect_joint_states, joint_recording
from dvrk_drake.recordings.reader_matlab_content import ArrayContent, is_matlab, read_content
from dvrk_drake.recordings.reader_options import FileOptions, sha256_of
from dvrk_drake.recordings.recording import Recording

_SUFFIXES = (".mat", ".npz")
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
#: Quantities that the user can name.
QUANTITIES = tuple(_NAMES)
#: First dimension of an array of static poses (joints and gripper), and number of joints.
_POSE_ROWS, _POSE_JOINTS = 8, 7
#: Maximum number of arrays listed in a message.
_LISTED = 12


def is_array_file(path: Path) -> bool:
    """Returns whether a path is a MATLAB file, a NumPy archive, or a folder with such files."""
    if path.is_dir():
        return bool(_collection(path))
    if path.suffix.lower() in _SUFFIXES:
        return True
    with path.open("rb") as file:
        return is_matlab(file.read(520))


def read_array_file(path: Path, options: FileOptions) -> Recording:
    """Reads a recording from a MATLAB file, a NumPy archive, or all such files of a folder and its subfolders.

    Messages sensor_msgs/JointState in a structure array or cell array of MATLAB are read like a topic of a ROS bag.

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
    if unknown := set(names) - {*QUANTITIES, "poses"}:
        raise RecordingError(f"unknown quantity {', '.join(sorted(unknown))}; allowed: {', '.join(QUANTITIES)}, poses")
    parts = []
    for number, file in enumerate(files):
        options.progress(number / len(files))
        contents = read_content(file, read_input(file, RecordingError))
        if contents.messages and not names and not _has_positions(contents) and len(files) == 1:
            return _message_recording(path, contents.messages, options)
        parts.append(_rows(file, contents, options.num_joints, names))
    for file, part in zip(files, parts, strict=True):
        if (part.blocks.keys(), part.label) != (parts[0].blocks.keys(), parts[0].label):
            raise RecordingError(
                f"{file}: {part.note}; {files[0]}: {parts[0].note}. All files of a folder must have the same arrays."
            )
    order = options.joint_order(path)
    blocks = {quantity: np.concatenate([part.blocks[quantity] for part in parts]) for quantity in parts[0].blocks}
    blocks = {quantity: block if quantity == "t" else block[:, order] for quantity, block in blocks.items()}
    label = parts[0].label
    notes = [parts[0].note if len(files) == 1 else f"{len(files)} files; {parts[0].note} of each file"]
    if "t" in blocks and len(files) > 1:
        del blocks["t"]
        notes.append("times are not used, because each file has its own times")
    valid = _valid_rows(path, blocks, label, options.skip_invalid)
    if not np.all(valid):
        omitted, reason = np.flatnonzero(~valid) + 1, "NaN or infinite" + (label == "pose") * ", or all zeros"
        notes.append(f"{len(omitted)} of {len(valid)} {label}s skipped ({reason}): {listed(omitted)}")
    rows = np.flatnonzero(valid)
    if options.rate is not None and len(files) > 1:
        raise RecordingError(f"{path}: --rate does not apply to a folder; read the motion of one file")
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


def _collection(folder: Path) -> list[Path]:
    return sorted(
        file
        for file in folder.rglob("*")
        # macOS creates additional files whose names begin with a dot.
        if file.suffix.lower() in _SUFFIXES and file.is_file() and not file.name.startswith(".")
    )


def _has_positions(content: ArrayContent) -> bool:
    """Returns whether an array has a recognised name of positions."""
    return any(name.rpartition(".")[2].lower() in _NAMES["q"] for name in content.arrays)


def _message_recording(path: Path, variables: Mapping[str, list[JointState]], options: FileOptions) -> Recording:
    """Returns the recording of the only variable with messages."""
    if len(variables) > 1:
        raise RecordingError(
            f"{path}: several variables have JointState messages: {', '.join(variables)}. Save the messages of one arm."
        )
    (name, messages), *_ = variables.items()
    states = collect_joint_states(
        path, name, messages, skip_invalid=options.skip_invalid, item=lambda number: f"message {number} of {name}"
    )
    return joint_recording(path, states, None, options, sha256_of(path), "message")


def _rows(path: Path, content: ArrayContent, n: int, names: Mapping[str, str]) -> _Rows:
    """Returns the rows of the named and the recognised arrays."""
    arrays = content.arrays
    shapes = [f"{name} ({_shape(array)})" for name, array in arrays.items()]
    found = ", ".join(shapes[:_LISTED]) + (", ..." if len(shapes) > _LISTED else "") or "none"
    if content.unreadable:
        found += f"; {content.unreadable}"
    for quantity, name in names.items():
        if name not in arrays:
            raise RecordingError(f"{path}: has no array {name} for {quantity}. Arrays of real numbers: {found}.")
    chosen = _chosen(path, arrays, n, names, found)
    if "poses" in chosen:
        if len(chosen) > 1:
            raise RecordingError(f"{path}: poses contains positions and efforts; do not name other arrays")
        return _poses(path, chosen["poses"], arrays[chosen["poses"]], n)
    blocks = {
        quantity: _joint_rows(path, name, arrays[name], n) for quantity, name in chosen.items() if quantity != "t"
    }
    if "t" in chosen:
        t = arrays[chosen["t"]]
        if t.size != max(t.shape, default=0):
            raise RecordingError(f"{path}: {chosen['t']} is {_shape(t)}; allowed for t: a vector")
        blocks["t"] = np.asarray(t, float).reshape(-1)
    for quantity, block in blocks.items():
        if len(block) != len(blocks["q"]):
            raise RecordingError(
                f"{path}: {chosen[quantity]} has {len(block)} rows, but {chosen['q']} has {len(blocks['q'])}; all "
                "arrays must have the same number of rows"
            )
    note = ", ".join(f"{quantity} from array {name}" for quantity, name in chosen.items())
    return _Rows(blocks, f"{note}; {content.unreadable}" if content.unreadable else note)


def _chosen(path: Path, arrays: Mapping[str, NDArray], n: int, names: Mapping[str, str], found: str) -> dict[str, str]:
    """Returns the name of the array of each quantity: the named one, or the only one with a recognised name."""
    chosen = dict(names)
    if "poses" in names:
        return chosen
    for quantity, known in _NAMES.items():
        if quantity in names:
            continue
        fitting = [
            name
            for name, array in arrays.items()
            if name.rpartition(".")[2].lower() in known
            and (array.size > 1 if quantity == "t" else _is_joint_array(array, n))
        ]
        if len(fitting) > 1:
            raise RecordingError(
                f"{path}: several arrays may be {quantity}: {', '.join(fitting)}. Choose one with --arrays "
                f"{quantity}=NAME (arrays= in Python)."
            )
        if fitting:
            chosen[quantity] = fitting[0]
    if "q" in chosen:
        return chosen
    poses = [] if names or n != _POSE_JOINTS else [name for name, array in arrays.items() if _is_pose_array(array)]
    if len(poses) > 1:
        raise RecordingError(
            f"{path}: several arrays have the shape 8 x 2 x N of static poses: {', '.join(poses)}. Choose one with "
            "--arrays poses=NAME (arrays= in Python)."
        )
    if poses:
        return {"poses": poses[0]}
    raise RecordingError(
        f"{path}: no array of {n} joints has a recognised name. Name the arrays with --arrays q=NAME tau=NAME (arrays= "
        f"in Python). Arrays of real numbers: {found}."
    )


def _shape(array: NDArray) -> str:
    return " x ".join(map(str, array.shape)) or "one number"


def _is_joint_array(array: NDArray, n: int) -> bool:
    return (array.ndim == 2 and n in array.shape) or (array.ndim == 3 and array.shape[0] == n)


def _is_pose_array(array: NDArray) -> bool:
    # MATLAB drops trailing dimensions of 1, so one pose is 8 x 2.
    return array.ndim in (2, 3) and array.shape[:2] == (_POSE_ROWS, 2)


def _joint_rows(path: Path, name: str, array: NDArray, n: int) -> NDArray[np.float64]:
    if not _is_joint_array(array, n):
        raise RecordingError(
            f"{path}: {name} is {_shape(array)}; allowed for {n} joints: m x {n}, {n} x m, or {n} x poses x samples"
        )
    values = np.asarray(array, float)
    return values if values.ndim == 2 and values.shape[1] == n else values.reshape(n, -1).T.copy()


def _poses(path: Path, name: str, array: NDArray, n: int) -> _Rows:
    if n != _POSE_JOINTS:
        raise RecordingError(f"{path}: an array of poses contains {_POSE_JOINTS} joints, but the arm has {n}")
    if not _is_pose_array(array):
        raise RecordingError(f"{path}: {name} is {_shape(array)}; allowed: 8 x 2 x N (joint; position, effort; pose)")
    if array.size == 0:
        raise RecordingError(f"{path}: array {name} has no poses")
    joints = np.asarray(array, float).reshape(_POSE_ROWS, 2, -1)[:_POSE_JOINTS]
    blocks = {"q": joints[:, 0].T.copy(), "tau": joints[:, 1].T.copy()}
    return _Rows(blocks, f"static poses from array {name}; its eighth row (gripper) is ignored", "pose")


def _valid_rows(path: Path, blocks: Mapping[str, NDArray], label: str, skip_invalid: bool) -> NDArray[np.bool_]:
    """Returns a mask (m,) of the rows that contain only finite numbers.

    Poses of only zeros are not valid either, because arrays of 8 x 2 x N are allocated before the measurement.
    """
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
