"""Normal equations of a motion, accumulated per fold, and non-negative least squares on them."""

from __future__ import annotations

import itertools
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.linalg
from numpy.typing import NDArray
from scipy.optimize import nnls

#: Largest number of exchanges of unknowns between the positive set and the zero set.
MAX_EXCHANGES = 10
#: Indices of the nonzero columns of an actuator, and these columns (r, c).
OwnColumns = tuple[NDArray[np.int_], NDArray[np.float64]]


@dataclass(frozen=True, eq=False)
class SquareSums:
    """Products [X tau]'[X tau] of every actuator, summed over some rows.

    Attributes:
        size: k + 1, the number of columns with the measured effort, which is the last.
        own: (n) indices of the nonzero columns of each actuator, with that of the effort.
        blocks: (n) sums of products (c, c) of these columns.
    """

    size: int
    own: tuple[NDArray[np.int_], ...]
    blocks: tuple[NDArray[np.float64], ...]

    def weighted(self, weights: NDArray[np.float64]) -> NDArray[np.float64]:
        """Returns the sum (k + 1, k + 1) over the actuators, each multiplied by its weight."""
        sums = np.zeros((self.size, self.size))
        for weight, own, block in zip(weights, self.own, self.blocks, strict=True):
            sums[own[:, None], own] += weight * block
        return sums

    def squares(self, combination: NDArray[np.float64]) -> NDArray[np.float64]:
        """Returns the sum of squares (n,) of a linear combination (k + 1,) of the columns and the effort."""
        parts = [combination[own] for own in self.own]
        return np.array([max(x @ block @ x, 0.0) for x, block in zip(parts, self.blocks, strict=True)])

    def squared_errors(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """Returns the sum of squared residuals (n,) for x (k,)."""
        return self.squares(np.append(-x, 1.0))

    def dense(self) -> NDArray[np.float64]:
        """Returns the products (n, k + 1, k + 1) as a dense array."""
        return np.array([self.weighted(unit) for unit in np.eye(len(self.own))])


@dataclass(frozen=True, eq=False)
class NormalEquations:
    """Products [X tau]'[X tau] of every actuator, for every fold of a motion.

    Attributes:
        size: As in `SquareSums`.
        own: As in `SquareSums`.
        products: (n) products (folds, 3, c, c). The three parts of a fold are its start, its middle and its end.
    """

    size: int
    own: tuple[NDArray[np.int_], ...]
    products: tuple[NDArray[np.float64], ...]

    @classmethod
    def of(
        cls,
        columns: Iterable[OwnColumns],
        size: int,
        tau: NDArray[np.float64],
        fold: NDArray[np.int_] | None = None,
        edge: NDArray[np.bool_] | None = None,
    ) -> NormalEquations:
        """Accumulates the products.

        Args:
            columns: Columns of each of the n actuators.
            size: k, the number of all columns.
            tau: (r, n) measured efforts.
            fold: (r,) fold of each row. By default there is one fold.
            edge: (r, 2) masks of the rows at the start and at the end of their fold.
        """
        fold = np.zeros(len(tau), dtype=int) if fold is None else fold
        edge = np.zeros((len(tau), 2), dtype=bool) if edge is None else edge
        folds = int(fold.max()) + 1
        part = np.where(edge[:, 0], 0, np.where(edge[:, 1], 2, 1)) + 3 * fold
        order = np.argsort(part, kind="stable")
        ends = np.searchsorted(part[order], np.arange(3 * folds + 1))
        owns, products = [], []
        for i, (own, X) in enumerate(columns):
            full = np.column_stack([X, tau[:, i]])[order]
            rows = (full[start:end] for start, end in itertools.pairwise(ends))
            products.append(np.array([x.T @ x for x in rows]).reshape(folds, 3, len(own) + 1, -1))
            owns.append(np.append(own, size))
        return cls(size + 1, tuple(owns), tuple(products))

    @property
    def folds(self) -> int:
        """Number of folds."""
        return self.products[0].shape[0]

    def others(self, first: int, count: int) -> NDArray[np.int_]:
        """Returns the indices (folds - count,) of the folds that follow `count` folds from `first` on, cyclically."""
        return np.arange(first + count, first + self.folds) % self.folds

    def without(self, first: int, count: int) -> NormalEquations:
        """Returns the products of the other folds, without the edges that adjoin the removed folds."""
        products = tuple(p[self.others(first, count)] for p in self.products)
        for p in products:
            p[0, 0] = 0.0
            p[-1, 2] = 0.0
        return NormalEquations(self.size, self.own, products)

    @cached_property
    def total(self) -> SquareSums:
        """Sums over the whole motion."""
        return self._sums(p.sum(axis=(0, 1)) for p in self.products)

    def of_fold(self, fold: int, count: int = 1) -> SquareSums:
        """Returns the sums over `count` folds from `fold` on."""
        chosen = np.arange(fold, fold + count) % self.folds
        return self._sums(p[chosen].sum(axis=(0, 1)) for p in self.products)

    def without_fold(self, fold: int, count: int = 1) -> SquareSums:
        """Returns the sums over all rows except those of `count` folds and the adjoining edges of their neighbours."""
        before, after = (fold - 1) % self.folds, (fold + count) % self.folds
        out = self.of_fold(fold, count).blocks
        blocks = zip(self.total.blocks, out, self.products, strict=True)
        return self._sums(whole - own - p[before, 2] - p[after, 0] for whole, own, p in blocks)

    def _sums(self, blocks: Iterable[NDArray[np.float64]]) -> SquareSums:
        return SquareSums(self.size, self.own, tuple(blocks))


class NonNegativeFit:
    """Weighted non-negative least squares for one set of unknowns, or for this set and one more.

    The solution x (k,) minimises |y|^2 - 2 y' X x + x' (X' X + diag(precision)) x. Unknowns without a sign constraint
    are eliminated first, which leaves the Schur complement of the others. One more unknown adds one row to it, or one
    step of elimination. The rest is a small non-negative least-squares problem.
    """

    def __init__(
        self,
        sums: NDArray[np.float64],
        precision: NDArray[np.float64],
        non_negative: NDArray[np.bool_],
        used: NDArray[np.int_],
        others: NDArray[np.int_] | None = None,
    ) -> None:
        """Eliminates the unknowns without a sign constraint.

        Args:
            sums: (k + 1, k + 1) weighted sums of squares and products, the measured effort last.
            precision: (k,) reciprocal prior variance of each unknown about 0, positive.
            non_negative: (k,) mask of the unknowns that must not be negative.
            used: Indices of the unknowns. All others are 0.
            others: Indices of the unknowns that `solve` may add.
        """
        self._scale = np.append(1 / np.sqrt(np.diag(sums)[:-1] + precision), 1.0)
        self._free, bound = used[~non_negative[used]], used[non_negative[used]]
        self._bound, self._non_negative = np.arange(len(bound)), non_negative
        self._rest = np.concatenate([bound, [] if others is None else others, [len(precision)]]).astype(int)

        def scaled(rows: NDArray[np.int_], columns: NDArray[np.int_]) -> NDArray[np.float64]:
            return sums[rows[:, None], columns] * self._scale[rows, None] * self._scale[columns]

        H = scaled(self._free, self._free)
        H[np.diag_indices_from(H)] = 1.0
        self._factor = scipy.linalg.cholesky(H, lower=True, check_finite=False)
        self._coupling = _solve_lower(self._factor, scaled(self._free, self._rest))
        S = scaled(self._rest, self._rest)
        S[np.diag_indices(len(S) - 1)] = 1.0
        self._schur = S - self._coupling.T @ self._coupling
        self._positive = np.ones(len(bound), dtype=bool)
        self._positive = self._minimum(self._schur, self._bound) > 0

    def solve(self, added: int | None = None) -> NDArray[np.float64]:
        """Returns x (k,), optionally with one of `others` added."""
        S, bound = self._schur, self._bound
        y = np.zeros(len(self._rest))
        if added is not None:
            j = int(np.flatnonzero(self._rest == added)[0])
            if self._non_negative[added]:
                bound = np.append(bound, j)
            else:
                S = S - np.outer(S[j], S[j] / S[j, j])
        y[bound] = self._minimum(S, bound)
        if added is not None and not self._non_negative[added]:
            y[j] = (self._schur[j, -1] - self._schur[j] @ y) / self._schur[j, j]
        y[-1] = -1.0
        x = np.zeros(len(self._scale))
        x[self._rest] = y
        x[self._free] = scipy.linalg.solve_triangular(
            self._factor, -self._coupling @ y, lower=True, trans=1, check_finite=False
        )
        return (x * self._scale)[:-1]

    def _minimum(self, S: NDArray[np.float64], bound: NDArray[np.int_]) -> NDArray[np.float64]:
        """Returns y >= 0 that minimises y' S y / 2 - b' y, starting from the current positive set.

        All unknowns with a wrong sign, or with a wrong slope at 0, change sets at once (Portugal, Judice and Vicente,
        1994). This takes a few solutions. If it cycles, the method of Lawson and Hanson is used.
        """
        H, b = S[bound[:, None], bound], S[bound, -1]
        positive = np.append(self._positive, np.ones(len(b) - len(self._positive), dtype=bool))
        for _ in range(MAX_EXCHANGES):
            y = np.zeros(len(b))
            y[positive] = np.linalg.solve(H[np.ix_(positive, positive)], b[positive])
            wrong = np.where(positive, y <= 0, H @ y < b)
            if not np.any(wrong):
                return y
            positive ^= wrong
        L = np.linalg.cholesky(H)
        return np.asarray(nnls(L.T, _solve_lower(L, b))[0])


def _solve_lower(L: NDArray, b: NDArray) -> NDArray[np.float64]:
    return np.asarray(scipy.linalg.solve_triangular(L, b, lower=True, check_finite=False))
