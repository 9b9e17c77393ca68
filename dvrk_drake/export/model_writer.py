"""Writes the SDF, URDF or MJCF of an arm with identified inertial parameters, and its meshes."""

from __future__ import annotations

import base64
import binascii
import os
import re
import shutil
import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydrake.common.eigen_geometry import Quaternion

from dvrk_drake.dynamics.inertial_parameters import LinkInertia, link_inertias
from dvrk_drake.errors import ArmError, DvrkDrakeError, ModelError
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.files import MAX_BINARY, atomic_write, open_input, read_input, read_json_input
from dvrk_drake.models.mjcf import Drive, to_mjcf
from dvrk_drake.models.plant import arm_sdf
from dvrk_drake.models.sdf_elements import DRAKE
from dvrk_drake.models.urdf import to_urdf

#: Relative change of a parameter below which a link counts as unchanged.
_UNCHANGED = 1e-12
#: Number of random poses that an MJCF contains as keyframes.
KEYFRAMES = 10
#: Format of exported meshes. Only meshes in glTF format are converted to OBJ.
MeshFormat = Literal["gltf", "obj"]


@dataclass(frozen=True, eq=False)
class LinkChange:
    """Inertia of one link before and after an export.

    Attributes:
        link: Name of the link.
        before, after: Inertias in the arm's SDF and in the exported file.
    """

    link: str
    before: LinkInertia
    after: LinkInertia


def changed_links(arm: Arm, links: Sequence[LinkInertia]) -> list[LinkChange]:
    """Returns the change of each link in `links` whose inertial parameters differ from those in the arm's SDF.

    Raises:
        ModelError: A link does not belong to the arm or is given twice.
    """
    before = {inertia.link: inertia for inertia in link_inertias(arm)}
    names = [inertia.link for inertia in links]
    if unknown := set(names) - set(before):
        raise ModelError(f"{arm.name} has no moving link {', '.join(sorted(unknown))}; it has {', '.join(before)}")
    if len(set(names)) < len(names):
        raise ModelError(f"{arm.name}: each link may be given only once; got {', '.join(names)}")
    changes = (LinkChange(inertia.link, before[inertia.link], inertia) for inertia in links)
    return [c for c in changes if not _equal_parameters(c.before.parameters, c.after.parameters)]


def with_inertias(
    arm: Arm, links: Sequence[LinkInertia], rotor_inertias: Mapping[str, float] | None = None
) -> ElementTree.Element:
    """Returns the SDF of arm and instrument as one model, with the inertias of `links`. Other links are unchanged.

    Args:
        arm: Arm whose model is changed.
        links: Inertias of all or some moving links.
        rotor_inertias: Joint name -> rotor inertia reflected to the joint [kg m^2; kg if prismatic]. The joint must be
            moved by a single motor. Gear ratios are unchanged. None keeps the rotor inertias of the arm's model.

    Raises:
        ModelError: A link does not belong to the arm, an inertia is not physically consistent, or a rotor inertia is
            negative.
    """
    inertias = {}
    for change in changed_links(arm, links):
        if not np.linalg.eigvalsh(change.after.pseudo_inertia()).min() > 0:
            raise ModelError(
                f"{change.link}: the inertia is not physically consistent; its pseudo-inertia must be positive definite"
            )
        inertias[change.link] = change.after.to_spatial_inertia()
    root = arm_sdf(arm, inertias)
    for joint, inertia in (rotor_inertias or {}).items():
        _set_rotor(root, joint, inertia)
    return root


