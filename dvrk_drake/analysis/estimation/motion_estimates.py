"""Computes the standard errors and correlations of identified parameters."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from dvrk_drake.analysis.estimation.motion_columns import RecordingEffect
from dvrk_drake.analysis.estimation.motion_problem import ConsistentFit, DynamicProblem
from dvrk_drake.analysis.estimation.normal_equations import NormalEquations
from dvrk_drake.analysis.observations.signals import correlation
from dvrk_drake.dynamics.dynamic_regressor import derive_base_parameters
from dvrk_drake.dynamics.dynamic_section import (
    CorrelatedEstimates,
    DynamicSection,
    LinkEstimate,
    MotionParameterEstimate,
)
from dvrk_drake.dynamics.gravity_parameters import gravity_parameters
from dvrk_drake.dynamics.identified_model import BaseParameterEstimate
from dvrk_drake.dynamics.physical_consistency import reached_bounds
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.effects_schema import EFFECT_KINDS

#: Largest absolute correlation of two parameters that are identifiable separately. At this value, the standard error of
#: each is 1 / sqrt(1 - 0.95^2) = 3.2 times that with the other parameter known.
STRONG_CORRELATION = 0.95


#: Largest time lag at which effort errors are assumed to be correlated [s]. If the motion repeats, errors at lags near
#: whole periods are also correlated. Half or twice the value changes the median standard error for the public
#: motions `mtm_one` and `psm_one` by less than 2 %.
MAX_CORRELATION_TIME = 1.0
#: Degrees of freedom of a variance that is estimated with a Parzen window, times the largest lag of the window, divided
#: by the duration (Priestley, "Spectral Analysis and Time Series", 1981, table 6.2).
PARZEN_FREEDOM = 3.71
#: Ratio of two rates: the rate of the rows from which the covariance is computed, and twice the cut-off frequency of
#: the low-pass filter. The gain of the filter is 2e-4 at half the rate of the rows.
_OVERSAMPLING = 2.0
#: Smallest number of directions from which the size of the deviations from the SDF is estimated, and largest variance
#: of the noise in such a direction, as a share of the prior variance. Half or twice these values change the median
#: standard error for the public motions `mtm_one` and `psm_one` by less than 4 %.
_MIN_DIRECTIONS, _MAX_NOISE = 5, 0.1
#: Smallest accepted ratio of the variance of the deviations from the SDF to the prior variance. A smaller estimate may
#: be due to chance: with five directions, its relative standard error is sqrt(2 / 5) = 0.63.
_MIN_SCALE = 0.5


class ResidualSeries(NamedTuple):
    """Residuals of one motion, at a constant rate.

    Attributes:
        rows: Slice of the rows of the motion.
        rate: Rate of the rows [Hz].
        period: Period of the motion [s], or None if the motion does not repeat.
    """

    rows: slice
    rate: float
    period: float | None


class ParameterCovariance(NamedTuple):
    """Covariances (p + e, p + e) of the rigid-body parameters and effect coefficients.

    Attributes:
        estimates: Covariance of the estimates.
        prior: Covariance before the recording, for the size of the deviations from the SDF that the recording shows.
        degrees_of_freedom: Degrees of freedom of the standard errors.
    """

    estimates: NDArray[np.float64]
    prior: NDArray[np.float64]
    degrees_of_freedom: float


def parameter_covariance(
    problem: DynamicProblem,
    fit: ConsistentFit,
    residuals: NDArray[np.float64],
    cut_off: float,
    series: Sequence[ResidualSeries],
) -> ParameterCovariance:
    """Returns the covariance of `fit.x`, for a fixed set of effects and without inequality constraints.

    The inverse Hessian of the cost is A = (X'WX + P)^-1. The covariance is

        A (sum_i w_i^2 X_i' Omega_i X_i + P) A,

    where P is the Hessian of the priors, and X_i are the columns and w_i the weight of actuator i in one recording,
    summed over the actuators and the recordings. The block of P for
    the rigid-body parameters is multiplied by `_deviation_scale` in the second factor. Omega_i (r, r) is
    the covariance matrix of the errors of actuator i at the rows. It is estimated from the residuals. Therefore, slowly
    varying errors, for example of the friction model, count as few measurements. Errors that repeat in every period
    count once, regardless of the number of periods.

    For independent errors with variance s^2, the residuals of a fold have the covariance (I - H) s^2, where H is the
    block of the hat matrix for the fold. The residuals of a fold that is held out have the covariance (I - H)^-1 s^2.
    The covariance of the errors is therefore estimated from products of a fit residual and a held-out residual, whose
    expected value has no such factor (MacKinnon and White, "Some heteroskedasticity-consistent covariance matrix
    estimators", 1985: HC2).

    Args:
        problem: Problem that was solved.
        fit: Solution of the problem.
        residuals: Effort residuals (r, n) of the fit [N m, N].
        cut_off: Cut-off of the low-pass filter of the efforts [Hz].
        series: Rows of each motion. Errors of different motions are assumed to be independent.
    """
    A = _inverse(fit.information + fit.prior_precision)
    to_base = problem.to_base(len(fit.effects))
    middle = np.zeros((len(to_base),) * 2)
    steps = _steps_without_folds(problem, fit, residuals, to_base)
    for i, own_residuals in enumerate(residuals.T):
        own, X = problem.actuator_columns(i, fit.effects)
        held_out = own_residuals + np.einsum("rc,rc->r", X, steps[:, own][problem.fold])
        for motion in series:
            step = max(1, int(motion.rate / (2 * cut_off * _OVERSAMPLING)))
            rows = slice(motion.rows.start, motion.rows.stop, step)
            weight = fit.weights[problem.recording[motion.rows.start], i]
            covariance = error_covariance(own_residuals[rows], held_out[rows], motion.rate / step, motion.period)
            middle[own[:, None], own] += (weight * step) ** 2 * (X[rows].T @ toeplitz_product(covariance, X[rows]))
    noise = to_base.T @ middle @ to_base
    factor = np.ones(len(A))
    factor[: problem.num_rigid] = np.sqrt(_deviation_scale(fit, problem.prior, A @ noise @ A))
    scaled = fit.prior_precision * np.outer(factor, factor)
    prior = _inverse(fit.prior_precision) * np.outer(factor, factor)
    seconds = sum(min(_duration(motion), motion.period or np.inf) for motion in series)
    return ParameterCovariance(A @ (noise + scaled) @ A, prior, PARZEN_FREEDOM * seconds / MAX_CORRELATION_TIME)


def _duration(motion: ResidualSeries) -> float:
    return (motion.rows.stop - motion.rows.start) / motion.rate


def _deviation_scale(fit: ConsistentFit, mean: NDArray[np.float64], noise: NDArray[np.float64]) -> float:
    """Returns the variance of the deviations of an arm's links from the SDF, divided by the prior variance.

    The links of an arm can deviate more or less from its SDF than the prior assumes. The ratio is estimated from the
    directions in parameter space that the recording determines. Without enough such directions, it is 1.

    Args:
        fit: Solution of the problem.
        mean: Prior means (p,) of the rigid-body parameters.
        noise: Covariance of `fit.x` due to the errors of the efforts.
    """
    p = len(mean)
    P, H = fit.prior_precision[:p, :p], fit.information
    coupling = H[:p, p:] @ _inverse(H[p:, p:] + fit.prior_precision[p:, p:]) @ H[p:, :p] if len(H) > p else 0.0
    unit = 1 / np.sqrt(np.diag(P))
    information, V = scipy.linalg.eigh((H[:p, :p] - coupling) * np.outer(unit, unit), P * np.outer(unit, unit))
    to_units = (V * unit[:, None]).T @ P
    variance = np.einsum("ij,jk,ik->i", to_units, noise[:p, :p], to_units)
    shrinkage = (information / (1 + information)) ** 2
    determined = (variance < _MAX_NOISE) & (shrinkage > 1 - _MAX_NOISE)
    if np.sum(determined) < _MIN_DIRECTIONS:
        return 1.0
    squares = (to_units @ (fit.x[:p] - mean)) ** 2
    scale = np.mean(squares[determined]) / np.mean(shrinkage[determined] + variance[determined])
    return max(float(scale), _MIN_SCALE)


def _steps_without_folds(
    problem: DynamicProblem, fit: ConsistentFit, residuals: NDArray[np.float64], to_base: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Returns the changes (folds, b + e) of the unknowns with which a fit without one fold predicts this fold.

    A held-out residual is the residual of `fit` plus the effort of this change. The fit without the fold is one Newton
    step from `fit`. It does not change parameters that are at their lower bounds.
    """
    free = np.flatnonzero(fit.x > fit.lower)
    to_free = to_base[:, free]
    known = (fit.information + fit.prior_precision)[np.ix_(free, free)]
    columns = (problem.actuator_columns(i, fit.effects) for i in range(residuals.shape[1]))
    equations = NormalEquations.of(columns, len(to_base), residuals, problem.fold, recording=problem.recording)
    steps = []
    for fold in range(equations.folds):
        sums = equations.of_fold(fold).weighted(fit.weights)
        step = _inverse(known - to_free.T @ sums[:-1, :-1] @ to_free) @ (to_free.T @ sums[:-1, -1])
        steps.append(to_free @ step)
    return np.array(steps)


def error_covariance(
    fitted: NDArray[np.float64], held_out: NDArray[np.float64], rate: float, period: float | None
) -> NDArray[np.float64]:
    """Returns the autocovariance (r,) of an actuator's error, for lags of 0 to r - 1 rows.

    Up to a lag of `MAX_CORRELATION_TIME`, the result is the sample autocovariance of the error, multiplied by a Parzen
    window. For lags near a multiple of the period, the values for lags near one period are used again. This part is
    due to errors that repeat in every period.

    Args:
        fitted: Residuals (r,) of a fit to all rows.
        held_out: Held-out residuals (r,), each for a fit to the other folds.
        rate: Rate of the rows [Hz].
        period: Period of the motion [s], or None if the motion does not repeat.
    """
    count = len(fitted)
    products = correlation(fitted, held_out)
    lags = (products + products[::-1])[count - 1 :] / 2 / np.arange(count, 0, -1)
    width = min(round(MAX_CORRELATION_TIME * rate), count - 1)
    window = _parzen(np.arange(-width, width + 1) / width)
    near_zero = np.concatenate([lags[width:0:-1], lags[: width + 1]]) * window
    covariance = np.zeros(count + width)
    covariance[: width + 1] = near_zero[width:]
    shift = 0 if period is None else round(period * rate)
    if width < min(shift, count - shift):
        near_period = lags[shift - width : shift + width + 1] * window
        for start in range(shift, count + width, shift):
            end = min(start + width + 1, len(covariance))
            covariance[start - width : end] += near_period[: end - start + width]
    return _nearest_covariance(covariance[:count])


def toeplitz_product(covariance: NDArray[np.float64], X: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns C X (r, k) for the symmetric Toeplitz matrix C whose first row is `covariance` (r,), and X (r, k).

    Lags with negligible covariance are omitted. In long motions, this is faster than `scipy.linalg.matmul_toeplitz`,
    whose FFTs have twice the length of the motion.
    """
    from scipy.signal import oaconvolve  # takes 0.3 s

    if not X.size:
        return X  # an effort that was not measured has no columns, which oaconvolve does not accept
    last = int(np.max(np.flatnonzero(np.abs(covariance) > np.finfo(float).eps * covariance[0]), initial=0))
    kernel = np.concatenate([covariance[last:0:-1], covariance[: last + 1]])
    return np.asarray(oaconvolve(X, kernel[:, None], mode="same", axes=0))


def _parzen(u: NDArray[np.float64]) -> NDArray[np.float64]:
    u = np.abs(u)
    return np.asarray(np.where(u < 0.5, 1 - 6 * u**2 * (1 - u), 2 * (1 - u) ** 3))


def _nearest_covariance(covariance: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns the nearest autocovariance with a nonnegative spectrum."""
    circulant = np.concatenate([covariance, covariance[-1:0:-1]])
    spectrum = np.maximum(np.fft.rfft(circulant).real, 0.0)
    return np.asarray(np.fft.irfft(spectrum, len(circulant))[: len(covariance)], dtype=np.float64)


def _inverse(H: NDArray[np.float64]) -> NDArray[np.float64]:
    scale = 1 / np.sqrt(np.diag(H))
    return np.asarray(np.linalg.inv(H * np.outer(scale, scale)) * np.outer(scale, scale), dtype=np.float64)


#: Smallest identifiability (1 - variance / prior variance) at which a base parameter counts as identifiable. At this
#: value, the information from the motion equals that from the prior.
MIN_IDENTIFIABILITY = 0.5


def link_estimates(problem: DynamicProblem, fit: ConsistentFit, covariance: ParameterCovariance) -> list[LinkEstimate]:
    """Returns the estimates of all links, for a fit and the covariance of `fit.x`."""
    estimates = []
    for k, link in enumerate(problem.regressor.links):
        rows = slice(10 * k, 10 * k + 10)
        x, variance = fit.x[rows], np.diag(covariance.estimates)[rows]
        estimates.append(
            LinkEstimate(
                link.link,
                [float(v) for v in x],
                [float(v) for v in np.sqrt(variance)],
                _identifiability(variance[0], covariance.prior[10 * k, 10 * k]),
                reached_bounds(x, link, problem.boxes[link.link]),
            )
        )
    return estimates


def motion_parameters(
    problem: DynamicProblem, fit: ConsistentFit, covariance: ParameterCovariance
) -> tuple[list[MotionParameterEstimate], list[CorrelatedEstimates]]:
    """Returns the base parameters of the dynamics, and the pairs of estimates that are not identifiable separately.

    A pair is two base parameters, or a base parameter and an effect. Pairs whose first parameter has an identifiability
    below `MIN_IDENTIFIABILITY` are omitted.
    """
    p = problem.num_rigid
    base = derive_base_parameters(problem.regressor)
    B = base.combination
    prior_variances = np.einsum("bp,pq,bq->b", B, covariance.prior[:p, :p], B)
    # Effects with coefficient 0, which is their lower bound, are omitted.
    effects = [problem.columns.effects[k] for k in fit.effects]
    shared = [k for k, effect in enumerate(effects) if fit.x[p + k] != 0 and not isinstance(effect, RecordingEffect)]
    to_all = np.zeros((len(B) + len(shared), len(fit.x)))
    to_all[: len(B), :p] = B
    to_all[len(B) + np.arange(len(shared)), p + np.array(shared, dtype=int)] = 1.0
    of_all = to_all @ covariance.estimates @ to_all.T
    estimates = [
        MotionParameterEstimate(name, unit, float(value), float(error), _identifiability(error**2, variance))
        for name, unit, value, error, variance in zip(
            base.base.names, base.base.units, B @ fit.x[:p], np.sqrt(np.diag(of_all)), prior_variances, strict=False
        )
    ]
    identifiable = {estimate.name for estimate in estimates if estimate.identifiability >= MIN_IDENTIFIABILITY}
    pairs = strong_correlations([*base.base.names, *(str(effects[k]) for k in shared)], of_all)
    return estimates, [pair for pair in pairs if pair.first in identifiable]


def strong_correlations(names: Sequence[str], covariance: NDArray[np.float64]) -> list[CorrelatedEstimates]:
    """Returns the pairs of estimates whose absolute correlation exceeds `STRONG_CORRELATION`, the largest one first."""
    spread = np.sqrt(np.diag(covariance))
    correlation = np.triu(covariance / np.outer(spread, spread), 1)
    pairs = np.argwhere(np.abs(correlation) > STRONG_CORRELATION).tolist()
    pairs.sort(key=lambda pair: -abs(correlation[tuple(pair)]))
    return [CorrelatedEstimates(names[i], names[k], float(correlation[i, k])) for i, k in pairs]


def dry_friction(
    problem: DynamicProblem, fit: ConsistentFit, covariance: ParameterCovariance
) -> dict[str, tuple[float, float]]:
    """Returns coordinate -> sum of Coulomb and presliding friction, and standard error of this sum [N m, N]."""
    dry: dict[str, list[int]] = {}
    for k, effect in enumerate((problem.columns.effects[k] for k in fit.effects), start=problem.num_rigid):
        if EFFECT_KINDS[effect.kind].symmetric and not isinstance(effect, RecordingEffect):
            dry.setdefault(effect.coordinate, []).append(k)
    variances = {name: float(np.sum(covariance.estimates[np.ix_(own, own)])) for name, own in dry.items()}
    return {name: (float(np.sum(fit.x[own])), variances[name] ** 0.5) for name, own in dry.items()}


def _identifiability(variance: float, prior_variance: float) -> float:
    return float(np.clip(1 - variance / prior_variance, 0.0, 1.0))


def base_parameter_estimates(
    arm: Arm, section: DynamicSection, covariance: NDArray[np.float64]
) -> list[BaseParameterEstimate]:
    """Returns the base parameters of gravity with standard errors, computed from the links of `section`.

    Args:
        arm: Arm with the gravity direction of `section`.
        section: Identified dynamics.
        covariance: Covariance of all identified parameters. The link parameters come first.
    """
    gravity = gravity_parameters(arm)
    B = gravity.combination_of([link.link for link in section.links])
    phi = np.concatenate([link.parameters for link in section.links])
    values = B @ phi
    errors = np.sqrt(np.diag(B @ covariance[: len(phi), : len(phi)] @ B.T))
    return [
        BaseParameterEstimate(name, float(value), float(error), section.degrees_of_freedom)
        for name, value, error in zip(gravity.base.names, values, errors, strict=True)
    ]
