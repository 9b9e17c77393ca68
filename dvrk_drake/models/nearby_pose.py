"""A pose beside another one, inside the limits."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.models.arm import Arm


def beside(arm: Arm, pose: NDArray[np.float64], offset: NDArray[np.float64]) -> NDArray[np.float64]:
    """pose + offset (n,), where the offset of each joint is shortened so that no limit of `arm` is crossed."""
    A, lower, upper = arm.limit_matrix()
    change = A @ offset
    room = np.where(change > 0, upper - A @ pose, A @ pose - lower)
    share = np.clip(np.divide(room, np.abs(change), out=np.ones_like(room), where=change != 0), 0.0, 1.0)
    joint_share = np.array([share[A[:, j] != 0].min() for j in range(arm.num_joints)])
    point = pose + joint_share * offset
    # Coupled limits with coefficients of both signs could be crossed by shortening one joint alone.
    return pose if arm.limit_violations(point, 1e-9) else point
