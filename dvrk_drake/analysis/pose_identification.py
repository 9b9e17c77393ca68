"""Identifies the static model from holding torques at poses (Rutfield et al., 2015, section III.I, with extensions)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import version
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.analysis.estimation.pose_effects import MIN_TORQUE, StaticProblem, select_effects
from dvrk_drake.analysis.estimation.robust_fit import FOLDS, blocks, rms, weighted_fit
from dvrk_drake.analysis.observations.static_poses import (
    ExcludedMeasurement,
    exclude_outliers,
    find_excluded,
    usable_measurements,
    usable_poses,
)
from dvrk_drake.analysis.results import LARGEST_RATIO, Identification
from dvrk_drake.dynamics.actuator_effects import ActuatorEffect
from dvrk_drake.dynamics.holding_torque import static_model
from dvrk_drake.dynamics.identified_model import (
    BaseParameterEstimate,
    IdentifiedModel,
    JointStatistics,
    Provenance,
)
from dvrk_drake.errors import IdentificationError
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.effects_schema import DriveEffect
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
