"""Reads the arrays and messages in MATLAB files (version 4 to 7.3) and NumPy archives (.npz), by their names."""

from __future__ import annotations

import io
import pickle
import struct
import subprocess
import sys
import warnings
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import scipy.io
from numpy.typing import NDArray
from scipy.io.matlab import MatlabOpaque

from dvrk_drake.errors import RecordingError
from dvrk_drake.recordings.joint_states import MESSAGE_BLOCKS, JointState

_HDF5_MAGIC = b"\x89HDF\r\n\x1a\n"
_ZIP_MAGIC = b"PK\x03\x04"
#: Type of a compressed variable in a MATLAB file of version 5 to 7.
_COMPRESSED = 15
#: MATLAB classes of numbers.
_NUMERIC = ("double", "single", "logical", *(f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64)))
#: Options of scipy.io.loadmat.
_LOADING: dict[str, Any] = {"simplify_cells": False, "squeeze_me": False, "struct_as_record": True}
#: Filters of warnings (action, start of the message). "Returned data may be corrupt" becomes an error. scipy gives the
#: name "None" to all objects of classes.
_WARNINGS: tuple[tuple[Literal["error", "ignore"], str], ...] = (
    ("error", ""),
    ("ignore", 'Duplicate variable name "None"'),
)


class ArrayContent(NamedTuple):
    """Content of a file.

    Attributes:
        arrays: Arrays of real numbers by name.
        messages: Messages sensor_msgs/JointState by the name of their variable.
        classes: Names of the MATLAB classes of objects that cannot be read.
    """

    arrays: dict[str, NDArray]
    messages: dict[str, list[JointState]]
    classes: set[str]

    @property
    def unreadable(self) -> str:
        """Returns a text on the objects that cannot be read, or ""."""
        if not self.classes:
            return ""
        classes = ", ".join(sorted(self.classes))
        return (
            f"objects of the MATLAB class {classes} are not read; save their numbers as arrays, e.g. "
            "q = data.Data; t = data.Time; save('log.mat', 'q', 't', '-v7')"
        )


def _is_hdf5(content: bytes) -> bool:
    # MATLAB writes a header of 512 bytes before the HDF5 signature.
    return any(content[start : start + 8] == _HDF5_MAGIC for start in (0, 512))


def is_matlab(start: bytes) -> bool:
    """Returns whether a file that starts with these 520 bytes is a MATLAB file of version 5 or later."""
    return start[126:128] in (b"IM", b"MI") or _is_hdf5(start)


def read_content(path: Path, content: bytes) -> ArrayContent:
    """Returns the content of a file. Members of structures have names with dots: "log.q"."""
    read = _read_hdf5 if _is_hdf5(content) else _read_npz if content[:4] == _ZIP_MAGIC else _read_mat
    found = ArrayContent({}, {}, set())
    try:
        with warnings.catch_warnings():
            for action, message in _WARNINGS:
                warnings.filterwarnings(action, message, UserWarning)
            for name, value in read(content).items():
                _visit(found, name, value)
    except Exception as error:
        # For a damaged file the libraries raise errors of many types: ValueError, OSError, zlib.error, KeyError, ...
        text = " ".join(str(error).split())
        raise RecordingError(f"{path}: the file is damaged, or not a MATLAB file or NumPy archive ({text})") from error
    return found


def _read_mat(content: bytes) -> dict[str, object]:
    """Returns the content of a file up to version 7, see `_visit`."""
    loaded = scipy.io.loadmat(io.BytesIO(content), **_LOADING) if _has_checksums(content) else _load_apart(content)

    def plain(value: Any) -> object:
        if isinstance(value, MatlabOpaque):
            # scipy 1.18 has changed the names of the members.
            name = value["_Class" if "_Class" in value.dtype.names else "s2"].item()
            return name if isinstance(name, str) else name.decode()
        if isinstance(value, np.ndarray) and value.dtype.names:
            return [{name: plain(item[name]) for name in value.dtype.names} for item in value.reshape(-1)]
        if isinstance(value, np.ndarray) and value.dtype == object:
            return [plain(item) for item in value.reshape(-1)]
        return value

    return {name: plain(value) for name, value in loaded.items() if not name.startswith("__")}


#: Program that reads a MATLAB file from its standard input.
_LOADER = f"""
import io, pickle, sys, warnings, scipy.io
for action, message in {_WARNINGS}:
    warnings.filterwarnings(action, message, UserWarning)
content = scipy.io.loadmat(io.BytesIO(sys.stdin.buffer.read()), **{_LOADING})
sys.stdout.buffer.write(pickle.dumps(content))
"""


