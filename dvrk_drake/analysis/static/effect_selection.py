"""Selects the joint effects of a static model by cross-validation."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.analysis.static.linear_fit import RobustFit, robust_fit
from dvrk_drake.dynamics.actuator_effects import (
    ActuatorEffect,
    is_prismatic,
    joint_row,
    position_along,
    spring_over,
)
from dvrk_drake.models.arm import Arm

if TYPE_CHECKING:
    from dvrk_drake.dynamics.static_model import StaticModel

#: Prior standard deviation of a base parameter, as a share of the value at which it alone reaches some joint's effort
#: limit.
BASE_PRIOR = 0.25
#: Prior standard deviation of an effect, as a share of the effort that the joint limits allow along its coordinate.
#: Offsets have a small deviation. Over a narrow range a large offset would replace gravity and be wrong outside of it.
EFFECT_PRIOR = {"offset": 0.03, "cable sine": 0.3, "cable cosine": 0.3, "spring": 0.3}
#: Least standard deviation of a torque measurement, as a share of the effort limit.
SIGMA_FLOOR = 2e-3
#: Least reduction of the sum of squared held-out residuals (in sigma) per coefficient, about log(poses).
MIN_GAIN = 4.0
#: Least reduction in standard errors over poses.
MIN_SIGNIFICANCE = 1.5
#: Least travel of a coordinate for a cable or a spring to be a candidate [rad]. Over less travel, a sine or a spring
#: would fit the servo error, and a cosine would equal an offset.
MIN_SPAN = {"cable sine": 0.25, "cable cosine": 1.5, "spring": 0.25}


class StaticProblem:
    """Regression of one recording's torques on base parameters and any set of effects."""

    def __init__(self, arm: Arm, q: NDArray[np.float64], tau: NDArray[np.float64], usable: NDArray[np.bool_]):
        """Constructs the problem for poses q (m, n) and torques tau (m, n). `usable` (m, n) is False if excluded."""
        from dvrk_drake.dynamics.static_model import compile_static_model  # sympy takes 0.3 s, and motions need none

        self.arm, self.q, self.tau, self.usable = arm, q, tau, usable
        self.base_model = compile_static_model(arm)
        self._Y = self.base_model.regressor(q)
        self.sigma_floor = SIGMA_FLOOR * arm.effort_limits

    def subset(self, rows: NDArray[np.bool_]) -> StaticProblem:
        """Returns the problem for a subset of the poses."""
        return StaticProblem(self.arm, self.q[rows], self.tau[rows], self.usable[rows])

    def regressor(self, effects: Sequence[ActuatorEffect]) -> NDArray[np.float64]:
        """Returns the regressor X (m, n, b + e)."""
        X = np.zeros((*self.tau.shape, self._Y.shape[2] + len(effects)))
        X[..., : self._Y.shape[2]] = self._Y
        for column, effect in enumerate(effects, start=self._Y.shape[2]):
            X[..., column] = effect_column(self.arm, effect, self.q)
        return X

    def prior_precision(self, effects: Sequence[ActuatorEffect]) -> NDArray[np.float64]:
        """Returns the reciprocal prior variances (b + e,) about zero."""
        effect_sd = [
            EFFECT_PRIOR[effect.kind] * _effort_limit(self.arm, effect.coordinate) / _largest_shape(effect)
            for effect in effects
        ]
        sd = np.concatenate([BASE_PRIOR * _largest_base_parameters(self.base_model), effect_sd])
        return 1 / sd**2

    def fit(
        self, effects: Sequence[ActuatorEffect], iterations: int = 12, start: NDArray[np.float64] | None = None
    ) -> RobustFit:
        """Returns the robust fit with shrinkage for the given effects; `start` (n,) as in `robust_fit`."""
        X, prior = self.regressor(effects), self.prior_precision(effects)
        return robust_fit(X, self.tau, self.usable, prior, self.sigma_floor, iterations, start)


def candidate_effects(problem: StaticProblem) -> list[list[ActuatorEffect]]:
    """Returns groups of candidate effects per joint that the poses can identify: an offset, a cable, a spring.

    A spring is a candidate if the arm file lists it for the joint's drive (`motion.known_effects`). Other coordinates
    of the transmission are not candidates, because they slightly increase the error on other MTM recordings.
    """
    arm, groups = problem.arm, []
    for joint in arm.joint_names:
        name = f"joint.{joint}"
        effects = [ActuatorEffect(name, "offset"), *_cables(problem, name)]
        groups += [[e for e in effects if not _is_gravity_too(problem.base_model, e)], _known_spring(problem, joint)]
    return groups


def _known_spring(problem: StaticProblem, joint: str) -> list[ActuatorEffect]:
    name = f"actuator.{joint}"
    if "spring" not in problem.arm.identification.known_effects.get(name, []):
        return []
    x = position_along(problem.arm, name, problem.q)
    return [spring_over(name, x)] if np.ptp(x) >= MIN_SPAN["spring"] else []


