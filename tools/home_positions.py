"""Reads the positions of the links and frames of an SDF in the home pose [mm]."""

import xml.etree.ElementTree as ElementTree
from pathlib import Path


def home_positions(sdf: Path) -> dict[str, tuple[float, float, float]]:
    """Returns the origin [mm] of each link and named frame in the model frame, in the home pose.

    In this pose all links are parallel to the model frame.
    """
    model = ElementTree.parse(sdf).getroot().find("model")
    assert model is not None
    origins: dict[str, tuple[float, float, float]] = {}
    for part in (*model.findall("link"), *model.findall("frame")):
        x, y, z = (1000 * float(number) for number in part.findtext("pose", "0 0 0").split()[:3])
        # Frames on links of other files, e.g. of the instrument, are not needed. Their positions remain relative to the
        # link.
        base = origins.get(part.get("attached_to", ""), (0.0, 0.0, 0.0))
        origins[part.get("name", "")] = (base[0] + x, base[1] + y, base[2] + z)
    return origins