def _has_checksums(content: bytes) -> bool:
    """Returns whether all variables are compressed, with a checksum. True for a file of version 4."""
    if content[126:128] not in (b"IM", b"MI"):
        return True
    order, position = "<" if content[126:128] == b"IM" else ">", 128
    while position + 8 <= len(content):
        kind, size = struct.unpack_from(f"{order}II", content, position)
        if kind != _COMPRESSED:
            return False
        position += 8 + size
    return True


def _load_apart(content: bytes) -> dict[str, Any]:
    """Reads a file without checksums in another process, because damaged files can crash scipy (1.17)."""
    run = subprocess.run([sys.executable, "-c", _LOADER], input=content, capture_output=True, check=False)
    if run.returncode:
        lines = run.stderr.decode(errors="replace").strip().splitlines()
        raise ValueError(lines[-1] if lines and run.returncode > 0 else "the reader crashed")
    loaded: dict[str, Any] = pickle.loads(run.stdout)
    return loaded


def _read_hdf5(content: bytes) -> dict[str, object]:
    """Returns the content of a file of version 7.3, see `_visit`."""
    # The import takes 0.2 s, and most commands read no file of version 7.3.
    import h5py

    def is_of_references(item: Any) -> bool:
        return isinstance(item, h5py.Dataset) and h5py.check_ref_dtype(item.dtype) is not None

    def plain(item: Any) -> object:
        if isinstance(item, h5py.Group):
            members = {name: plain(member) for name, member in item.items()}
            # The members of a structure array are arrays of references to the values of its elements.
            if members and all(is_of_references(own) and "MATLAB_class" not in own.attrs for own in item.values()):
                return [dict(zip(members, own, strict=True)) for own in zip(*members.values(), strict=True)]
            return [members]
        matlab_class = item.attrs.get("MATLAB_class", b"double").decode()
        if "MATLAB_empty" in item.attrs:
            return [] if matlab_class == "cell" else np.empty(0, bool)
        # MATLAB stores arrays by columns, HDF5 by rows.
        values = np.asarray(item).T
        if is_of_references(item):
            return [plain(item.file[reference]) for reference in values.reshape(-1)]
        if matlab_class == "char":
            return np.array("".join(map(chr, values.reshape(-1, order="F"))))
        return values if matlab_class in _NUMERIC else matlab_class

    with h5py.File(io.BytesIO(content), "r") as file:
        # MATLAB stores references under a name that begins with #.
        return {name: plain(item) for name, item in file.items() if not name.startswith("#")}


def _read_npz(content: bytes) -> dict[str, object]:
    with np.load(io.BytesIO(content), allow_pickle=False) as archive:
        return {name: archive[name] for name in archive.files}


def _visit(found: ArrayContent, name: str, value: object) -> None:
    """Adds a variable to the content of a file.

    Args:
        found: Content of the file.
        name: Name of the variable, or of the member of a structure.
        value: Array; list of the elements of a cell array; list of dictionaries of the members of a structure array,
            which has one element for a structure; or name of the class of an object that cannot be read.
    """
    if isinstance(value, str):
        found.classes.add(value)
    elif isinstance(value, np.ndarray) and value.dtype.kind in "fiu":
        found.arrays[name] = value
    elif isinstance(value, list) and value:
        structures = [item for item in value if isinstance(item, dict)]
        if messages := _messages(value):
            found.messages[name] = messages
        elif len(structures) == len(value) == 1:
            for member, own in structures[0].items():
                _visit(found, f"{name}.{member}", own)
        else:
            found.classes.add("struct" if len(structures) == len(value) else "cell")


def _messages(items: list[object]) -> list[JointState]:
    """Returns the JointState messages in the elements of a structure array or a cell array, or an empty list.

    `readMessages(bag, DataFormat="struct")` of MATLAB's ROS Toolbox returns such cell arrays.
    """
    messages = []
    for number, item in enumerate(items, 1):
        fields = _members(item)
        stamp = _members(_members(fields.get("header")).get("stamp"))
        if "sec" not in stamp or not {"name", "position"} <= fields.keys():
            return []
        sec, nanosec = (
            int(np.sum(np.asarray(stamp.get(name, 0), np.int64)))
            for name in ("sec", "nanosec" if "nanosec" in stamp else "nsec")
        )
        names = np.asarray(fields["name"]).reshape(-1).tolist()
        blocks = [np.asarray(fields.get(name, ()), float).reshape(-1) for name in MESSAGE_BLOCKS]
        messages.append(JointState(number, sec * 1_000_000_000 + nanosec, names, *blocks))
    return messages


def _members(value: Any) -> dict[str, Any]:
    """Returns the members of a structure by their names in lower case, or an empty dictionary."""
    if isinstance(value, list) and len(value) == 1:
        value = value[0]
    return {name.lower(): member for name, member in value.items()} if isinstance(value, dict) else {}
