"""Random motions of an arm that nearly reach its limits."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.analysis.excitation.motion_limits import MotionLimits
from dvrk_drake.analysis.excitation.periodic_motion import FourierBasis, PeriodicMotion
from dvrk_drake.analysis.excitation.predicted_effort import PredictedEffort
from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.errors import ExcitationError
from dvrk_drake.models.arm import Arm

#: Number of times per harmonic at which the limits are imposed. Between the times, the highest harmonic grows by at
#: most 2.5 % of its amplitude.
LIMIT_TIMES = 14
#: Share of the limits that random and optimised motions use. Between the times, a motion may exceed a limit slightly:
#: the highest harmonic, by 2.5 % of its amplitude, is a part of the motion.
USED = 0.98


def random_motion(
    arm: Arm,
    limits: MotionLimits,
    period: float,
    harmonics: int,
    generator: np.random.Generator,
    model: IdentifiedModel | None = None,
) -> PeriodicMotion:
    """Returns a random Fourier motion that nearly reaches the limits.

    The velocities of all harmonics have the same distribution. Each joint is scaled to its own limits. Then all joints
    are scaled by one factor until the coupled limits and the effort limits are met.
    """
    basis = FourierBasis.of(period, harmonics)
    center = middle_pose(arm, limits, generator)
    k = np.arange(1, harmonics + 1)
    sine, cosine = generator.normal(size=(2, arm.num_joints, harmonics)) / k
    weights = np.hstack([sine @ basis.sines[:, : harmonics - 1], cosine @ basis.cosines[:, harmonics - 1 :]])
    coefficients = np.column_stack([center, weights])
    coefficients[:, 1:] *= _joint_scales(coefficients, basis, arm, limits)[:, None]
    coefficients[:, 1:] *= _largest_scale(coefficients, basis, PredictedEffort(arm, model), limits)
    return PeriodicMotion.of_coefficients(arm, basis, coefficients, 1)


def state_of(motion: PeriodicMotion, count: int) -> NDArray[np.float64]:
    """Returns the states (3, count, n) of one period of a motion: q, v and vd."""
    return np.array(motion.evaluate(np.arange(count) * motion.period / count)[:3])


def middle_pose(arm: Arm, limits: MotionLimits, generator: np.random.Generator) -> NDArray[np.float64]:
    """Returns the mean of random poses (n,), moved into the additional position limits."""
    center = arm.sample_poses(200, generator, max(limits.margin, 0.2)).mean(axis=0)
    if not limits.positions:
        return center
    joints, n = limits.of_arm(arm), arm.num_joints
    middle, half = (joints.lower[:n] + joints.upper[:n]) / 2, (joints.upper[:n] - joints.lower[:n]) / 2
    return np.asarray(np.clip(center, middle - 0.5 * half, middle + 0.5 * half))


def sample_times(basis: FourierBasis, per_harmonic: int) -> NDArray[np.float64]:
    """Returns evenly spaced times (m,) in one period of a basis [s]."""
    count = per_harmonic * len(basis.rates)
    return np.arange(count) * 2 * np.pi / basis.rates[0] / count


def states_at(values: NDArray[np.float64], coefficients: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns the states (3, m, n) for values (3, m, 2h - 1) and coefficients (n, 2h - 1), see `FourierBasis`."""
    return np.asarray(values @ coefficients.T)


def effort_without_friction(predicted: PredictedEffort, limits: MotionLimits) -> NDArray[np.float64]:
    """Returns the largest joint efforts (n,) without dry friction [N m, N].

    Raises:
        ExcitationError: The dry friction of a joint exceeds the limit.
    """
    allowed = limits.of_arm(predicted.arm).effort - predicted.dry_friction
    if np.any(allowed <= 0):
        name = predicted.arm.joint_names[int(np.argmin(allowed))]
        raise ExcitationError(f"{name}: the dry friction exceeds {100 * limits.effort:g} % of the effort limit")
    return np.asarray(allowed)


def _joint_scales(
    coefficients: NDArray[np.float64], basis: FourierBasis, arm: Arm, limits: MotionLimits
) -> NDArray[np.float64]:
    """Returns the largest factors (n,) with which the amplitude of each joint meets its own limits."""
    joints, n = limits.of_arm(arm), arm.num_joints
    values = basis.values(sample_times(basis, LIMIT_TIMES))
    moves = [v[:, 1:] @ coefficients[:, 1:].T for v in values]
    walls = slice(len(joints.A) // 2, len(joints.A) // 2 + n)
    x = np.abs([moves[0] + joints.look_ahead[walls] * moves[1], *moves]).max(axis=1)
    center = coefficients[:, 0]
    rooms = [np.minimum(joints.upper[k] - center, center - joints.lower[k]) for k in (walls, slice(n))]
    allowed = np.array([*rooms, joints.speed, joints.acceleration, joints.jerk])
    return np.asarray(USED * np.min(allowed / x, axis=0))


def _largest_scale(
    coefficients: NDArray[np.float64], basis: FourierBasis, predicted: PredictedEffort, limits: MotionLimits
) -> float:
    """Returns the largest factor up to 1 with which the motion meets the coupled limits and the effort limits."""
    arm = predicted.arm
    joints, values = limits.of_arm(arm), basis.values(sample_times(basis, LIMIT_TIMES))
    allowed = effort_without_friction(predicted, limits)
    for scale in 0.95 ** np.arange(100):
        scaled = np.column_stack([coefficients[:, 0], scale * coefficients[:, 1:]])
        q, v, vd = states_at(values[:3], scaled)
        positions = joints.positions(q, v)
        tau = predicted.without_dry_friction(q, v, vd)
        if np.all((positions >= joints.lower) & (positions <= joints.upper)) and np.all(np.abs(tau) <= allowed):
            return float(scale)
    j = int(np.argmax(np.abs(tau).max(axis=0) / allowed))
    reason = "the middle of the motion exceeds a position limit"
    if np.abs(tau[:, j]).max() > allowed[j]:
        reason = (
            f"the effort of {arm.joint_names[j]} in the middle of the motion, including dry friction, exceeds "
            f"{100 * limits.effort:g} % of the effort limit"
        )
    raise ExcitationError(f"{arm.name}: no motion meets all limits: {reason}")
