"""Converts the SDF of `plant_tree` to URDF."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree

import numpy as np
from pydrake.math import RigidTransform, RollPitchYaw

from dvrk_drake.errors import ModelError
from dvrk_drake.models.sdf_elements import DRAKE

#: Speed limit of joints for which the SDF has no speed limit [rad/s, m/s]. URDF requires a speed limit. It is the
#: largest one of an arm of this package, so that a URDF can be used as an arm.
NO_SPEED_LIMIT = "100"
#: Inertia of a link without `<inertial>`, which only the fixed base may be: a sphere of 1 kg with a radius of 0.1 m.
#: libsdformat removes a link without mass from a URDF, and all links that it carries.
_BASE_MASS, _BASE_MOMENT = "1", "0.004"


def to_urdf(root: ElementTree.Element) -> ElementTree.Element:
    """Returns the URDF element `<robot>` of the root element of an SDF from `PlantTree.to_sdf`.

    Dependent joints of the linkage become mimic joints, because URDF does not support closed loops. A capsule becomes a
    cylinder and two spheres, because URDF does not support capsules. Rotor inertias, gear ratios, named frames and
    collision filters are written in Drake's extensions of URDF. A link without `<inertial>` gets a mass.

    Raises:
        ModelError: URDF does not support a part of the model: a joint spring or the shape of a link.
    """
    (model,) = root.findall("model")
    robot = ElementTree.Element("robot", name=model.get("name", ""))
    X_ML = {link.get("name", ""): _pose(link) for link in model.findall("link")}
    for link in model.findall("link"):
        _add_link(robot, link)
    limits = {
        joint.get("name", ""): [float(joint.findtext(f"axis/limit/{side}", "inf")) for side in ("lower", "upper")]
        for joint in model.findall("joint")
    }
    for joint in model.findall("joint"):
        _add_joint(robot, joint, X_ML, limits)
    for joint in model.findall("joint"):
        if float(joint.findtext("axis/limit/effort", "0")) > 0:
            _add_transmission(robot, joint)
    for frame in model.findall("frame"):
        attributes = {"name": frame.get("name", ""), "link": frame.get("attached_to", "")}
        ElementTree.SubElement(robot, "frame", attributes | _xyz_rpy(_pose(frame)))
    for group in model.findall(f"{DRAKE}collision_filter_group"):
        out = ElementTree.SubElement(robot, group.tag, group.attrib)
        for entry in group:
            attribute = "link" if entry.tag == f"{DRAKE}member" else "name"
            ElementTree.SubElement(out, entry.tag, {attribute: entry.text or ""})
    return robot


def _add_link(robot: ElementTree.Element, link: ElementTree.Element) -> None:
    out = ElementTree.SubElement(robot, "link", name=link.get("name", ""))
    element, inertial = ElementTree.SubElement(out, "inertial"), link.find("inertial")
    mass, inertia = _BASE_MASS, dict.fromkeys(("ixx", "iyy", "izz"), _BASE_MOMENT)
    inertia |= dict.fromkeys(("ixy", "ixz", "iyz"), "0")
    if inertial is not None:
        _add_origin(element, _pose(inertial))
        mass = inertial.findtext("mass", "")
        inertia = {name: inertial.findtext(f"inertia/{name}", "") for name in inertia}
    ElementTree.SubElement(element, "mass", value=mass)
    ElementTree.SubElement(element, "inertia", inertia)
    for part in link:
        if part.tag in ("visual", "collision"):
            _add_shape(out, part)


def _add_shape(out: ElementTree.Element, part: ElementTree.Element) -> None:
    (shape,) = part.findall("geometry/*")
    name, tag, X_LG = part.get("name", ""), shape.tag, _pose(part)
    values = {value.tag: value.text or "" for value in shape}
    shapes = [(name, X_LG, tag, values)]
    if tag == "mesh":
        shapes = [(name, X_LG, tag, {"filename": values["uri"], "scale": values["scale"]})]
    elif tag == "capsule":
        shapes = [(name, X_LG, "cylinder", values)]
        for end, sign in (("end", 1), ("start", -1)):
            X_GS = RigidTransform(np.array([0.0, 0.0, sign * float(values["length"]) / 2]))
            shapes.append((f"{name}_{end}", X_LG @ X_GS, "sphere", {"radius": values["radius"]}))
    elif tag not in ("box", "sphere", "cylinder"):
        raise ModelError(f"link {out.get('name')}, {part.tag} {name}: URDF does not support the shape {tag}")
    for shape_name, X_LS, shape_tag, attributes in shapes:
        element = ElementTree.SubElement(out, part.tag, name=shape_name)
        _add_origin(element, X_LS)
        ElementTree.SubElement(ElementTree.SubElement(element, "geometry"), shape_tag, attributes)
        if (color := part.findtext("material/diffuse")) is not None:
            # Materials with the same name would have the same colour in the whole file.
            material = ElementTree.SubElement(element, "material", name=f"{out.get('name')}_{shape_name}")
            ElementTree.SubElement(material, "color", rgba=color)


def _add_joint(
    robot: ElementTree.Element,
    joint: ElementTree.Element,
    X_ML: dict[str, RigidTransform],
    limits: dict[str, list[float]],
) -> None:
    name, parent, child = joint.get("name", ""), joint.findtext("parent", ""), joint.findtext("child", "")
    if joint.find("axis/dynamics/spring_stiffness") is not None:
        raise ModelError(f"joint {name} has a spring; URDF does not support joint springs")
    out = ElementTree.SubElement(robot, "joint", name=name, type=joint.get("type", ""))
    ElementTree.SubElement(out, "parent", link=parent)
    ElementTree.SubElement(out, "child", link=child)
    _add_origin(out, X_ML[parent].inverse() @ X_ML[child])
    ElementTree.SubElement(out, "axis", xyz=joint.findtext("axis/xyz", ""))
    lower, upper = limits[name]
    mimic = joint.find(f"{DRAKE}mimic")
    if mimic is not None:
        ElementTree.SubElement(out, "mimic", mimic.attrib)
        multiplier, offset = float(mimic.get("multiplier", "1")), float(mimic.get("offset", "0"))
        lower, upper = sorted(multiplier * bound + offset for bound in limits[mimic.get("joint", "")])
    effort, velocity = joint.findtext("axis/limit/effort", "0"), joint.findtext("axis/limit/velocity", NO_SPEED_LIMIT)
    limit = {"lower": repr(lower), "upper": repr(upper), "effort": effort, "velocity": velocity}
    ElementTree.SubElement(out, "limit", limit)
    terms = {tag: joint.findtext(f"axis/dynamics/{tag}") for tag in ("damping", "friction")}
    if stated := {tag: value for tag, value in terms.items() if value is not None}:
        ElementTree.SubElement(out, "dynamics", stated)


def _add_transmission(robot: ElementTree.Element, joint: ElementTree.Element) -> None:
    name = joint.get("name", "")
    out = ElementTree.SubElement(robot, "transmission", name=f"{name}_transmission")
    ElementTree.SubElement(out, "type").text = "transmission_interface/SimpleTransmission"
    ElementTree.SubElement(out, "joint", name=name)
    actuator = ElementTree.SubElement(out, "actuator", name=name)
    for tag in (f"{DRAKE}rotor_inertia", f"{DRAKE}gear_ratio"):
        if (value := joint.findtext(tag)) is not None:
            ElementTree.SubElement(actuator, tag, value=value)


def _pose(element: ElementTree.Element) -> RigidTransform:
    numbers = np.array(element.findtext("pose", "0 0 0 0 0 0").split(), dtype=np.float64)
    return RigidTransform(RollPitchYaw(numbers[3:]), numbers[:3])


def _add_origin(element: ElementTree.Element, X: RigidTransform) -> None:
    if not X.IsExactlyIdentity():
        ElementTree.SubElement(element, "origin", _xyz_rpy(X))


def _xyz_rpy(X: RigidTransform) -> dict[str, str]:
    vectors = {"xyz": X.translation(), "rpy": RollPitchYaw(X.rotation()).vector()}
    return {name: " ".join(repr(float(x) + 0.0) for x in vector) for name, vector in vectors.items()}
