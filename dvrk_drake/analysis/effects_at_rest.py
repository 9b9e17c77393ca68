"""Corrects the holding torque of a model that was identified from motions, with static poses of the same arm."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.analysis.estimation.estimator import Estimator, Prior
from dvrk_drake.analysis.estimation.normal_equations import NormalEquations, fold_sums
from dvrk_drake.analysis.estimation.robust_fit import FOLDS, blocks
from dvrk_drake.analysis.pose_identification import MIN_MOTION, StaticIdentification
from dvrk_drake.analysis.results import NEGLIGIBLE
from dvrk_drake.dynamics.actuator_effects import ActuatorEffect, distinct_coordinates, position_along, spring_over
from dvrk_drake.dynamics.dynamic_model import ROUNDING_EFFORT
from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.models.effects_schema import EFFECT_KINDS, DriveEffect

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
