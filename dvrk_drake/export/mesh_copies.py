"""Meshes beside an exported model, so that the folder can be moved and any reader finds them."""

from __future__ import annotations

import os
import shutil
import xml.etree.ElementTree as ElementTree
from pathlib import Path

from dvrk_drake.errors import ArmError, DvrkDrakeError
from dvrk_drake.models.files import LARGEST_BINARY, atomic_write, open_input, read_json_input
from dvrk_drake.models.sdf_model import MODELS_FOLDER, PACKAGE_URL

_FILE_URL = "file://"


def mesh_folder(model_path: Path) -> str:
    """Name of the folder beside an exported model that holds its meshes."""
    return f"{model_path.stem}_meshes"


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
    if uri.startswith(PACKAGE_URL):
        return MODELS_FOLDER / uri.removeprefix(PACKAGE_URL)
    if uri.startswith(_FILE_URL) or "://" not in uri:
        return Path(uri.removeprefix(_FILE_URL))
    return None


def _parts_of(mesh: Path) -> list[str]:
    """Buffers and images that a glTF file keeps outside of itself."""
    if mesh.suffix != ".gltf":
        return []
    content = read_json_input(mesh, ArmError, LARGEST_BINARY)
    try:
        uris = [part.get("uri", "data:") for kind in ("buffers", "images") for part in content.get(kind, [])]
        names = [uri for uri in uris if not uri.startswith("data:")]
    except (AttributeError, TypeError) as error:
        raise ArmError(f"{mesh}: not a glTF file: its buffers and images must be lists of tables with a uri") from error
    if outside := [name for name in names if Path(name).is_absolute() or ".." in Path(name).parts]:
        raise ArmError(f"{mesh}: refers to {outside[0]}, which is not in its folder; move it there")
    return names
