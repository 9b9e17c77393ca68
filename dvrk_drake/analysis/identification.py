"""Identifies a model of an arm from a recording of poses, or from motions, and estimates the direction of gravity."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from itertools import combinations
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.stats import t as student

from dvrk_drake.analysis.check.mounting import find_mounting, is_assumed
from dvrk_drake.analysis.check.recording_check import require_usable, with_power
from dvrk_drake.analysis.estimation.pose_effects import BASE_PRIOR, StaticProblem, candidate_effects
from dvrk_drake.analysis.estimation.robust_fit import FOLDS, blocks, robust_fit
from dvrk_drake.analysis.motion_identification import DynamicIdentification, identify_dynamic
from dvrk_drake.analysis.observations.finding import Finding
from dvrk_drake.analysis.observations.observations import Observations, Poses
from dvrk_drake.analysis.observations.static_poses import find_excluded, usable_measurements, usable_poses
from dvrk_drake.analysis.pose_identification import (
    MIN_NUM_POSES,
    Method,
    StaticIdentification,
    identify_static,
    with_effects_at_rest,
)
from dvrk_drake.analysis.results import unexplained_effort
from dvrk_drake.dynamics.actuator_effects import ActuatorEffect, effect_column
from dvrk_drake.dynamics.dynamic_model import ROUNDING_EFFORT
from dvrk_drake.dynamics.dynamic_regressor import DynamicRegressor
from dvrk_drake.dynamics.gravity_parameters import independent_columns
from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.errors import DvrkDrakeError, IdentificationError, RecordingError
from dvrk_drake.models.arm import Arm
from dvrk_drake.progress import Progress, step_progress
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


def gravity_direction(recording: Recording, arm: Arm) -> GravityDirection:
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


#: Largest share of the rows of a motion that may occur in another motion. Real efforts do not repeat exactly.
MAX_COMMON_ROWS = 0.05


def identify(
    recording: Recording | Sequence[Recording],
    arm: Arm,
    *,
    method: Method = "robust",
    estimate_gravity: bool = False,
    progress: Progress | None = None,
) -> StaticIdentification | DynamicIdentification:
    """Checks a recording and identifies the arm's model from it, as `dvrk-drake identify` does.

    A recording of poses, or a motion with enough static poses, gives a static model with gravity, cables, springs and
    offsets. Any other motion gives a dynamic model with physically consistent inertial parameters, rotor inertias and
    friction.

    Several motions, for example of different days, give one dynamic model. The links, cables and springs are those of
    all motions. Offsets and friction may differ between the motions, and the model contains their means. The
    cross-validated errors are those of each motion with a model of the other motions.

    Motions and one recording of poses give one dynamic model. The poses correct its holding torques
    (`with_effects_at_rest`).

    Args:
        recording: Poses with efforts (m, n), or a motion with times and efforts, in joint or actuator coordinates. Or
            several motions, also with one recording of poses.
        arm: Arm that was recorded, with the gravity direction of its mounting, see `Arm.with_gravity`.
        method: Method for poses: "robust", or "paper" for the least squares of Rutfield et al. (2015).
        estimate_gravity: True to estimate the direction of gravity in the base frame, for a base with an unknown tilt.
            The vector of `arm` is the initial estimate. Motions of an MTM always give this estimate.
        progress: Callback that receives the name of the step ("checking the recording" or "identifying") and the
            finished share of the step (0 to 1).

    Returns:
        Result with the model as `model`, the recording used for the fit as `recording`, and `warnings`. The method
        `save` of the result writes the model file.

    Raises:
        RecordingError: The recording does not fit the arm, or `check` rejects the recording. The attribute `findings`
            of the error contains the reasons.
        IdentificationError: No model is identifiable from the recording.

    Example:
        >>> import dvrk_drake as dvrk, numpy as np
        >>> arm = dvrk.load_arm("mtmr")
        >>> generator = np.random.default_rng(0)
        >>> q = arm.sample_poses(40, generator)
        >>> tau = dvrk.IdentifiedModel.from_arm(arm).holding_torque(q)
        >>> tau += 0.003 * arm.effort_limits * generator.normal(size=q.shape)
        >>> result = dvrk.identify(dvrk.Recording(q=q, tau=tau), arm)
        >>> len(result.model.base_parameters), len(result.model.joints)
        (12, 7)
        >>> for warning in result.warnings:
        ...     print(warning)
        >>> result.save("model.yaml")
    """
    recordings = [recording] if isinstance(recording, Recording) else list(recording)
    if not recordings:
        raise RecordingError("no recordings were given; a model requires at least one")
    if len(recordings) > 1 and method != "robust":
        raise RecordingError(f'method "{method}": requires one recording, but {len(recordings)} were given')
    if estimate_gravity:
        arm = replace(arm, identification=replace(arm.identification, base_may_tilt=True))
    names = [own.source or f"recording {i}" for i, own in enumerate(recordings, start=1)]
    warnings: list[Finding] = []

    def warn(name: str, findings: Iterable[Finding]) -> None:
        warnings.extend(finding.within(name) if len(recordings) > 1 else finding for finding in findings)

    for k, name in enumerate(names):
        recordings[k], dropped = with_power(recordings[k], arm)
        warn(name, dropped)
    if is_assumed(arm):
        arm, mounting = find_mounting(Observations(recordings[0], arm))
        warnings += mounting
    motions, static = _motions_and_poses(names, [Observations(own, arm).poses() for own in recordings])
    for name, poses in motions + static:
        report = require_usable(poses.observations, progress, channels=True)
        warn(name, report.warnings)
    share = step_progress(progress, "identifying")
    try:
        if not motions:
            identified = _identify_poses(static[0][1], method, estimate_gravity, share)
            return replace(identified, warnings=(*warnings, *identified.warnings))
        result = identify_dynamic([motion.observations for _, motion in motions], lambda done: share(0.95 * done))
        for _, poses in static:
            at_rest = identify_static(poses.recording, arm)
            model = with_effects_at_rest(result.model, at_rest)
            result = replace(result, model=model, note=_note(model, len(at_rest.recording)))
        share(1.0)
    except DvrkDrakeError as error:
        error.findings = tuple(warnings)
        raise
    return replace(result, warnings=(*warnings, *_unexplained(result)))


def _motions_and_poses(
    names: Sequence[str], recordings: Sequence[Poses]
) -> tuple[list[tuple[str, Poses]], list[tuple[str, Poses]]]:
    """Returns the motions and the static poses among the named recordings.

    Raises:
        RecordingError: Several recordings contain static poses, or two motions have the same efforts.
    """
    named = list(zip(names, recordings, strict=True))
    motions, static = ([(name, own) for name, own in named if own.moves == moves] for moves in (True, False))
    if len(static) > 1:
        raise RecordingError(
            f"{static[1][0]}: contains static poses, or is sampled too slowly for a motion, and so does "
            f"{static[0][0]}; several recordings can be combined only if all of them, or all but one, are motions"
        )
    for (name, own), (other_name, other) in combinations(motions, 2):
        pair = own.recording, other.recording
        efforts = [{row.tobytes() for row in x.measured_effort().round(9) if row.any()} for x in pair]
        if len(efforts[0] & efforts[1]) > MAX_COMMON_ROWS * min(map(len, pair)):
            raise RecordingError(
                f"{other_name}: contains the same efforts as {name}; give different recordings, because each of them "
                "is predicted from the others"
            )
    return motions, static


def _identify_poses(
    poses: Poses, method: Method, estimate_gravity: bool, progress: Callable[[float], object]
) -> StaticIdentification:
    """Returns the static model, with a warning if the base seems to be tilted."""
    arm, source, note = poses.observations.arm, poses.observations.source, poses.note
    direction, limit = gravity_direction(poses.recording, arm), f"{np.rad2deg(LARGE_TILT):g} deg"
    if estimate_gravity:
        if not direction.is_determined:
            raise IdentificationError(
                f"{source}: the poses do not determine the direction of gravity: {direction} from the arm file; at "
                f"most +- {limit} is allowed. Measure the tilt of the base and give the gravity vector, or record more "
                "poses over larger ranges."
            )
        arm = arm.with_gravity(direction.gravity.tolist())
        note = f"{note} Gravity in the base frame, estimated from the poses: {direction} from the arm file.".strip()
    static = identify_static(poses.recording, arm, method, progress)
    static = replace(static, note=note, num_rows=len(poses.recording))
    if estimate_gravity or not direction.is_large:
        return static
    static.model.provenance.base_tilt = f"gravity estimated from the poses: {direction} from the assumed direction"
    what = (
        f"the base seems to be tilted by more than {limit}. Gravity estimated from the poses: {direction} from the "
        "assumed direction. Cable terms of the model replace part of the tilt, so the model is wrong at other poses "
        "and in an exported file"
    )
    advice = "Measure the tilt and identify again with --gravity X Y Z."
    if direction.is_determined:
        advice = "Identify again with --gravity X Y Z, or with --gravity estimate."
    return replace(static, warnings=(Finding("warning", "base tilt", source, what, advice),))


def _note(model: IdentifiedModel, num_poses: int) -> str:
    effects = ", ".join(f"{ActuatorEffect.of(e)} {e.coefficient:+.4f}" for e in model.effects)
    few = f" ({MIN_NUM_POSES} poses are required)" if num_poses < MIN_NUM_POSES else ""
    return f"Corrections of the holding torque from {num_poses} static poses [N m; N]: {effects or 'none'}{few}."


def _unexplained(result: DynamicIdentification) -> tuple[Finding, ...]:
    actuators = result.model.dynamic_model.section.actuators
    return unexplained_effort({a.name: a.rms_cross_validation / a.rms_effort for a in actuators if a.rms_effort > 0})