def _cables(problem: StaticProblem, coordinate: str) -> list[ActuatorEffect]:
    if is_prismatic(problem.arm, coordinate):
        return []
    span = np.ptp(position_along(problem.arm, coordinate, problem.q))
    kinds = ("cable sine", "cable cosine")
    return [ActuatorEffect(coordinate, kind, 1.0) for kind in kinds if span >= MIN_SPAN[kind]]


def select_effects(problem: StaticProblem) -> tuple[ActuatorEffect, ...]:
    """Adds the effect, or all effects of one joint, that reduces the leave-one-out error most, while it is significant.

    A reduction is significant if it exceeds `MIN_GAIN` per coefficient and `MIN_SIGNIFICANCE` standard errors over
    poses. Squared errors are limited to nine variances, so that no single pose decides.
    """
    chosen: tuple[ActuatorEffect, ...] = ()
    current = problem.fit(chosen)
    groups = candidate_effects(problem)
    while True:
        loss = _loss(problem, current, current.sigma)
        best_gain = 0.0
        best: tuple[ActuatorEffect, ...] = ()
        for group in groups:
            new = [e for e in group if e not in chosen and not _says_the_same(e, chosen)]
            candidates: list[tuple[ActuatorEffect, ...]] = [(e,) for e in new] + ([tuple(new)] if len(new) > 1 else [])
            for candidate in candidates:
                trial = problem.fit((*chosen, *candidate), iterations=3, start=current.sigma)
                gains = loss - _loss(problem, trial, current.sigma)
                gain = gains.sum()
                clear = gain > MIN_SIGNIFICANCE * gains.std() * np.sqrt(len(gains)) and gain > MIN_GAIN * len(candidate)
                if clear and gain > best_gain:
                    best_gain, best = gain, candidate
        if not best:
            return tuple(effect for group in groups for effect in group if effect in chosen)
        chosen = (*chosen, *best)
        current = problem.fit(chosen)


def _says_the_same(effect: ActuatorEffect, chosen: Sequence[ActuatorEffect]) -> bool:
    """Returns whether `chosen` has a cable for this spring, or a spring for this cable, at the same joint."""
    joint = effect.coordinate.partition(".")[2]
    laws = {e.kind.partition(" ")[0] for e in chosen if e.coordinate.partition(".")[2] == joint}
    return (effect.kind == "spring" and "cable" in laws) or (effect.kind.startswith("cable") and "spring" in laws)


def _loss(problem: StaticProblem, fit: RobustFit, sigma: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns the limited squared leave-one-out error (m,) of each pose in units of sigma."""
    return (np.minimum((fit.fit.leave_one_out_residuals / sigma) ** 2, 9.0) * problem.usable).sum(axis=1)


@cache
def _largest_base_parameters(model: StaticModel) -> NDArray[np.float64]:
    """Returns the size (b,) at which each base parameter alone reaches a joint's effort limit in some pose."""
    arm = model.gravity.arm
    q = np.random.default_rng(0).uniform(arm.position_lower, arm.position_upper, (3000, arm.num_joints))
    largest = np.abs(model.regressor(q)).max(axis=0)
    limits = np.where(largest > 1e-9, arm.effort_limits[:, None] / np.maximum(largest, 1e-9), np.inf)
    return limits.min(axis=0)


@cache
def _is_gravity_too(model: StaticModel, effect: ActuatorEffect) -> bool:
    """Returns whether the effect cannot be separated from gravity by any measurement.

    An example is a spring at a yaw joint that lifts weight.
    """
    arm = model.gravity.arm
    poses = arm.sample_poses(100, np.random.default_rng(0))
    Y = model.regressor(poses).reshape(-1, len(model.gravity.base.names))
    column = effect_column(arm, effect, poses)
    rest = column.ravel() - Y @ np.linalg.lstsq(Y, column.ravel(), rcond=None)[0]
    return bool(np.linalg.norm(rest) < 1e-9 * np.linalg.norm(column))


def effect_column(arm: Arm, effect: ActuatorEffect, q: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns the joint torques (m, n) of a position-dependent effect at poses q (m, n), for a coefficient of 1."""
    x = position_along(arm, effect.coordinate, q)
    return effect.column(x, 0 * x)[:, None] * joint_row(arm, effect.coordinate)


def _largest_shape(effect: ActuatorEffect) -> float:
    """Returns the largest effort of the effect per unit of its coefficient."""
    return effect.scale if effect.kind == "spring" else 1.0


def _effort_limit(arm: Arm, coordinate: str) -> float:
    """Returns the largest effort along the coordinate that is within the limits of all joints."""
    row = np.abs(joint_row(arm, coordinate))
    return float(np.min(arm.effort_limits[row > 1e-9] / row[row > 1e-9]))
