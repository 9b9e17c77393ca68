"""Accumulates the normal equations of a motion per fold, and solves non-negative least-squares problems."""

from __future__ import annotations

import itertools
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.linalg
from numpy.typing import NDArray
from scipy.optimize import nnls

#: Maximum number of iterations in which unknowns change between the positive set and the zero set. If they are not
#: sufficient, a slower method is used. Half the number changes no result of the public motions `mtm_one` and `psm_one`.
MAX_EXCHANGES = 10
#: Indices (c,) of the nonzero regressor columns of one actuator, and the values (r, c) of these columns.
OwnColumns = tuple[NDArray[np.int_], NDArray[np.float64]]


def fold_sums(values: NDArray, fold: NDArray[np.int_]) -> NDArray[np.float64]:
    """Returns the sums (folds, n) of the rows of each fold, for values (r, n) and the fold (r,) of each row."""
    return np.array([np.sum(values[fold == k], axis=0) for k in range(int(fold.max()) + 1)], dtype=float)


@dataclass(frozen=True, eq=False)
class SquareSums:
    """Products [X tau]'[X tau] of every actuator, summed over a set of rows of each recording.

    X (r, k) contains the regressor columns, and tau (r,) contains the efforts of the actuator at these rows.

    Attributes:
        size: Number k + 1 of columns. The last column is the measured effort.
        own: Indices (c,) of the nonzero columns of each actuator, including the column of the effort.
        blocks: Sums of products (s, c, c) of these columns in each of s recordings, for each actuator.
    """

    size: int
    own: tuple[NDArray[np.int_], ...]
    blocks: tuple[NDArray[np.float64], ...]

    def weighted(self, weights: NDArray[np.float64]) -> NDArray[np.float64]:
        """Returns the weighted sum (k + 1, k + 1) of the products of all actuators, for weights (s, n) or (n,)."""
        sums = np.zeros((self.size, self.size))
        for weight, own, block in zip(np.atleast_2d(weights).T, self.own, self.blocks, strict=True):
            sums[own[:, None], own] += np.tensordot(weight, block, axes=1)
        return sums

    def squared_errors(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """Returns the sums of squared residuals (s, n) of the actuators in each recording for unknowns x (k,)."""
        combination = np.append(-x, 1.0)
        coefficients = [combination[own] for own in self.own]
        return np.maximum(np.transpose([block @ c @ c for c, block in zip(coefficients, self.blocks, strict=True)]), 0)

    def dense(self) -> NDArray[np.float64]:
        """Returns the products (n, k + 1, k + 1) over all recordings as a dense array."""
        units = np.eye(len(self.own))
        return np.array([self.weighted(np.tile(unit, (len(self.blocks[0]), 1))) for unit in units])


@dataclass(frozen=True, eq=False)
class NormalEquations:
    """Products [X tau]'[X tau] of every actuator, for every fold of a motion.

    Attributes:
        size: Number of columns, see `SquareSums`.
        own: Indices of the nonzero columns of each actuator, see `SquareSums`.
        products: Products (folds, 3, c, c) of each actuator. The second index selects the start, the middle or the end
            of a fold.
        member: Matrix (s, folds), 1.0 if the fold belongs to the recording, otherwise 0.
    """

    size: int
    own: tuple[NDArray[np.int_], ...]
    products: tuple[NDArray[np.float64], ...]
    member: NDArray[np.float64]

    @classmethod
    def of(
        cls,
        columns: Iterable[OwnColumns],
        size: int,
        tau: NDArray[np.float64],
        fold: NDArray[np.int_] | None = None,
        edge: NDArray[np.bool_] | None = None,
        recording: NDArray[np.int_] | None = None,
    ) -> NormalEquations:
        """Accumulates the products of all rows.

        Args:
            columns: Indices and values of the nonzero columns, for each of the n actuators.
            size: Number k of regressor columns.
            tau: Measured efforts (r, n).
            fold: Index (r,) of the fold of each row. If None, each recording is a fold.
            edge: Masks (r, 2) of the rows at the start and at the end of their fold. If None, no row is marked.
            recording: Index (r,) of the recording of each row. If None, all rows are in one recording. A fold has rows
                of one recording only.
        """
        recording = np.zeros(len(tau), dtype=int) if recording is None else recording
        fold = recording if fold is None else fold
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
        member = np.zeros((int(recording.max()) + 1, folds))
        member[recording, fold] = 1.0
        return cls(size + 1, tuple(owns), tuple(products), member)

    @property
    def folds(self) -> int:
        """Number of folds."""
        return self.products[0].shape[0]

    def others(self, first: int, count: int) -> NDArray[np.int_]:
        """Returns the indices of all folds except `count` adjacent folds that start with `first`.

        The result (folds - count,) is in cyclic order and starts with the fold after the excluded folds.
        """
        return np.arange(first + count, first + self.folds) % self.folds

    def without(self, first: int, count: int) -> NormalEquations:
        """Returns the normal equations without `count` adjacent folds that start with `first`.

        The rows next to these folds, at the edges of the neighbouring folds, are also excluded.
        """
        others = self.others(first, count)
        products = tuple(p[others] for p in self.products)
        for p in products:
            p[0, 0] = 0.0
            p[-1, 2] = 0.0
        return NormalEquations(self.size, self.own, products, self.member[:, others])

    @cached_property
    def total(self) -> SquareSums:
        """Sums over all rows."""
        return self._sums(np.ones((self.folds, 3)))

    def of_fold(self, fold: int) -> SquareSums:
        """Returns the sums over the rows of one fold."""
        kept = np.zeros((self.folds, 3))
        kept[fold] = 1.0
        return self._sums(kept)

    def without_fold(self, fold: int, count: int = 1) -> SquareSums:
        """Returns the sums over all rows except those of `count` adjacent folds that start with `fold`.

        The rows next to these folds, at the edges of the neighbouring folds, are also excluded.
        """
        kept = np.ones((self.folds, 3))
        kept[np.arange(fold, fold + count) % self.folds] = 0.0
        kept[(fold - 1) % self.folds, 2] = kept[(fold + count) % self.folds, 0] = 0.0
        return self._sums(kept)

    def _sums(self, kept: NDArray[np.float64]) -> SquareSums:
        """Returns the sums over the parts of folds for which `kept` (folds, 3) is 1.0."""
        parts = (self.member[:, :, None] * kept).reshape(len(self.member), -1)
        sums = ((parts @ p.reshape(parts.shape[1], -1)).reshape(-1, *p.shape[2:]) for p in self.products)
        return SquareSums(self.size, self.own, tuple(sums))


class NonNegativeFit:
    """Weighted non-negative least squares for a set of unknowns, optionally with one additional unknown.

    The solution x (k,) minimises |y|^2 - 2 y' X x + x' (X' X + diag(precision)) x for weighted efforts y and columns X.
    Unknowns without a sign constraint are eliminated first. The Schur complement of the constrained unknowns remains.
    An additional unknown with a sign constraint adds one row to this complement. An additional unknown without a sign
    constraint is also eliminated. The remaining problem is a small non-negative least-squares problem.
    """

    def __init__(
        self,
        sums: NDArray[np.float64],
        precision: NDArray[np.float64],
        non_negative: NDArray[np.bool_],
        used: NDArray[np.int_],
        candidates: NDArray[np.int_] | None = None,
        fixed: NDArray[np.float64] | float = 0.0,
    ) -> None:
        """Eliminates the unknowns without a sign constraint.

        Args:
            sums: Weighted sums of products (k + 1, k + 1). The last column is the measured effort.
            precision: Reciprocals (k,) of the prior variances of the unknowns, greater than 0. The prior means are 0.
            non_negative: Mask (k,) of the unknowns that must not be negative.
            used: Indices of the unknowns in the fit.
            candidates: Indices of the unknowns that `solve` may add. If None, `solve` cannot add an unknown.
            fixed: Values (k,) of the unknowns that are not in the fit, 0 for all others. Their efforts are not in
                `sums`.
        """
        self._fixed = fixed
        self._scale = np.append(1 / np.sqrt(np.diag(sums)[:-1] + precision), 1.0)
        self._free, constrained = used[~non_negative[used]], used[non_negative[used]]
        self._constrained, self._non_negative = np.arange(len(constrained)), non_negative
        self._remaining = np.concatenate(
            [constrained, [] if candidates is None else candidates, [len(precision)]]
        ).astype(int)

        def scaled(rows: NDArray[np.int_], columns: NDArray[np.int_]) -> NDArray[np.float64]:
            return sums[rows[:, None], columns] * self._scale[rows, None] * self._scale[columns]

        H = scaled(self._free, self._free)
        H[np.diag_indices_from(H)] = 1.0
        self._factor = scipy.linalg.cholesky(H, lower=True, check_finite=False)
        self._coupling = _solve_lower(self._factor, scaled(self._free, self._remaining))
        S = scaled(self._remaining, self._remaining)
        S[np.diag_indices(len(S) - 1)] = 1.0
        self._schur = S - self._coupling.T @ self._coupling
        self._positive = np.ones(len(constrained), dtype=bool)
        self._positive = self._minimum(self._schur, self._constrained) > 0

    def solve(self, added: int | None = None) -> NDArray[np.float64]:
        """Returns the solution x (k,).

        Args:
            added: Index of one of the `candidates` that the fit also includes, or None.
        """
        S, constrained = self._schur, self._constrained
        y = np.zeros(len(self._remaining))
        if added is not None:
            j = int(np.flatnonzero(self._remaining == added)[0])
            if self._non_negative[added]:
                constrained = np.append(constrained, j)
            else:
                S = S - np.outer(S[j], S[j] / S[j, j])
        y[constrained] = self._minimum(S, constrained)
        if added is not None and not self._non_negative[added]:
            y[j] = (self._schur[j, -1] - self._schur[j] @ y) / self._schur[j, j]
        y[-1] = -1.0
        x = np.zeros(len(self._scale))
        x[self._remaining] = y
        x[self._free] = scipy.linalg.solve_triangular(
            self._factor, -self._coupling @ y, lower=True, trans=1, check_finite=False
        )
        return (x * self._scale)[:-1] + self._fixed

    def _minimum(self, S: NDArray[np.float64], constrained: NDArray[np.int_]) -> NDArray[np.float64]:
        """Returns y >= 0 that minimises y' H y / 2 - b' y. H and b are the elements of S for `constrained`.

        The iteration starts from the current positive set. In each iteration, positive unknowns with y <= 0 and zero
        unknowns with a negative gradient change to the other set (Portugal, Judice and Vicente, 1994). If the iteration
        does not converge, the method of Lawson and Hanson is used.
        """
        H, b = S[constrained[:, None], constrained], S[constrained, -1]
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
