"""Maximum-a-posteriori fit of efforts, prior deviations, errors of held-out folds, and selection of unknowns."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.analysis.estimation.normal_equations import NonNegativeFit, NormalEquations, SquareSums
from dvrk_drake.dynamics.dynamic_regressor import DynamicRegressor
from dvrk_drake.dynamics.inertial_parameters import rotor_links
from dvrk_drake.dynamics.physical_consistency import LinkScale
from dvrk_drake.models.arm import Arm

#: Assumed relative error of the efforts before the first fit, and lower limit of the relative error of an actuator in
#: the computation of its weight. Half or twice the first number, and half the second one, change the mean
#: cross-validated errors of the public motions `mtm_one` and `psm_one` by at most 0.001 percentage points.
ASSUMED_ERROR, MIN_ERROR = 0.1, 0.02
#: Number of fits in which the variances of the errors are estimated. A fourth fit changes the errors of the public
#: motions of two PSMs on other motions by less than 0.01 %.
_ITERATIONS = 3
#: Smallest reduction of the cross-validated relative error for which an effect is added. The error is averaged over the
#: actuators. Smaller reductions are due to chance. On the public motions, a lower threshold adds different effects for
#: different held-out folds, and increases the errors on these folds.
MIN_GAIN = 0.005
#: Number of candidate effects that are cross-validated in each step. With half or twice as many, the same effects are
#: selected for the public motions `mtm_one` and `psm_one`.
NUM_TRIALS = 8


class Prior(NamedTuple):
    """Independent Gaussian priors of k unknowns.

    Attributes:
        mean: Means (k,).
        precision: Reciprocals (k,) of the variances, greater than 0.
        non_negative: Mask (k,) of the unknowns that must not be negative.
    """

    mean: NDArray[np.float64]
    precision: NDArray[np.float64]
    non_negative: NDArray[np.bool_]


@dataclass(eq=False)
class Estimator:
    """Fit of k unknowns x to the efforts tau of n actuators in s recordings.

    The fit minimises the weighted sum of the squared errors tau - X x plus the sum of precision (x - mean)^2. The
    weight of an actuator in a recording is the number of independent values of its effort, divided by the sum of its
    squared errors. A fit may include only some of the unknowns. The others keep their prior means.

    Attributes:
        equations: Normal equations of the columns X and the efforts tau. The efforts may be differences from those of a
            nominal model.
        prior: Priors of the unknowns.
        efforts: Sums of squares (folds, n) of the measured efforts, to which all relative errors refer.
        independent: Effective numbers (folds, n) of independent values of the efforts.
        weights: Weights (s, n) of the squared errors, updated by `fit`, 0 for efforts that were not measured.
    """

    equations: NormalEquations
    prior: Prior
    efforts: NDArray[np.float64]
    independent: NDArray[np.float64]

    def __post_init__(self) -> None:
        equations = self.equations
        self._total = equations.total
        self._efforts = equations.member @ self.efforts
        self._independent = equations.member @ self.independent
        self.weights = self._weights(ASSUMED_ERROR**2 * self._efforts)

    @property
    def all(self) -> NDArray[np.int_]:
        """Indices (k,) of all unknowns."""
        return np.arange(len(self.prior.mean))

    def fit(self, used: NDArray[np.int_]) -> NDArray[np.float64]:
        """Returns the estimates x (k,), in which the unknowns `used` are fitted, and updates `weights`."""
        for _ in range(_ITERATIONS):
            x = self.solve(used)
            self.weights = self._weights(self._total.squared_errors(x))
        return x

    def solve(self, used: NDArray[np.int_], without_fold: int | None = None) -> NDArray[np.float64]:
        """Returns the estimates x (k,) for the present weights, from all rows or without those of one fold."""
        sums = self._total if without_fold is None else self._folds[without_fold][0]
        return self.fit_to(sums.weighted(self.weights), used).solve()

    def squared_errors(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """Returns the sums of squared errors (s, n) of the actuators in each recording."""
        return self._total.squared_errors(x)

    def information(self) -> NDArray[np.float64]:
        """Returns the sum (k, k) of the weighted X' X and the prior precision, the inverse of the covariance of x."""
        return self._total.weighted(self.weights)[:-1, :-1] + np.diag(self.prior.precision)

    def standard_errors(self, used: NDArray[np.int_]) -> NDArray[np.float64]:
        """Returns the standard errors (u,) of the unknowns `used` for independent errors and the present weights."""
        deviation = self.prior.precision[used] ** -0.5
        # In units of the prior deviations, the matrix has no eigenvalue below 1.
        H = self.information()[np.ix_(used, used)] * np.outer(deviation, deviation)
        return deviation * np.sqrt(np.diag(np.linalg.inv(H)))

    def cross_validated(self, used: NDArray[np.int_], added: Sequence[int] = ()) -> NDArray[np.float64]:
        """Returns the cross-validated relative errors (1 + a, s, n) without and with each of a additional unknowns.

        Each fold is predicted from a fit to the other folds. All fits use the present weights. The error is 0 if an
        effort was not measured.
        """
        squares = np.zeros((1 + len(added), *self._efforts.shape))
        candidates = np.array(added, dtype=int)
        for training, held_out in self._folds:
            fit = self.fit_to(training.weighted(self.weights), used, candidates)
            squares += [held_out.squared_errors(fit.solve(k)) for k in (None, *added)]
        return np.sqrt(squares / np.where(self._efforts > 0, self._efforts, np.inf))

    def fold_errors(self, used: NDArray[np.int_]) -> NDArray[np.float64]:
        """Returns the sums (folds, s, n) of squared errors of each fold, predicted from the other folds."""
        fits = ((held_out, self.fit_to(x.weighted(self.weights), used).solve()) for x, held_out in self._folds)
        return np.array([held_out.squared_errors(x) for held_out, x in fits])

    @cached_property
    def _folds(self) -> list[tuple[SquareSums, SquareSums]]:
        """Sums of the training rows and of the held-out rows of each fold."""
        equations = self.equations
        return [(equations.without_fold(fold), equations.of_fold(fold)) for fold in range(equations.folds)]

    @property
    def measured(self) -> NDArray[np.bool_]:
        """Mask (s, n) of the efforts that were measured."""
        return self._efforts > 0

    def without(self, first: int, count: int) -> Self:
        """Returns the estimator without `count` adjacent folds that start with `first`."""
        kept = self.equations.others(first, count)
        equations = self.equations.without(first, count)
        return replace(self, equations=equations, efforts=self.efforts[kept], independent=self.independent[kept])

    def fit_to(
        self, sums: NDArray[np.float64], used: NDArray[np.int_], candidates: NDArray[np.int_] | None = None
    ) -> NonNegativeFit:
        """Returns the fit of the unknowns `used` to weighted sums (k + 1, k + 1), to which `candidates` may be added.

        Unknowns that are not used have their prior means. The prior mean of a candidate must be 0.
        """
        mean, precision, non_negative = self.prior
        fixed = mean.copy()
        fixed[used] = 0.0
        if np.any(mean):
            # The efforts of the fixed unknowns are subtracted. The prior means act as measurements of the unknowns.
            sums = sums.copy()
            sums[:-1, -1] += precision * (mean - fixed) - sums[:-1, :-1] @ fixed
            sums[-1, :-1] = sums[:-1, -1]
        return NonNegativeFit(sums, precision, non_negative, used, candidates, fixed)

    def _weights(self, squares: NDArray[np.float64]) -> NDArray[np.float64]:
        """Returns the weights (s, n) of the actuators for sums of squared errors (s, n)."""
        squares = np.maximum(squares, MIN_ERROR**2 * self._efforts)
        return self._independent / np.where(self.measured, squares, np.inf)