def write_model(
    arm: Arm,
    links: Sequence[LinkInertia],
    path: str | Path,
    origin: str,
    rotor_inertias: Mapping[str, float] | None = None,
    meshes: MeshFormat = "gltf",
    format: Literal["sdf", "urdf", "mjcf"] = "sdf",
    drives: Sequence[Drive] = (),
) -> None:
    """Writes the model of `with_inertias` atomically, and copies its meshes into the folder <name>_meshes beside it.

    Args:
        arm, links, rotor_inertias: Arguments of `with_inertias`.
        path: Path of the file.
        origin: Source of the inertias, written into a comment at the start of the file.
        meshes: "obj" converts glTF meshes to OBJ, for programs that do not read glTF, such as PyBullet and MuJoCo.
        format: Format of the file. The meshes of an MJCF are OBJ files, and its keyframes are random poses of the arm.
        drives: Friction, springs and rotors. SDF and URDF contain only the friction of single joints.

    Raises:
        ModelError: An argument is invalid, see `with_inertias`, or URDF does not support a part of the model.
        DvrkDrakeError: A file cannot be written.
    """
    target = Path(path)
    root = with_inertias(arm, links, rotor_inertias)
    copies = redirect_meshes(root, target, "obj" if format == "mjcf" else meshes)
    if format == "mjcf":
        root = to_mjcf(root, arm.gravity, drives, _keyframes(arm))
    else:
        _add_friction(root, drives)
    if format == "urdf":
        root = to_urdf(root)
    copy_meshes(copies)
    with atomic_write(target) as stream:
        stream.write(to_text(root, f"{arm.name}, inertial parameters of {origin}. Written by dvrk-drake export."))


def _keyframes(arm: Arm) -> dict[str, dict[str, float]]:
    """Returns the positions of all joints at the home pose and at random poses."""
    home = np.clip(0.0, arm.position_lower, arm.position_upper)
    poses = [home, *arm.sample_poses(KEYFRAMES, np.random.default_rng(0))]
    names = ["home", *(f"pose_{i}" for i in range(1, len(poses)))]
    return {
        name: dict(zip(arm.tree_joint_names, map(float, arm.linkage.position(q)), strict=True))
        for name, q in zip(names, poses, strict=True)
    }


def _add_friction(root: ElementTree.Element, drives: Sequence[Drive]) -> None:
    """Adds the friction of single joints to an SDF."""
    joints = {joint.get("name"): joint for joint in root.iterfind("model/joint")}
    for drive in drives:
        (name,) = drive.row
        axis = joints[name].find("axis")
        assert axis is not None
        dynamics = axis.find("dynamics")
        dynamics = ElementTree.SubElement(axis, "dynamics") if dynamics is None else dynamics
        damping = dynamics.find("damping")
        damping = ElementTree.SubElement(dynamics, "damping") if damping is None else damping
        damping.text = repr(float(damping.text or 0.0) + drive.viscous)
        ElementTree.SubElement(dynamics, "friction").text = repr(drive.dry)


def to_text(root: ElementTree.Element, comment: str = "") -> str:
    """Returns the indented XML text of a model."""
    ElementTree.indent(root)
    comment = re.sub("-(?=-)", "- ", comment)  # XML does not allow -- in a comment.
    head = '<?xml version="1.0"?>\n' + (f"<!-- {comment} -->\n" if comment else "")
    return head + ElementTree.tostring(root, encoding="unicode") + "\n"


def _set_rotor(root: ElementTree.Element, joint: str, inertia: float) -> None:
    element = next((j for j in root.iterfind("model/joint") if j.get("name") == joint), None)
    if element is None:
        raise ModelError(f"the SDF has no joint {joint}")
    if not inertia >= 0:
        raise ModelError(f"{joint}: rotor inertia {inertia:.6g} must not be negative")
    gear = float(element.findtext(f"{DRAKE}gear_ratio", "1"))
    for tag, value in (("rotor_inertia", inertia / gear**2), ("gear_ratio", gear)):
        child = element.find(f"{DRAKE}{tag}")
        if child is None:
            child = ElementTree.SubElement(element, f"{DRAKE}{tag}")
        child.text = repr(value)


