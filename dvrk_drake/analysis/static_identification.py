"""Parameters of the static model from recorded poses and holding torques (paper, III.I, and further)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import version
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.analysis.doubts import Doubt, find_doubts, outlier_doubts, usable_measurements
from dvrk_drake.analysis.effect_selection import StaticProblem, select_effects
from dvrk_drake.analysis.linear_fit import LinearFit, weighted_fit
from dvrk_drake.dynamics.identified_model import (
    BaseParameterEstimate,
    EffectEstimate,
    IdentifiedModel,
    JointStatistics,
    Provenance,
)
from dvrk_drake.dynamics.joint_effects import JointEffect
from dvrk_drake.dynamics.static_model import compile_static_model
from dvrk_drake.errors import IdentificationError
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.recording import Recording

Method = Literal["robust", "paper"]

#: Fewest poses that are accepted, and fewest for which cross-validation means something.
LEAST_POSES = 5
#: RMS joint speed above which a recording counts as a motion [rad/s or m/s].
REST_SPEED = 0.05
#: A joint whose measured torque stays below this share of its effort limit says nothing about its model.
LEAST_TORQUE = 0.02
FOLDS = 10


@dataclass(frozen=True)
class StaticIdentification:
    """A model with what a report of it needs: the doubts, and (m, n) residuals in joint coordinates."""

    model: IdentifiedModel
    doubts: list[Doubt]
    residuals: NDArray[np.float64]
    left_out_residuals: NDArray[np.float64]


def identify_static(
    recording: Recording,
    arm: Arm,
    method: Method = "robust",
    progress: Callable[[float], None] = lambda share: None,
) -> StaticIdentification:
    """Identifies the static model of `arm` from a recording of poses at rest.

    "paper": unweighted least squares on the base parameters, eq. 9-10 of the paper.
    "robust" (default): each joint weighted by its own spread, measurements on a stop or far off left out, joint effects
    chosen by leave-one-out, every parameter shrunk toward zero by a prior derived from the effort limits, and a joint's
    torque scaled down where leave-one-out says that the model is no better than zero torque.

    Args:
        recording: poses with efforts, in either coordinates.
        arm: the arm it was recorded on.
        method: see above.
        progress: called with the finished share, 0..1.

    Raises:
        RecordingError: the recording does not fit the arm or has no efforts.
        IdentificationError: too few poses, a motion instead of poses, or (method "paper") a rank too low.
    """
    recording.check_fits(arm)
    recording = recording.in_joint_coordinates(arm)
    tau = recording.measured_effort()
    _check_poses(recording)
    gravity_model = compile_static_model(arm)
    Y = gravity_model.regressor(recording.q)
    stacked = Y.reshape(-1, Y.shape[2])
    rank = int(np.linalg.matrix_rank(stacked, tol=1e-9 * np.linalg.norm(stacked, 2)))
    doubts = find_doubts(recording, arm)
    usable = usable_measurements(tau.shape, doubts)
    effects: tuple[JointEffect, ...] = ()
    trust = np.ones(arm.num_joints)
    validated = np.full_like(tau, np.nan)
    if method == "paper":
        if rank < Y.shape[2]:
            raise IdentificationError(
                f"{recording.source}: {len(recording)} poses determine only {rank} of {Y.shape[2]} base parameters; "
                "least squares has no unique answer: record more varied poses or use --method robust"
            )
        fit = weighted_fit(Y, tau, np.ones_like(tau), np.zeros(Y.shape[2]))
        # Unit weights: the covariance takes its scale from the residuals, as the textbook does.
        variance = np.sum(fit.residuals**2) / (tau.size - Y.shape[2])
        validated, sd = fit.left_out_residuals, np.sqrt(variance * np.diag(fit.covariance))
    else:
        problem = StaticProblem(arm, recording.q, tau, usable)
        progress(0.0)
        effects = select_effects(problem)
        progress(1 / (FOLDS + 1))
        robust = problem.fit(effects)
        fit, sd = robust.fit, np.sqrt(np.diag(robust.fit.covariance))
        doubts = doubts + outlier_doubts(recording, arm, robust.outliers, fit.residuals)
        usable = usable & ~robust.outliers
        trust = _trust(tau, fit.left_out_residuals, usable, arm)
        validated = _cross_validate(problem, progress)
    fit = _scaled(fit, tau, trust)
    model = IdentifiedModel(
        arm=arm.name.lower(),
        gravity=[float(x) for x in arm.gravity],
        base_parameters=[
            BaseParameterEstimate(name, *_estimate(value, error))
            for name, value, error in zip(gravity_model.gravity.base.names, fit.theta, sd, strict=False)
        ],
        joint_effects=[
            EffectEstimate(effect.joint, effect.kind, *_estimate(value, error))
            for effect, value, error in zip(effects, fit.theta[Y.shape[2] :], sd[Y.shape[2] :], strict=True)
        ],
        joints=_statistics(recording, arm, fit, validated, usable, trust),
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
    return StaticIdentification(model, doubts, fit.residuals, fit.left_out_residuals)


def _check_poses(recording: Recording) -> None:
    if len(recording) < LEAST_POSES:
        raise IdentificationError(
            f"{recording.source}: has {len(recording)} poses, too few to identify from; "
            f"at least {LEAST_POSES}, better 40 or more that cover the arm's range"
        )
    if recording.qd is not None:
        speed = np.sqrt(np.mean(recording.qd**2, axis=0))
        if np.any(speed > REST_SPEED):
            joint = int(np.argmax(speed))
            raise IdentificationError(
                f"{recording.source}: the arm moves (qd{joint + 1} is {speed[joint]:.2g} rad/s RMS); "
                f"static identification needs poses at rest, below {REST_SPEED} rad/s"
            )


def _trust(
    tau: NDArray[np.float64], left_out: NDArray[np.float64], usable: NDArray[np.bool_], arm: Arm
) -> NDArray[np.float64]:
    """(n,) scale of each joint's torque that leave-one-out supports: 1 unless it is no better than zero torque."""
    trust = np.ones(arm.num_joints)
    for j in range(arm.num_joints):
        measured, predicted = tau[usable[:, j], j], (tau - left_out)[usable[:, j], j]
        if len(measured) == 0 or _rms(measured) < LEAST_TORQUE * arm.effort_limits[j]:
            trust[j] = 0.0
        elif _rms(measured - predicted) > 0.98 * _rms(measured):
            power = np.sum(predicted**2)
            trust[j] = float(np.clip(measured @ predicted / power, 0.0, 1.0)) if power > 0 else 1.0
    return trust