@dataclass(eq=False)
class StepwiseSelection(Estimator):
    """Estimator whose last unknowns are effects that may be selected. All prior means are 0.

    Indices of effects count from the first effect.

    Attributes:
        num_rigid: Number of rigid-body unknowns, which are the first ones.
    """

    num_rigid: int

    def fit_with(self, effects: NDArray[np.int_]) -> NDArray[np.float64]:
        """Returns the estimates (k,) of all unknowns, with 0 for excluded effects, and updates `weights`."""
        return self.fit(self._index(effects))

    def errors(self, effects: NDArray[np.int_], candidates: NDArray[np.int_]) -> NDArray[np.float64]:
        """Returns the cross-validated error with `effects`, and those with one of the c candidates too (1 + c,).

        Each error is a mean over the actuators and the recordings.
        """
        added = (self.num_rigid + candidates).tolist()
        return np.mean(self.cross_validated(self._index(effects), added)[:, self.measured], axis=1)

    def select(
        self,
        mandatory: NDArray[np.int_],
        candidates: NDArray[np.int_],
        progress: Callable[[float], object] = lambda _: None,
    ) -> NDArray[np.int_]:
        """Adds candidates that reduce the error by at least `MIN_GAIN`, then removes unnecessary candidates.

        A candidate is unnecessary if its removal increases the error by less than half of `MIN_GAIN`.

        Args:
            mandatory: Indices of the effects that are always included.
            candidates: Indices of the effects that may be added.
            progress: Callback that receives the estimated finished share, 0 to 1.

        Returns:
            Indices (f,) of the mandatory and the added effects.
        """
        selected, none = mandatory, np.empty(0, dtype=int)
        for step in itertools.count():
            progress(1 - 0.85**step)
            self.fit_with(selected)
            trials = self._best_candidates(selected, np.setdiff1d(candidates, selected))
            best, *errors = self.errors(selected, trials).tolist()
            if not errors or min(errors) > best - MIN_GAIN:
                break
            selected = np.union1d(selected, trials[[np.argmin(errors)]])
        for k in np.intersect1d(candidates, selected):
            without = np.setdiff1d(selected, [k])
            (error,) = self.errors(without, none).tolist()
            if error < best + MIN_GAIN / 2:
                selected, best = without, error
        return selected

    def _best_candidates(self, selected: NDArray[np.int_], candidates: NDArray[np.int_]) -> NDArray[np.int_]:
        """Returns the `NUM_TRIALS` candidates that most reduce the weighted sum of squared errors.

        Sign constraints of the candidates are ignored.
        """
        used, new = self._index(selected), self.num_rigid + candidates
        sums, precision = self._total.weighted(self.weights), self.prior.precision
        x = self.fit_to(sums, used).solve()
        residual = (sums[:-1, -1] - sums[:-1, :-1] @ x)[new]
        H = sums[np.ix_(used, used)] + np.diag(precision[used])
        explained = np.einsum("ij,ij->j", sums[np.ix_(used, new)], np.linalg.solve(H, sums[np.ix_(used, new)]))
        gain = residual**2 / (np.diag(sums)[new] + precision[new] - explained)
        return candidates[np.argsort(-gain)[:NUM_TRIALS]]

    def _index(self, effects: NDArray[np.int_]) -> NDArray[np.int_]:
        return np.concatenate([np.arange(self.num_rigid), self.num_rigid + np.sort(effects)])


