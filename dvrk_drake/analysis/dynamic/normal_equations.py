"""Least squares over many parts of a motion at once: sums of squares and products, fold by fold, and what they give."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import scipy.linalg
from numpy.typing import NDArray
from scipy.optimize import nnls


@dataclass(frozen=True, eq=False)
class NormalEquations:
    """[X tau]'[X tau] of every actuator over every part of a motion.

    Attributes:
        products: (n, folds, 3, k + 1, k + 1); the three parts of a fold are its start, its middle and its end, the last
            column is the measured effort.
    """

    products: NDArray[np.float64]

    @classmethod
    def of(
        cls,
        columns: Iterable[NDArray[np.float64]],
        tau: NDArray[np.float64],
        fold: NDArray[np.int_],
        edge: NDArray[np.bool_],
    ) -> NormalEquations:
        """Sums up.

        Args:
            columns: (r, k) of each of the n actuators.
            tau: (r, n).
            fold: (r,) of each row.
            edge: (r, 2) whether it is at the start, at the end of its fold.
        """
        folds = int(fold.max()) + 1
        part = np.where(edge[:, 0], 0, np.where(edge[:, 1], 2, 1)) + 3 * fold
        products = []
        for i, X in enumerate(columns):
            full = np.column_stack([X, tau[:, i]])
            k, some = full.shape[1], np.flatnonzero(np.any(full, axis=0))
            sums = np.zeros((folds, 3, k, k))
            for b in range(3 * folds):
                rows = full[part == b][:, some]
                sums[b // 3, b % 3][np.ix_(some, some)] = rows.T @ rows
            products.append(sums)
        return cls(np.array(products))

    @property
    def folds(self) -> int:
        """Number of folds."""
        return self.products.shape[1]

    def others(self, first: int, count: int) -> NDArray[np.int_]:
        """(folds - count,) which folds come after `count` from `first` on, in their circle."""
        return np.arange(first + count, first + self.folds) % self.folds

    def without(self, first: int, count: int) -> NormalEquations:
        """Of the other folds, without the edges that touch those."""
        products = self.products[:, self.others(first, count)]
        products[:, 0, 0] = 0.0
        products[:, -1, 2] = 0.0
        return NormalEquations(products)

    def total(self) -> NDArray[np.float64]:
        """(n, k + 1, k + 1) over the whole motion."""
        return self.products.sum(axis=(1, 2))

    def of_fold(self, fold: int, count: int = 1) -> NDArray[np.float64]:
        """(n, k + 1, k + 1) over `count` folds from one on."""
        return self.products[:, np.arange(fold, fold + count) % self.folds].sum(axis=(1, 2))

    def without_fold(self, fold: int, count: int = 1) -> NDArray[np.float64]:
        """(n, k + 1, k + 1) over all rows but those of `count` folds from one on and those of neighbours that touch."""
        before, after = (fold - 1) % self.folds, (fold + count) % self.folds
        return self.total() - self.of_fold(fold, count) - self.products[:, before, 2] - self.products[:, after, 0]


def squared_errors(products: NDArray[np.float64], x: NDArray[np.float64]) -> NDArray[np.float64]:
    """(n,) sum of squares that x (k,) leaves, from products (n, k + 1, k + 1)."""
    residual = np.append(-x, 1.0)
    return np.maximum(np.einsum("a,nab,b->n", residual, products, residual, optimize=True), 0.0)


def solve(
    products: NDArray[np.float64],
    weights: NDArray[np.float64],
    precision: NDArray[np.float64],
    non_negative: NDArray[np.bool_],
) -> NDArray[np.float64]:
    """x (k,) that minimises sum_i weights_i |tau_i - X_i x|^2 + sum_j precision_j x_j^2, some of it not negative.

    What may have any sign is eliminated first; the rest is scipy's non-negative least squares (Lawson and Hanson).

    Args:
        products: (n, k + 1, k + 1).
        weights: (n,) one over the variance of an effort.
        precision: (k,) one over the variance of each unknown about 0, before the recording; positive.
        non_negative: (k,).
    """
    sums = np.tensordot(weights, products, axes=(0, 0))
    H = sums[:-1, :-1] + np.diag(precision)
    scale = 1 / np.sqrt(np.diag(H))
    H, b = H * np.outer(scale, scale), sums[:-1, -1] * scale
    free, bound = np.flatnonzero(~non_negative), np.flatnonzero(non_negative)
    factor = scipy.linalg.cho_factor(H[np.ix_(free, free)], lower=True, check_finite=False)
    x = np.zeros(len(b))
    if len(bound):
        coupling = scipy.linalg.cho_solve(factor, H[np.ix_(free, bound)], check_finite=False)
        left = H[np.ix_(bound, bound)] - H[np.ix_(bound, free)] @ coupling
        L = np.linalg.cholesky(left)
        x[bound] = nnls(L.T, scipy.linalg.solve_triangular(L, b[bound] - coupling.T @ b[free], lower=True))[0]
        b = b - H[:, bound] @ x[bound]
    x[free] = scipy.linalg.cho_solve(factor, b[free], check_finite=False)
    return x * scale
