"""Positions of the links and frames of an SDF at home, in millimetres."""

import xml.etree.ElementTree as ElementTree
from pathlib import Path


def home_positions(sdf: Path) -> dict[str, tuple[float, float, float]]:
    """Origin of each link and named frame in the model's frame; all links are parallel to it at home."""
    model = ElementTree.parse(sdf).getroot().find("model")
    assert model is not None
    where: dict[str, tuple[float, float, float]] = {}
    for part in (*model.findall("link"), *model.findall("frame")):
        x, y, z = (1000 * float(number) for number in part.findtext("pose", "0 0 0").split()[:3])
        # A frame on a link of another file (an instrument's on the arm) is not needed and stays relative.
        base = where.get(part.get("attached_to", ""), (0.0, 0.0, 0.0))
        where[part.get("name", "")] = (base[0] + x, base[1] + y, base[2] + z)
    return where
