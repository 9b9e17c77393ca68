"""Evaluates the mechanisms of the simulated arms: DH table of the MTM; remote centre and wrist axes of the PSM."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.framework import Context

from dvrk_drake.experiments.reproduction.published import LENGTHS, TableRow
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.plant import make_arm_plant, set_arm_positions

#: Number of random poses from which the rows of the DH table are computed.
POSES = 20


def recomputed_table(arm: Arm) -> tuple[NDArray[np.float64], float]:
    """Computes the DH table of an MTM from the motion of the plant's frames `paper_0` to `paper_7`.

    These frames are fixed to the links. If the motion between two consecutive frames is not that of a DH
    joint, the returned error is large.

    Returns:
        - Table (n, 5) with the columns sign, offset [rad], d [m], alpha [rad] and a [m].
        - Error: largest difference between corresponding entries of the DH matrices and the plant's transforms
          (translations in m).
    """
    plant = make_arm_plant(arm)
    poses = np.vstack([np.zeros(arm.num_joints), arm.sample_poses(POSES, np.random.default_rng(0))])
    links = np.array([_transforms(plant, arm, q) for q in poses])
    rows, max_error = [], 0.0
    for j in range(arm.num_joints):
        A = links[:, j]
        theta = np.arctan2(A[:, 1, 0], A[:, 0, 0])
        sign = float(np.sign(np.median(np.sin(theta[1:] - theta[0]) * np.sin(poses[1:, j]))))
        offset = float(np.angle(np.mean(np.exp(1j * (theta - sign * poses[:, j])))))
        alpha = float(np.arctan2(A[0, 2, 1], A[0, 2, 2]))
        a = float(A[0, :2, 3] @ [np.cos(theta[0]), np.sin(theta[0])])
        rows.append([sign, offset, float(A[0, 2, 3]), alpha, a])
        recomputed = np.array([_dh_transform(sign * q + offset, rows[-1][2], alpha, a) for q in poses[:, j]])
        max_error = max(max_error, float(np.abs(recomputed - A).max()))
    table = np.round(rows, 12) + 0.0  # no -0
    table[:, [1, 3]] = np.where(table[:, [1, 3]] == np.round(-np.pi, 12), np.pi, table[:, [1, 3]])
    return table, max_error


def _transforms(plant: MultibodyPlant, arm: Arm, q: NDArray[np.float64]) -> list[NDArray[np.float64]]:
    """Returns the transforms (4, 4) between consecutive frames `paper_0` to `paper_7`, one per joint."""
    context = plant.CreateDefaultContext()
    set_arm_positions(plant, context, arm, q)
    frames = [plant.GetFrameByName(f"paper_{i}") for i in range(arm.num_joints + 1)]
    return [child.CalcPose(context, parent).GetAsMatrix4() for parent, child in pairwise(frames)]


def _dh_transform(theta: float, d: float, alpha: float, a: float) -> NDArray[np.float64]:
    """Returns the transform Rz(theta) Tz(d) Tx(a) Rx(alpha) (4, 4)."""
    c, s, ca, sa = np.cos(theta), np.sin(theta), np.cos(alpha), np.sin(alpha)
    return np.array([[c, -s * ca, s * sa, a * c], [s, c * ca, -c * sa, a * s], [0, sa, ca, d], [0, 0, 0, 1.0]])


def published_row(row: TableRow) -> NDArray[np.float64]:
    """Returns a row (5,) of Table I with numbers for its lengths: sign, offset [rad], d [m], alpha [rad], a [m]."""
    d, a = ((-1) ** symbol.startswith("-") * LENGTHS[symbol.lstrip("-")] + 0.0 for symbol in (row.d, row.a))
    return np.array([row.sign, row.offset, d, row.alpha, a])


#: Number of poses at which the mechanism is evaluated.
PSM_POSES = 200


def mechanism_errors(arm: Arm) -> tuple[float, float]:
    """Evaluates the mechanism of the PSM at random poses.

    Returns:
        Maximum distance of the axis of the instrument shaft from the remote centre [m], and minimum angle between the
        wrist pitch axis and the wrist yaw axis [rad].
    """
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


def _axis(plant: MultibodyPlant, context: Context, name: str) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Returns a point on a joint axis [m] and the direction of the axis, in the world frame.

    The origin of the world frame is the remote centre.
    """
    joint = plant.GetJointByName(name)
    X_WJ = joint.frame_on_parent().CalcPoseInWorld(context)
    return X_WJ.translation(), X_WJ.rotation() @ joint.revolute_axis()
