"""Poses from which an arm approaches a static pose from below and from above, within its limits."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.models.arm import Arm

#: Length of an approach, as a fraction of the range of the joint. Dry friction is elastic at first, so a short approach
#: does not reverse it completely. Random poses have at least a tenth of the range on both sides.
APPROACH = 0.08


def approach_offset(arm: Arm) -> NDArray[np.float64]:
    """Returns the offset (n,) of the pose at which the approach of a static pose begins [rad, m].

    The offset is subtracted for the approach from below and added for the approach from above, see `offset_pose`. The
    offsets of all joints have the same sign, because this reverses the dry friction of actuators that are coupled to
    several joints most completely.
    """
    return np.asarray(APPROACH * (arm.position_upper - arm.position_lower))


def offset_pose(arm: Arm, pose: NDArray[np.float64], offset: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns pose + offset (n,), with the offset of each joint reduced so that no limit of `arm` is violated.

    If the reduced offsets still violate a coupled limit, `pose` is returned unchanged.
    """
    A, lower, upper = arm.limit_matrix()
    change = A @ offset
    room = np.where(change > 0, upper - A @ pose, A @ pose - lower)
    share = np.clip(np.divide(room, np.abs(change), out=np.ones_like(room), where=change != 0), 0.0, 1.0)
    joint_share = np.array([share[A[:, j] != 0].min() for j in range(arm.num_joints)])
    point = pose + joint_share * offset
    # If coefficients have both signs, reducing the offset of one joint may violate a coupled limit.
    return pose if arm.limit_violations(point, 1e-9) else point
