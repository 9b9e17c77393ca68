"""The few facts of an SDF that Drake parses but does not give back, or that are needed before parsing."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass
from pathlib import Path

from dvrk_drake.errors import ArmError

DRAKE = "{http://drake.mit.edu}"


@dataclass(frozen=True)
class SdfFacts:
    """Moving joints of one SDF model, in the order of the file.

    Attributes:
        joint_names: every joint that can move.
        mimics: dependent joint -> (joint it follows, multiplier, offset).
        effort_limits: joint -> `<effort>` [N m or N]; joints without the tag are missing.
    """

    joint_names: tuple[str, ...]
    mimics: dict[str, tuple[str, float, float]]
    effort_limits: dict[str, float]


def read_sdf_facts(path: Path) -> SdfFacts:
    """Reads them from the file at `path`.

    Raises:
        ArmError: the file is not an SDF with one model, or holds `<friction>`, which Drake drops silently.
    """
    try:
        model = ElementTree.parse(path).getroot().find("model")
    except (OSError, ElementTree.ParseError) as error:
        raise ArmError(f"{path}: not a readable SDF: {error}") from error
    if model is None:
        raise ArmError(f"{path}: holds no <model>")
    names, mimics, efforts = [], {}, {}
    for joint in model.findall("joint"):
        name = joint.get("name", "")
        if joint.get("type") == "fixed":
            continue
        if joint.find(".//friction") is not None:
            raise ArmError(f"{path}: joint {name} has <friction>, which Drake drops silently; model it elsewhere")
        names.append(name)
        mimic = joint.find(f"{DRAKE}mimic")
        if mimic is not None:
            mimics[name] = (
                mimic.get("joint", ""),
                float(mimic.get("multiplier", "1")),
                float(mimic.get("offset", "0")),
            )
        effort = joint.findtext("axis/limit/effort")
        if effort is not None:
            efforts[name] = float(effort)
    return SdfFacts(tuple(names), mimics, efforts)
