"""Converts an arm to a Pinocchio model, with the joints and inertias of the Drake plant."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import pinocchio
from numpy.typing import NDArray
from pydrake.multibody.plant import MultibodyPlant

from dvrk_drake.models.arm import Arm

JOINT_MODELS = {
    "revolute": lambda joint: pinocchio.JointModelRevoluteUnaligned(joint.revolute_axis()),
    "prismatic": lambda joint: pinocchio.JointModelPrismaticUnaligned(joint.translation_axis()),
}


def build_pinocchio(arm: Arm, plant: MultibodyPlant, joint_names: Sequence[str]) -> pinocchio.Model:
    """Returns a Pinocchio model of the links that these joints move.

    The frame of each link is at its joint. In the zero pose, it is parallel to the base frame.
    """
    context = plant.CreateDefaultContext()
    model = pinocchio.Model()
    model.gravity.linear = arm.gravity
    joints = {name: plant.GetJointByName(name) for name in joint_names}
    index_of: dict[str, int] = {}
    while joints:
        for name, joint in list(joints.items()):
            parent = joint.parent_body().name()
            if any(parent == other.child_body().name() for other in joints.values()):
                continue
            p = joint.frame_on_parent().CalcPose(context, joint.parent_body().body_frame()).translation()
            model_of_joint = JOINT_MODELS[joint.type_name()](joint)
            index = model.addJoint(index_of.get(parent, 0), model_of_joint, pinocchio.SE3(np.eye(3), p), name)
            index_of[joint.child_body().name()] = index
            M = joint.child_body().default_spatial_inertia()
            I_BBcm = M.Shift(M.get_com()).CalcRotationalInertia().CopyToFullMatrix3()
            inertia = pinocchio.Inertia(M.get_mass(), M.get_com(), I_BBcm)
            model.appendBodyToJoint(index, inertia, pinocchio.SE3.Identity())
            del joints[name]
    return model


def regressor_loop(model: pinocchio.Model, motion: Sequence[NDArray]) -> Callable[[], None]:
    """Returns a function that calls computeJointTorqueRegressor for each sample of q, v, vd (m, t).

    Pinocchio has no batch function. Each call overwrites the previous regressor.
    """
    data = model.createData()

    def run() -> None:
        for q, v, vd in zip(*motion, strict=True):
            pinocchio.computeJointTorqueRegressor(model, data, q, v, vd)

    return run
