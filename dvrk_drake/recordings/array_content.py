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
_NUMERIC_CLASSES = ("double", "single", *(f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64)))
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
    classes: list[str]

    @property
    def unreadable(self) -> str:
        """Returns a text on the objects that cannot be read, or ""."""
        if not self.classes:
            return ""
        return (
            f"objects of the MATLAB class {', '.join(self.classes)} are not read; save their numbers as arrays, e.g. "
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
    try:
        with warnings.catch_warnings():
            for action, message in _WARNINGS:
                warnings.filterwarnings(action, message, UserWarning)
            found = read(content)
    except Exception as error:
        # For a damaged file the libraries raise errors of many types: ValueError, OSError, zlib.error, KeyError, ...
        text = " ".join(str(error).split())
        raise RecordingError(f"{path}: the file is damaged, or not a MATLAB file or NumPy archive ({text})") from error
    arrays = {
        name: value for name, value in found.items() if isinstance(value, np.ndarray) and value.dtype.kind in "fiu"
    }
    messages = {name: value for name, value in found.items() if isinstance(value, list)}
    classes = sorted({value for value in found.values() if isinstance(value, str)})
    return ArrayContent(arrays, messages, classes)


def _read_mat(content: bytes) -> dict[str, object]:
    """Returns arrays by name, messages as lists, and the name of the class of each object."""
    loaded = scipy.io.loadmat(io.BytesIO(content), **_LOADING) if _has_checksums(content) else _load_apart(content)
    found: dict[str, object] = {}

    def visit(name: str, value: object) -> None:
        if isinstance(value, MatlabOpaque):
            found[f"object {len(found)}"] = value["s2"][0].decode()
        elif messages := _messages(value):
            found[name] = messages
        # A structure is an array (1, 1) of records.
        elif isinstance(value, np.ndarray) and value.dtype.names and value.size == 1:
            for member in value.dtype.names:
                visit(f"{name}.{member}", value[member].item())
        else:
            found[name] = value

    for name, value in loaded.items():
        if not name.startswith("__"):
            visit(name, value)
    return found


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


def _messages(value: object) -> list[JointState]:
    """Returns the JointState messages in a structure array or a cell array, or an empty list.

    `readMessages(bag, DataFormat="struct")` of MATLAB's ROS Toolbox returns such cell arrays.
    """
    if not isinstance(value, np.ndarray) or not (value.dtype.names or value.dtype == object):
        return []
    messages = []
    for number, item in enumerate(value.reshape(-1), 1):
        fields = _members(item)
        stamp = _members(_members(fields.get("header")).get("stamp"))
        if "sec" not in stamp or not {"name", "position"} <= fields.keys():
            return []
        sec, nanosec = (
            int(np.sum(np.asarray(stamp.get(name, 0), np.int64)))
            for name in ("sec", "nanosec" if "nanosec" in stamp else "nsec")
        )
        names = [str(np.asarray(name).item()) for name in np.asarray(fields["name"]).reshape(-1)]
        blocks = [np.asarray(fields.get(name, ()), float).reshape(-1) for name in MESSAGE_BLOCKS]
        messages.append(JointState(number, sec * 1_000_000_000 + nanosec, names, *blocks))
    return messages


def _members(value: object) -> dict[str, NDArray]:
    """Returns the members of a record, or of an array with one record, by their names in lower case."""
    if isinstance(value, dict):
        return value
    if isinstance(value, np.ndarray) and value.size == 1:
        value = value.reshape(-1)[0]
    return (
        {name.lower(): value[name] for name in value.dtype.names}
        if isinstance(value, np.void) and value.dtype.names
        else {}
    )


def _read_hdf5(content: bytes) -> dict[str, object]:
    # The import takes 0.2 s, and most commands read no file of version 7.3.
    import h5py

    found: dict[str, object] = {}

    def is_of_references(item: Any) -> bool:
        return isinstance(item, h5py.Dataset) and h5py.check_ref_dtype(item.dtype) is not None

    def value(item: Any) -> Any:
        """Returns a text, an array, or a dictionary of the members of a structure."""
        if isinstance(item, h5py.Group):
            return {name.lower(): value(member) for name, member in item.items()}
        if "MATLAB_empty" in item.attrs:
            return np.empty(0)
        # MATLAB stores arrays by columns, HDF5 by rows.
        numbers = np.asarray(item).T
        if is_of_references(item):
            return [value(item.file[reference]) for reference in numbers.reshape(-1)]
        is_text = item.attrs.get("MATLAB_class", b"double") == b"char"
        return "".join(map(chr, numbers.reshape(-1, order="F"))) if is_text else numbers

    def visit(name: str, item: Any) -> None:
        # MATLAB stores references under names that begin with #.
        if name.startswith("#"):
            return
        if isinstance(item, h5py.Group):
            # The members of a structure array are arrays of references to the values of its elements.
            if len(item) and all(is_of_references(own) and "MATLAB_class" not in own.attrs for own in item.values()):
                members = {key.lower(): value(member) for key, member in item.items()}
                read_messages(
                    name,
                    [dict(zip(members, own, strict=True)) for own in zip(*members.values(), strict=True)],
                    "struct",
                )
            else:
                for key, member in item.items():
                    visit(f"{name}.{key}" if name else key, member)
        elif "MATLAB_empty" not in item.attrs:
            matlab_class = item.attrs.get("MATLAB_class", b"double").decode()
            if matlab_class in _NUMERIC_CLASSES:
                found[name] = np.asarray(item).T
            elif matlab_class == "cell":
                read_messages(name, value(item), matlab_class)
            elif matlab_class not in ("char", "logical"):
                # The content of an object is not an array of numbers.
                found[f"object {len(found)}"] = matlab_class

    def read_messages(name: str, items: list[object], matlab_class: str) -> None:
        elements = np.empty(len(items), dtype=object)
        elements[:] = items
        messages = _messages(elements)
        found[name if messages else f"object {len(found)}"] = messages or matlab_class

    with h5py.File(io.BytesIO(content), "r") as file:
        visit("", file)
    return found


def _read_npz(content: bytes) -> dict[str, object]:
    with np.load(io.BytesIO(content), allow_pickle=False) as archive:
        return {name: archive[name] for name in archive.files}
