"""What both tuners and the comparison of gains agree on, and what they need to know of an arm."""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.models.arm import Arm
from dvrk_drake.models.effects_schema import per_actuator

#: A joint is tried by steps of this size [rad, m].
STEP_REVOLUTE, STEP_PRISMATIC = 0.05, 0.005


def step_size(arm: Arm) -> NDArray[np.float64]:
    """(n,) of each joint [rad, m]."""
    return arm.per_joint(STEP_REVOLUTE, STEP_PRISMATIC)


def counts(arm: Arm) -> NDArray[np.float64]:
    """(n,) what a joint's position is known to [rad, m]: a count of each of the encoders that it is computed from."""
    encoder = arm.effects.encoder
    table = per_actuator(encoder.resolution if encoder else {}, arm.joint_names, 0.0)
    return np.abs(arm.transmission.inverse().matrix) @ table


def band(arm: Arm) -> NDArray[np.float64]:
    """(n,) a joint has settled if it stays this near [rad, m]: 2 % of the step, or a count if that is more."""
    return np.maximum(0.02 * step_size(arm), counts(arm))


def effort_limits(arm: Arm) -> NDArray[np.float64]:
    """(n,) the largest effort that a joint can have while the others have none: the arm's, or its motors'."""
    motors = per_actuator(arm.effects.saturation, arm.joint_names, np.inf)
    # tau_joint = J' tau_actuator: one joint's effort needs these actuator efforts.
    share = np.abs(np.linalg.inv(arm.transmission.matrix).T)
    with np.errstate(divide="ignore"):
        return np.minimum(arm.effort_limits, np.min(motors[:, None] / share, axis=0))


@cache
def middle_pose(arm: Arm) -> NDArray[np.float64]:
    """(n,) the pose nearest to the middle of the joint box, in ranges, of 500 that the coupled limits allow."""
    poses = arm.sample_poses(500, np.random.default_rng(0), margin=0.1)
    width = arm.position_upper - arm.position_lower
    middle = 0.5 * (arm.position_upper + arm.position_lower)
    nearest: NDArray[np.float64] = poses[np.argmin(np.sum(((poses - middle) / width) ** 2, axis=1))]
    return nearest
