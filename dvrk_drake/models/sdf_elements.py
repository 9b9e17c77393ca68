"""Reads XML files of models, and writes elements of SDF from objects of Drake."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from pydrake.geometry import Box, Capsule, Convex, Cylinder, Ellipsoid, Mesh, Shape, Sphere
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.tree import SpatialInertia

from dvrk_drake.errors import ArmError
from dvrk_drake.models.files import MAX_TEXT, read_input

#: Name of the link that no joint of an arm moves.
BASE_LINK = "base_link"
#: Prefix of the names of Drake's extensions of SDF and URDF.
DRAKE = "{http://drake.mit.edu}"
#: Maximum nesting of elements; the models of the dVRK's arms have 7 levels.
_MAX_DEPTH = 50


def read_xml(path: Path) -> ElementTree.Element:
    """Returns the root element of an XML file.

    Raises:
        ArmError: The file cannot be read, is not XML, or has more than `_MAX_DEPTH` levels of elements.
    """
    parser: Any = ElementTree.XMLPullParser(("start", "end"))
    depth = 0
    root: ElementTree.Element | None = None
    try:
        parser.feed(read_input(path, ArmError, MAX_TEXT))
        for event, element in parser.read_events():
            root = element if root is None else root
            depth += 1 if event == "start" else -1
            if depth > _MAX_DEPTH:
                raise ValueError(f"elements are nested deeper than {_MAX_DEPTH} levels")
        parser.close()
        if root is None:
            raise ValueError("the file has no element")
    except (ElementTree.ParseError, ValueError, LookupError) as error:
        raise ArmError(f"{path}: invalid XML: {error}") from error
    return root


def inertial_element(M_LLo_L: SpatialInertia) -> ElementTree.Element:
    """Returns the element `<inertial>` in full precision, with the rotational inertia about the centre of mass."""
    p_LoLcm_L = M_LLo_L.get_com()
    I_LLcm_L = M_LLo_L.Shift(p_LoLcm_L).CalcRotationalInertia()
    element = ElementTree.Element("inertial")
    add_element(element, "pose", f"{numbers_text(p_LoLcm_L)} 0 0 0")
    add_element(element, "mass", repr(float(M_LLo_L.get_mass())))
    inertia_element = ElementTree.SubElement(element, "inertia")
    values = numbers_text([*I_LLcm_L.get_moments(), *I_LLcm_L.get_products()]).split()
    for name, value in zip(("ixx", "iyy", "izz", "ixy", "ixz", "iyz"), values, strict=True):
        add_element(inertia_element, name, value)
    return element


def shape_element(shape: Shape) -> ElementTree.Element | None:
    """Returns the SDF element of a shape, None if SDF has no such shape."""
    match shape:
        case Box():
            values = {"size": shape.size()}
        case Sphere():
            values = {"radius": [shape.radius()]}
        case Cylinder() | Capsule():
            values = {"radius": [shape.radius()], "length": [shape.length()]}
        case Ellipsoid():
            values = {"radii": [shape.a(), shape.b(), shape.c()]}
        case Mesh() | Convex() if shape.source().is_path():
            element = ElementTree.Element("mesh")
            add_element(element, "uri", f"file://{shape.source().path()}")
            add_element(element, "scale", numbers_text(shape.scale3()))
            if isinstance(shape, Convex):
                ElementTree.SubElement(element, f"{DRAKE}declare_convex")
            return element
        case _:
            return None
    element = ElementTree.Element(type(shape).__name__.lower())
    for tag, numbers in values.items():
        add_element(element, tag, numbers_text(numbers))
    return element


def add_pose(element: ElementTree.Element, X: RigidTransform) -> None:
    """Adds the element `<pose>`, unless it is the identity."""
    if not X.IsExactlyIdentity():
        rpy = RollPitchYaw(X.rotation()).vector()
        add_element(element, "pose", " ".join(repr(float(x) + 0.0) for x in (*X.translation(), *rpy)))


def add_element(parent: ElementTree.Element, tag: str, text: str) -> ElementTree.Element:
    """Adds an element with a text."""
    element = ElementTree.SubElement(parent, tag)
    element.text = text
    return element


def numbers_text(values: ArrayLike) -> str:
    """Formats numbers in full precision. Numbers below 1e-15 times the largest number become 0."""
    array = np.asarray(values, dtype=float).ravel()
    threshold = 1e-15 * np.abs(array).max()
    return " ".join(repr(float(x)) if abs(x) > threshold else "0" for x in array)
