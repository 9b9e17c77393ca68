"""Which effects the drives of an arm have: chosen one by one, by how well folds of the motion predict each other."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.analysis.dynamic.normal_equations import NonNegativeFit, NormalEquations

#: An effect must lower the cross-validated error, relative and averaged over the actuators, by this much. What gains
#: less is chosen by chance: on the public motions other phases choose others, which predict the left-out phases worse.
MIN_GAIN = 0.005
#: So many of the effects that promise most are tried at every step.
TRIALS = 8
#: An actuator's error is not taken for less than this share of its effort.
MIN_ERROR = 0.02


@dataclass
class StepwiseSelection:
    """The choice of effects on one motion, in unknowns that are 0 before the recording.

    Attributes:
        equations: columns: the rigid body's unknowns, then the effects; the last is what remains of the effort.
        efforts: (folds, n) sum of squares of the measured efforts.
        rows: (folds,) their number.
        num_rigid: of the rigid body's.
        precision: (k,) of all unknowns.
        non_negative: (k,).
        independent: share of the rows that are independent measurements of an actuator's effort.
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
        """The choice that knows nothing of some folds: `count` from `first` on."""
        kept = self.equations.others(first, count)
        return replace(
            self, equations=self.equations.without(first, count), efforts=self.efforts[kept], rows=self.rows[kept]
        )

    def fit(self, effects: NDArray[np.int_]) -> NDArray[np.float64]:
        """(k,) all unknowns, 0 where an effect is not chosen; weighs every actuator by the error that is left."""
        for _ in range(3):
            x = self._fit_to(self._total.weighted(self.weights), effects).solve()
            self.weights = self._weights(self._total.squared_errors(x) / self._efforts)
        return x

    def relative_error(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """(n,) |tau - X x| / |tau|."""
        return np.asarray(np.sqrt(self._total.squared_errors(x) / self._efforts))

    def cross_validated(self, effects: NDArray[np.int_], candidates: Sequence[int] = ()) -> tuple[float, list[float]]:
        """Error of folds that are predicted from the others, with the current weights; with each candidate added.

        It is relative, and the mean over the actuators.
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
        """Adds candidates to `start` while `MIN_GAIN` is had, and drops those that are no longer of use.

        Args:
            start, candidates: indices of effects, from 0.
            report: told the share of the work that is done, a guess.
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
        """The open effects that would lower the sum of squares most, were all signs free."""
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
        """To weighted sums; `others`: effects that may be added."""
        new = None if others is None else self.num_rigid + others
        return NonNegativeFit(sums, self.precision, self.non_negative, self._index(effects), new)

    def _weights(self, squared: NDArray[np.float64]) -> NDArray[np.float64]:
        """One over the variance of an independent measurement, from the squared relative errors."""
        variance = np.maximum(squared, MIN_ERROR**2) * self._efforts / np.sum(self.rows)
        return np.asarray(self.independent / variance)
