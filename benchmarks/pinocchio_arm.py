"""An arm as a model of Pinocchio, the peer of the regressors: built from the Drake plant's own joints and inertias."""

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
    """Pinocchio's model of the links that these joints move; each link's frame is its joint's, parallel to the base."""
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
    """computeJointTorqueRegressor of each sample of q, v, vd (m, t); it has no batch, each overwrites the last."""
    data = model.createData()

    def run() -> None:
        for q, v, vd in zip(*motion, strict=True):
            pinocchio.computeJointTorqueRegressor(model, data, q, v, vd)

    return run
