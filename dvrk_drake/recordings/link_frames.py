"""Computes the transforms between the links of an arm, and a URDF with the same frame names, for ROS tools."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from typing import NamedTuple

from numpy.typing import ArrayLike
from pydrake.math import RigidTransform
from pydrake.multibody.tree import Frame, WeldJoint

from dvrk_drake.errors import ModelError
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.plant import dh_frames, set_arm_positions, shared_plant
from dvrk_drake.models.sdf_model import compose_sdf
from dvrk_drake.models.urdf import to_urdf

#: Frame to which the base of the arm is welded.
WORLD = "world"
#: Elements of a URDF for programs that draw the arm.
_DRAWN = ("link", "joint")
#: Colour of the links (red, green, blue, alpha), which is visible on a white and on a black background.
_COLOR = "0.36 0.45 0.56 1"


class FrameTransform(NamedTuple):
    """Pose X_PC of a child frame in its parent frame. The frames have the names `<ARM>/<link>`, or `WORLD`."""

    parent: str
    child: str
    X_PC: RigidTransform


class LinkFrames:
    """Frames of the links of an arm, including the links of its closed linkage.

    Attributes:
        static: Constant transforms: of the base, of welded links, and of the frames dh_0, dh_1, ... in their links.
    """

    def __init__(self, arm: Arm) -> None:
        """Creates the frames of `arm`. Its locked joints have their stated positions."""
        self._arm = arm
        self._plant = plant = shared_plant(arm)
        self._context = plant.CreateDefaultContext()
        pending = [plant.get_joint(index) for index in plant.GetJointIndices()]
        placed, self._joints, self.static = {WORLD}, [], []
        while pending:
            joint = next(joint for joint in pending if joint.parent_body().name() in placed)
            pending.remove(joint)
            placed.add(joint.child_body().name())
            if isinstance(joint, WeldJoint):
                self.static.append(self._transform(joint.parent_body().body_frame(), joint.child_body().body_frame()))
            else:
                self._joints.append(joint)
        self.static += [self._transform(frame.body().body_frame(), frame) for frame in dh_frames(plant).values()]

    def moving(self, q: ArrayLike) -> list[FrameTransform]:
        """Returns the transforms of all moving links at the pose q (n,) of the independent joints [rad, m].

        Each parent is `base_link`, a welded link, or the child of an earlier transform.
        """
        set_arm_positions(self._plant, self._context, self._arm, q)
        return [
            self._transform(joint.parent_body().body_frame(), joint.child_body().body_frame()) for joint in self._joints
        ]

    def _transform(self, parent: Frame, child: Frame) -> FrameTransform:
        X_PC = self._plant.CalcRelativeTransform(self._context, parent, child)
        return FrameTransform(frame_id(self._arm, parent.name()), frame_id(self._arm, child.name()), X_PC)


def frame_id(arm: Arm, name: str) -> str:
    """Returns the name of a frame in messages: `<ARM>/<name>`, or `WORLD`."""
    return name if name == WORLD else f"{arm.name}/{name}"


def drawable_urdf(arm: Arm) -> str:
    """Returns a URDF that draws the links of an arm in the frames of `LinkFrames`.

    A viewer cannot open the meshes of this package, so each link is drawn with its collision shapes. A link without
    collision shapes is drawn with its visual shapes other than meshes. The names of the links are frame names.

    Returns:
        URDF, or "" if URDF does not support a part of the model.
    """
    root = compose_sdf(arm.sdf)
    for link in root.iter("link"):
        shapes = {kind: link.findall(kind) for kind in ("visual", "collision")}
        drawn = [shape for shape in shapes["collision"] or shapes["visual"] if shape.find("geometry/mesh") is None]
        for shape in [*shapes["visual"], *shapes["collision"]]:
            link.remove(shape)
        for shape in drawn:
            shape.tag = "visual"
            link.append(shape)
    try:
        robot = to_urdf(root)
    except ModelError:
        return ""
    robot.set("name", arm.name)
    for element in list(robot):
        if element.tag not in _DRAWN:
            robot.remove(element)
    for visual in robot.iter("visual"):
        ElementTree.SubElement(ElementTree.SubElement(visual, "material", name="link"), "color", rgba=_COLOR)
    for element, attribute in (
        *((link, "name") for link in robot.iter("link")),
        *((end, "link") for joint in robot.iter("joint") for end in joint if end.tag in ("parent", "child")),
    ):
        element.set(attribute, frame_id(arm, element.get(attribute, "")))
    return ElementTree.tostring(robot, encoding="unicode")
