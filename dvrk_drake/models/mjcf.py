"""Converts the SDF of `plant_tree` to MJCF, the format of MuJoCo."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import PurePosixPath

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydrake.math import RigidTransform, RollPitchYaw

from dvrk_drake.errors import ModelError
from dvrk_drake.models.sdf_elements import BASE_LINK, DRAKE, numbers_text

#: Time constant [s] and damping ratio, and impedance of the equality constraints of a linkage. The default constraints
#: of MuJoCo are soft: a PSM sags by 0.4 rad in 1 s (benchmarks/mujoco_holding.py).
_STIFF = {"solref": "0.002 1", "solimp": "0.9999 0.9999 0.001 0.5 2"}
#: Attributes of the geometries that are only drawn, and of those with contact.
_VISUAL, _COLLISION = {"contype": "0", "conaffinity": "0", "group": "2"}, {"group": "3"}


@dataclass(frozen=True, eq=False)
class Drive:
    """Friction, spring and rotor that act along a combination of joints, x = row q.

    Attributes:
        name: Name of the coordinate x.
        row: Coefficient of each independent joint; joints without an entry do not move it.
        dry: Dry friction [N m, N].
        viscous: Viscous friction [N m s/rad, N s/m].
        stiffness: Stiffness of a spring that is relaxed at x = 0 [N m/rad, N/m].
        inertia: Inertia of a rotor [kg m^2, kg].
    """

    name: str
    row: Mapping[str, float]
    dry: float = 0.0
    viscous: float = 0.0
    stiffness: float = 0.0
    inertia: float = 0.0


def to_mjcf(
    root: ElementTree.Element,
    gravity: ArrayLike,
    drives: Sequence[Drive] = (),
    poses: Mapping[str, Mapping[str, float]] | None = None,
) -> ElementTree.Element:
    """Returns the MJCF element `<mujoco>` of the root element of an SDF from `PlantTree.to_sdf`.

    Dependent joints of the linkage are held by equality constraints, and pairs of links without contact are excluded.
    Each independent joint has a motor with the name and the effort limit of the joint. Named frames become sites. A
    drive that moves with one joint is a part of the joint; any other drive is a fixed tendon.

    Args:
        root: The SDF.
        gravity: Gravity vector (3,) in the base frame [m/s^2].
        drives: Friction, springs and rotors. Rotors of the SDF are added to them.
        poses: Name of a keyframe -> positions of all joints [rad, m].

    Raises:
        ModelError: MJCF does not support the shape of a link.
    """
    (model,) = root.findall("model")
    mujoco = ElementTree.Element("mujoco", model=model.get("name", ""))
    ElementTree.SubElement(mujoco, "compiler", angle="radian", autolimits="true")
    ElementTree.SubElement(mujoco, "option", gravity=numbers_text(gravity), timestep="0.001", integrator="implicitfast")
    assets = ElementTree.SubElement(mujoco, "asset")
    world = ElementTree.SubElement(mujoco, "worldbody")
    joints = {joint.findtext("child", ""): joint for joint in model.findall("joint")}
    own, coupled = _joint_attributes(model, drives)
    X_ML = {link.get("name", ""): _pose(link) for link in model.findall("link")}
    bodies = {BASE_LINK: ElementTree.SubElement(world, "body", name=BASE_LINK)}
    for name, link in _from_base(model, joints):
        if name != BASE_LINK:
            parent = joints[name].findtext("parent", "")
            X = X_ML[parent].inverse() @ X_ML[name]
            bodies[name] = ElementTree.SubElement(bodies[parent], "body", {"name": name} | _placed(X))
            _add_inertial(bodies[name], link)
            _add_joint(bodies[name], joints[name], own.get(joints[name].get("name", ""), {}))
        for part in link:
            if part.tag in ("visual", "collision"):
                _add_geometry(bodies[name], part, assets)
    for frame in model.findall("frame"):
        site = ElementTree.SubElement(bodies[frame.get("attached_to", "")], "site", name=frame.get("name", ""))
        site.attrib |= _placed(_pose(frame)) | {"size": "0.002", "group": "4"}
    _add_excludes(mujoco, model)
    _add_equalities(mujoco, model)
    _add_tendons(mujoco, coupled)
    actuators = ElementTree.SubElement(mujoco, "actuator")
    for joint in model.findall("joint"):
        if (effort := float(joint.findtext("axis/limit/effort", "0"))) > 0:
            name = joint.get("name", "")
            ElementTree.SubElement(actuators, "motor", name=name, joint=name, ctrlrange=f"{-effort!r} {effort!r}")
    keyframes = ElementTree.SubElement(mujoco, "keyframe")
    order = [joint.get("name", "") for joint in mujoco.iterfind("worldbody//joint")]
    for name, pose in (poses or {}).items():
        ElementTree.SubElement(keyframes, "key", name=name, qpos=numbers_text([pose[joint] for joint in order]))
    return mujoco


def _from_base(
    model: ElementTree.Element, joints: Mapping[str, ElementTree.Element]
) -> list[tuple[str, ElementTree.Element]]:
    """Returns the links by name, each after the link that carries it."""
    waiting = {link.get("name", ""): link for link in model.findall("link")}
    found: list[tuple[str, ElementTree.Element]] = []
    while waiting:
        names = {name for name, _ in found}
        ready = [name for name in waiting if name == BASE_LINK or joints[name].findtext("parent") in names]
        found += [(name, waiting.pop(name)) for name in ready]
    return found


def _joint_attributes(
    model: ElementTree.Element, drives: Sequence[Drive]
) -> tuple[dict[str, dict[str, float]], list[Drive]]:
    """Returns joint -> values of its drives by attribute, with those of the SDF, and the drives of several joints."""
    own: dict[str, dict[str, float]] = {}

    def add(joint: str, drive: Drive, factor: float = 1.0) -> None:
        values = own.setdefault(joint, dict.fromkeys(("frictionloss", "damping", "stiffness", "armature"), 0.0))
        values["frictionloss"] += abs(factor) * drive.dry
        for name, value in (("damping", drive.viscous), ("stiffness", drive.stiffness), ("armature", drive.inertia)):
            values[name] += factor**2 * value

    for joint in model.findall("joint"):
        gear = float(joint.findtext(f"{DRAKE}gear_ratio", "1"))
        inertia = float(joint.findtext(f"{DRAKE}rotor_inertia", "0")) * gear**2
        damping = float(joint.findtext("axis/dynamics/damping", "0"))
        add(joint.get("name", ""), Drive("", {}, viscous=damping, inertia=inertia))
    coupled = []
    for drive in drives:
        if len(drive.row) == 1:
            ((joint_name, factor),) = drive.row.items()
            add(joint_name, drive, factor)
        else:
            coupled.append(drive)
    return own, coupled


def _add_inertial(body: ElementTree.Element, link: ElementTree.Element) -> None:
    inertial = link.find("inertial")
    if inertial is None:
        raise ModelError(f"link {link.get('name')} has no inertial parameters")
    moments = [inertial.findtext(f"inertia/{name}", "0") for name in ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")]
    values = {"mass": inertial.findtext("mass", ""), "fullinertia": " ".join(moments)}
    ElementTree.SubElement(body, "inertial", {"pos": "0 0 0"} | _placed(_pose(inertial)) | values)


def _add_joint(body: ElementTree.Element, joint: ElementTree.Element, drive: Mapping[str, float]) -> None:
    kind = "slide" if joint.get("type") == "prismatic" else "hinge"
    out = ElementTree.SubElement(body, "joint", name=joint.get("name", ""), type=kind)
    out.set("axis", joint.findtext("axis/xyz", ""))
    lower, upper = (joint.findtext(f"axis/limit/{side}") for side in ("lower", "upper"))
    if lower is not None and upper is not None and joint.find(f"{DRAKE}mimic") is None:
        out.set("range", f"{lower} {upper}")
    values = dict(drive)
    if (stiffness := joint.findtext("axis/dynamics/spring_stiffness")) is not None:
        # Two springs at one joint act as one, which is relaxed where their efforts are opposite.
        reference = float(joint.findtext("axis/dynamics/spring_reference", "0"))
        values["stiffness"] += float(stiffness)
        out.set("springref", repr(reference * float(stiffness) / values["stiffness"]) if values["stiffness"] else "0")
    out.attrib |= {name: repr(value) for name, value in values.items() if value}


def _add_geometry(body: ElementTree.Element, part: ElementTree.Element, assets: ElementTree.Element) -> None:
    (shape,) = part.findall("geometry/*")
    values = {value.tag: [float(x) for x in (value.text or "").split()] for value in shape if value.tag != "uri"}
    name = f"{body.get('name')}_{part.get('name')}"
    geometry = {"name": name, "type": shape.tag}
    match shape.tag:
        case "box":
            geometry["size"] = numbers_text(np.array(values["size"]) / 2)
        case "sphere":
            geometry["size"] = numbers_text(values["radius"])
        case "cylinder" | "capsule":
            geometry["size"] = numbers_text([values["radius"][0], values["length"][0] / 2])
        case "ellipsoid":
            geometry["size"] = numbers_text(values["radii"])
        case "mesh":
            file = PurePosixPath(shape.findtext("uri", ""))
            attributes = {"name": name, "file": str(file), "scale": numbers_text(values.get("scale", [1.0, 1.0, 1.0]))}
            # The mass of the shape is not used, and an open surface has no volume.
            ElementTree.SubElement(assets, "mesh", attributes | {"inertia": "shell"})
            geometry |= {"mesh": name}
        case _:
            raise ModelError(f"link {body.get('name')}, {part.tag} {part.get('name')}: MJCF has no shape {shape.tag}")
    if (color := part.findtext("material/diffuse")) is not None:
        geometry["rgba"] = color
    geometry |= _placed(_pose(part)) | (_VISUAL if part.tag == "visual" else _COLLISION)
    ElementTree.SubElement(body, "geom", geometry)


def _add_excludes(mujoco: ElementTree.Element, model: ElementTree.Element) -> None:
    contact = ElementTree.SubElement(mujoco, "contact")
    groups = {
        group.get("name", ""): [member.text or "" for member in group.findall(f"{DRAKE}member")]
        for group in model.findall(f"{DRAKE}collision_filter_group")
    }
    pairs = {
        tuple(sorted((first, second)))
        for group in model.findall(f"{DRAKE}collision_filter_group")
        for other in group.findall(f"{DRAKE}ignored_collision_filter_group")
        for first in groups[group.get("name", "")]
        for second in groups[other.text or ""]
        if first != second
    }
    for first, second in sorted(pairs):
        ElementTree.SubElement(contact, "exclude", body1=first, body2=second)


def _add_equalities(mujoco: ElementTree.Element, model: ElementTree.Element) -> None:
    equality = ElementTree.SubElement(mujoco, "equality")
    for joint in model.findall("joint"):
        if (mimic := joint.find(f"{DRAKE}mimic")) is not None:
            pair = {"joint1": joint.get("name", ""), "joint2": mimic.get("joint", "")}
            polynomial = f"{mimic.get('offset', '0')} {mimic.get('multiplier', '1')} 0 0 0"
            ElementTree.SubElement(equality, "joint", pair | {"polycoef": polynomial} | _STIFF)


def _add_tendons(mujoco: ElementTree.Element, drives: Sequence[Drive]) -> None:
    tendons = ElementTree.SubElement(mujoco, "tendon")
    for drive in drives:
        values = {
            "frictionloss": drive.dry,
            "damping": drive.viscous,
            "stiffness": drive.stiffness,
            "armature": drive.inertia,
        }
        if any(values.values()):
            attributes = {name: repr(float(value)) for name, value in values.items() if value}
            tendon = ElementTree.SubElement(tendons, "fixed", {"name": drive.name, "springlength": "0"} | attributes)
            for joint, coefficient in drive.row.items():
                ElementTree.SubElement(tendon, "joint", joint=joint, coef=repr(float(coefficient)))


def _pose(element: ElementTree.Element) -> RigidTransform:
    numbers: NDArray[np.float64] = np.array(element.findtext("pose", "0 0 0 0 0 0").split(), dtype=np.float64)
    return RigidTransform(RollPitchYaw(numbers[3:]), numbers[:3])


def _placed(X: RigidTransform) -> dict[str, str]:
    """Returns the attributes of a pose, without those of the identity."""
    pose = {}
    if np.any(X.translation()):
        pose["pos"] = numbers_text(X.translation())
    if not X.rotation().IsExactlyIdentity():
        pose["quat"] = numbers_text(X.rotation().ToQuaternion().wxyz())
    return pose
