"""Converts meshes from glTF to OBJ, for programs that do not read glTF."""

from __future__ import annotations

import base64
import binascii
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydrake.common.eigen_geometry import Quaternion

from dvrk_drake.errors import ArmError
from dvrk_drake.models.files import MAX_BINARY, read_input, read_json_input

#: Component type of glTF 2.0 -> numpy type.
_TYPES = {5121: "<u1", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_TRIANGLES = 4
#: Rotation from the axes of glTF (y upwards) to those of SDF, URDF and OBJ files of robots (z upwards).
_Z_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])


def to_obj(path: Path) -> str:
    """Returns the triangles of a glTF 2.0 file as the text of an OBJ file. Colours are omitted.

    Raises:
        ArmError: The file is invalid, or has a part that is not supported: binary glTF, other primitives than
            triangles, or sparse or compressed data.
    """
    if path.suffix != ".gltf":
        raise ArmError(f"{path}: only meshes in .gltf files can be converted to OBJ; convert it to .gltf or .obj")
    content = read_json_input(path, ArmError, MAX_BINARY)
    try:
        buffers = [_buffer(path, buffer["uri"]) for buffer in content["buffers"]]
        scene = content["scenes"][content.get("scene", 0)]
        lines: list[str] = []
        count = 0
        for root in scene["nodes"]:
            for mesh, X in _meshes(content, root, np.eye(4)):
                for part in content["meshes"][mesh]["primitives"]:
                    if part.get("mode", _TRIANGLES) != _TRIANGLES:
                        raise ArmError(f"{path}: has primitives other than triangles; export the mesh as triangles")
                    points = _array(content, buffers, part["attributes"]["POSITION"]).reshape(-1, 3).astype(float)
                    corners = np.arange(len(points))
                    if "indices" in part:
                        corners = _array(content, buffers, part["indices"]).astype(int)
                    if np.linalg.det(X[:3, :3]) < 0:  # A mirrored mesh keeps its outer side.
                        corners = corners.reshape(-1, 3)[:, ::-1]
                    points = (points @ X[:3, :3].T + X[:3, 3]) @ _Z_UP.T
                    lines += [f"v {x:.7g} {y:.7g} {z:.7g}" for x, y, z in points + 0.0]
                    lines += [f"f {a} {b} {c}" for a, b, c in corners.reshape(-1, 3) + count + 1]
                    count += len(points)
    except (KeyError, IndexError, TypeError, ValueError, AttributeError, RecursionError) as error:
        raise ArmError(f"{path}: not a glTF file that can be converted to OBJ ({error!r})") from error
    return "\n".join(lines) + "\n"


def _buffer(path: Path, uri: str) -> bytes:
    if uri.startswith("data:"):
        try:
            return base64.b64decode(uri.partition(",")[2], validate=True)
        except binascii.Error as error:
            raise ValueError(str(error)) from error
    if Path(uri).is_absolute() or ".." in Path(uri).parts:
        raise ValueError(f"{uri} is outside the folder of the mesh")
    return read_input(path.parent / uri, ArmError, MAX_BINARY)


def _meshes(content: Any, index: int, X: NDArray[np.float64]) -> list[tuple[int, NDArray[np.float64]]]:
    """Returns the meshes of a node and of its children, each with its transformation (4, 4) to the scene."""
    node = content["nodes"][index]
    if "matrix" in node:
        X = X @ np.array(node["matrix"], dtype=np.float64).reshape(4, 4).T
    else:
        local = np.eye(4)
        x, y, z, w = node.get("rotation", (0.0, 0.0, 0.0, 1.0))
        local[:3, :3] = Quaternion([w, x, y, z]).rotation() * np.array(node.get("scale", (1.0, 1.0, 1.0)))
        local[:3, 3] = node.get("translation", (0.0, 0.0, 0.0))
        X = X @ local
    own = [(int(node["mesh"]), X)] if "mesh" in node else []
    return own + [pair for child in node.get("children", ()) for pair in _meshes(content, child, X)]


def _array(content: Any, buffers: list[bytes], index: int) -> NDArray[Any]:
    """Returns the numbers of an accessor, without structure."""
    accessor = content["accessors"][index]
    view = content["bufferViews"][accessor["bufferView"]]
    if "sparse" in accessor or view.get("extensions"):
        raise ValueError("sparse or compressed data")
    kind = np.dtype(_TYPES[accessor["componentType"]])
    width = {"SCALAR": 1, "VEC3": 3}[accessor["type"]]
    step = view.get("byteStride", width * kind.itemsize)
    data, first = buffers[view["buffer"]], view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
    rows = np.ndarray((accessor["count"], width), kind, data, first, (step, kind.itemsize))
    return rows.ravel()
