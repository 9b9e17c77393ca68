"""Poses of the joint axes and frames of an arm, for drawing."""

from __future__ import annotations

import re

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.tree import Joint

from dvrk_drake.models.arm import Arm
from dvrk_drake.models.plant import set_arm_positions, shared_plant


class ArmJoints:
    """Poses of joints and frames in the base frame, at the last pose that was set.

    Attributes:
        frame_names: SDF frames to draw. These are the frames dh_0, dh_1, ... of the dVRK's DH convention. For an SDF
            without such frames, they are the base link and the links that the independent joints move.
    """

    def __init__(self, arm: Arm) -> None:
        """Starts with all joints at zero."""
        self._arm, self._plant = arm, shared_plant(arm)
        self._context = self._plant.CreateDefaultContext()
        self._joints = [self._plant.GetJointByName(name) for name in arm.joint_names]
        instance = self._joints[0].model_instance()
        names = [self._plant.get_frame(index).name() for index in self._plant.GetFrameIndices(instance)]
        dh = sorted((name for name in names if re.fullmatch(r"dh_\d+", name)), key=lambda name: int(name[3:]))
        self.frame_names = dh or ["base_link", *(joint.child_body().name() for joint in self._joints)]

    def set_positions(self, q: ArrayLike) -> None:
        """Sets the pose q (n,) [rad, m]."""
        set_arm_positions(self._plant, self._context, self._arm, q)

    def axis_frames(self) -> list[RigidTransform]:
        """Returns one pose per joint: origin of the joint, z along its axis, and x fixed to the parent link."""
        return [
            joint.frame_on_parent().CalcPoseInWorld(self._context)
            @ RigidTransform(RotationMatrix.MakeFromOneVector(_axis(joint), 2))
            for joint in self._joints
        ]

    def frame_pose(self, name: str) -> RigidTransform:
        """Returns the pose of an SDF frame."""
        return self._plant.GetFrameByName(name).CalcPoseInWorld(self._context)


def _axis(joint: Joint) -> NDArray[np.float64]:
    axis = joint.translation_axis() if joint.type_name() == "prismatic" else joint.revolute_axis()
    return np.asarray(axis, float)
