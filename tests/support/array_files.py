"""Writes MATLAB files and NumPy archives for tests."""

import io
import itertools
import struct
from pathlib import Path

import h5py
import numpy as np
import scipy.io

#: Kinds of files: MATLAB version 5 and 7.3, NumPy archive.
KINDS = ("v5", "v7.3", "npz")
#: Names of referenced elements.
_NUMBERS = itertools.count()


def write_arrays(folder: Path, kind: str, arrays: dict) -> Path:
    """Writes arrays; a dictionary is a structure, which an archive cannot contain. Returns the path of the file."""
    path = folder / ("arrays.npz" if kind == "npz" else "arrays.mat")
    if kind == "npz":
        np.savez(path, **{name: value for name, value in arrays.items() if not isinstance(value, dict)})
    elif kind == "v5":
        scipy.io.savemat(path, arrays, do_compression=True)
    else:
        # MATLAB writes a header of 512 bytes before the HDF5 data.
        with h5py.File(path, "w", userblock_size=512) as file:
            _store(file, arrays)
        content = bytearray(path.read_bytes())
        content[:128] = b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM"
        path.write_bytes(bytes(content))
    return path


def with_objects(path: Path, *classes: str) -> Path:
    """Appends an object of each MATLAB class to a file of version 5, as MATLAB's `save` does."""
    buffer = io.BytesIO()
    scipy.io.savemat(buffer, {"content": np.arange(6, dtype=np.uint32)[:, None]})
    content = buffer.getvalue()[128:]
    for name in classes:
        # Class number of opaque objects; name of the variable, type system and class; content.
        element = struct.pack("<IIII", 6, 8, 17, 0)
        for text in (b"recorded", b"MCOS", name.encode()):
            element += struct.pack("<II", 1, len(text)) + text.ljust(-(-len(text) // 8) * 8, b"\0")
        element += content
        path.write_bytes(path.read_bytes() + struct.pack("<II", 14, len(element)) + element)
    return path


def _references(file, values) -> np.ndarray:
    """Stores the elements of an array, as MATLAB does for a cell array, and returns references to them."""
    targets = file.require_group("#refs#")
    references = np.empty(values.T.shape, h5py.ref_dtype)
    for index, element in np.ndenumerate(values.T):
        name = str(next(_NUMBERS))
        _store(targets, {name: element})
        references[index] = targets[name].ref
    return references


def _store(group, arrays: dict) -> None:
    for name, value in arrays.items():
        if isinstance(value, dict):
            _store(group.create_group(name), value)
        elif isinstance(value, str):
            group[name] = np.frombuffer(value.encode("utf-16-le"), np.uint16)[:, None]
            group[name].attrs["MATLAB_class"] = np.bytes_("char")
        elif isinstance(value, np.ndarray) and value.dtype.names:
            members = group.create_group(name)
            members.attrs["MATLAB_class"] = np.bytes_("struct")
            for member in value.dtype.names:
                members[member] = _references(group.file, value[member])
        elif isinstance(value, np.ndarray) and value.dtype == object:
            group[name] = _references(group.file, value)
            group[name].attrs["MATLAB_class"] = np.bytes_("cell")
        else:
            group[name] = np.asarray(value).T
