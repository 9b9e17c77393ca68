"""Stepwise selection of joint effects by cross-validation over the folds of a motion."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.analysis.dynamic.normal_equations import NonNegativeFit, NormalEquations

#: Least reduction of the cross-validated relative error, averaged over the actuators, for adding an effect. Smaller
#: gains are due to chance: on the public motions they select different effects in different phases, and the errors on
#: held-out phases increase.
MIN_GAIN = 0.005
#: Number of the most promising effects that are evaluated at every step.
TRIALS = 8
#: Least relative error of an actuator that the weights assume.
MIN_ERROR = 0.02


@dataclass
class StepwiseSelection:
    """Stepwise selection of effects on one motion, in unknowns with prior mean 0.

    Attributes:
        equations: Normal equations. The columns are the rigid-body unknowns, the effects and the remaining effort.
        efforts: (folds, n) sums of squares of the measured efforts.
        rows: (folds,) numbers of rows.
        num_rigid: Number of rigid-body unknowns.
        precision: (k,) reciprocal prior variances of all unknowns.
        non_negative: (k,) mask of the unknowns that must not be negative.
        independent: Share of the rows that are independent measurements of an actuator's effort.
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
        self._learnt = [equations.without_fold(fold) for fold in range(equations.folds)]
        self._predicted = [equations.of_fold(fold) for fold in range(equations.folds)]
        self._efforts = np.sum(self.efforts, axis=0)
        self.weights = self._weights(np.full(len(self._efforts), 0.1**2))

    def without(self, first: int, count: int) -> StepwiseSelection:
        """Returns the selection without `count` folds from `first` on."""
        kept = self.equations.others(first, count)
        return replace(
            self, equations=self.equations.without(first, count), efforts=self.efforts[kept], rows=self.rows[kept]
        )

    def fit(self, effects: NDArray[np.int_]) -> NDArray[np.float64]:
        """Returns all unknowns (k,), 0 for excluded effects, and updates the weights from the residuals."""
        for _ in range(3):
            x = self._fit_to(self._total.weighted(self.weights), effects).solve()
            self.weights = self._weights(self._total.squared_errors(x) / self._efforts)
        return x

    def relative_error(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """Returns the relative error |tau - X x| / |tau| of each actuator (n,)."""
        return np.asarray(np.sqrt(self._total.squared_errors(x) / self._efforts))

    def cross_validated(self, effects: NDArray[np.int_], candidates: Sequence[int] = ()) -> tuple[float, list[float]]:
        """Returns the cross-validated error with `effects`, and with each candidate added, for the current weights.

        The error is relative, and averaged over the actuators.
        """
        squares = np.zeros((1 + len(candidates), len(self._efforts)))
        added = [None, *(self.num_rigid + k for k in candidates)]
        for learnt, predicted in zip(self._learnt, self._predicted, strict=True):
            fit = self._fit_to(learnt.weighted(self.weights), effects, np.array(candidates, dtype=int))
            squares += [predicted.squared_errors(fit.solve(k)) for k in added]
        error, *errors = np.mean(np.sqrt(squares / self._efforts), axis=1).tolist()
        return error, errors

    def choose(
        self, start: NDArray[np.int_], candidates: NDArray[np.int_], report: Callable[[float], object] = lambda _: None
    ) -> NDArray[np.int_]:
        """Adds candidates to `start` while the gain is at least `MIN_GAIN`, then drops those that are no longer useful.

        Args:
            start: Indices of the effects to start from, counted from 0.
            candidates: Indices of the effects that may be added, counted from 0.
            report: Callback that receives the estimated share of the work that is done.
        """
        chosen = start
        for step in itertools.count():
            report(1 - 0.85**step)
            self.fit(chosen)
            tries = self._promising(chosen, np.setdiff1d(candidates, chosen))
            best, errors = self.cross_validated(chosen, tries.tolist())
            if not errors or min(errors) > best - MIN_GAIN:
                break
            chosen = np.union1d(chosen, tries[[np.argmin(errors)]])
        for k in np.intersect1d(candidates, chosen):
            without = np.setdiff1d(chosen, [k])
            error, _ = self.cross_validated(without)
            if error < best + MIN_GAIN / 2:
                chosen, best = without, error
        return chosen

    def _promising(self, chosen: NDArray[np.int_], open_: NDArray[np.int_]) -> NDArray[np.int_]:
        """Returns the open effects that reduce the sum of squares most, without sign constraints."""
        used, new = self._index(chosen), self.num_rigid + open_
        sums = self._total.weighted(self.weights)
        x = self._fit_to(sums, chosen).solve()
        residual = (sums[:-1, -1] - sums[:-1, :-1] @ x)[new]
        H = sums[np.ix_(used, used)] + np.diag(self.precision[used])
        explained = np.einsum("ij,ij->j", sums[np.ix_(used, new)], np.linalg.solve(H, sums[np.ix_(used, new)]))
        gain = residual**2 / (np.diag(sums)[new] + self.precision[new] - explained)
        return open_[np.argsort(-gain)[:TRIALS]]

    def _index(self, effects: NDArray[np.int_]) -> NDArray[np.int_]:
        return np.concatenate([np.arange(self.num_rigid), self.num_rigid + np.sort(effects)])

    def _fit_to(
        self, sums: NDArray[np.float64], effects: NDArray[np.int_], others: NDArray[np.int_] | None = None
    ) -> NonNegativeFit:
        """Returns the fit to weighted sums. `others` are effects that may be added."""
        new = None if others is None else self.num_rigid + others
        return NonNegativeFit(sums, self.precision, self.non_negative, self._index(effects), new)

    def _weights(self, squared: NDArray[np.float64]) -> NDArray[np.float64]:
        """Returns the reciprocal variances of independent measurements, from the squared relative errors."""
        variance = np.maximum(squared, MIN_ERROR**2) * self._efforts / np.sum(self.rows)
        return np.asarray(self.independent / variance)
