"""Combines the SDF files of an arm into one model, and reads properties that Drake's API does not provide."""

from __future__ import annotations

import copy
import math
import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

from dvrk_drake.errors import ArmError
from dvrk_drake.models.arm_schema import EFFORTS
from dvrk_drake.models.dvrk_tool import tool_sdf
from dvrk_drake.models.immutable import cached
from dvrk_drake.models.model_file import MODEL_SUFFIXES, convert_model
from dvrk_drake.models.ranges import Range
from dvrk_drake.models.sdf_elements import BASE_LINK, DRAKE, read_xml

MODELS_FOLDER = Path(__file__).parent
PACKAGE_URL = "package://dvrk_drake/"
#: Numbers in SDF files that mean that a joint has no position limit.
_NO_LIMIT = (-1e16, 1e16, -math.inf, math.inf)
_MOMENTS, _PRODUCTS = Range(0.0, 50.0, "kg m^2"), Range(-50.0, 50.0, "kg m^2")
_LENGTHS = Range(1e-6, 10.0, "m")
#: Mapping from an element or attribute to the range of its numbers. The links of a dVRK have masses of 1 g to 10 kg,
#: those of a UR10e up to 13 kg. All these links are shorter than 1 m. The ranges of `_SIZE_EXPONENTS` grow with the
#: arm. The other ranges do not, because they detect typing errors such as degrees in place of radians. -1 and 0 denote
#: unspecified limits of velocity or effort.
_RANGES = {
    "mass": Range(1e-6, 200.0, "kg"),
    **{f"i{axis}": _MOMENTS for axis in ("xx", "yy", "zz")},
    **{f"i{axes}": _PRODUCTS for axes in ("xy", "xz", "yz")},
    "pose": Range(-5.0, 5.0, "m"),
    "xyz": Range(-1000.0, 1000.0),
    "lower": Range(-1000.0, 1000.0, "rad or m", also=_NO_LIMIT),
    "upper": Range(-1000.0, 1000.0, "rad or m", also=_NO_LIMIT),
    "velocity": Range(1e-3, 100.0, "rad/s or m/s", also=(-1.0, 0.0, math.inf)),
    "effort": replace(EFFORTS, also=(-1.0, 0.0)),
    "damping": Range(0.0, 1000.0, "N m s/rad or N s/m"),
    "scale": Range(1e-6, 1e4, either_sign=True),
    **dict.fromkeys(("radius", "length", "size"), _LENGTHS),
    f"{DRAKE}rotor_inertia": Range(0.0, 50.0, "kg m^2 or kg"),
    f"{DRAKE}gear_ratio": Range(1e-3, 1e4, either_sign=True),
    "multiplier": Range(1e-3, 1e3, also=(0.0,), either_sign=True),
    "offset": Range(-12.6, 12.6, "rad or m"),
}
#: Largest effort limit of an arm [N m, N] for which the ranges are as stated. If an arm is k times as large in all
#: directions, its efforts are k^4 times as large, and the upper bounds of these elements grow with these powers of k.
_USUAL_EFFORT = 2000.0
_SIZE_EXPONENTS = {
    **dict.fromkeys(("pose", "radius", "length", "size"), 1),
    "mass": 3,
    "damping": 4,
    **dict.fromkeys(("ixx", "iyy", "izz", "ixy", "ixz", "iyz", f"{DRAKE}rotor_inertia"), 5),
}
#: Ranges of the angles of a pose (roll, pitch, yaw) in radians and degrees.
_POSE_ANGLES, _POSE_DEGREES = Range(-12.6, 12.6, "rad"), Range(-720.0, 720.0, "degrees")
ElementTree.register_namespace("drake", DRAKE.strip("{}"))
#: Accepted counts of numbers in elements with several numbers; a pose with a quaternion has 7.
_COUNTS = {"pose": (6, 7), "xyz": (3,), "scale": (3,), "size": (3,)}


@dataclass(frozen=True)
class SdfFacts:
    """Moving joints of one SDF model, in the order of the file.

    Attributes:
        joint_names: Names of all moving joints.
        mimics: Mapping from a dependent joint to (leading joint, multiplier, offset).
        effort_limits: Mapping from a joint to its `<effort>` [N m or N]; joints without the tag have no entry.
        position_limits: Mapping from a joint to its [lower, upper] [rad, m]; joints without both have no entry.
        prismatic: Names of the prismatic joints; all others are revolute.
        link_names: Names of the links.
        frame_names: Names of the frames that are not frames of links.
        last_link: Link that the last moving joint moves, or "" if there is no joint.
    """

    joint_names: tuple[str, ...]
    mimics: dict[str, tuple[str, float, float]]
    effort_limits: dict[str, float]
    position_limits: dict[str, list[float]]
    prismatic: frozenset[str]
    link_names: frozenset[str]
    frame_names: frozenset[str]
    last_link: str


