"""Checks position limits and coupled limits, and reduces pose offsets that would violate them."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.models.arm_schema import ANGLE_WIDTHS, ANGLES, TRAVEL_WIDTHS, TRAVELS, CoupledLimit
from dvrk_drake.models.schema_fault import number_fault

if TYPE_CHECKING:
    from dvrk_drake.models.arm import Arm

#: Length of an approach, as a fraction of the range of the joint. Dry friction is elastic at first, so a short approach
#: does not reverse it completely. Random poses have at least a tenth of the range on both sides.
APPROACH = 0.08


def coupled_limit_fault(arm: Arm, limit: CoupledLimit) -> str:
    """Returns a message on the first fault of a coupled limit, with the accepted values, or "" if there is none."""
    key = f"coupled_limits.{limit.name}"
    row = np.array([limit.coefficients.get(name, 0.0) for name in arm.joint_names])
    coupled = row != 0
    if not np.any(coupled):
        return f"{key}: all coefficients are 0; allowed: at least one other value"
    slides = bool(np.all(arm.prismatic[coupled]))
    if fault := number_fault(limit):
        return f"{key}.{fault}"
    if fault := limits_fault(key, limit.lower, limit.upper, slides):
        return fault
    ends = np.sort(row * [arm.position_lower, arm.position_upper], axis=0).sum(axis=1)
    if ends[1] < limit.lower or ends[0] > limit.upper:
        return (
            f"{key}: no pose within position_limits meets {limit.lower:g}..{limit.upper:g}; "
            f"allowed: limits that overlap {ends[0]:.4g}..{ends[1]:.4g}"
        )
    return ""


def can_meet_coupled_limits(arm: Arm) -> bool:
    """Returns whether at least one pose within the position limits meets all coupled limits."""
    from scipy.optimize import linprog  # slow import; few arms have two coupled limits

    A, lower, upper = arm.limit_matrix()
    n = arm.num_joints
    bounds = np.column_stack([lower[:n], upper[:n]])
    inequalities = np.vstack([A[n:], -A[n:]]), np.concatenate([upper[n:], -lower[n:]])
    return bool(linprog(np.zeros(n), *inequalities, bounds=bounds).success)


def limits_fault(key: str, lower: float, upper: float, slides: bool) -> str:
    """Returns a message on the first fault of a lower and an upper position limit, or "" if there is none."""
    positions, widths = (TRAVELS, TRAVEL_WIDTHS) if slides else (ANGLES, ANGLE_WIDTHS)
    if fault := positions.fault(f"{key}[0]", lower) or positions.fault(f"{key}[1]", upper):
        return fault
    if not lower < upper:
        return f"{key} is [{lower:g}, {upper:g}]; allowed: [lower, upper] with lower < upper"
    return widths.fault(f"{key}: upper - lower", upper - lower)


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
