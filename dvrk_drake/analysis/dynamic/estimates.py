"""What an identification found, parameter by parameter with standard errors, from the fit and its covariance."""

from __future__ import annotations

import numpy as np
import sympy
from numpy.typing import NDArray

from dvrk_drake.analysis.dynamic.parameter_uncertainty import ParameterUncertainty
from dvrk_drake.analysis.dynamic.problem import ConsistentFit, DynamicProblem
from dvrk_drake.dynamics.dynamic_base_parameters import derive_base_parameters
from dvrk_drake.dynamics.dynamic_regressor import DynamicRegressor
from dvrk_drake.dynamics.dynamic_section import (
    CorrelatedEstimates,
    DynamicSection,
    LinkEstimate,
    MotionParameterEstimate,
)
from dvrk_drake.dynamics.gravity_regressor import GRAVITY, SymbolicGravity, derive_gravity
from dvrk_drake.dynamics.identified_model import BaseParameterEstimate
from dvrk_drake.dynamics.inertial_parameters import pseudo_inertia
from dvrk_drake.dynamics.physical_consistency import reached_bounds
from dvrk_drake.models.arm import Arm

#: A base parameter of which the motion took away less than this share of the prior's variance is not told by it.
LEAST_TOLD = 0.5
#: What rubs at any speed: `dry_friction` sums these up.
DRY_KINDS = ("coulomb", "presliding")


class DynamicEstimates:
    """The estimates of one fit."""

    def __init__(self, problem: DynamicProblem, fit: ConsistentFit, covariance: NDArray[np.float64]) -> None:
        """covariance: (p + e, p + e) of `fit.x`, see `parameter_covariance`."""
        self._problem, self._fit, self._covariance = problem, fit, covariance
        self._prior = np.linalg.inv(fit.prior_precision)
        self._effects = [problem.columns.effects[k] for k in fit.chosen]

    def links(self) -> list[LinkEstimate]:
        """Of every link."""
        estimates = []
        for k, link in enumerate(self._problem.regressor.links):
            chosen = slice(10 * k, 10 * k + 10)
            x, variance = self._fit.x[chosen], np.diag(self._covariance)[chosen]
            estimates.append(
                LinkEstimate(
                    link.link,
                    [float(v) for v in x],
                    float(np.linalg.eigvalsh(pseudo_inertia(x))[0]),
                    [float(v) for v in np.sqrt(variance)],
                    _told(variance[0], self._prior[10 * k, 10 * k]),
                    reached_bounds(x, link, self._problem.boxes[link.link]),
                )
            )
        return estimates

    def base_parameters(self) -> tuple[list[MotionParameterEstimate], list[CorrelatedEstimates]]:
        """Of the base parameters, and which of them are hardly told apart from each other or from an effect."""
        problem, p = self._problem, self._problem.num_rigid
        base = derive_base_parameters(problem.regressor, coupled_rotors=False)
        B = base.combination
        values = B @ self._fit.x[:p]
        before = np.einsum("bp,pq,bq->b", B, self._prior[:p, :p], B)
        # Of the effects those that are there: beside their bound, 0, they tell nothing.
        there = p + np.flatnonzero(self._fit.x[p:] != 0)
        to_all = np.zeros((len(B) + len(there), len(self._fit.x)))
        to_all[: len(B), :p] = B
        to_all[len(B) + np.arange(len(there)), there] = 1.0
        names = (*base.base.names, *(str(self._effects[k - p]) for k in there))
        uncertainty = ParameterUncertainty.of_covariance(names, to_all @ self._covariance @ to_all.T)
        estimates = [
            MotionParameterEstimate(name, unit, float(value), float(error), _told(error**2, variance))
            for name, unit, value, error, variance in zip(
                base.base.names, base.base.units, values, uncertainty.standard_errors, before, strict=False
            )
        ]
        told = {estimate.name for estimate in estimates if estimate.told >= LEAST_TOLD}
        pairs = uncertainty.strong_correlations()
        return estimates, [
            CorrelatedEstimates(pair.first, pair.second, pair.correlation) for pair in pairs if pair.first in told
        ]

    def dry_friction(self) -> dict[str, tuple[float, float]]:
        """Coordinate -> size of the dry friction in both directions, Coulomb and presliding, and its standard error."""
        p = self._problem.num_rigid
        friction = {}
        for name in dict.fromkeys(effect.coordinate for effect in self._effects):
            which = [
                p + k
                for k, effect in enumerate(self._effects)
                if effect.coordinate == name and effect.kind in DRY_KINDS
            ]
            if which:
                variance = float(np.sum(self._covariance[np.ix_(which, which)]))
                friction[name] = float(np.sum(self._fit.x[which])), variance**0.5
        return friction


def _told(variance: float, before: float) -> float:
    return float(np.clip(1 - variance / before, 0.0, 1.0))


def base_parameter_estimates(
    arm: Arm, section: DynamicSection, regressor: DynamicRegressor, covariance: NDArray[np.float64]
) -> list[BaseParameterEstimate]:
    """Base parameters of the section's links, with standard errors.

    Args:
        arm: mounted as the section says.
        section: the identified dynamics.
        regressor: of that arm.
        covariance: of the links' parameters, which come first.
    """
    gravity = derive_gravity(arm)
    B = base_parameter_map(gravity, regressor)
    phi = np.concatenate([link.parameters for link in section.links])
    values = B @ phi
    errors = np.sqrt(np.diag(B @ covariance[: len(phi), : len(phi)] @ B.T))
    return [
        BaseParameterEstimate(name, float(value), float(error), bool(abs(value) > 2 * error))
        for name, value, error in zip(gravity.base.names, values, errors, strict=True)
    ]


def base_parameter_map(gravity: SymbolicGravity, regressor: DynamicRegressor) -> NDArray[np.float64]:
    """(b, 10 links) B with beta = B phi: both regressors give the torque that holds the arm, at all poses."""
    arm = gravity.arm
    q = np.random.default_rng(0).uniform(-1, 1, (60, arm.num_joints))
    Y = sympy.lambdify(
        gravity.q, gravity.regressor.subs(GRAVITY, gravity.gravity_magnitude).tolist(), "numpy", cse=True
    )
    ours = np.array([Y(*pose) for pose in q], dtype=float).reshape(-1, len(gravity.base.names))
    rest = np.zeros_like(q)
    full = regressor.regressor(q, rest, rest)[..., : 10 * len(regressor.links)]
    B = np.linalg.lstsq(ours, full.reshape(len(ours), -1), rcond=None)[0]
    return np.where(np.abs(B) < 1e-12, 0.0, B)
