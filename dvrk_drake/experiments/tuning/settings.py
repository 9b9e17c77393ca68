"""What both tuners and the comparison of gains agree on, and what they need to know of an arm."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from functools import cache

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.dynamics.dynamic_section import ActuatorEffectEstimate
from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.errors import ArmError
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.arm_schema import Gains
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


def known_model(arm: Arm) -> IdentifiedModel:
    """What an identification leaves a controller with: the SDF's links, and springs and cables of the arm's effects."""
    position = [*arm.effects.cables, *arm.effects.springs]
    effects = [ActuatorEffectEstimate(e.coordinate, e.kind, e.scale, e.coefficient) for e in position]
    return dataclasses.replace(IdentifiedModel.from_arm(arm), effects=effects)


#: Poses that tuning looks at need this share of each motor's largest effort to be held, at most: with nothing left to
#: move the joint no gains help. (An MTM's wrist spring alone asks for more than its motor has in some of the box.)
HOLDING_SHARE = 0.5


@cache
def tuning_poses(arm: Arm, count: int, seed: int) -> NDArray[np.float64]:
    """(count, n) poses all over the joint box, a tenth of each range from the stops, that the motors hold easily.

    Raises:
        ArmError: hardly any pose is.
    """
    candidates = arm.sample_poses(40 * count, np.random.default_rng(seed), margin=0.1)
    efforts = known_model(arm).holding_torque(candidates) @ np.linalg.inv(arm.transmission.matrix)
    motors = per_actuator(arm.effects.saturation, arm.joint_names, np.inf)
    light = candidates[np.all(np.abs(efforts) <= HOLDING_SHARE * motors, axis=1)]
    if len(light) < count:
        raise ArmError(f"{arm.name}: its motors hold hardly any pose with {100 * HOLDING_SHARE:.0f} % of their effort")
    return light[:count]


def middle_pose(arm: Arm) -> NDArray[np.float64]:
    """(n,) of such poses the one nearest to the middle of the joint box, in ranges."""
    poses = tuning_poses(arm, 200, 0)
    width = arm.position_upper - arm.position_lower
    middle = 0.5 * (arm.position_upper + arm.position_lower)
    nearest: NDArray[np.float64] = poses[np.argmin(np.sum(((poses - middle) / width) ** 2, axis=1))]
    return nearest


def rounded_gains(joints: Iterable[tuple[float, float, float]]) -> Gains:
    """Of (kp, kd, ki) of each joint, to three digits: what is compared is what a file has."""
    return Gains(*([float(f"{value:.3g}") for value in column] for column in zip(*joints, strict=True)))


#: The paper's simulation (Rutfield, Zia, Boos, Santoso, Sujumnong, WPI 2015), from the controller node that the team
#: gave along with it: gains of the joints of an MTM.
_PUBLISHED_JOINTS = (
    *("outer_yaw", "shoulder_pitch", "elbow_pitch"),
    *("wrist_platform", "wrist_pitch", "wrist_yaw", "wrist_roll"),
)
_PUBLISHED_KP = (0.5, 0.8, 0.85, 3.7, 0.5, 0.02, 0.006)
_PUBLISHED_KV = (1.95, 0.95, 1.75, 0.2, 0.1, 0.8, 0.08)
_PUBLISHED_KI = (1e-5, 5e-5, 1e-4, 4e-4, 1e-6, 1e-7, 1e-8)
#: The controller ran at 100 Hz and summed errors sample by sample: 1 of its Ki is 100 N m/(rad s).
_PUBLISHED_RATE = 100.0


def published_gains(arm: Arm) -> Gains | None:
    """Of an arm with the joints of an MTM, per second; None of another one, for which none were published."""
    if arm.joint_names != _PUBLISHED_JOINTS:
        return None
    return Gains(list(_PUBLISHED_KP), list(_PUBLISHED_KV), [_PUBLISHED_RATE * ki for ki in _PUBLISHED_KI])
