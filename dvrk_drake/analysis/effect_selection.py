"""Which joint effects a static recording supports, chosen by cross-validation."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache

import numpy as np
import sympy
from numpy.typing import NDArray

from dvrk_drake.analysis.linear_fit import RobustFit, robust_fit
from dvrk_drake.dynamics.joint_effects import EFFECT_KINDS, JointEffect, kinds_of
from dvrk_drake.dynamics.static_model import StaticModel, compile_static_model
from dvrk_drake.models.arm import Arm

#: Prior standard deviation of a base parameter, as a share of what would use up some joint's effort limit by itself.
BASE_PRIOR = 0.25
#: Prior standard deviation of a joint effect, as a share of the joint's effort limit. Offsets are kept small: over a
#: narrow range a large one would take the place of gravity, and mislead outside of it.
EFFECT_PRIOR = {"offset": 0.03, "spring": 0.3}
#: Least standard deviation of a torque measurement, as a share of the effort limit.
SIGMA_FLOOR = 2e-3
#: An effect must lower the sum of squared left-out residuals (in sigma) by this much a coefficient: about log(poses).
LEAST_GAIN = 4.0
#: And by this many of its own standard errors over poses.
LEAST_SIGNIFICANCE = 1.5
#: A position-dependent effect is considered if the joint moved by this much [rad]; else it would fit servo error.
LEAST_SPAN = 0.25


class StaticProblem:
    """The regression of one recording's torques on base parameters and any choice of joint effects."""

    def __init__(self, arm: Arm, q: NDArray[np.float64], tau: NDArray[np.float64], usable: NDArray[np.bool_]):
        """Of poses q (m, n) and torques tau (m, n) with `usable` (m, n) False where a measurement is doubted."""
        self.arm, self.q, self.tau, self.usable = arm, q, tau, usable
        self.base_model = compile_static_model(arm)
        self._Y = self.base_model.regressor(q)
        self.sigma_floor = SIGMA_FLOOR * arm.effort_limits

    def subset(self, rows: NDArray[np.bool_]) -> StaticProblem:
        """The problem of some of the poses."""
        return StaticProblem(self.arm, self.q[rows], self.tau[rows], self.usable[rows])

    def regressor(self, effects: Sequence[JointEffect]) -> NDArray[np.float64]:
        """X (m, n, b + e)."""
        X = np.zeros((*self.tau.shape, self._Y.shape[2] + len(effects)))
        X[..., : self._Y.shape[2]] = self._Y
        for column, effect in enumerate(effects, start=self._Y.shape[2]):
            joint = self.arm.joint_names.index(effect.joint)
            X[:, joint, column] = _numeric(effect.kind)(self.q[:, joint])
        return X

    def prior_precision(self, effects: Sequence[JointEffect]) -> NDArray[np.float64]:
        """(b + e,) inverse prior variances about zero."""
        limit = dict(zip(self.arm.joint_names, self.arm.effort_limits, strict=True))
        effect_sd = [EFFECT_PRIOR[effect.kind] * limit[effect.joint] for effect in effects]
        sd = np.concatenate([BASE_PRIOR * _largest_base_parameters(self.base_model), effect_sd])
        return 1 / sd**2

    def fit(
        self, effects: Sequence[JointEffect], iterations: int = 12, start: NDArray[np.float64] | None = None
    ) -> RobustFit:
        """Robust, shrunk fit with the given effects; `start` (n,) as in `robust_fit`."""
        X, prior = self.regressor(effects), self.prior_precision(effects)
        return robust_fit(X, self.tau, self.usable, prior, self.sigma_floor, iterations, start)


def select_effects(problem: StaticProblem) -> tuple[JointEffect, ...]:
    """Adds the effect (or all of one joint's) that lowers the leave-one-out error most, until none clearly does.

    "Clearly": by more than `LEAST_GAIN` per coefficient and by more than 1.5 of the gain's own standard errors over
    poses. Squared errors are capped at nine variances so that no single pose decides.
    """
    chosen: tuple[JointEffect, ...] = ()
    current = problem.fit(chosen)
    span = np.ptp(problem.q, axis=0)
    while True:
        loss = _loss(problem, current, current.sigma)
        best_gain = 0.0
        best: tuple[JointEffect, ...] = ()
        for joint, name in enumerate(problem.arm.joint_names):
            possible = kinds_of(bool(problem.arm.prismatic[joint]))
            kinds = [k for k in possible if k == "offset" or span[joint] >= LEAST_SPAN]
            possible_effects = (JointEffect(name, k) for k in kinds)
            new = [e for e in possible_effects if e not in chosen and not _is_gravity_too(problem.base_model, e)]
            candidates: list[tuple[JointEffect, ...]] = [(e,) for e in new] + ([tuple(new)] if len(new) > 1 else [])
            for candidate in candidates:
                trial = problem.fit((*chosen, *candidate), iterations=3, start=current.sigma)
                gains = loss - _loss(problem, trial, current.sigma)
                gain = gains.sum()
                clear = gain > LEAST_SIGNIFICANCE * gains.std() * np.sqrt(len(gains)) and gain > LEAST_GAIN * len(
                    candidate
                )
                if clear and gain > best_gain:
                    best_gain, best = gain, candidate
        if not best:
            order = {name: i for i, name in enumerate(problem.arm.joint_names)}
            return tuple(sorted(chosen, key=lambda e: (order[e.joint], e.kind)))
        chosen = (*chosen, *best)
        current = problem.fit(chosen)


def _loss(problem: StaticProblem, fit: RobustFit, sigma: NDArray[np.float64]) -> NDArray[np.float64]:
    """(m,) capped squared leave-one-out error of each pose in units of sigma."""
    return (np.minimum((fit.fit.left_out_residuals / sigma) ** 2, 9.0) * problem.usable).sum(axis=1)


@cache
def _largest_base_parameters(model: StaticModel) -> NDArray[np.float64]:
    """(b,) size at which each base parameter alone would need some joint's whole effort limit somewhere in the box."""
    arm = model.gravity.arm
    q = np.random.default_rng(0).uniform(arm.position_lower, arm.position_upper, (3000, arm.num_joints))
    largest = np.abs(model.regressor(q)).max(axis=0)
    limits = np.where(largest > 1e-9, arm.effort_limits[:, None] / np.maximum(largest, 1e-9), np.inf)
    return limits.min(axis=0)


@cache
def _is_gravity_too(model: StaticModel, effect: JointEffect) -> bool:
    """Whether no measurement could tell the effect from gravity, as a spring at a yaw joint that lifts weight."""
    arm = model.gravity.arm
    poses = arm.sample_poses(100, np.random.default_rng(0))
    Y = model.regressor(poses).reshape(-1, len(model.gravity.base.names))
    joint = arm.joint_names.index(effect.joint)
    column = np.zeros((len(poses), arm.num_joints))
    column[:, joint] = _numeric(effect.kind)(poses[:, joint])
    rest = column.ravel() - Y @ np.linalg.lstsq(Y, column.ravel(), rcond=None)[0]
    return bool(np.linalg.norm(rest) < 1e-9 * np.linalg.norm(column))


@cache
def _numeric(kind: str):
    q = sympy.Symbol("q")
    function = sympy.lambdify(q, EFFECT_KINDS[kind](q), modules="numpy")
    return lambda values: np.broadcast_to(function(values), values.shape)