def _equal_parameters(a: NDArray[np.float64], b: NDArray[np.float64]) -> bool:
    """Returns whether mass, first moments and rotational inertia are equal, each relative to its magnitude."""
    parts = (slice(0, 1), slice(1, 4), slice(4, 10))
    return all(np.abs(a[p] - b[p]).max() <= _UNCHANGED * np.abs(a[p]).max() for p in parts)


def mesh_folder(model_path: Path) -> str:
    """Returns the name of the mesh folder of an exported model."""
    return f"{model_path.stem}_meshes"


def refuse_existing_meshes(model_path: str | Path, overwrite: bool) -> None:
    """Raises DvrkDrakeError if the mesh folder of a model contains files and `overwrite` is False."""
    folder = Path(model_path).with_name(mesh_folder(Path(model_path)))
    if not overwrite and folder.is_dir() and any(folder.iterdir()):
        raise DvrkDrakeError(
            f"{folder}: the folder contains files already; choose another name for the model file, or replace the "
            "files with --overwrite"
        )


def redirect_meshes(root: ElementTree.Element, model_path: Path, meshes: MeshFormat = "gltf") -> dict[Path, Path]:
    """Replaces every mesh `<uri>` in a model by a path in `mesh_folder`, relative to the model file.

    Args:
        root: Model from `with_inertias`, which is modified.
        model_path: Path of the file to which the model will be written.
        meshes: Format of the copies of glTF files.

    Returns:
        Mapping from the source to the target of each file to copy, including the files to which glTF files refer. A
        target with another suffix than its source must be converted.

    Raises:
        ArmError: Two meshes would have the same target.
    """
    copies: dict[Path, Path] = {}
    for uri in root.iter("uri"):
        source = Path((uri.text or "").removeprefix("file://"))
        relative = Path(mesh_folder(model_path)) / source.parent.name / source.name
        if meshes == "obj" and source.suffix in (".gltf", ".glb"):
            relative = relative.with_suffix(".obj")
        target = model_path.parent / relative
        if copies.setdefault(source, target) != target or list(copies.values()).count(target) > 1:
            raise ArmError(
                f"{source}: another mesh file of the model has the same file name, in a folder with the same name. "
                "Rename one of the files"
            )
        for file in _referenced_files(source) if target.suffix == source.suffix else ():
            copies[source.parent / file] = target.parent / file
        uri.text = relative.as_posix()
    return copies


def copy_meshes(copies: dict[Path, Path]) -> None:
    """Copies each file atomically, or converts it to OBJ if the target has this format.

    Args:
        copies: Mapping from source to target.

    Raises:
        DvrkDrakeError: A file cannot be written.
    """
    converted = {source: to_obj(source) for source, target in copies.items() if target.suffix != source.suffix}
    for source, target in copies.items():
        if str(source) == os.path.realpath(target):
            continue
        try:
            target.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise DvrkDrakeError(f"{target.parent}: the folder cannot be created: {error.strerror}") from error
        if source in converted:
            with atomic_write(target) as text:
                text.write(converted[source])
            continue
        with open_input(source, ArmError) as stream, atomic_write(target, "wb") as copy:
            shutil.copyfileobj(stream, copy)


def _referenced_files(mesh: Path) -> list[str]:
    """Returns the paths of the buffers and images of a glTF file, relative to its folder. Other meshes have none."""
    if mesh.suffix.lower() != ".gltf":
        return []
    content = read_json_input(mesh, ArmError, MAX_BINARY)
    try:
        uris = [file.get("uri", "data:") for kind in ("buffers", "images") for file in content.get(kind, [])]
        names = [uri for uri in uris if not uri.startswith("data:")]
    except (AttributeError, TypeError) as error:
        raise ArmError(f"{mesh}: not a valid glTF file; its buffers and images must be objects with a uri") from error
    if outside := [name for name in names if Path(name).is_absolute() or ".." in Path(name).parts]:
        raise ArmError(
            f"{mesh}: refers to {outside[0]}, which is outside the folder of the mesh; move {outside[0]} into "
            "this folder and correct its path in the mesh file"
        )
    return names


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
