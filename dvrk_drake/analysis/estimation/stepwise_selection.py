"""Stepwise selection of effects (friction, cables, springs) by cross-validation over the folds of a motion."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.analysis.estimation.estimator import Estimator

#: Smallest reduction of the cross-validated relative error for which an effect is added. The error is averaged over the
#: actuators. Smaller reductions are due to chance. On the public motions, a lower threshold adds different effects for
#: different held-out folds, and increases the errors on these folds.
MIN_GAIN = 0.005
#: Number of candidate effects that are cross-validated in each step. With half or twice as many, the same effects are
#: selected for the public motions `mtm_one` and `psm_one`.
NUM_TRIALS = 8


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
