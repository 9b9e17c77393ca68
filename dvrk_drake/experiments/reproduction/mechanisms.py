"""Evaluates the mechanisms of the simulated arms: DH table of the MTM; remote centre and wrist axes of the PSM."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.models.arm import Arm
from dvrk_drake.models.plant import make_arm_plant, set_arm_positions

#: Number of random poses from which the rows of the DH table are computed, and at which the axes are evaluated.
TABLE_POSES, AXIS_POSES = 20, 200


def recomputed_table(arm: Arm) -> tuple[NDArray[np.float64], float]:
    """Computes the DH table of an arm from the motion of the plant's frames `paper_0` to `paper_n`.

    These frames are fixed to the links. If the motion between two consecutive frames is not that of a DH
    joint, the returned error is large.

    Returns:
        - Table (n, 5) with the columns sign, offset [rad], d [m], alpha [rad] and a [m].
        - Error: largest difference between corresponding entries of the DH matrices and the plant's transforms
          (translations in m).
    """
    plant = make_arm_plant(arm)
    context = plant.CreateDefaultContext()
    frames = [plant.GetFrameByName(f"paper_{i}") for i in range(arm.num_joints + 1)]
    poses = np.vstack([np.zeros(arm.num_joints), arm.sample_poses(TABLE_POSES, np.random.default_rng(0))])
    links = np.empty((len(poses), arm.num_joints, 4, 4))
    for k, q in enumerate(poses):
        set_arm_positions(plant, context, arm, q)
        links[k] = [child.CalcPose(context, parent).GetAsMatrix4() for parent, child in pairwise(frames)]
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


def _dh_transform(theta: float, d: float, alpha: float, a: float) -> NDArray[np.float64]:
    """Returns the transform Rz(theta) Tz(d) Tx(a) Rx(alpha) (4, 4)."""
    c, s, ca, sa = np.cos(theta), np.sin(theta), np.cos(alpha), np.sin(alpha)
    return np.array([[c, -s * ca, s * sa, a * c], [s, c * ca, -c * sa, a * s], [0, sa, ca, d], [0, 0, 0, 1.0]])


def mechanism_errors(arm: Arm, remote_axis: str, wrist_axes: Sequence[str]) -> tuple[float, float]:
    """Evaluates the axes of an arm with a remote centre of motion at random poses.

    Args:
        arm: Arm. The origin of its base frame is the remote centre.
        remote_axis: Name of the joint whose axis passes through the remote centre.
        wrist_axes: Names of the two joints of the wrist.

    Returns:
        Maximum distance of the remote axis from the remote centre [m], and minimum angle of the wrist axes [rad].
    """
    plant = make_arm_plant(arm)
    context = plant.CreateDefaultContext()
    remote, angle = 0.0, np.pi
    for q in arm.sample_poses(AXIS_POSES, np.random.default_rng(0)):
        set_arm_positions(plant, context, arm, q)
        X_WJ = plant.GetJointByName(remote_axis).frame_on_parent().CalcPoseInWorld(context)
        shaft = X_WJ.rotation() @ plant.GetJointByName(remote_axis).revolute_axis()
        remote = max(remote, float(np.linalg.norm(np.cross(X_WJ.translation(), shaft))))
        pitch, yaw = (
            joint.frame_on_parent().CalcPoseInWorld(context).rotation() @ joint.revolute_axis()
            for joint in map(plant.GetJointByName, wrist_axes)
        )
        angle = min(angle, float(np.arccos(min(1.0, abs(float(pitch @ yaw))))))
    return remote, angle
