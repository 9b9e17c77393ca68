"""Poses of the joint axes and frames of an arm, for drawing."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.tree import Joint

from dvrk_drake.models.arm import Arm
from dvrk_drake.models.plant import main_frames, set_arm_positions, shared_plant


class ArmJoints:
    """Poses of joints and frames in the base frame, at the last pose that was set.

    Attributes:
        frame_names: SDF frames to draw, see `main_frames`.
    """

    def __init__(self, arm: Arm) -> None:
        """Starts with all joints at zero."""
        self._arm, self._plant = arm, shared_plant(arm)
        self._context = self._plant.CreateDefaultContext()
        self._joints = [self._plant.GetJointByName(name) for name in arm.joint_names]
        self.frame_names = main_frames(arm)

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