def _cross_validate(problem: StaticProblem, progress: Callable[[float], None]) -> NDArray[np.float64]:
    """(m, n) residuals of ten-fold cross-validation, effects and trust chosen anew in every fold."""
    poses = len(problem.q)
    folds = np.random.default_rng(0).permutation(poses) % min(FOLDS, poses)
    residuals = np.empty_like(problem.tau)
    for fold in range(folds.max() + 1):
        rest = problem.subset(folds != fold)
        effects = select_effects(rest)
        robust = rest.fit(effects)
        trust = _trust(rest.tau, robust.fit.left_out_residuals, rest.usable & ~robust.outliers, problem.arm)
        out = problem.subset(folds == fold)
        residuals[folds == fold] = out.tau - trust * (out.regressor(effects) @ robust.fit.theta)
        progress((fold + 2) / (FOLDS + 1))
    return residuals


def _scaled(fit: LinearFit, tau: NDArray[np.float64], trust: NDArray[np.float64]) -> LinearFit:
    """The fit's residuals with each joint's prediction scaled by its trust."""
    return LinearFit(
        fit.theta,
        fit.covariance,
        tau - trust * (tau - fit.residuals),
        tau - trust * (tau - fit.left_out_residuals),
    )


def _statistics(
    recording: Recording,
    arm: Arm,
    fit: LinearFit,
    validated: NDArray[np.float64],
    usable: NDArray[np.bool_],
    trust: NDArray[np.float64],
) -> list[JointStatistics]:
    tau = recording.measured_effort()
    statistics = []
    for j, name in enumerate(arm.joint_names):
        use = usable[:, j]
        lower, upper = recording.q[:, j].min(), recording.q[:, j].max()
        statistics.append(
            JointStatistics(
                name=name,
                rms_zero_torque=_rms(tau[:, j]),
                rms_fit=_rms(fit.residuals[:, j]),
                rms_leave_one_out=_rms(fit.left_out_residuals[:, j]),
                rms_zero_torque_undoubted=_rms(tau[use, j]),
                rms_fit_undoubted=_rms(fit.residuals[use, j]),
                rms_leave_one_out_undoubted=_rms(fit.left_out_residuals[use, j]),
                rms_cross_validation_undoubted=_rms(validated[use, j]),
                num_doubted=int(np.sum(~use)),
                trust=float(trust[j]),
                position_lower=float(lower),
                position_upper=float(upper),
                coverage=float((upper - lower) / (arm.position_upper[j] - arm.position_lower[j])),
            )
        )
    return statistics


def _estimate(value: float, standard_error: float) -> tuple[float, float, bool]:
    return float(value), float(standard_error), bool(abs(value) > 2 * standard_error)


def _rms(values: NDArray[np.float64]) -> float:
    return float(np.sqrt(np.mean(values**2))) if len(values) else 0.0
