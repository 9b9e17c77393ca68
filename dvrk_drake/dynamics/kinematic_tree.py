"""Reads the tree of links of an arm from its plant into arrays, for compiled recursions over the links."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import Joint

from dvrk_drake.dynamics.inertial_parameters import moving_bodies
from dvrk_drake.errors import ArmError
from dvrk_drake.models.arm import Arm


@dataclass(frozen=True, eq=False)
class KinematicTree:
    """Moving links C of an arm with their parents P and inboard joints. Each parent precedes its children.

    With the joint coordinate x = G q + c, the same formulas represent revolute, prismatic and fixed joints:

        X_PC(x) = T0 + sin(x) T1 + (1 - cos(x)) T2 + x T3,    V_PC_C = H dx/dt.

    Attributes:
        links: Names of the l links.
        parents: Indices (l,) of the parents, -1 for the base.
        pose_terms: Matrices T0 to T3 (l, 4, 3, 4), each with a rotation part and a translation part [m].
        hinges: Hinge vectors H (l, 6). They contain the angular velocity of C and the velocity of its origin Co,
            relative to P, per unit of dx/dt, expressed in C.
        G: Matrix (l, n) that maps the independent joint positions q to the joint coordinates. The rows of fixed joints
            are zero.
        c: Offsets (l,) of the joint coordinates [rad, m].
        affects: Mask (l, n), True where an independent joint moves a link.
    """

    links: tuple[str, ...]
    parents: NDArray[np.int64]
    pose_terms: NDArray[np.float64]
    hinges: NDArray[np.float64]
    G: NDArray[np.float64]
    c: NDArray[np.float64]
    affects: NDArray[np.bool_]

    @classmethod
    def from_plant(cls, plant: MultibodyPlant, arm: Arm) -> KinematicTree:
        """Reads joint frames, axes and offsets from a finalized plant that contains only `arm`.

        Raises:
            ArmError: A joint is not revolute, prismatic or fixed.
        """
        inboard = {joint.child_body().name(): joint for joint in _joints(plant)}
        links = _parents_first([body.name() for body in moving_bodies(plant)], inboard)
        joints = [inboard[link] for link in links]
        parents = [joint.parent_body().name() for joint in joints]
        G, c = np.zeros((len(links), arm.num_joints)), np.zeros(len(links))
        for row, joint in enumerate(joints):
            if joint.name() in arm.tree_joint_names:
                index = arm.tree_joint_names.index(joint.name())
                G[row], c[row] = arm.linkage.matrix[index], arm.linkage.offset[index]
        parent_rows = [links.index(parent) if parent in links else -1 for parent in parents]
        affects = G != 0
        for row, parent in enumerate(parent_rows):
            affects[row] |= affects[parent] if parent >= 0 else False
        return cls(
            links=links,
            parents=np.array(parent_rows),
            pose_terms=np.array([_pose_terms(plant, joint) for joint in joints]),
            hinges=np.array([_hinge(joint) for joint in joints]),
            G=G,
            c=c,
            affects=affects,
        )


def _joints(plant: MultibodyPlant) -> list[Joint]:
    return [plant.get_joint(index) for index in plant.GetJointIndices()]


def _parents_first(links: list[str], inboard: dict[str, Joint]) -> tuple[str, ...]:
    """Returns the links in the given order, but with every parent before its children."""
    ordered: list[str] = []

    def add(link: str) -> None:
        parent = inboard[link].parent_body().name()
        if parent in links and parent not in ordered:
            add(parent)
        if link not in ordered:
            ordered.append(link)

    for link in links:
        add(link)
    return tuple(ordered)


def _axis(joint: Joint) -> NDArray[np.float64]:
    """Returns the unit axis (3,) of a joint in the joint frames F and M, or zero for a fixed joint."""
    match joint.type_name():
        case "revolute":
            return joint.revolute_axis()
        case "prismatic":
            return joint.translation_axis()
        case "weld":
            return np.zeros(3)
    raise ArmError(f"joint {joint.name()} is {joint.type_name()}; allowed: revolute, prismatic, fixed")


def _pose_terms(plant: MultibodyPlant, joint: Joint) -> NDArray[np.float64]:
    """Returns T0 to T3 (4, 3, 4) of X_PC = X_PF X_FM(x) X_MC. The world frame replaces P if the parent is anchored."""
    X_FM = joint.X_FM() if joint.type_name() == "weld" else RigidTransform()
    X_PF, X_MC = _pose_in_parent(plant, joint), joint.frame_on_child().GetFixedPoseInBodyFrame().inverse()
    x, y, z = _axis(joint)
    K = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    terms = np.zeros((4, 4, 4))
    terms[0] = X_FM.GetAsMatrix4()
    if joint.type_name() == "revolute":  # Rodrigues' formula R = 1 + sin(x) K + (1 - cos(x)) K^2
        terms[1, :3, :3], terms[2, :3, :3] = K, K @ K
    if joint.type_name() == "prismatic":
        terms[3, :3, 3] = x, y, z
    return np.array([(X_PF.GetAsMatrix4() @ term @ X_MC.GetAsMatrix4())[:3] for term in terms])


def _pose_in_parent(plant: MultibodyPlant, joint: Joint) -> RigidTransform:
    if plant.IsAnchored(joint.parent_body()):
        return joint.frame_on_parent().CalcPoseInWorld(plant.CreateDefaultContext())
    return joint.frame_on_parent().GetFixedPoseInBodyFrame()


def _hinge(joint: Joint) -> NDArray[np.float64]:
    """Returns H (6,), the spatial velocity V_PC_C of frame C per unit of dx/dt."""
    X_CM = joint.frame_on_child().GetFixedPoseInBodyFrame()
    axis_C = X_CM.rotation() @ _axis(joint)
    if joint.type_name() == "prismatic":
        return np.concatenate([np.zeros(3), axis_C])
    return np.concatenate([axis_C, np.cross(X_CM.translation(), axis_C)])
