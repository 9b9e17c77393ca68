"""SDF of an arm with identified inertial parameters."""

from __future__ import annotations

import difflib
import os
import shutil
import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.dynamics.inertial_parameters import LinkInertia, link_inertias
from dvrk_drake.errors import ArmError, DvrkDrakeError, ModelError
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.files import MAX_BINARY, atomic_write, open_input, read_json_input
from dvrk_drake.models.sdf_model import DRAKE, PACKAGE_URL, compose_sdf, local_path

#: Relative change of rounding errors, below which the text of a link is kept.
_UNCHANGED = 1e-12


@dataclass(frozen=True, eq=False)
class LinkChange:
    """Change of the inertia of one link by an export.

    Attributes:
        link: Name of the link.
        before, after: Inertias about the link's origin.
    """

    link: str
    before: LinkInertia
    after: LinkInertia


def changed_links(arm: Arm, links: Sequence[LinkInertia]) -> list[LinkChange]:
    """Returns the links whose parameters differ from those of the arm's SDF.

    Raises:
        ModelError: A link does not belong to the arm or is given twice.
    """
    before = {inertia.link: inertia for inertia in link_inertias(arm)}
    names = [inertia.link for inertia in links]
    if unknown := set(names) - set(before):
        raise ModelError(f"{arm.name} has no moving link {', '.join(sorted(unknown))}; it has {', '.join(before)}")
    if len(set(names)) < len(names):
        raise ModelError(f"{arm.name}: a link is given twice: {', '.join(names)}")
    changes = (LinkChange(inertia.link, before[inertia.link], inertia) for inertia in links)
    return [c for c in changes if not _same(c.before.parameters, c.after.parameters)]


def with_inertias(
    arm: Arm, links: Sequence[LinkInertia], rotor_inertias: Mapping[str, float] | None = None
) -> ElementTree.Element:
    """Returns the arm's SDF with instrument as one model with the inertias of `links`. Other links are unchanged.

    Args:
        arm: Arm whose SDF is changed.
        links: Inertias of any of its moving links.
        rotor_inertias: Rotor inertia by joint, as seen at the joint [kg m^2; kg if prismatic], for joints that are
            driven by one motor alone. Gear ratios are unchanged.

    Raises:
        ModelError: A link does not belong to the arm, an inertia is not physical, or a rotor inertia is negative.
    """
    root = compose_sdf(arm.sdf, arm.mirrored_links)
    elements = {link.get("name"): link for link in root.iterfind("model/link")}
    for change in changed_links(arm, links):
        element = elements[change.link]
        old = element.find("inertial")
        position = 0 if old is None else list(element).index(old)
        if old is not None:
            element.remove(old)
        element.insert(position, inertial_element(change.after))
    for joint, inertia in (rotor_inertias or {}).items():
        _set_rotor(root, joint, inertia)
    return root


def write_sdf(
    arm: Arm,
    links: Sequence[LinkInertia],
    path: str | Path,
    origin: str,
    rotor_inertias: Mapping[str, float] | None = None,
) -> None:
    """Writes `with_inertias`, at once or not at all, and copies of the meshes into the folder <name>_meshes beside it.

    Args:
        arm, links, rotor_inertias: as of `with_inertias`.
        path: the SDF to write.
        origin: where the numbers come from, for the comment at its head.

    Raises:
        ModelError: see `with_inertias`.
        DvrkDrakeError: a file cannot be written.
    """
    target = Path(path)
    root = with_inertias(arm, links, rotor_inertias)
    copies = redirect_meshes(root, target)
    copy_meshes(copies)
    with atomic_write(target) as stream:
        stream.write(to_text(root, f"{arm.name}, inertial parameters of {origin}. Written by dvrk-drake export."))


def sdf_difference(arm: Arm, links: Sequence[LinkInertia], rotor_inertias: Mapping[str, float] | None = None) -> str:
    """Returns the unified diff from the arm's composed SDF to that of `with_inertias`, empty if nothing changes."""
    before, after = (
        to_text(root).splitlines(keepends=True)
        for root in (compose_sdf(arm.sdf, arm.mirrored_links), with_inertias(arm, links, rotor_inertias))
    )
    return "".join(difflib.unified_diff(before, after, " + ".join(arm.sdf), "exported", n=4))


def to_text(root: ElementTree.Element, comment: str = "") -> str:
    """Returns the XML file of a model, indented."""
    ElementTree.indent(root)
    head = '<?xml version="1.0"?>\n' + (f"<!-- {comment.replace('--', '- -')} -->\n" if comment else "")
    return head + ElementTree.tostring(root, encoding="unicode") + "\n"


