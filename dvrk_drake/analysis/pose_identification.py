"""Identifies the static model from holding torques at poses (Rutfield et al., 2015, section III.I, with extensions)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from importlib.metadata import version
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.analysis.estimation.estimator import Estimator, Prior
from dvrk_drake.analysis.estimation.normal_equations import NormalEquations, fold_sums
from dvrk_drake.analysis.estimation.pose_effects import MIN_TORQUE, StaticProblem, select_effects
from dvrk_drake.analysis.estimation.robust_fit import FOLDS, blocks, rms, weighted_fit
from dvrk_drake.analysis.observations.static_poses import (
    ExcludedMeasurement,
    exclude_outliers,
    find_excluded,
    usable_measurements,
    usable_poses,
)
from dvrk_drake.analysis.results import LARGEST_RATIO, NEGLIGIBLE, Identification
from dvrk_drake.dynamics.actuator_effects import ActuatorEffect, distinct_coordinates, position_along, spring_over
from dvrk_drake.dynamics.dynamic_model import ROUNDING_EFFORT
from dvrk_drake.dynamics.holding_torque import static_model
from dvrk_drake.dynamics.identified_model import (
    BaseParameterEstimate,
    IdentifiedModel,
    JointStatistics,
    Provenance,
)
from dvrk_drake.errors import IdentificationError
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.effects_schema import EFFECT_KINDS, DriveEffect
from dvrk_drake.recordings.recording import Recording

Method = Literal["robust", "paper"]

#: Smallest range of the recorded positions of a joint with a feedforward, as a share of the range between the joint
#: limits. With a smaller range, most predicted torques would be extrapolated.
MIN_MOTION = 0.02
#: Largest ratio of the leave-one-out error to the RMS torque for a feedforward scale of 1. At this ratio, the model
#: explains 4 % of the squared torque.
MAX_ERROR_RATIO = 0.98


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class StaticIdentification(Identification):
    """Model identified from poses.

    Attributes:
        excluded: Excluded measurements and the reasons for the exclusion.
        residuals: Measured minus fitted efforts (m, n) [N m, N].
        leave_one_out_residuals: Measured efforts minus predictions (m, n) of a fit to all other poses [N m, N].
        cross_validation_residuals: Measured efforts minus predictions (m, n) for the poses of each held-out fold, see
            `JointStatistics` [N m, N]. For the method "paper", they are `leave_one_out_residuals`.
        usable: Mask (m, n) of the efforts that are not excluded.
    """

    excluded: list[ExcludedMeasurement]
    residuals: NDArray[np.float64]
    leave_one_out_residuals: NDArray[np.float64]
    cross_validation_residuals: NDArray[np.float64]
    usable: NDArray[np.bool_]


def identify_static(
    recording: Recording,
    arm: Arm,
    method: Method = "robust",
    progress: Callable[[float], object] = lambda share: None,
) -> StaticIdentification:
    """Identifies the static model of `arm` from a recording of poses at rest.

    Method "paper" is unweighted least squares on the base parameters (Rutfield et al., 2015, eq. 9-10).

    Method "robust" (default) weights each joint by the reciprocal of its residual variance. It excludes poses at a
    joint stop, efforts beyond their limit, and outliers. Effects are selected by leave-one-out cross-validation. A
    prior from the effort limits shrinks all parameters towards zero. The feedforward scale of a joint is reduced if the
    model's leave-one-out error is not smaller than the error of zero torque, or if the joint hardly moved. Repeated
    samples of one pose are averaged first, because they are not independent.

    Args:
        recording: Poses with efforts, in joint or actuator coordinates.
        arm: Arm that was recorded.
        method: "robust" or "paper".
        progress: Callback that receives the finished share, 0 to 1.

    Raises:
        RecordingError: The recording does not match the arm or has no efforts.
        IdentificationError: The method is unknown, there are too few poses, the recording is a motion, or the base
            parameters are not identifiable (method "paper").
    """
    if method not in get_args(Method):
        raise IdentificationError(f'method is "{method}"; allowed: {", ".join(get_args(Method))}')
    known = None if recording.tau is None else recording.measured_joints(arm)
    recording = usable_poses(recording, arm, averaged=method == "robust")
    tau = recording.measured_effort()
    gravity_model = static_model(arm)
    Y = gravity_model.regressor(recording.q)
    stacked = Y.reshape(-1, Y.shape[2])
    rank = int(np.linalg.matrix_rank(stacked, tol=1e-9 * np.linalg.norm(stacked, 2)))
    excluded = find_excluded(recording, arm)
    usable = usable_measurements(tau.shape, excluded)
    if known is not None:
        usable &= known
    effects: tuple[ActuatorEffect, ...] = ()
    feedforward_scale = np.ones(arm.num_joints)
    if method == "paper":
        if rank < Y.shape[2]:
            raise IdentificationError(
                f"{recording.source or 'recording'}: {len(recording)} poses determine only {rank} of {Y.shape[2]} base "
                "parameters, so least squares has no unique solution. Record more varied poses, or use --method robust."
            )
        fit = weighted_fit(Y, tau, np.ones_like(tau), np.zeros(Y.shape[2]))
        # The weights are 1, so the covariance is multiplied by the residual variance.
        variance = np.sum(fit.residuals**2) / (tau.size - Y.shape[2])
        validated, sd = fit.leave_one_out_residuals, np.sqrt(variance * np.diag(fit.covariance))
        freedom = np.full(len(sd), float(tau.size - Y.shape[2]))
    else:
        problem = StaticProblem(arm, recording.q, tau, usable)
        progress(0.0)
        effects = select_effects(problem)
        progress(1 / (FOLDS + 1))
        robust = problem.fit(effects)
        fit, sd, freedom = robust.fit, np.sqrt(np.diag(robust.fit.covariance)), robust.degrees_of_freedom
        excluded = excluded + exclude_outliers(recording, arm, robust.outliers, fit.residuals)
        usable = usable & ~robust.outliers
        feedforward_scale = _feedforward_scales(problem, fit.leave_one_out_residuals, usable)
        validated = _cross_validate(problem, progress)
    residuals, leave_one_out = (
        tau - feedforward_scale * (tau - errors) for errors in (fit.residuals, fit.leave_one_out_residuals)
    )
    model = IdentifiedModel(
        arm=arm,
        base_parameters=[
            BaseParameterEstimate(name, float(value), float(error), float(own))
            for name, value, error, own in zip(gravity_model.gravity.base.names, fit.theta, sd, freedom, strict=False)
        ],
        effects=[
            DriveEffect(
                *(effect.coordinate, effect.kind, effect.scale, float(value)),
                standard_error=float(error),
                degrees_of_freedom=float(own),
            )
            for effect, value, error, own in zip(
                effects, *(x[Y.shape[2] :] for x in (fit.theta, sd, freedom)), strict=True
            )
        ],
        joints=_statistics(recording, arm, (residuals, leave_one_out, validated), usable, feedforward_scale),
        provenance=Provenance(
            recording=recording.source,
            sha256=recording.sha256,
            poses=len(recording),
            method=method,
            rank=rank,
            condition_number=float(np.linalg.cond(stacked)) if rank == Y.shape[2] else float("inf"),
            version=version("dvrk-drake"),
        ),
    )
    return StaticIdentification(
        model=model,
        recording=recording,
        excluded=excluded,
        residuals=residuals,
        leave_one_out_residuals=leave_one_out,
        cross_validation_residuals=validated,
        usable=usable,
    )


def _feedforward_scales(
    problem: StaticProblem, leave_one_out: NDArray[np.float64], usable: NDArray[np.bool_]
) -> NDArray[np.float64]:
    """Returns the feedforward scale (n,) of each joint.

    The scale is below 1 if the model is not better than zero torque. It is 0 if the joint hardly moves, or if its
    torque is small and the leave-one-out error is large (`LARGEST_RATIO`).

    Args:
        problem: Problem with the poses and torques.
        leave_one_out: Leave-one-out residuals (m, n) [N m, N].
        usable: Mask (m, n) of the measurements that are not excluded.
    """
    arm = problem.arm
    min_motion = MIN_MOTION * (arm.position_upper - arm.position_lower)
    feedforward_scale = np.ones(arm.num_joints)
    for j in range(arm.num_joints):
        use = usable[:, j]
        measured, predicted = problem.tau[use, j], (problem.tau - leave_one_out)[use, j]
        ratio = rms(measured - predicted) / max(rms(measured), 1e-12)
        small = rms(measured) < MIN_TORQUE * arm.effort_limits[j]
        if not np.any(use) or np.ptp(problem.q[use, j]) <= min_motion[j] or (small and ratio > LARGEST_RATIO):
            feedforward_scale[j] = 0.0
        elif ratio > MAX_ERROR_RATIO:
            power = np.sum(predicted**2)
            feedforward_scale[j] = float(np.clip(measured @ predicted / power, 0.0, 1.0)) if power > 0 else 1.0
    return feedforward_scale


def _cross_validate(problem: StaticProblem, progress: Callable[[float], object]) -> NDArray[np.float64]:
    """Returns the residuals (m, n) of a 10-fold cross-validation. The folds are blocks of successive poses.

    For each fold, the effects are selected and the model is fitted again.
    """
    folds = blocks(len(problem.q), FOLDS)
    residuals = np.empty_like(problem.tau)
    for fold in range(folds.max() + 1):
        training = problem.subset(folds != fold)
        effects = select_effects(training)
        robust = training.fit(effects)
        usable = training.usable & ~robust.outliers
        feedforward_scale = _feedforward_scales(training, robust.fit.leave_one_out_residuals, usable)
        held_out = problem.subset(folds == fold)
        predicted = feedforward_scale * (held_out.regressor(effects) @ robust.fit.theta)
        residuals[folds == fold] = held_out.tau - predicted
        progress((fold + 2) / (FOLDS + 1))
    return residuals


def _statistics(
    recording: Recording,
    arm: Arm,
    errors: tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]],
    usable: NDArray[np.bool_],
    feedforward_scale: NDArray[np.float64],
) -> list[JointStatistics]:
    """Returns the statistics of the joints for the errors (m, n) of the fit, of leave-one-out and of held-out folds."""
    statistics = []
    for j, name in enumerate(arm.joint_names):
        lower, upper = float(recording.q[:, j].min()), float(recording.q[:, j].max())
        use = usable[:, j]
        torque, fitted, leave_one_out, held_out = (x[:, j] for x in (recording.measured_effort(), *errors))
        statistics.append(
            JointStatistics(
                name=name,
                rms_zero_torque=rms(torque),
                rms_fit=rms(fitted),
                rms_leave_one_out=rms(leave_one_out),
                rms_zero_torque_included=rms(torque[use]),
                rms_fit_included=rms(fitted[use]),
                rms_leave_one_out_included=rms(leave_one_out[use]),
                rms_cross_validation_included=rms(held_out[use]),
                num_excluded=int(np.sum(~use)),
                feedforward_scale=float(feedforward_scale[j]),
                position_lower=lower,
                position_upper=upper,
                coverage=(upper - lower) / float(arm.position_upper[j] - arm.position_lower[j]),
            )
        )
    return statistics


#: Smallest coefficient of a correction in standard errors. With half the value, `mtmr_2017_sweep40` gives the same
#: corrections of the model of `mtm_one`; with twice the value, one of four is omitted.
MIN_RATIO = 3.0
#: Smallest number of poses for corrections. The errors of a gravity model depend on the posture, so fewer poses can
#: increase the errors at other poses.
MIN_NUM_POSES = 20
#: Smallest range of a coordinate at the poses for a spring, as a share of its range in the workspace. With half the
#: value, one of these four corrections is omitted; with twice the value, they change by at most 0.007 N m.
MIN_SPRING_RANGE = 0.3
#: Travels of the hysteresis between poses, as shares of the range of the coordinate in the workspace. Half or twice
#: these travels change these four corrections by at most 0.007 N m.
TRAVELS = (0.03, 0.1, 0.2, 0.4)


def with_effects_at_rest(model: IdentifiedModel, poses: StaticIdentification) -> IdentifiedModel:
    """Returns a model with dynamics whose holding torques are corrected by static poses.

    The corrections are offsets of actuators and springs along coordinates, which a motion does not determine at rest:

    - The offset of an actuator in a motion can be caused by an error of the gravity model or by direction-dependent
      friction (`DynamicModel.holding_effects`).
    - Presliding friction whose travel is as wide as the motion acts like a spring.

    The efforts at the poses contain hysteresis: friction with a wide travel is not reversed by the short approach of a
    pose, and depends on the previous poses. It is estimated together with the corrections, from the order of the poses,
    and is not part of the model. The prior standard deviations are the dry friction for the hysteresis, and the RMS
    residual for a correction. Corrections are removed one after the other if they are not significant (`MIN_RATIO`), or
    do not reduce the error at held-out poses. With fewer than `MIN_NUM_POSES` poses, there is no correction. The poses
    change no other parameter.

    Args:
        model: Model with dynamics.
        poses: Poses of the same arm in the order of the measurement, with their usable measurements.
    """
    model, q = replace(model, effects=[]), poses.recording.q
    arm = model.arm
    to_actuator = arm.transmission.inverse
    residual = to_actuator.pull_back_effort(poses.recording.measured_effort() - model.holding_torque(q))
    usable = np.array([np.all(poses.usable[:, column != 0], axis=1) for column in to_actuator.matrix.T]).T
    candidates = _candidates(model, q, residual) if len(q) >= MIN_NUM_POSES else []
    estimator = _estimator(candidates, residual, usable)
    is_correction = np.array([c.effect.kind != "presliding" for c in candidates], dtype=bool)
    least = np.array([c.least for c in candidates])
    selected = np.arange(len(candidates))
    while np.any(is_correction[selected]):
        x, errors = estimator.fit(selected)[selected], estimator.standard_errors(selected)
        ratios = np.where(np.abs(x) > least[selected], np.abs(x) / errors, 0.0)
        ratios[~is_correction[selected]] = np.inf
        if np.min(ratios) >= MIN_RATIO:
            break
        selected = np.delete(selected, np.argmin(ratios))
    while len(corrections := np.flatnonzero(is_correction[selected])):
        without = [_held_out_error(estimator, np.delete(selected, k)) for k in corrections]
        if min(without) > _held_out_error(estimator, selected):
            break
        selected = np.delete(selected, corrections[np.argmin(without)])
        estimator.fit(selected)
    x, errors = estimator.fit(selected)[selected], estimator.standard_errors(selected)
    known = {e.coordinate: e.coefficient for e in model.holding_effects if e.kind == "offset"}
    effects = [
        DriveEffect(
            c.effect.coordinate,
            c.effect.kind,
            c.effect.scale,
            float(value + (known.get(c.effect.coordinate, 0.0) if c.effect.kind == "offset" else 0.0)),
            standard_error=float(error),
            degrees_of_freedom=float(max(len(q) - len(selected), 1)),
        )
        for c, value, error in zip([candidates[k] for k in selected], x, errors, strict=True)
        if c.effect.kind != "presliding"
    ]
    source = poses.recording
    provenance = replace(
        model.provenance,
        recording=f"{model.provenance.recording}, {source.source}",
        sha256=f"{model.provenance.sha256} {source.sha256}",
        poses=model.provenance.poses + len(source),
    )
    return replace(model, effects=effects, provenance=provenance)


@dataclass(frozen=True, eq=False)
class _Candidate:
    """Candidate effect.

    Attributes:
        effect: Effect.
        efforts: Efforts (m, n) of the actuators for a coefficient of 1.
        deviation: Prior standard deviation of the coefficient.
        least: Smallest absolute coefficient of a correction, whose RMS effort is then `NEGLIGIBLE`.
    """

    effect: ActuatorEffect
    efforts: NDArray[np.float64]
    deviation: float
    least: float


def _candidates(model: IdentifiedModel, q: NDArray[np.float64], residual: NDArray[np.float64]) -> list[_Candidate]:
    arm = model.arm
    rows = arm.effect_coordinates
    of_motion = [e for e in model.dynamic_model.section.effects if EFFECT_KINDS[e.kind].symmetric]
    dry = np.sum([np.abs(rows[e.coordinate] * e.coefficient) for e in of_motion], axis=0) * np.ones(arm.num_joints)
    largest = np.maximum(np.sqrt(np.mean(residual**2, axis=0)), ROUNDING_EFFORT)
    workspace = arm.sample_poses(200, np.random.default_rng(0))

    def candidate(effect: ActuatorEffect, shape: NDArray[np.float64]) -> _Candidate:
        row = rows[effect.coordinate]
        size = np.sqrt(np.mean(shape**2)) * np.abs(row)
        acts = size > 0
        friction = float(np.min(np.maximum(dry, ROUNDING_EFFORT)[acts] / size[acts], initial=np.inf))
        if effect.kind == "presliding":
            return _Candidate(effect, np.outer(shape, row), friction / len(TRAVELS), 0.0)
        deviation = float(np.min(largest[acts] / size[acts]))
        return _Candidate(effect, np.outer(shape, row), deviation, NEGLIGIBLE * friction)

    candidates = []
    for name in distinct_coordinates(arm):
        x, possible = position_along(arm, name, q), position_along(arm, name, workspace)
        if name.startswith("actuator.") and np.ptp(x) > MIN_MOTION * np.ptp(possible):
            candidates.append(candidate(ActuatorEffect(name, "offset"), np.ones(len(q))))
        if np.ptp(x) > MIN_SPRING_RANGE * np.ptp(possible):
            spring = spring_over(name, possible)
            candidates.append(candidate(spring, spring.column(x, np.zeros_like(x))))
            for travel in TRAVELS:
                effect = ActuatorEffect(name, "presliding", travel * float(np.ptp(possible)))
                candidates.append(candidate(effect, _hysteresis(x, effect.scale)))
    return candidates


def _hysteresis(x: NDArray[np.float64], travel: float) -> NDArray[np.float64]:
    """Returns the share (m,) of presliding friction at positions x (m,) that a coordinate reaches one after another."""
    share = np.zeros(len(x))
    for k in range(1, len(x)):
        share[k] = np.clip(share[k - 1] + (x[k] - x[k - 1]) / travel, -1.0, 1.0)
    return share


def _estimator(candidates: list[_Candidate], residual: NDArray[np.float64], usable: NDArray[np.bool_]) -> Estimator:
    """Returns the estimator of the coefficients (k,) from residuals (m, n) with a mask (m, n) of the usable ones.

    A fold is a block of successive poses.
    """
    efforts = np.array([c.efforts for c in candidates]).reshape(-1, *residual.shape) * usable
    columns = []
    for i in range(residual.shape[1]):
        own = np.flatnonzero(np.any(efforts[:, :, i], axis=1))
        columns.append((own, efforts[own, :, i].T))
    tau, fold = residual * usable, blocks(len(residual), FOLDS)
    is_friction = np.array([c.effect.kind == "presliding" for c in candidates], dtype=bool)
    precision = np.array([c.deviation for c in candidates]) ** -2.0
    return Estimator(
        NormalEquations.of(columns, len(candidates), tau, fold),
        Prior(np.zeros(len(candidates)), precision, is_friction),
        fold_sums(tau**2, fold),
        fold_sums(usable, fold),
    )


def _held_out_error(estimator: Estimator, selected: NDArray[np.int_]) -> float:
    """Returns the sum over the actuators of the mean squared error in held-out blocks, relative to the residual."""
    return float(np.sum(estimator.cross_validated(selected) ** 2))
