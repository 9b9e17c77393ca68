"""How well data determine the parameters of a linear model: standard errors and parameters that go together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dvrk_drake.errors import IdentificationError

#: Above this size of their correlation the data tell the sum or difference of two parameters, hardly each of them.
STRONG_CORRELATION = 0.95
#: Smallest eigenvalue of an information matrix scaled to a unit diagonal that can be told from rounding.
_SMALLEST_EIGENVALUE = 1e-13


@dataclass(frozen=True)
class StrongCorrelation:
    """Two parameters that the data hardly tell apart; `correlation` of their estimates, -1..1."""

    first: str
    second: str
    correlation: float

    def __str__(self) -> str:
        what = "difference" if self.correlation > 0 else "sum"
        pair = f"{self.first} and {self.second}"
        return f"{pair}: correlation {self.correlation:+.3f}, only their scaled {what} is well known"


@dataclass(frozen=True, eq=False)
class ParameterUncertainty:
    """Of the estimates of b parameters.

    Attributes:
        names: (b,).
        standard_errors: (b,) in the parameters' units.
        correlation: (b, b) of the estimates.
    """

    names: tuple[str, ...]
    standard_errors: NDArray[np.float64]
    correlation: NDArray[np.float64]

    @classmethod
    def of_covariance(cls, names: Sequence[str], covariance: NDArray[np.float64]) -> ParameterUncertainty:
        """From the covariance (b, b) of the estimates."""
        spread = np.sqrt(np.diag(covariance))
        return cls(tuple(names), spread, covariance / np.outer(spread, spread))

    def strong_correlations(self, limit: float = STRONG_CORRELATION) -> list[StrongCorrelation]:
        """Pairs whose correlation exceeds `limit` in size, the strongest first."""
        size = np.abs(np.triu(self.correlation, 1))
        pairs = sorted(np.argwhere(size > limit).tolist(), key=lambda pair: -size[tuple(pair)])
        return [StrongCorrelation(self.names[i], self.names[k], float(self.correlation[i, k])) for i, k in pairs]


def parameter_uncertainty(names: Sequence[str], information: ArrayLike) -> ParameterUncertainty:
    """Standard errors and correlations from an information matrix.

    Args:
        names: (b,) of the parameters.
        information: (b, b) Y' W Y with the inverse variances W of the rows' noise (plus what a prior knows): the
            covariance of the estimate is its inverse. Rows whose noise is not independent count less than one each.

    Raises:
        IdentificationError: the data do not determine the parameters; names those that they leave open.
    """
    N = np.asarray(information, float)
    if N.shape != (len(names),) * 2 or not np.all(np.isfinite(N)):
        raise IdentificationError(f"information matrix {N.shape} must be finite and ({len(names)}, {len(names)})")
    # Scaled to a unit diagonal: parameters range over decades (kg m^2 at the shoulder, g mm^2 at the handle).
    diagonal = np.diag(N)
    if not np.all(diagonal > 0):
        unmoved = [name for name, size in zip(names, diagonal, strict=True) if not size > 0]
        raise IdentificationError(f"the data say nothing of {', '.join(unmoved)}")
    scale = 1 / np.sqrt(diagonal)
    eigenvalues, vectors = np.linalg.eigh(N * np.outer(scale, scale))
    if eigenvalues[0] < _SMALLEST_EIGENVALUE:
        largest = np.argsort(-np.abs(vectors[:, 0]))[:3]
        open_ones = ", ".join(names[i] for i in sorted(largest) if abs(vectors[i, 0]) > 0.1)
        raise IdentificationError(f"the data do not tell a combination of {open_ones}: move more, or give a prior")
    scaled_covariance = (vectors / eigenvalues) @ vectors.T
    spread = np.sqrt(np.diag(scaled_covariance))
    return ParameterUncertainty(tuple(names), scale * spread, scaled_covariance / np.outer(spread, spread))


def information_matrix(Y: NDArray[np.float64], residual_variance: ArrayLike) -> NDArray[np.float64]:
    """(b, b) Y' W Y of a regressor Y (m, n, b) whose joints' residuals have the variances (n,) [N^2 m^2; N^2]."""
    weighted = Y / np.sqrt(np.asarray(residual_variance, float))[:, None]
    rows = weighted.reshape(-1, Y.shape[-1])
    return rows.T @ rows
