"""Closes the kinematic loops of a plant: the parallelogram of an MTM and the remote centre linkage of a PSM."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from typing import Literal

import numpy as np
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import ModelInstanceIndex

from dvrk_drake.errors import ArmError
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.arm_schema import LoopClosure
from dvrk_drake.models.sdf_elements import DRAKE

#: Methods of closing the loops of a linkage: "mimic" couples joints of the tree, "ball" adds constraints at the points
#: where the loops are cut in the tree.
Closure = Literal["mimic", "ball"]


def pin_loop(plant: MultibodyPlant, instance: ModelInstanceIndex, loop: LoopClosure) -> None:
    """Closes a loop with a ball constraint (pin) and a distance constraint.

    The pin joins the origins of frame_a and frame_b. The link of frame_a is a bar. The distance constraint keeps the
    distance between the parent joint of this bar and frame_b equal to the length of the bar.

    Drake's solver SAP gives each constraint the compliance (5e-10 s^2) / M at a time step of 1 ms, where M [kg] is
    the effective mass of the unconstrained tree at the pin. The three equations of the pin share one effective mass. A
    light bar that rotates freely makes the pin compliant in all directions, including the direction of the bar, in
    which the linkage is loaded. The distance constraint has the effective mass of the linkage and is stiff. With this
    constraint, the weight of the PSM moves its remote centre by 1e-8 m instead of 2e-6 m.
    """
    A, B = (plant.GetFrameByName(name, instance) for name in (loop.frame_a, loop.frame_b))
    p_AP, p_BQ = (frame.GetFixedPoseInBodyFrame().translation() for frame in (A, B))
    plant.AddBallConstraint(A.body(), p_AP, B.body(), p_BQ)
    joints = [plant.get_joint(i) for i in plant.GetJointIndices(instance)]
    hinge = next((joint for joint in joints if joint.child_body() is A.body()), None)
    if hinge is None:
        raise ArmError(f"{A.body().name()}, the link of frame {loop.frame_a} in loop_closures, has no parent joint")
    p_CH = hinge.frame_on_parent().GetFixedPoseInBodyFrame().translation()
    p_AH = hinge.frame_on_child().GetFixedPoseInBodyFrame().translation()
    plant.AddDistanceConstraint(hinge.parent_body(), p_CH, B.body(), p_BQ, float(np.linalg.norm(p_AP - p_AH)))


def remove_loop_mimics(root: ElementTree.Element, arm: Arm) -> None:
    """Removes the mimic tags of the joints in a loop.

    The mimic tag of a rotor or counterweight is kept, because it represents a cable and closes no loop.
    """
    loop_joints = _loop_joints(root, arm)
    for joint in root.iter("joint"):
        for mimic in joint.findall(f"{DRAKE}mimic"):
            if joint.get("name") in loop_joints:
                joint.remove(mimic)


def _loop_joints(root: ElementTree.Element, arm: Arm) -> set[str]:
    """Returns the names of the dependent joints between the base and the two frames of each loop."""
    parent_joint = {joint.findtext("child"): joint for joint in root.iter("joint")}
    frame_link = {frame.get("name"): frame.get("attached_to") for frame in root.iter("frame")}
    names = set()
    for loop in arm.loop_closures:
        for frame in (loop.frame_a, loop.frame_b):
            if frame not in frame_link:
                raise ArmError(f"{', '.join(arm.sdf)}: <frame> {frame} of loop_closures is missing")
            link = frame_link[frame]
            while link in parent_joint:
                names.add(parent_joint[link].get("name", ""))
                link = parent_joint[link].findtext("parent")
    return names - set(arm.joint_names)
