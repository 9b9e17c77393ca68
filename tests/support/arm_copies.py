"""Copies of the files of an arm, with changes."""

from collections.abc import Callable
from pathlib import Path

import yaml

from dvrk_drake.models.sdf_model import MODELS_FOLDER, local_path


def copy_arm(folder: Path, name: str, **changes: Callable[[str], str]) -> Path:
    """Writes arm.yaml, mechanism.yaml, model.sdf and, if the arm has one, instrument.yaml. Returns the arm file.

    Args:
        folder: Existing folder.
        name: Name of an arm with a mechanism.
        **changes: Function from the text of a file to its changed text, by "arm", "mechanism", "instrument" or "sdf".
    """
    text = (MODELS_FOLDER / "arms" / f"{name}.yaml").read_text()
    parts = {kind: part for kind, part in yaml.safe_load(text).items() if kind in ("mechanism", "instrument")}
    texts = {kind: (MODELS_FOLDER / f"{kind}s" / f"{part}.yaml").read_text() for kind, part in parts.items()}
    texts["arm"] = text
    owner = next(kind for kind in texts if "\nsdf: " in texts[kind] and kind != "instrument")
    url = yaml.safe_load(texts[owner])["sdf"]
    texts[owner] = texts[owner].replace(url, "model.sdf")
    for kind, part in parts.items():
        texts["arm"] = texts["arm"].replace(f"{kind}: {part}", f"{kind}: {kind}.yaml")
    texts["sdf"] = local_path(url).read_text()
    for kind, content in texts.items():
        path = folder / ("model.sdf" if kind == "sdf" else f"{kind}.yaml")
        path.write_text(changes.get(kind, str)(content))
    return folder / "arm.yaml"
