"""Stepwise selection of effects (friction, cables, springs) by cross-validation over the folds of a motion."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.analysis.dynamic.normal_equations import NonNegativeFit, NormalEquations

#: Smallest reduction of the cross-validated relative error for which an effect is added. The error is averaged over the
#: actuators. Smaller reductions are due to chance. On the public motions, a lower threshold adds different effects for
#: different held-out folds, and increases the errors on these folds.
MIN_GAIN = 0.005
#: Number of candidate effects that are cross-validated in each step.
NUM_TRIALS = 8
#: Lower limit of the relative error of an actuator in the computation of the weights.
MIN_ERROR = 0.02


@dataclass
class StepwiseSelection:
    """Stepwise selection of effects for one motion. All k unknowns have prior mean 0.

    Attributes:
        equations: Normal equations with columns for the rigid-body unknowns, the effects and the tilt. The efforts in
            these equations are the measured efforts minus the efforts of the SDF.
        efforts: Sums of squares (folds, n) of the measured efforts.
        rows: Number of rows (folds,) in each fold.
        num_rigid: Number of rigid-body unknowns.
        precision: Reciprocals (k,) of the prior variances of all unknowns.
        non_negative: Mask (k,) of the unknowns that must not be negative.
        independent: Effective number of independent rows, divided by the number of rows.
        weights: Weights (s, n) of the squared errors of the actuators in each of s recordings, updated by `fit`. They
            are reciprocals of the error variances, and 0 for efforts that were not measured.
    """

    equations: NormalEquations
    efforts: NDArray[np.float64]
    rows: NDArray[np.int_]
    num_rigid: int
    precision: NDArray[np.float64]
    non_negative: NDArray[np.bool_]
    independent: float

    def __post_init__(self) -> None:
        equations = self.equations
        self._total = equations.total
        self._training = [equations.without_fold(fold) for fold in range(equations.folds)]
        self._held_out = [equations.of_fold(fold) for fold in range(equations.folds)]
        self._efforts, self._rows = equations.member @ self.efforts, equations.member @ self.rows
        self.weights = self._weights(np.full(self._efforts.shape, 0.1**2))

    def without(self, first: int, count: int) -> StepwiseSelection:
        """Returns the selection without `count` adjacent folds that start with `first`."""
        kept = self.equations.others(first, count)
        return replace(
            self, equations=self.equations.without(first, count), efforts=self.efforts[kept], rows=self.rows[kept]
        )

    def fit(self, effects: NDArray[np.int_]) -> NDArray[np.float64]:
        """Returns the estimates (k,) of all unknowns, with 0 for excluded effects, and updates `weights`."""
        for _ in range(3):
            x = self._fit_to(self._total.weighted(self.weights), effects).solve()
            self.weights = self._weights(self._relative(self._total.squared_errors(x)))
        return x

    def relative_error(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """Returns the relative errors (s, n) |tau - X x| / |tau| of the actuators in each recording."""
        return np.sqrt(self._relative(self._total.squared_errors(x)))

    def cross_validated(self, effects: NDArray[np.int_], candidates: Sequence[int] = ()) -> tuple[float, list[float]]:
        """Returns the cross-validated relative error with `effects`, and the errors with one more effect.

        The second result contains one error per candidate, with this candidate as the additional effect. Each error is
        a mean over the actuators and the recordings. All fits use the current weights.
        """
        squares = np.zeros((1 + len(candidates), *self._efforts.shape))
        added = [None, *(self.num_rigid + k for k in candidates)]
        for training, held_out in zip(self._training, self._held_out, strict=True):
            fit = self._fit_to(training.weighted(self.weights), effects, np.array(candidates, dtype=int))
            squares += [held_out.squared_errors(fit.solve(k)) for k in added]
        error, *errors = np.mean(np.sqrt(self._relative(squares))[:, self._efforts > 0], axis=1).tolist()
        return error, errors

    def select(
        self,
        mandatory: NDArray[np.int_],
        candidates: NDArray[np.int_],
        progress: Callable[[float], object] = lambda _: None,
    ) -> NDArray[np.int_]:
        """Adds candidates that reduce the error by at least `MIN_GAIN`, then removes unnecessary candidates.

        A candidate is unnecessary if its removal increases the error by less than half of `MIN_GAIN`.

        Args:
            mandatory: Indices of the effects that are always included. Index 0 is the first effect.
            candidates: Indices of the effects that may be added. Index 0 is the first effect.
            progress: Callback that receives the estimated finished share, 0 to 1.

        Returns:
            Indices (f,) of the mandatory and the added effects.
        """
        selected = mandatory
        for step in itertools.count():
            progress(1 - 0.85**step)
            self.fit(selected)
            trials = self._best_candidates(selected, np.setdiff1d(candidates, selected))
            best, errors = self.cross_validated(selected, trials.tolist())
            if not errors or min(errors) > best - MIN_GAIN:
                break
            selected = np.union1d(selected, trials[[np.argmin(errors)]])
        for k in np.intersect1d(candidates, selected):
            without = np.setdiff1d(selected, [k])
            error, _ = self.cross_validated(without)
            if error < best + MIN_GAIN / 2:
                selected, best = without, error
        return selected

    def _best_candidates(self, selected: NDArray[np.int_], candidates: NDArray[np.int_]) -> NDArray[np.int_]:
        """Returns the `NUM_TRIALS` candidates that most reduce the weighted sum of squared errors.

        Sign constraints of the candidates are ignored.
        """
        used, new = self._index(selected), self.num_rigid + candidates
        sums = self._total.weighted(self.weights)
        x = self._fit_to(sums, selected).solve()
        residual = (sums[:-1, -1] - sums[:-1, :-1] @ x)[new]
        H = sums[np.ix_(used, used)] + np.diag(self.precision[used])
        explained = np.einsum("ij,ij->j", sums[np.ix_(used, new)], np.linalg.solve(H, sums[np.ix_(used, new)]))
        gain = residual**2 / (np.diag(sums)[new] + self.precision[new] - explained)
        return candidates[np.argsort(-gain)[:NUM_TRIALS]]

    def _index(self, effects: NDArray[np.int_]) -> NDArray[np.int_]:
        return np.concatenate([np.arange(self.num_rigid), self.num_rigid + np.sort(effects)])

    def _fit_to(
        self, sums: NDArray[np.float64], effects: NDArray[np.int_], candidates: NDArray[np.int_] | None = None
    ) -> NonNegativeFit:
        """Returns the fit to weighted sums (k + 1, k + 1) with `effects`, to which `candidates` may be added."""
        new = None if candidates is None else self.num_rigid + candidates
        return NonNegativeFit(sums, self.precision, self.non_negative, self._index(effects), new)

    def _weights(self, squared: NDArray[np.float64]) -> NDArray[np.float64]:
        """Returns the weights (s, n) of the actuators for squared relative errors (s, n)."""
        variance = np.maximum(squared, MIN_ERROR**2) * self._efforts / np.maximum(self._rows, 1)[:, None]
        return self.independent / np.where(self._efforts > 0, variance, np.inf)

    def _relative(self, squares: NDArray[np.float64]) -> NDArray[np.float64]:
        """Divides squared errors (..., s, n) by the squared efforts. The result is 0 if an effort was not measured."""
        return squares / np.where(self._efforts > 0, self._efforts, np.inf)