#: Prior standard deviation of an inertial parameter about its value in the SDF, as a share of the scale of the
#: parameter (`LinkScale`). Half or twice the value increases the mean cross-validated errors of the public motions
#: `mtm_one` and `psm_one`.
LINK_DEVIATION = 0.3
#: Smallest prior standard deviation of a rotor inertia, as a share of the smallest rotor that the model states for the
#: same type of joints. It is for rotors without a stated inertia beside others: the model contains them as links. For
#: an MTM, the deviation is 3e-6 kg m^2.
UNSTATED_ROTOR_SHARE = 0.22
#: Acceleration of a rotor by the effort limit of its joint [rad/s^2, m/s^2] at one prior standard deviation of its
#: inertia, if the model states no rotors. The drives of published robots (UR, Franka, Staubli) reach 10 to 100 rad/s^2.
ROTOR_ACCELERATION = 100.0, 30.0
#: Factor of the prior standard deviation of the first moments, for rotors that the SDF models as links. The factor is
#: small because rotors are balanced. Zero would have no reciprocal.
_BALANCE = 1e-6
#: Prior standard deviation of the direction of gravity [rad]. It is the accuracy with which a base is levelled.
TILT_DEVIATION = 0.05
#: Prior standard deviation of a known coefficient of an effect, as a share of the coefficient. The friction power of
#: one PSM on two days is 0.96 to 1.54 times that of its arm file (`FRICTION_FACTOR`).
EFFECT_DEVIATION = 0.5
#: Prior standard deviation of the torque of a spring or cable that the arm file lists, as a share of the RMS effort,
#: because it may balance gravity. For other effects, see `EffectKind.prior_share`.
KNOWN_SHARE = 1.0


def rigid_deviations(regressor: DynamicRegressor, num_rigid: int, link_scale: float = 1.0) -> NDArray[np.float64]:
    """Returns the prior standard deviations (num_rigid,) of the link parameters and rotor inertias.

    Args:
        regressor: Regressor of the arm.
        num_rigid: Number of link parameters and rotor inertias.
        link_scale: Factor of the deviations of the links.
    """
    rotors_as_links = rotor_links(regressor.arm)
    links = [link_scale * LINK_DEVIATION * LinkScale.of(link).deviations for link in regressor.links]
    for link, deviation in zip(regressor.links, links, strict=True):
        if link.link in rotors_as_links:
            deviation[1:4] *= _BALANCE
    stated, rotors = regressor.values[10 * len(links) : num_rigid], _unstated_rotor_deviations(regressor.arm)
    for joints in (regressor.arm.prismatic, ~regressor.arm.prismatic):
        if np.any(of_type := joints & (stated > 0)):
            rotors[joints] = np.maximum(LINK_DEVIATION * stated[joints], UNSTATED_ROTOR_SHARE * np.min(stated[of_type]))
    return np.concatenate([*links, rotors])


def _unstated_rotor_deviations(arm: Arm) -> NDArray[np.float64]:
    """Returns the prior standard deviations (n,) of rotor inertias about 0, for a model that states no rotors.

    Most model files omit the rotors, although those of geared joints often exceed the inertia of the links.
    """
    acceleration = arm.per_joint(*ROTOR_ACCELERATION)
    # The joint that first reaches its limit bounds the effort of the actuator.
    J = np.abs(arm.transmission.matrix)
    shares = arm.effort_limits / np.where(J > 0, J, np.nan)
    joint = np.nanargmin(shares, axis=1)
    return np.array([arm.effort_limits[j] / (J[i, j] ** 2 * acceleration[j]) for i, j in enumerate(joint)])
