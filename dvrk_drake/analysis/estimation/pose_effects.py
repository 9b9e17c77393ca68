"""Selects the effects (offsets, cables and springs) of a static model by cross-validation."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.analysis.estimation.robust_fit import RobustFit, robust_fit
from dvrk_drake.dynamics.actuator_effects import (
    ActuatorEffect,
    effect_column,
    is_prismatic,
    joint_row,
    position_along,
    spring_over,
)
from dvrk_drake.dynamics.holding_torque import StaticModel, static_model
from dvrk_drake.models.arm import Arm

#: Prior standard deviation of a base parameter, as a share of the value at which this parameter alone produces the
#: effort limit of a joint. That value is then at four standard deviations, because motors also accelerate the arm. Half
#: the value increases the mean cross-validated errors of three public recordings of poses by 0.1 to 0.7 percentage
#: points, twice the value changes them by at most 0.1.
BASE_PRIOR = 0.25
#: Prior standard deviation of the effort of an effect, as a share of the effort limit along the effect's coordinate.
#: The value for offsets is small: over a narrow range of positions, a large offset would replace gravity in the fit,
#: and the model would be wrong outside this range. A cable or a spring may balance a part of gravity; the effort limit
#: is at three standard deviations.
EFFECT_PRIOR = {"offset": 0.03, "cable sine": 0.3, "cable cosine": 0.3, "spring": 0.3}
#: RMS torque below which a torque is small, as a share of the effort limit. It is twice the standard deviation of a
#: measurement that the design of poses assumes (`EFFORT_ERROR`).
MIN_TORQUE = 0.02
#: Smallest standard deviation of a torque measurement, as a share of the effort limit. It is a quarter of the smallest
#: RMS residual of the public poses `mtm_2015_good72`, so it only applies if a few poses fit almost exactly. Half or
#: twice the value changes these errors by at most 0.03 percentage points.
SIGMA_FLOOR = 2e-3
#: Smallest reduction of the sum of squared leave-one-out residuals [sigma^2] by an added effect, per coefficient. The
#: value is about the logarithm of the number of poses.
MIN_GAIN = 4.0
#: Smallest ratio of this reduction to its standard error over the poses. An effect that does not exist exceeds it with
#: a probability of 7 %. Half the value increases one of these errors by 0.2 percentage points, twice the value another
#: one by 3.8.
MIN_SIGNIFICANCE = 1.5
#: Smallest range of a coordinate for adding a cable or a spring [rad]. Within a smaller range, a sine or a spring would
#: fit the position errors of the arm's controller, and a cosine would be almost equal to an offset.
MIN_RANGE = {"cable sine": 0.25, "cable cosine": 1.5, "spring": 0.25}
#: Smallest range of a joint for adding a second harmonic of its position [rad]: one period. Within a smaller range, the
#: second harmonic is almost a combination of an offset and the first one.
MIN_SECOND_RANGE = np.pi


class StaticProblem:
    """Regression of joint torques on base parameters and effects."""

    def __init__(self, arm: Arm, q: NDArray[np.float64], tau: NDArray[np.float64], usable: NDArray[np.bool_]):
        """Constructs the problem.

        Args:
            arm: Arm that was recorded.
            q: Poses (m, n) [rad, m].
            tau: Joint torques (m, n) [N m, N].
            usable: Mask (m, n) of the measurements that are not excluded.
        """
        self.arm, self.q, self.tau, self.usable = arm, q, tau, usable
        self.base_model = static_model(arm)
        self._Y = self.base_model.regressor(q)
        self.sigma_floor = SIGMA_FLOOR * arm.effort_limits

    def subset(self, rows: NDArray[np.bool_]) -> StaticProblem:
        """Returns the problem for the poses in the mask `rows` (m,)."""
        return StaticProblem(self.arm, self.q[rows], self.tau[rows], self.usable[rows])

    def regressor(self, effects: Sequence[ActuatorEffect]) -> NDArray[np.float64]:
        """Returns the regressor (m, n, b + e) of the base parameters and the effects."""
        X = np.zeros((*self.tau.shape, self._Y.shape[2] + len(effects)))
        X[..., : self._Y.shape[2]] = self._Y
        for column, effect in enumerate(effects, start=self._Y.shape[2]):
            X[..., column] = effect_column(self.arm, effect, self.q)
        return X

    def prior_precision(self, effects: Sequence[ActuatorEffect]) -> NDArray[np.float64]:
        """Returns the reciprocal prior variances (b + e,) of base parameters and effects. The prior means are 0."""
        effect_sd = [
            EFFECT_PRIOR[effect.kind] * _effort_limit(self.arm, effect.coordinate) / _largest_shape(effect)
            for effect in effects
        ]
        sd = np.concatenate([BASE_PRIOR * _largest_base_parameters(self.base_model), effect_sd])
        return 1 / sd**2

    def fit(
        self, effects: Sequence[ActuatorEffect], iterations: int = 12, start: NDArray[np.float64] | None = None
    ) -> RobustFit:
        """Returns the robust fit of base parameters and effects with priors, see `robust_fit` for `start` (n,)."""
        X, prior = self.regressor(effects), self.prior_precision(effects)
        return robust_fit(X, self.tau, self.usable, prior, self.sigma_floor, iterations, start)


def candidate_effects(problem: StaticProblem) -> list[list[ActuatorEffect]]:
    """Returns groups of candidate effects, for each joint: offset and cables, second harmonic, spring of its actuator.

    All candidates are identifiable from the poses. A spring is a candidate if the arm file lists it for the actuator
    (`motion.known_effects`). Other effects at actuators are not candidates, because they increase the error on MTM
    recordings that are not used for the fit.
    """
    arm, groups = problem.arm, []
    for joint in arm.joint_names:
        name = f"joint.{joint}"
        effects = [ActuatorEffect(name, "offset"), *_cables(problem, name)]
        groups += [
            [e for e in effects if not _is_equal_to_gravity(problem.base_model, e)],
            _second_harmonic(problem, name),
            _known_spring(problem, joint),
        ]
    return groups


def _known_spring(problem: StaticProblem, joint: str) -> list[ActuatorEffect]:
    name = f"actuator.{joint}"
    if "spring" not in problem.arm.identification.known_effects.get(name, []):
        return []
    x = position_along(problem.arm, name, problem.q)
    return [spring_over(name, x)] if np.ptp(x) >= MIN_RANGE["spring"] else []


def _cables(problem: StaticProblem, coordinate: str) -> list[ActuatorEffect]:
    if is_prismatic(problem.arm, coordinate):
        return []
    span = np.ptp(position_along(problem.arm, coordinate, problem.q))
    kinds = ("cable sine", "cable cosine")
    return [ActuatorEffect(coordinate, kind, 1.0) for kind in kinds if span >= MIN_RANGE[kind]]


def _second_harmonic(problem: StaticProblem, coordinate: str) -> list[ActuatorEffect]:
    if is_prismatic(problem.arm, coordinate):
        return []
    if np.ptp(position_along(problem.arm, coordinate, problem.q)) < MIN_SECOND_RANGE:
        return []
    return [ActuatorEffect(coordinate, kind, 2.0) for kind in ("cable sine", "cable cosine")]


def select_effects(problem: StaticProblem) -> tuple[ActuatorEffect, ...]:
    """Selects the effects by stepwise reduction of the leave-one-out error.

    Each step adds one effect, or all effects of one group, depending on which reduces the error most. A reduction is
    significant if it is at least `MIN_GAIN` per coefficient and at least `MIN_SIGNIFICANCE` times its standard error
    over the poses. The selection ends if no reduction is significant. Each squared error is limited to nine times the
    residual variance, so that no single pose dominates the selection.
    """
    selected: tuple[ActuatorEffect, ...] = ()
    current = problem.fit(selected)
    groups = candidate_effects(problem)
    while True:
        loss = _loss(problem, current, current.sigma)
        best_gain = 0.0
        best: tuple[ActuatorEffect, ...] = ()
        for group in groups:
            new = [e for e in group if e not in selected and not _is_redundant(e, selected)]
            candidates: list[tuple[ActuatorEffect, ...]] = [(e,) for e in new] + ([tuple(new)] if len(new) > 1 else [])
            for candidate in candidates:
                trial = problem.fit((*selected, *candidate), iterations=3, start=current.sigma)
                gains = loss - _loss(problem, trial, current.sigma)
                gain = gains.sum()
                error = gains.std() * np.sqrt(len(gains))
                significant = gain > MIN_SIGNIFICANCE * error and gain > MIN_GAIN * len(candidate)
                if significant and gain > best_gain:
                    best_gain, best = gain, candidate
        if not best:
            return tuple(effect for group in groups for effect in group if effect in selected)
        selected = (*selected, *best)
        current = problem.fit(selected)


def _is_redundant(effect: ActuatorEffect, selected: Sequence[ActuatorEffect]) -> bool:
    """Returns whether the effect is a spring at a joint with a selected cable, or a cable at one with a spring."""
    joint = effect.coordinate.partition(".")[2]
    kinds = {e.kind.partition(" ")[0] for e in selected if e.coordinate.partition(".")[2] == joint}
    return (effect.kind == "spring" and "cable" in kinds) or (effect.kind.startswith("cable") and "spring" in kinds)


def _loss(problem: StaticProblem, fit: RobustFit, sigma: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns the limited squared leave-one-out errors (m,) of the poses, summed over the joints [sigma^2]."""
    return (np.minimum((fit.fit.leave_one_out_residuals / sigma) ** 2, 9.0) * problem.usable).sum(axis=1)