def is_in_degrees(pose: ElementTree.Element) -> bool:
    """Returns whether the angles of an SDF pose are in degrees."""
    return pose.get("degrees", "").lower() in ("true", "1")


def local_path(url: str) -> Path:
    """Returns the path for a package URL; a path is returned unchanged."""
    return MODELS_FOLDER / url.removeprefix(PACKAGE_URL) if url.startswith(PACKAGE_URL) else Path(url)


def compose_sdf(urls: Sequence[str]) -> ElementTree.Element:
    """Returns the model of the first file, extended by the links, joints and frames of the other files.

    Relative paths of meshes become absolute. If a file repeats a link of an earlier file, only the shapes of that link
    are added. For example, the housing of an instrument becomes a shape of the carriage of the arm, not an additional
    body.

    Args:
        urls: Package URLs or paths.

    Raises:
        ArmError: A file is not a model of an arm, or repeats a link with inertia.
    """
    root = _read(local_path(urls[0]), may_convert=True)
    (model,) = root.findall("model")
    links = {link.get("name", ""): link for link in model.findall("link")}
    for url in urls[1:]:
        other = _read(local_path(url), may_convert=False, arm=root)
        for part in other.iterfind("model/*"):
            if part.tag == "link" and part.get("name", "") in links:
                _add_shapes(links[part.get("name", "")], part)
            else:
                model.append(part)
                if part.tag == "link":
                    _add_to_filter_groups(model, part.get("name", ""))
    return root


def _add_to_filter_groups(model: ElementTree.Element, link: str) -> None:
    """Adds an instrument's link to the collision filter groups of its arm."""
    for group in model.findall(f"{DRAKE}collision_filter_group"):
        member = ElementTree.SubElement(group, f"{DRAKE}member")
        member.text = link


def read_sdf_facts(root: ElementTree.Element) -> SdfFacts:
    """Reads the moving joints from a composed model.

    Raises:
        ArmError: The link `BASE_LINK` is missing, another link has no mass, two joints have the same name, or the
            model has an unsupported joint. Unsupported are joint types other than revolute, prismatic and fixed;
            `<friction>`, which Drake ignores silently; and `drake:mimic` of a fixed joint or with a multiplier of 0.
    """
    if root.find(f"model/link[@name='{BASE_LINK}']") is None:
        raise ArmError(f"the SDF has no link {BASE_LINK}")
    for link in root.findall("model/link"):
        # If the mass is missing, Drake uses 1 kg without a warning.
        if link.get("name") != BASE_LINK and not float(link.findtext("inertial/mass") or 0.0) > 0:
            raise ArmError(f"link {link.get('name')} of the SDF needs a positive <inertial><mass>")
    names, mimics, efforts, positions, prismatic, last_link = [], {}, {}, {}, set(), ""
    for joint in root.findall("model/joint"):
        name = joint.get("name", "")
        mimic = joint.find(f"{DRAKE}mimic")
        if (kind := joint.get("type")) not in ("revolute", "prismatic", "fixed"):
            raise ArmError(f"joint {name} of the SDF has type {kind!r}; allowed: revolute, prismatic, fixed")
        if kind == "fixed":
            if mimic is not None:
                raise ArmError(f"joint {name} of the SDF is fixed and cannot have <drake:mimic>")
            continue
        if joint.find(".//friction") is not None:
            raise ArmError(
                f"joint {name} of the SDF has <friction>, which Drake ignores; use effects.friction of the YAML file"
            )
        if name in names:
            raise ArmError(f"the SDF has two joints named {name}")
        names.append(name)
        last_link = joint.findtext("child", "")
        if joint.get("type") == "prismatic":
            prismatic.add(name)
        if mimic is not None:
            mimics[name] = (
                mimic.get("joint", ""),
                float(mimic.get("multiplier", "1")),
                float(mimic.get("offset", "0")),
            )
            if mimics[name][1] == 0:
                raise ArmError(f"joint {name} of the SDF has a mimic multiplier of 0; make the joint fixed instead")
        effort = joint.findtext("axis/limit/effort")
        if effort is not None:
            efforts[name] = float(effort)
        limits = [float(joint.findtext(f"axis/limit/{side}", "inf")) for side in ("lower", "upper")]
        if not set(limits) & set(_NO_LIMIT):
            positions[name] = limits
    links, frames = (
        frozenset(part.get("name", "") for part in root.findall(f"model/{tag}")) for tag in ("link", "frame")
    )
    return SdfFacts(tuple(names), mimics, efforts, positions, frozenset(prismatic), links, frames, last_link)


