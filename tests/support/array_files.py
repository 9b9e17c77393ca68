"""Writes MATLAB files and NumPy archives for tests."""

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


def _store(group, arrays: dict) -> None:
    for name, value in arrays.items():
        if isinstance(value, dict):
            _store(group.create_group(name), value)
        elif isinstance(value, str):
            group[name] = np.frombuffer(value.encode("utf-16-le"), np.uint16)[:, None]
            group[name].attrs["MATLAB_class"] = np.bytes_("char")
        else:
            group[name] = np.asarray(value).T
