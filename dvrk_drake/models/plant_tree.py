"""Writes a finalized plant as SDF in a simple form, which can be converted to other formats.

All poses are x, y, z, roll, pitch and yaw [m, rad]. Links have a pose in the model, and all other parts in their link.
The frame of a joint is that of its child link.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from pydrake.geometry import GeometryId, Role, SceneGraph
from pydrake.math import RigidTransform
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import (
    BodyIndex,
    ForceElementIndex,
    Joint,
    PrismaticJoint,
    PrismaticSpring,
    RevoluteJoint,
    RevoluteSpring,
    RigidBody,
    SpatialInertia,
    WeldJoint,
)

from dvrk_drake.errors import ArmError
from dvrk_drake.models.sdf_elements import (
    BASE_LINK,
    DRAKE,
    add_element,
    add_pose,
    inertial_element,
    numbers_text,
    shape_element,
)

#: Leading joint, multiplier and offset [rad, m] of a dependent joint.
Mimic = tuple[str, float, float]


@dataclass(frozen=True, eq=False)
class Link:
    """A body with all bodies that are welded to it.

    Attributes:
        name: Name of the link.
        members: Body -> its pose X_LB in the frame of the link.
    """

    name: str
    members: dict[BodyIndex, RigidTransform]


@dataclass(frozen=True, eq=False)
class MovingLink(Link):
    """Link with the joint that moves it."""

    joint: RevoluteJoint | PrismaticJoint


@dataclass(eq=False)
class PlantTree:
    """Tree of the links of a finalized plant with one robot.

    The links are `base_link`, which is the world and all that is welded to it, and one link per moving joint. Bodies
    that are welded to a link become a part of it, and their frames become frames of the link. The origin of a link is
    on the axis of its joint.

    Attributes:
        plant: Finalized plant.
        scene_graph: Shapes of the plant, None without shapes.
    """

    plant: MultibodyPlant
    scene_graph: SceneGraph | None

    @property
    def joints(self) -> list[Joint]:
        """All joints."""
        return [self.plant.get_joint(index) for index in self.plant.GetJointIndices()]

    @cached_property
    def links(self) -> tuple[Link, ...]:
        """Base, and all other links in their order in the plant.

        Raises:
            ArmError: A joint is not revolute, prismatic or fixed.
        """
        children: dict[BodyIndex, list[Joint]] = {}
        for joint in self.joints:
            children.setdefault(joint.parent_body().index(), []).append(joint)
        names = {BASE_LINK, "world"}
        base = Link(BASE_LINK, {self.plant.world_body().index(): RigidTransform()})
        moving: list[MovingLink] = []
        open_links = [base]
        while open_links:
            link = open_links.pop(0)
            todo = list(link.members)
            while todo:
                body = todo.pop()
                for joint in children.get(body, ()):
                    X_LP = link.members[body] @ joint.frame_on_parent().GetFixedPoseInBodyFrame()
                    X_MB = joint.frame_on_child().GetFixedPoseInBodyFrame().inverse()
                    child = joint.child_body().index()
                    if isinstance(joint, WeldJoint):
                        link.members[child] = X_LP @ joint.X_FM() @ X_MB
                        todo.append(child)
                    elif isinstance(joint, RevoluteJoint | PrismaticJoint):
                        moving.append(MovingLink(self._name(joint.child_body(), names), {child: X_MB}, joint))
                        open_links.append(moving[-1])
                    else:
                        raise ArmError(
                            f"joint {joint.name()} is of type {joint.type_name()}; allowed: revolute, continuous, "
                            "prismatic and fixed joints"
                        )
        return base, *sorted(moving, key=lambda link: min(link.members))

    @property
    def moving(self) -> list[MovingLink]:
        """Links without the base."""
        return [link for link in self.links if isinstance(link, MovingLink)]

    def _name(self, body: RigidBody, names: set[str]) -> str:
        """Returns the name of a body, with the name of its model if another body has the same name."""
        name = body.name()
        if name in names:
            name = f"{self.plant.GetModelInstanceName(body.model_instance())}_{name}"
        names.add(name)
        return name

    def inertias(self, of_bodies: Mapping[str, SpatialInertia]) -> list[SpatialInertia]:
        """Returns the inertia of each moving link about its origin.

        Args:
            of_bodies: Name of a body -> its spatial inertia about its origin, which replaces that of the plant.
        """
        found = []
        for link in self.moving:
            M_LLo_L = SpatialInertia.Zero()
            for index, X_LB in link.members.items():
                body = self.plant.get_body(index)
                M_BBo_B = of_bodies.get(body.name(), body.default_spatial_inertia())
                if M_BBo_B.get_mass() > 0:
                    M_LLo_L += M_BBo_B.ReExpress(X_LB.rotation()).Shift(-X_LB.translation())
            found.append(M_LLo_L)
        return found

    def to_sdf(
        self, inertias: Sequence[SpatialInertia], mimics: Mapping[str, Mimic], efforts: Mapping[str, float]
    ) -> ElementTree.Element:
        """Returns the root element of the SDF.

        Args:
            inertias: Inertias of the moving links about their origins.
            mimics: Dependent joints, which a plant does not state.
            efforts: Joint -> effort limit [N m, N]. Joints without an entry have an unknown limit.
        """
        root = ElementTree.Element("sdf", version="1.9")
        instance = self.plant.get_body(next(iter(self.moving[0].members))).model_instance()
        model = ElementTree.SubElement(root, "model", name=self.plant.GetModelInstanceName(instance))
        context = self.plant.CreateDefaultContext()
        self.plant.SetPositions(context, np.zeros(self.plant.num_positions()))
        for link, inertia in zip(self.links, [None, *inertias], strict=True):
            body, X_LB = next(iter(link.members.items()))
            X_ML = self.plant.get_body(body).EvalPoseInWorld(context) @ X_LB.inverse()
            element = ElementTree.SubElement(model, "link", name=link.name)
            add_pose(element, X_ML)
            if inertia is not None:
                element.append(inertial_element(inertia))
            self._add_shapes(element, link)
        parents = {body: link.name for link in self.links for body in link.members}
        for link in sorted(self.moving, key=lambda link: link.joint.index()):
            parent, name = parents[link.joint.parent_body().index()], link.joint.name()
            self._add_joint(model, link, parent, efforts.get(name), mimics.get(name))
        self._add_frames(model)
        self._add_filters(model)
        return root

    def _add_joint(
        self, model: ElementTree.Element, link: MovingLink, parent: str, effort: float | None, mimic: Mimic | None
    ) -> None:
        joint = link.joint
        slides = isinstance(joint, PrismaticJoint)
        element = ElementTree.SubElement(model, "joint", name=joint.name(), type="prismatic" if slides else "revolute")
        add_element(element, "parent", parent)
        add_element(element, "child", link.name)
        axis = ElementTree.SubElement(element, "axis")
        add_element(axis, "xyz", numbers_text(joint.translation_axis() if slides else joint.revolute_axis()))
        limit = ElementTree.SubElement(axis, "limit")
        speed = float(joint.velocity_upper_limits()[0])
        limits = {
            "lower": float(joint.position_lower_limits()[0]),
            "upper": float(joint.position_upper_limits()[0]),
            "effort": effort,
            "velocity": speed if speed > 0 else None,
        }
        for tag, value in limits.items():
            if value is not None and math.isfinite(value):
                add_element(limit, tag, repr(value))
        dynamics = {"damping": float(joint.default_damping_vector()[0]), **self._spring(joint)}
        if any(dynamics.values()):
            dynamics_element = ElementTree.SubElement(axis, "dynamics")
            for tag, value in dynamics.items():
                add_element(dynamics_element, tag, repr(value))
        if mimic is not None:
            leader, multiplier, offset = mimic
            values = {"joint": leader, "multiplier": repr(multiplier), "offset": repr(offset)}
            ElementTree.SubElement(element, f"{DRAKE}mimic", values)
        for index in self.plant.GetJointActuatorIndices():
            actuator = self.plant.get_joint_actuator(index)
            if actuator.joint() is joint and actuator.default_rotor_inertia() > 0:
                add_element(element, f"{DRAKE}rotor_inertia", repr(actuator.default_rotor_inertia()))
                add_element(element, f"{DRAKE}gear_ratio", repr(actuator.default_gear_ratio()))

    def _spring(self, joint: Joint) -> dict[str, float]:
        """Returns the elements of the spring of a joint."""
        for i in range(self.plant.num_force_elements()):
            match self.plant.get_force_element(ForceElementIndex(i)):
                case RevoluteSpring() as spring if spring.joint() is joint:
                    stiffness, reference = spring.default_stiffness(), spring.default_nominal_angle()
                case PrismaticSpring() as spring if spring.joint() is joint:
                    stiffness, reference = spring.stiffness(), spring.nominal_position()
                case _:
                    continue
            return {"spring_stiffness": stiffness, "spring_reference": reference}
        return {}

    def _add_frames(self, model: ElementTree.Element) -> None:
        """Adds the frames of the bodies that are a part of a link, and the other frames of the plant."""
        names = {"world", *(link.name for link in self.links)}
        of_joints = {f.index() for joint in self.joints for f in (joint.frame_on_parent(), joint.frame_on_child())}
        for link in self.links:
            for body, X_LB in link.members.items():
                own = self.plant.get_body(body)
                others = map(self.plant.get_frame, self.plant.GetFrameIndices(own.model_instance()))
                frames = [own.body_frame(), *(f for f in others if f.body() is own and not f.is_body_frame())]
                for frame in frames:
                    name = frame.name()
                    is_own = frame.is_body_frame() or frame.index() not in of_joints
                    if name and is_own and name not in names and not name.startswith("__"):
                        names.add(name)
                        element = ElementTree.SubElement(model, "frame", name=name, attached_to=link.name)
                        add_pose(element, X_LB @ frame.GetFixedPoseInBodyFrame())

    def _geometries(self, link: Link, role: Role) -> Iterator[tuple[RigidTransform, GeometryId]]:
        """Yields the shapes of a link with the poses X_LB of their bodies."""
        if self.scene_graph is not None:
            for body, X_LB in link.members.items():
                frame = self.plant.GetBodyFrameIdOrThrow(body)
                for geometry in self.scene_graph.model_inspector().GetGeometries(frame, role):
                    yield X_LB, geometry

    def _add_shapes(self, element: ElementTree.Element, link: Link) -> None:
        names: set[str] = set()
        for tag, role in (("visual", Role.kIllustration), ("collision", Role.kProximity)):
            for X_LB, geometry in self._geometries(link, role):
                assert self.scene_graph is not None
                inspector = self.scene_graph.model_inspector()
                shape = shape_element(inspector.GetShape(geometry))
                if shape is None:
                    continue
                name = inspector.GetName(geometry).rpartition("::")[2]
                name = name if name not in names else f"{name}_{len(names)}"
                names.add(name)
                part = ElementTree.SubElement(element, tag, name=name)
                add_pose(part, X_LB @ inspector.GetPoseInFrame(geometry))
                ElementTree.SubElement(part, "geometry").append(shape)
                properties = inspector.GetIllustrationProperties(geometry) if tag == "visual" else None
                if properties is not None and properties.HasProperty("phong", "diffuse"):
                    color = properties.GetProperty("phong", "diffuse")
                    material = ElementTree.SubElement(part, "material")
                    add_element(material, "diffuse", numbers_text([color.r(), color.g(), color.b(), color.a()]))

    def _add_filters(self, model: ElementTree.Element) -> None:
        """Adds groups of links without contact. The links of a group have contact with the same other links."""
        if self.scene_graph is None:
            return
        link_of = {shape: link.name for link in self.links for _, shape in self._geometries(link, Role.kProximity)}
        candidates = self.scene_graph.model_inspector().GetCollisionCandidates()
        touching = {frozenset(link_of[geometry] for geometry in pair) for pair in candidates}
        names = list(dict.fromkeys(link_of.values()))
        groups: dict[tuple[str, ...], list[str]] = {}
        for name in names:
            without_contact = (other for other in names if other == name or {name, other} not in touching)
            groups.setdefault(tuple(without_contact), []).append(name)
        for others, members in groups.items():
            group = ElementTree.SubElement(model, f"{DRAKE}collision_filter_group", name=f"{members[0]}_filter")
            for member in members:
                add_element(group, f"{DRAKE}member", member)
            for other in groups.values():
                if other[0] in others:
                    add_element(group, f"{DRAKE}ignored_collision_filter_group", f"{other[0]}_filter")
