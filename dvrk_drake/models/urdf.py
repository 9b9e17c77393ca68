"""Converts the SDF of an arm to URDF."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping

import numpy as np
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RigidTransform, RollPitchYaw

from dvrk_drake.errors import ModelError
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.sdf_elements import DRAKE
from dvrk_drake.models.sdf_model import SdfFacts, is_in_degrees, read_sdf_facts

#: Speed limit of joints for which the SDF has no speed limit [rad/s, m/s]. URDF requires a speed limit.
NO_SPEED_LIMIT = "1000"
#: Inertia of a link without `<inertial>`, which only the fixed base may be: a sphere of 1 kg with a radius of 0.1 m.
#: libsdformat removes a link without mass from a URDF, and all links that it carries.
_BASE_MASS, _BASE_MOMENT = "1", "0.004"


def to_urdf(root: ElementTree.Element, arm: Arm) -> ElementTree.Element:
    """Converts an SDF with one model, see `compose_sdf`, to the URDF element `<robot>`.

    Dependent joints of the linkage become mimic joints, because URDF does not support closed loops. A capsule becomes a
    cylinder and two spheres, because URDF does not support capsules. Rotor inertias, gear ratios, named frames and
    collision filters are written in Drake's extensions of URDF. A link without `<inertial>` gets a mass.

    Raises:
        ModelError: URDF does not support a part of the SDF, such as a `<pose>` in a joint, a joint spring or an
            unsupported shape.
    """
    (model,) = root.findall("model")
    facts = read_sdf_facts(root)
    robot = ElementTree.Element("robot", name=model.get("name", arm.name))
    X_ML: dict[str, RigidTransform] = {}
    for link in model.findall("link"):
        name = link.get("name", "")
        X_ML[name] = _pose(link)
        _add_link(robot, name, link)
    ranges = dict(zip(arm.joint_names, zip(arm.position_lower, arm.position_upper, strict=True), strict=True))
    ranges |= {name: (position, position) for name, position in arm.locked_joints.items()}
    for joint in model.findall("joint"):
        _add_joint(robot, joint, X_ML, facts, ranges)
    for joint in model.findall("joint"):
        if facts.effort_limits.get(joint.get("name", ""), 0.0) > 0:
            _add_transmission(robot, joint)
    for frame in model.findall("frame"):
        if (carrier := frame.get("attached_to", "")) not in X_ML:
            raise ModelError(
                f"frame {frame.get('name')} is attached to {carrier!r}; URDF supports only frames of links"
            )
        X_LF = _pose(frame)
        xyz, rpy = _xyz_rpy(X_LF)
        attributes = {"name": frame.get("name", ""), "link": carrier, "xyz": xyz, "rpy": rpy}
        ElementTree.SubElement(robot, "frame", attributes)
    for group in model.findall(f"{DRAKE}collision_filter_group"):
        _add_filter_group(robot, group)
    return robot


def _add_link(robot: ElementTree.Element, name: str, link: ElementTree.Element) -> None:
    out = ElementTree.SubElement(robot, "link", name=name)
    inertial = link.find("inertial")
    element = ElementTree.SubElement(out, "inertial")
    mass, moments = _BASE_MASS, {tag: _BASE_MOMENT for tag in ("ixx", "iyy", "izz")}
    products = dict.fromkeys(("ixy", "ixz", "iyz"), "0")
    if inertial is not None:
        _add_origin(element, _pose(inertial))
        mass = _text(inertial, "mass")
        moments = {tag: _text(inertial, f"inertia/{tag}") for tag in moments}
        products = {tag: inertial.findtext(f"inertia/{tag}", "0") for tag in products}
    ElementTree.SubElement(element, "mass", value=mass)
    ElementTree.SubElement(element, "inertia", moments | products)
    for kind in ("visual", "collision"):
        for shape in link.findall(kind):
            _add_shape(out, kind, name, shape)


def _add_shape(out: ElementTree.Element, kind: str, link: str, shape: ElementTree.Element) -> None:
    name, X_LG = shape.get("name", ""), _pose(shape)
    parts: list[tuple[str, RigidTransform, str, dict[str, str]]] = []
    geometry = shape.find("geometry")
    shape_element = next(iter(geometry)) if geometry is not None and len(geometry) else None
    tag = "none" if shape_element is None else shape_element.tag
    if shape_element is not None and tag == "mesh":
        parts.append(
            (
                name,
                X_LG,
                "mesh",
                {"filename": _text(shape_element, "uri"), "scale": shape_element.findtext("scale", "1 1 1")},
            )
        )
    elif shape_element is not None and tag == "box":
        parts.append((name, X_LG, "box", {"size": _text(shape_element, "size")}))
    elif shape_element is not None and tag == "sphere":
        parts.append((name, X_LG, "sphere", {"radius": _text(shape_element, "radius")}))
    elif shape_element is not None and tag in ("cylinder", "capsule"):
        radius, length = _text(shape_element, "radius"), _text(shape_element, "length")
        parts.append((name, X_LG, "cylinder", {"radius": radius, "length": length}))
        if tag == "capsule":
            for end, sign in (("end", 1), ("start", -1)):
                X_GS = RigidTransform(np.array([0.0, 0.0, sign * float(length) / 2]))
                parts.append((f"{name}_{end}", X_LG @ X_GS, "sphere", {"radius": radius}))
    else:
        raise ModelError(f"link {link}, {kind} {name}: URDF does not support the shape {tag}")
    for part_name, X_LP, part_tag, attributes in parts:
        element = ElementTree.SubElement(out, kind, name=part_name)
        _add_origin(element, X_LP)
        ElementTree.SubElement(ElementTree.SubElement(element, "geometry"), part_tag, attributes)


def _add_joint(
    robot: ElementTree.Element,
    joint: ElementTree.Element,
    X_ML: Mapping[str, RigidTransform],
    facts: SdfFacts,
    ranges: Mapping[str, tuple[float, float]],
) -> None:
    name, kind = joint.get("name", ""), joint.get("type", "")
    if joint.find("pose") is not None:
        raise ModelError(f"joint {name} has a <pose>; in URDF, the joint frame must equal the frame of the child link")
    parent, child = _text(joint, "parent"), _text(joint, "child")
    if missing := {parent, child} - set(X_ML):
        raise ModelError(f"joint {name}: the SDF has no link {', '.join(sorted(missing))}")
    out = ElementTree.SubElement(robot, "joint", name=name, type=kind)
    ElementTree.SubElement(out, "parent", link=parent)
    ElementTree.SubElement(out, "child", link=child)
    _add_origin(out, X_ML[parent].inverse() @ X_ML[child])
    if kind == "fixed":
        return
    ElementTree.SubElement(out, "axis", xyz=_axis(joint, child, X_ML))
    lower, upper = ranges.get(name, (0.0, 0.0))
    if name in facts.mimics:
        leader, multiplier, offset = facts.mimics[name]
        lower, upper = sorted(multiplier * bound + offset for bound in ranges[leader])
        values = {"joint": leader, "multiplier": repr(multiplier), "offset": repr(offset)}
        ElementTree.SubElement(out, "mimic", values)
    effort, velocity = joint.findtext("axis/limit/effort", "0"), joint.findtext("axis/limit/velocity", NO_SPEED_LIMIT)
    limit = {"lower": repr(float(lower)), "upper": repr(float(upper)), "effort": effort, "velocity": velocity}
    ElementTree.SubElement(out, "limit", limit)
    dynamics = joint.find("axis/dynamics")
    if dynamics is not None:
        if float(dynamics.findtext("spring_stiffness", "0")) != 0:
            raise ModelError(f"joint {name}: spring_stiffness is not 0; URDF does not support joint springs")
        ElementTree.SubElement(out, "dynamics", damping=dynamics.findtext("damping", "0"))


def _add_transmission(robot: ElementTree.Element, joint: ElementTree.Element) -> None:
    name = joint.get("name", "")
    out = ElementTree.SubElement(robot, "transmission", name=f"{name}_transmission")
    ElementTree.SubElement(out, "type").text = "transmission_interface/SimpleTransmission"
    ElementTree.SubElement(out, "joint", name=name)
    actuator = ElementTree.SubElement(out, "actuator", name=name)
    for tag in (f"{DRAKE}rotor_inertia", f"{DRAKE}gear_ratio"):
        value = joint.findtext(tag)
        if value is not None:
            ElementTree.SubElement(actuator, tag, value=value)


def _add_filter_group(robot: ElementTree.Element, group: ElementTree.Element) -> None:
    out = ElementTree.SubElement(robot, f"{DRAKE}collision_filter_group", name=group.get("name", ""))
    for member in group.findall(f"{DRAKE}member"):
        ElementTree.SubElement(out, f"{DRAKE}member", link=member.text or "")
    for ignored in group.findall(f"{DRAKE}ignored_collision_filter_group"):
        ElementTree.SubElement(out, f"{DRAKE}ignored_collision_filter_group", name=ignored.text or "")


def _axis(joint: ElementTree.Element, child: str, X_ML: Mapping[str, RigidTransform]) -> str:
    """Returns the axis of a joint, expressed in the frame of its child link."""
    text, xyz = _text(joint, "axis/xyz"), joint.find("axis/xyz")
    frame = "" if xyz is None else xyz.get("expressed_in", "")
    if frame in ("", child, joint.get("name")):
        return text
    if frame != "__model__" and frame not in X_ML:
        raise ModelError(
            f"joint {joint.get('name')}: <xyz expressed_in> is {frame!r}; URDF export supports links and __model__"
        )
    X_MF = RigidTransform() if frame == "__model__" else X_ML[frame]
    axis = X_ML[child].rotation().inverse() @ X_MF.rotation() @ np.array(text.split(), dtype=np.float64)
    return " ".join(repr(float(x) + 0.0) for x in axis)


def _pose(element: ElementTree.Element) -> RigidTransform:
    """Returns the pose of an element, which is the identity if the element has no `<pose>`."""
    pose = element.find("pose")
    if pose is None or not (pose.text or "").strip():
        return RigidTransform()
    name, is_euler = element.get("name"), pose.get("rotation_format", "euler_rpy") == "euler_rpy"
    if pose.get("relative_to"):
        raise ModelError(f"{name}: URDF does not support <pose relative_to>; remove relative_to")
    numbers = np.array((pose.text or "").split(), dtype=np.float64)
    if len(numbers) != (6 if is_euler else 7):
        raise ModelError(f"{name}: <pose> has {len(numbers)} numbers; allowed: {6 if is_euler else 7}")
    p, angles = numbers[:3], numbers[3:]
    if not is_euler:
        x, y, z, w = angles / np.linalg.norm(angles)
        return RigidTransform(Quaternion(w, x, y, z), p)
    return RigidTransform(RollPitchYaw(np.deg2rad(angles) if is_in_degrees(pose) else angles), p)


def _add_origin(element: ElementTree.Element, X: RigidTransform) -> None:
    xyz, rpy = _xyz_rpy(X)
    if xyz != "0.0 0.0 0.0" or rpy != "0.0 0.0 0.0":
        ElementTree.SubElement(element, "origin", xyz=xyz, rpy=rpy)


def _xyz_rpy(X: RigidTransform) -> tuple[str, str]:
    angles = RollPitchYaw(X.rotation()).vector()
    return tuple(" ".join(repr(float(x) + 0.0) for x in vector) for vector in (X.translation(), angles))  # type: ignore[return-value]


def _text(element: ElementTree.Element, path: str) -> str:
    text = element.findtext(path)
    if text is None or not text.strip():
        raise ModelError(f"the SDF's {element.tag} {element.get('name', '')} has no <{path}>")
    return text.strip()