def _read(path: Path, may_convert: bool, arm: ElementTree.Element | None = None) -> ElementTree.Element:
    """Returns the model of a file. A file that is not an SDF of one model with a link `base_link` may be converted.

    The file of an instrument of the dVRK needs the arm that carries it.
    """
    if path.suffix.lower() == ".json":
        root = tool_sdf(path, arm)
        _check_numbers(path, root)
        return root
    if may_convert and path.suffix.lower() != ".sdf" and path.name.lower().endswith(MODEL_SUFFIXES):
        return _convert(path)
    root = read_xml(path)
    tags = [element.tag for element in root.iter() if element.tag in ("model", "include")]
    is_one_model = root.find("model") is not None and tags == ["model"]
    if may_convert and not (is_one_model and root.find(f"model/link[@name='{BASE_LINK}']") is not None):
        return _convert(path)
    if not is_one_model:
        raise ArmError(f"{path}: <sdf> must contain exactly one <model>, without a nested <model> or <include>")
    for link in root.iterfind("model/link"):
        # Files contain a mass of 0 only because Drake's parser uses 1 kg for a link without <inertial>.
        for inertial in link.findall("inertial"):
            if _number(inertial.findtext("mass") or "") == 0:
                link.remove(inertial)
    _check_numbers(path, root)
    for uri in root.iter("uri"):
        # A composed model has no folder, so Drake can resolve neither relative nor absolute paths.
        if uri.text and "://" not in uri.text:
            uri.text = f"file://{path.resolve().parent / uri.text}"
    return root


def _convert(path: Path) -> ElementTree.Element:
    state = (0, 0)
    with suppress(OSError):  # convert_model reports a missing file
        status = path.stat()
        state = (status.st_mtime_ns, status.st_size)
    return copy.deepcopy(_converted(path, state))


@cached
def _converted(path: Path, state: tuple[int, int]) -> ElementTree.Element:
    """Returns the converted model of a file. `state` (time of change, size) is its version."""
    root = convert_model(path)
    _check_numbers(path, root)
    return root


def _check_numbers(path: Path, root: ElementTree.Element) -> None:
    """Raises ArmError for a number that is invalid, not finite or outside its range in `_RANGES`."""
    efforts = [_number(effort.text or "") for effort in root.iterfind("model/joint/axis/limit/effort")]
    size = max([1.0, *(effort / _USUAL_EFFORT for effort in efforts if effort in EFFORTS)]) ** 0.25
    for part in root.iterfind("model/*"):
        for element in part.iter():
            texts = [(element.tag, f"<{element.tag}>", element.text)] if element.tag in _RANGES else []
            if element.tag == f"{DRAKE}mimic":
                texts = [(name, name, element.get(name, "1")) for name in ("multiplier", "offset")]
            for name, what, text in texts:
                where = f"{path}: {part.tag} {part.get('name')}: {what.replace(DRAKE, 'drake:')}"
                for value, allowed in zip(*_numbers_of(where, name, text or "", element, size), strict=True):
                    if fault := allowed.fault(where, value):
                        raise ArmError(fault)


def _numbers_of(
    where: str, name: str, text: str, element: ElementTree.Element, size: float
) -> tuple[list[float], list[Range]]:
    """Returns the numbers of an element or attribute, and the range of each for the size of the arm."""
    counts = _COUNTS.get(name, (1,))
    values = [_number(word) for word in text.split()]
    factor, usual = size ** _SIZE_EXPONENTS.get(name, 0), _RANGES[name]
    # Ranges that begin above 0 begin at a rounding error, which does not depend on the size.
    allowed = [replace(usual, low=min(usual.low, factor * usual.low), high=factor * usual.high)] * len(values)
    if name == "pose":
        allowed[3:] = [_POSE_DEGREES if is_in_degrees(element) else _POSE_ANGLES] * len(values[3:])
    are_numbers = all(math.isfinite(v) or v in a for v, a in zip(values, allowed, strict=True))
    if len(values) not in counts or not are_numbers:
        number = "a finite number" if counts == (1,) else f"{counts[0]} finite numbers"
        raise ArmError(f"{where} is {text[:60]!r}; allowed: {number}")
    return values, allowed


def _number(word: str) -> float:
    try:
        return float(word)
    except ValueError:
        return math.nan


def _add_shapes(link: ElementTree.Element, repeated: ElementTree.Element) -> None:
    for shape in repeated:
        if shape.tag not in ("visual", "collision"):
            raise ArmError(f"link {link.get('name')} has <{shape.tag}> in two files; allowed: <visual>, <collision>")
        link.append(shape)
