"""Reads the tree of links of an arm from its plant into arrays, for compiled recursions over the links."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import Joint

from dvrk_drake.dynamics.inertial_parameters import moving_bodies
from dvrk_drake.dynamics.regressor_kernel import TreeArrays
from dvrk_drake.errors import ArmError
from dvrk_drake.models.arm import Arm


@dataclass(frozen=True, eq=False)
class KinematicTree:
    """Moving links C of an arm with their parents P and inboard joints. Each parent precedes its children.

    A joint moves its frame Z, which is fixed in C, along or about the z-axis of Z. With the joint coordinate
    x = G q + c, the pose of a link is X_PC = X_PZ0 X_Z0Z(x) X_CZ^-1. Fixed joints are prismatic joints with x = 0.

    Attributes:
        links: Names of the l links.
        parents: Indices (l,) of the parents, -1 for the base.
        mounts: Poses X_PZ0 (l, 4, 4) of the joint frames at x = 0 in the parents [m]. For the base, P is its frame.
        joint_poses: Poses X_CZ (l, 4, 4) of the joint frames in the links.
        prismatic: Mask (l,) of prismatic and fixed joints.
        G: Matrix (l, n) that maps the independent joint positions q to the joint coordinates. The rows of fixed joints
            are zero.
        c: Offsets (l,) of the joint coordinates [rad, m].
    """

    links: tuple[str, ...]
    parents: NDArray[np.int64]
    mounts: NDArray[np.float64]
    joint_poses: NDArray[np.float64]
    prismatic: NDArray[np.bool_]
    G: NDArray[np.float64]
    c: NDArray[np.float64]

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
        frames = [_joint_frames(plant, joint) for joint in joints]
        return cls(
            links=links,
            parents=np.array([links.index(parent) if parent in links else -1 for parent in parents]),
            mounts=np.array([X_PZ0.GetAsMatrix4() for X_PZ0, _ in frames]),
            joint_poses=np.array([X_CZ.GetAsMatrix4() for _, X_CZ in frames]),
            prismatic=np.array([joint.type_name() != "revolute" for joint in joints]),
            G=G,
            c=c,
        )

    def in_frames(self, poses: Sequence[RigidTransform]) -> KinematicTree:
        """Returns the tree with other link frames F. `poses` contains the pose X_LF of F in each link frame L."""
        X_FL = np.array([pose.inverse().GetAsMatrix4() for pose in poses])
        carriers = np.array([X_FL[parent] if parent >= 0 else np.eye(4) for parent in self.parents])
        return replace(self, mounts=carriers @ self.mounts, joint_poses=X_FL @ self.joint_poses)

    def without(self, links: Collection[str]) -> KinematicTree:
        """Returns the tree without some links, which must not carry other links."""
        kept = [i for i, link in enumerate(self.links) if link not in links]
        arrays = {name: getattr(self, name)[kept] for name in ("mounts", "joint_poses", "prismatic", "G", "c")}
        parents = np.array([kept.index(parent) if parent >= 0 else -1 for parent in self.parents[kept]])
        return KinematicTree(tuple(self.links[i] for i in kept), parents, **arrays)

    @cached_property
    def inherited_rates(self) -> NDArray[np.float64]:
        """Matrix (l, n) that maps dq/dt to the rotation of each parent about the axis of the link's joint [1].

        It contains the joints of all successive parents with parallel axes. It is 0 if the axes are not parallel, or if
        a joint is not revolute. The link rotates about the axis with `inherited_rates + G`.
        """
        rates = np.zeros_like(self.G)
        for i, parent in enumerate(self.parents):
            are_revolute = parent >= 0 and not self.prismatic[i] and not self.prismatic[parent]
            if are_revolute and np.allclose(self.mounts[i, :3, 2], self.joint_poses[parent, :3, 2], rtol=0, atol=1e-9):
                rates[i] = rates[parent] + self.G[parent]
        return rates

    @cached_property
    def arrays(self) -> TreeArrays:
        """Arrays for compiled functions."""
        affects = self.G != 0
        for row, parent in enumerate(self.parents):
            affects[row] |= affects[parent] if parent >= 0 else False
        # X_Z0Z is 1 + sin(x) K + (1 - cos(x)) K^2 for a rotation (Rodrigues), where K is the cross product matrix of z.
        terms, H = np.zeros((len(self.links), 4, 4, 4)), np.zeros((len(self.links), 6))
        terms[:, 0] = np.eye(4)
        revolute = ~self.prismatic
        terms[revolute, 1, :2, :2], terms[revolute, 2, :2, :2] = [[0, -1], [1, 0]], -np.eye(2)
        terms[self.prismatic, 3, 2, 3] = 1.0
        X_ZC = np.linalg.inv(self.joint_poses)
        axes, points = self.joint_poses[:, :3, 2], self.joint_poses[:, :3, 3]
        H[revolute, :3], H[revolute, 3:] = axes[revolute], np.cross(points, axes)[revolute]
        H[self.prismatic, 3:] = axes[self.prismatic]
        pose_terms = self.mounts[:, None] @ terms @ X_ZC[:, None]
        return TreeArrays(self.parents, np.ascontiguousarray(pose_terms[:, :, :3]), H, self.G, self.c, affects)


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


def _joint_frames(plant: MultibodyPlant, joint: Joint) -> tuple[RigidTransform, RigidTransform]:
    """Returns X_PZ0 and X_CZ of a joint. The world frame replaces P if the parent is anchored."""
    match joint.type_name():
        case "revolute":
            axis = joint.revolute_axis()
        case "prismatic":
            axis = joint.translation_axis()
        case "weld":
            axis = [0.0, 0.0, 1.0]
        case kind:
            raise ArmError(f"joint {joint.name()} is {kind}; allowed: revolute, prismatic, fixed")
    X_PF = joint.frame_on_parent().GetFixedPoseInBodyFrame()
    if plant.IsAnchored(joint.parent_body()):
        X_PF = joint.frame_on_parent().CalcPoseInWorld(plant.CreateDefaultContext())
    X_FM0 = joint.X_FM() if joint.type_name() == "weld" else RigidTransform()
    X_MZ = RigidTransform(RotationMatrix.MakeFromOneVector(axis, 2))
    return X_PF @ X_FM0 @ X_MZ, joint.frame_on_child().GetFixedPoseInBodyFrame() @ X_MZ
