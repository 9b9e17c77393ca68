"""Least squares over many parts of a motion at once: sums of squares and products, fold by fold, and what they give."""

from __future__ import annotations

import itertools
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.linalg
from numpy.typing import NDArray
from scipy.optimize import nnls

#: Exchanges of unknowns between positive and 0 that are tried.
MAX_EXCHANGES = 10
#: Indices of an actuator's own columns among all, and these (r, c); the others are 0 for it.
OwnColumns = tuple[NDArray[np.int_], NDArray[np.float64]]


@dataclass(frozen=True, eq=False)
class SquareSums:
    """[X tau]'[X tau] of every actuator over some rows.

    Attributes:
        size: k + 1, of all columns and the measured effort, which is the last.
        own: (n) indices of each actuator's own columns, with that of the effort.
        blocks: (n) their (c, c) sums of products.
    """

    size: int
    own: tuple[NDArray[np.int_], ...]
    blocks: tuple[NDArray[np.float64], ...]

    def weighted(self, weights: NDArray[np.float64]) -> NDArray[np.float64]:
        """(k + 1, k + 1) sum over the actuators, each times its weight."""
        sums = np.zeros((self.size, self.size))
        for weight, own, block in zip(weights, self.own, self.blocks, strict=True):
            sums[own[:, None], own] += weight * block
        return sums

    def squares(self, combination: NDArray[np.float64]) -> NDArray[np.float64]:
        """(n,) sum of squares of a combination (k + 1,) of the columns and the effort."""
        parts = [combination[own] for own in self.own]
        return np.array([max(x @ block @ x, 0.0) for x, block in zip(parts, self.blocks, strict=True)])

    def squared_errors(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """(n,) sum of squares that x (k,) leaves of the efforts."""
        return self.squares(np.append(-x, 1.0))

    def dense(self) -> NDArray[np.float64]:
        """(n, k + 1, k + 1)."""
        return np.array([self.weighted(unit) for unit in np.eye(len(self.own))])


@dataclass(frozen=True, eq=False)
class NormalEquations:
    """[X tau]'[X tau] of every actuator over every part of a motion.

    Attributes:
        size, own: as of `SquareSums`.
        products: (n) of (folds, 3, c, c); the three parts of a fold are its start, its middle and its end.
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
        """Sums up.

        Args:
            columns: of each of the n actuators.
            size: k, number of all columns.
            tau: (r, n).
            fold: (r,) of each row; by default there is one.
            edge: (r, 2) whether it is at the start, at the end of its fold.
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
        """(folds - count,) which folds come after `count` from `first` on, in their circle."""
        return np.arange(first + count, first + self.folds) % self.folds

    def without(self, first: int, count: int) -> NormalEquations:
        """Of the other folds, without the edges that touch those."""
        products = tuple(p[self.others(first, count)] for p in self.products)
        for p in products:
            p[0, 0] = 0.0
            p[-1, 2] = 0.0
        return NormalEquations(self.size, self.own, products)

    @cached_property
    def total(self) -> SquareSums:
        """Over the whole motion."""
        return self._sums(p.sum(axis=(0, 1)) for p in self.products)

    def of_fold(self, fold: int, count: int = 1) -> SquareSums:
        """Over `count` folds from one on."""
        chosen = np.arange(fold, fold + count) % self.folds
        return self._sums(p[chosen].sum(axis=(0, 1)) for p in self.products)

    def without_fold(self, fold: int, count: int = 1) -> SquareSums:
        """Over all rows but those of `count` folds from one on and those of neighbours that touch."""
        before, after = (fold - 1) % self.folds, (fold + count) % self.folds
        out = self.of_fold(fold, count).blocks
        blocks = zip(self.total.blocks, out, self.products, strict=True)
        return self._sums(whole - own - p[before, 2] - p[after, 0] for whole, own, p in blocks)

    def _sums(self, blocks: Iterable[NDArray[np.float64]]) -> SquareSums:
        return SquareSums(self.size, self.own, tuple(blocks))


class NonNegativeFit:
    """x (k,) that minimises a weighted sum of squares, some of it not negative, for one choice of unknowns or one more.

    |y|^2 - 2 y' X x + x' (X' X + diag(precision)) x is least at x. What may have any sign is eliminated first, which
    leaves the Schur complement of the others; one more unknown is a row more of it, or one more step of elimination.
    What remains is a small problem of non-negative least squares.
    """

    def __init__(
        self,
        sums: NDArray[np.float64],
        precision: NDArray[np.float64],
        non_negative: NDArray[np.bool_],
        used: NDArray[np.int_],
        others: NDArray[np.int_] | None = None,
    ) -> None:
        """Eliminates.

        Args:
            sums: (k + 1, k + 1) weighted sums of squares and products, the measured effort last.
            precision: (k,) one over the variance of each unknown about 0, before the recording; positive.
            non_negative: (k,).
            used: indices of the unknowns; the others are 0.
            others: indices of those that `solve` may add.
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
        """x (k,), with one of `others` if given."""
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
        """Returns y >= 0 that minimises y' S y / 2 - b' y, from the unknowns that are positive without the new one.

        All unknowns whose sign, or whose slope at 0, is wrong change sides at once (Portugal, Judice and Vicente,
        1994), which takes a few solutions; should it cycle, Lawson and Hanson's method follows.
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
