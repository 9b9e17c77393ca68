"""The paper's twelve parameters as a model that our controller runs."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydrake.multibody.tree import JacobianWrtVariable

from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.experiments.reproduction.published import CONTROLLED_WITH, PARAMETER_PLACES, PARAMETERS
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.plant import make_arm_plant, set_arm_positions

#: More poses than parameters, for the change to our base parameters.
_POSES = 40


def paper_torque(arm: Arm, q: ArrayLike, parameters: Sequence[float] = PARAMETERS) -> NDArray[np.float64]:
    """Torque (m, n) of the paper's twelve parameters [kg m] at poses q (m, n): its equation 8 with g = 9.81 m/s^2.

    Each parameter is the first moment h of one link in its frame of Table I, so P = g sum z . R_i h_i, and
    dP/dq_j = g sum z . (w_j x R_i h_i), w_j the angular velocity that joint j gives link i.
    """
    plant = make_arm_plant(arm)
    context = plant.CreateDefaultContext()
    world = plant.world_frame()
    tree = [plant.GetJointByName(name).velocity_start() for name in arm.joint_names]
    torque = np.zeros(np.shape(q))
    for k, pose in enumerate(np.asarray(q, float)):
        set_arm_positions(plant, context, arm, pose)
        for value, (link, axis) in zip(parameters, PARAMETER_PLACES, strict=True):
            frame = plant.GetFrameByName(f"paper_{link}")
            h_W = value * frame.CalcPoseInWorld(context).rotation().matrix()[:, "xyz".index(axis)]
            J = plant.CalcJacobianAngularVelocity(context, JacobianWrtVariable.kV, frame, world, world)
            # In a serial chain: joints of the linkage's other bars turn none of these links.
            torque[k] += CONTROLLED_WITH * np.cross(J[:, tree].T, h_W)[:, 2]
    return torque


def paper_model(arm: Arm) -> IdentifiedModel:
    """The model whose torque is `paper_torque`, in our base parameters: they span the same."""
    q = arm.sample_poses(_POSES, np.random.default_rng(0))
    model = IdentifiedModel.from_arm(arm)
    Y = model.static_model.regressor(q)
    beta = np.linalg.lstsq(Y.reshape(-1, Y.shape[2]), paper_torque(arm, q).ravel(), rcond=None)[0]
    parameters = [
        dataclasses.replace(p, value=float(value)) for p, value in zip(model.base_parameters, beta, strict=True)
    ]
    return dataclasses.replace(model, base_parameters=parameters)


def with_zeroed(model: IdentifiedModel, joints: Sequence[int]) -> IdentifiedModel:
    """The model with no torque on `joints` (from 0), as the paper's Fig. 6 has it."""
    statistics = [dataclasses.replace(s, trust=0.0) if j in joints else s for j, s in enumerate(model.joints)]
    return dataclasses.replace(model, joints=statistics)
