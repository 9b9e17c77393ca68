"""Writes MATLAB files and NumPy archives for tests."""

import io
import struct
from pathlib import Path

import h5py
import numpy as np
import scipy.io

#: Kinds of files: MATLAB version 5 and 7.3, NumPy archive.
KINDS = ("v5", "v7.3", "npz")


def write_arrays(folder: Path, kind: str, arrays: dict) -> Path:
    """Writes arrays; a dictionary is a structure, which an archive cannot contain. Returns the path of the file."""
    path = folder / ("arrays.npz" if kind == "npz" else "arrays.mat")
    if kind == "npz":
        np.savez(path, **{name: value for name, value in arrays.items() if not isinstance(value, dict)})
    elif kind == "v5":
        scipy.io.savemat(path, arrays)
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


def _store(group, arrays: dict) -> None:
    for name, value in arrays.items():
        if isinstance(value, dict):
            _store(group.create_group(name), value)
        elif isinstance(value, str):
            group[name] = np.frombuffer(value.encode("utf-16-le"), np.uint16)[:, None]
            group[name].attrs["MATLAB_class"] = np.bytes_("char")
        else:
            group[name] = np.asarray(value).T
