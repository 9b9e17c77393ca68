"""Estimates the direction of gravity in the base frame of an arm from static poses."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.stats import t as student

from dvrk_drake.analysis.estimation.pose_effects import BASE_PRIOR, StaticProblem, candidate_effects
from dvrk_drake.analysis.estimation.robust_fit import FOLDS, blocks, robust_fit
from dvrk_drake.analysis.observations.excluded_measurements import find_excluded, usable_measurements
from dvrk_drake.analysis.observations.static_poses import usable_poses
from dvrk_drake.dynamics.actuator_effects import effect_column
from dvrk_drake.dynamics.base_parameters import independent_columns
from dvrk_drake.dynamics.dynamic_model import ROUNDING_EFFORT
from dvrk_drake.dynamics.dynamic_regressor import DynamicRegressor
from dvrk_drake.models.arm import Arm
from dvrk_drake.recordings.recording import MIN_RANGE, Recording

#: Angle above which a difference from the assumed direction is reported, and largest half width of the 95 % interval of
#: an estimate that can be used [rad]. Poses of upright MTMs give up to 4.2 deg (mtm_2015_apr18_all80). At 5 deg, about
#: 0.09 N m of the 1 N m on the shoulder of an MTM act on the outer yaw, which is its dry friction.
LARGE_TILT = np.deg2rad(5.0)
#: Prior standard deviation of a change of the direction in one iteration [rad], and number of iterations. Half or twice
#: the deviation, and twice the number, change no printed tilt of the public poses.
_STEP, _ITERATIONS = 0.5, 10


class GravityDirection(NamedTuple):
    """Estimate of the gravity vector.

    Attributes:
        gravity: Estimated vector (3,) in the base frame, with the magnitude of the assumed vector [m/s^2].
        tilt: Angle between the estimated and the assumed vector [rad].
        half_width: Half width of the 95 % interval of `tilt` [rad].
    """

    gravity: NDArray[np.float64]
    tilt: float
    half_width: float

    def __str__(self) -> str:
        vector = ", ".join(f"{x:.3f}" for x in self.gravity)
        low, high = np.rad2deg([max(self.tilt - self.half_width, 0.0), self.tilt + self.half_width])
        return f"({vector}) m/s^2, {np.rad2deg(self.tilt):.1f} deg (95 % interval {low:.1f} to {high:.1f} deg)"

    @property
    def is_large(self) -> bool:
        """True if the 95 % interval of the tilt is above `LARGE_TILT`."""
        return self.tilt - self.half_width > LARGE_TILT

    @property
    def is_determined(self) -> bool:
        """True if the poses determine the direction, see `LARGE_TILT`."""
        return self.half_width <= LARGE_TILT


def estimate_gravity(recording: Recording, arm: Arm) -> GravityDirection:
    """Estimates the direction of gravity together with the links and all effects of `candidate_effects`.

    Efforts at rest are tau = sum_k g_k Y_k(q) phi + effects, with the regressors Y_k of unit gravity along the axes of
    the base frame. Each iteration is a robust linear fit of phi, the effects, and a change of g that is perpendicular
    to g, with the phi of the previous iteration in the products of both. The priors are those of the static model, so
    the estimate does not depend on the masses in the SDF.

    The interval is that of a jackknife over blocks of successive poses (cluster-robust covariance), because the errors
    of successive poses are often similar.

    Args:
        recording: Poses with efforts, see `usable_poses`.
        arm: Arm with the assumed gravity vector.

    Raises:
        RecordingError, IdentificationError: See `usable_poses`.
    """
    recording = usable_poses(recording, arm)
    q, tau = recording.q, recording.measured_effort()
    problem = StaticProblem(arm, q, tau, usable_measurements(tau.shape, find_excluded(recording, arm)))
    regressor, assumed = DynamicRegressor(arm), arm.gravity / np.linalg.norm(arm.gravity)
    size = float(np.linalg.norm(arm.gravity))
    axes = [regressor.with_gravity((size * axis).tolist()) for axis in np.eye(3)]
    poses = arm.sample_poses(100, np.random.default_rng(0))
    sampled = np.array([r.regressor(poses, 0 * poses, 0 * poses) for r in axes])
    independent, _ = independent_columns(sampled.reshape(-1, sampled.shape[-1]))
    Y = np.array([r.regressor(q, 0 * q, 0 * q)[..., independent] for r in axes])
    effects = [effect for group in candidate_effects(problem) for effect in group]
    of_effects = np.stack([effect_column(arm, e, q) for e in effects], axis=2) if effects else np.empty((*q.shape, 0))
    largest = np.abs(sampled[..., independent]).max(axis=(0, 1))
    limits = (arm.effort_limits[:, None] / np.maximum(largest, ROUNDING_EFFORT)).min(axis=0)
    own = problem.prior_precision(effects)[len(problem.base_model.gravity.base.names) :]
    prior = np.concatenate([(BASE_PRIOR * limits) ** -2.0, own, np.full(2, _STEP**-2.0)])
    # The effort of a joint that does not move contains a constant dry friction.
    usable = problem.usable & (np.ptp(q, axis=0) > arm.per_joint(*MIN_RANGE))
    g, phi = assumed, np.zeros(len(independent))
    for _ in range(_ITERATIONS):
        tangents = np.linalg.svd(g[None])[2][1:]
        changes = np.tensordot(tangents, Y @ phi, axes=(1, 0)).transpose(1, 2, 0)
        X = np.concatenate([np.tensordot(g, Y, axes=1), of_effects, changes], axis=2)
        robust = robust_fit(X, tau, usable, prior, problem.sigma_floor)
        phi, step = robust.fit.theta[: len(independent)], robust.fit.theta[-2:] @ tangents
        g = (g + step) / np.linalg.norm(g + step)
    robust_weights = np.where(usable & ~robust.outliers, robust.sigma**-2.0, 0.0)
    scores = np.einsum("mn,mnp->mp", robust_weights * robust.fit.leave_one_out_residuals, X)
    block = blocks(len(q), FOLDS)
    of_blocks = np.array([scores[block == b].sum(axis=0) for b in range(block[-1] + 1)])
    A = robust.fit.covariance[-2:]
    covariance = A @ (of_blocks.T @ of_blocks + np.diag(prior)) @ A.T
    # Variance of the angle: that of the component of g along the arc, or the largest one if the tilt is 0.
    along = tangents @ (g * (assumed @ g) - assumed)
    tilt = float(np.arctan2(np.linalg.norm(np.cross(assumed, g)), assumed @ g))
    if tilt > 1e-6:
        variance = float(along @ covariance @ along) / float(along @ along)
    else:
        variance = float(np.linalg.eigvalsh(covariance)[-1])
    quantile = float(student.ppf(0.975, max(len(of_blocks) - 1, 1)))
    return GravityDirection(size * g, tilt, quantile * variance**0.5)