def inertial_element(inertia: LinkInertia) -> ElementTree.Element:
    """Returns `<inertial>` with mass, centre of mass, and inertia about it in the link's axes, in full precision.

    Raises:
        ModelError: The inertia is not physical.
    """
    if not np.linalg.eigvalsh(inertia.pseudo_inertia()).min() > 0:
        raise ModelError(f"{inertia.link}: no body has this inertia: its pseudo-inertia must be positive definite")
    M_LLo_L = inertia.to_spatial_inertia()
    p_LoLcm_L = M_LLo_L.get_com()
    I_LLcm_L = M_LLo_L.Shift(p_LoLcm_L).CalcRotationalInertia()
    element = ElementTree.Element("inertial")
    _add(element, "pose", " ".join([*_numbers(p_LoLcm_L), "0 0 0"]))
    _add(element, "mass", repr(M_LLo_L.get_mass()))
    inertia_element = ElementTree.SubElement(element, "inertia")
    values = _numbers([*I_LLcm_L.get_moments(), *I_LLcm_L.get_products()])
    for name, value in zip(("ixx", "iyy", "izz", "ixy", "ixz", "iyz"), values, strict=True):
        _add(inertia_element, name, value)
    return element


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


def _add(parent: ElementTree.Element, tag: str, text: str) -> None:
    ElementTree.SubElement(parent, tag).text = text


def _numbers(values: Sequence[float] | NDArray[np.float64]) -> list[str]:
    """Formats numbers in full precision. Rounding errors relative to the largest number become 0."""
    least = 1e-15 * max(abs(x) for x in values)
    return [repr(float(x)) if abs(x) > least else "0" for x in values]


def _same(a: NDArray[np.float64], b: NDArray[np.float64]) -> bool:
    """Compares mass, first moments and inertia, each relative to its own size."""
    parts = (slice(0, 1), slice(1, 4), slice(4, 10))
    return all(np.abs(a[p] - b[p]).max() <= _UNCHANGED * np.abs(a[p]).max() for p in parts)


_FILE_URL = "file://"


def mesh_folder(model_path: Path) -> str:
    """Returns the name of the mesh folder beside an exported model."""
    return f"{model_path.stem}_meshes"


def refuse_existing_meshes(model_path: str | Path, overwrite: bool) -> None:
    """Raises DvrkDrakeError if the folder for a model's meshes contains files, unless they may be replaced."""
    folder = Path(model_path).with_name(mesh_folder(Path(model_path)))
    if not overwrite and folder.is_dir() and any(folder.iterdir()):
        raise DvrkDrakeError(
            f"{folder}: holds files already; name another model file, or write into it with --overwrite"
        )


def redirect_meshes(root: ElementTree.Element, model_path: Path) -> dict[Path, Path]:
    """Makes every `<uri>` of a composed model relative to `model_path`: meshes in `mesh_folder`.

    Returns:
        file to copy -> where to; what a glTF file refers to comes along. Packages other than ours stay as they are.

    Raises:
        ArmError: a mesh does not exist.
    """
    copies: dict[Path, Path] = {}
    for uri in root.iter("uri"):
        source = _local_path(uri.text or "")
        if source is None:
            continue
        if not os.path.isfile(source):
            raise ArmError(f"{source}: no such mesh")
        relative = Path(mesh_folder(model_path)) / source.parent.name / source.name
        target = model_path.parent / relative
        if copies.setdefault(source, target) != target or list(copies.values()).count(target) > 1:
            raise ArmError(f"{source}: another mesh of the model has the same name and folder name; rename one")
        for part in _parts_of(source):
            copies[source.parent / part] = target.parent / part
        uri.text = relative.as_posix()
    return copies


def copy_meshes(copies: dict[Path, Path]) -> None:
    """Copies files, each at once or not at all.

    Raises:
        DvrkDrakeError: a file cannot be written.
    """
    for source, target in copies.items():
        if str(source) == os.path.realpath(target):
            continue
        try:
            target.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise DvrkDrakeError(f"{target.parent}: cannot be made a folder: {error.strerror}") from error
        with open_input(source, ArmError) as stream, atomic_write(target, "wb") as copy:
            shutil.copyfileobj(stream, copy)


def _local_path(uri: str) -> Path | None:
    if "://" in uri.removeprefix(PACKAGE_URL).removeprefix(_FILE_URL):
        return None
    return local_path(uri.removeprefix(_FILE_URL))


def _parts_of(mesh: Path) -> list[str]:
    """Returns the external buffers and images of a glTF file."""
    if mesh.suffix != ".gltf":
        return []
    content = read_json_input(mesh, ArmError, MAX_BINARY)
    try:
        uris = [part.get("uri", "data:") for kind in ("buffers", "images") for part in content.get(kind, [])]
        names = [uri for uri in uris if not uri.startswith("data:")]
    except (AttributeError, TypeError) as error:
        raise ArmError(f"{mesh}: not a glTF file: its buffers and images must be lists of tables with a uri") from error
    if outside := [name for name in names if Path(name).is_absolute() or ".." in Path(name).parts]:
        raise ArmError(f"{mesh}: refers to {outside[0]}, which is not in its folder; move it there")
    return names
