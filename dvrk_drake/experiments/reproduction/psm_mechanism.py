"""The simulated PSM's mechanism: its remote centre of motion and its wrist axes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.framework import Context

from dvrk_drake.models.arm import Arm
from dvrk_drake.models.plant import make_arm_plant, set_arm_positions

#: Poses at which the mechanism is measured.
PSM_POSES = 200


def mechanism_errors(arm: Arm) -> tuple[float, float]:
    """Furthest that the shaft's axis ever passes from the remote centre [m], and the least angle between the axes of
    wrist pitch and wrist yaw [rad], over random poses."""
    plant = make_arm_plant(arm)
    context = plant.CreateDefaultContext()
    remote, angle = 0.0, np.pi
    for q in arm.sample_poses(PSM_POSES, np.random.default_rng(0)):
        set_arm_positions(plant, context, arm, q)
        point, shaft = _axis(plant, context, "roll")
        remote = max(remote, float(np.linalg.norm(np.cross(point, shaft))))
        _, pitch = _axis(plant, context, "wrist_pitch")
        _, yaw = _axis(plant, context, "wrist_yaw")
        angle = min(angle, float(np.arccos(min(1.0, abs(float(pitch @ yaw))))))
    return remote, angle


def _axis(plant: MultibodyPlant, context: Context, joint: str) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """A point of a hinge's axis and its direction in the world, whose origin is the remote centre."""
    hinge = plant.GetJointByName(joint)
    X_WJ = hinge.frame_on_parent().CalcPoseInWorld(context)
    return X_WJ.translation(), X_WJ.rotation() @ hinge.revolute_axis()