@cache
def _largest_base_parameters(model: StaticModel) -> NDArray[np.float64]:
    """Returns the values (b,) at which each base parameter alone produces the effort limit of a joint in some pose."""
    arm = model.gravity.arm
    q = np.random.default_rng(0).uniform(arm.position_lower, arm.position_upper, (3000, arm.num_joints))
    largest = np.abs(model.regressor(q)).max(axis=0)
    limits = np.where(largest > 1e-9, arm.effort_limits[:, None] / np.maximum(largest, 1e-9), np.inf)
    return limits.min(axis=0)


@cache
def _is_equal_to_gravity(model: StaticModel, effect: ActuatorEffect) -> bool:
    """Returns whether the effect is a linear combination of gravity torques and therefore not identifiable."""
    arm = model.gravity.arm
    poses = arm.sample_poses(100, np.random.default_rng(0))
    Y = model.regressor(poses).reshape(-1, len(model.gravity.base.names))
    column = effect_column(arm, effect, poses)
    residual = column.ravel() - Y @ np.linalg.lstsq(Y, column.ravel(), rcond=None)[0]
    return bool(np.linalg.norm(residual) < 1e-9 * np.linalg.norm(column))


def _largest_shape(effect: ActuatorEffect) -> float:
    """Returns the largest effort of the effect for a coefficient of 1."""
    return effect.scale if effect.kind == "spring" else 1.0


def _effort_limit(arm: Arm, coordinate: str) -> float:
    """Returns the largest effort along the coordinate within the effort limits of all joints [N m, N]."""
    row = np.abs(joint_row(arm, coordinate))
    return float(np.min(arm.effort_limits[row > 1e-9] / row[row > 1e-9]))
