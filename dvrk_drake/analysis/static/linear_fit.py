"""Weighted least squares over poses, with shrinkage, robust weights and closed-form leave-one-pose-out residuals."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

#: Residuals beyond the first number of robust standard deviations have less weight (Huber), beyond the second none.
HUBER_LIMIT, REJECTION_LIMIT = 3.0, 6.0


@dataclass(frozen=True)
class LinearFit:
    """Fit of tau = X theta over m poses of n joints.

    Attributes:
        theta: (p,) estimates.
        covariance: (p, p) covariance of theta, for unit variance of the weighted residuals.
        residuals: (m, n) measured minus fitted values of all measurements, including those with zero weight.
        leave_one_out_residuals: (m, n) measured values minus predictions of a fit to all other poses.
    """

    theta: NDArray[np.float64]
    covariance: NDArray[np.float64]
    residuals: NDArray[np.float64]
    leave_one_out_residuals: NDArray[np.float64]


@dataclass(frozen=True)
class RobustFit:
    """`LinearFit` with robust weights.

    Attributes:
        fit: Last weighted fit.
        sigma: (n,) standard deviation of each joint's residual.
        outliers: (m, n) mask of the rejected measurements.
    """

    fit: LinearFit
    sigma: NDArray[np.float64]
    outliers: NDArray[np.bool_]


def weighted_fit(
    X: NDArray[np.float64],
    tau: NDArray[np.float64],
    weights: NDArray[np.float64],
    prior_precision: NDArray[np.float64],
) -> LinearFit:
    """Minimizes sum(weights (tau - X theta)^2) + sum(prior_precision theta^2).

    The leave-one-out residuals are exact. For pose i with hat block H_i = X_i A^-1 X_i' W_i they are (I - H_i)^-1 e_i.

    Args:
        X: (m, n, p) regressor.
        tau: (m, n) measured torques.
        weights: (m, n) inverse variances; 0 excludes a measurement.
        prior_precision: (p,) inverse variance of each parameter about zero; 0 for no shrinkage.

    Raises:
        numpy.linalg.LinAlgError: The data and the prior together do not determine theta.
    """
    WX = weights[..., None] * X
    A = np.einsum("mnp,mnr->pr", X, WX) + np.diag(prior_precision)
    # Scale to a unit diagonal, because parameters range over decades (kg m at the shoulder, g mm at the handle).
    scale = 1 / np.sqrt(np.diag(A))
    covariance = np.linalg.inv(A * np.outer(scale, scale)) * np.outer(scale, scale)
    theta = covariance @ np.einsum("mnp,mn->p", WX, tau)
    residuals = tau - X @ theta
    hat = np.einsum("mip,pr,mjr->mij", X, covariance, WX, optimize=True)
    left_out = np.linalg.solve(np.eye(tau.shape[1]) - hat, residuals[..., None])[..., 0]
    return LinearFit(theta, covariance, residuals, left_out)


def robust_fit(
    X: NDArray[np.float64],
    tau: NDArray[np.float64],
    usable: NDArray[np.bool_],
    prior_precision: NDArray[np.float64],
    sigma_floor: NDArray[np.float64],
    iterations: int = 12,
    start: NDArray[np.float64] | None = None,
) -> RobustFit:
    """Fits by iteratively reweighted least squares, with one variance per joint and reduced weights for outliers.

    Args:
        X: (m, n, p) regressor.
        tau: (m, n) measured torques.
        usable: (m, n) False excludes a measurement.
        prior_precision: (p,) prior precision, as in `weighted_fit`.
        sigma_floor: (n,) least standard deviation to assume for each joint.
        iterations: Number of reweighting iterations.
        start: (n,) initial standard deviations. By default they are the spread of tau.
    """
    sigma = np.maximum(_spread(tau, usable) if start is None else start, sigma_floor)
    weights = usable.astype(float)
    fit = weighted_fit(X, tau, weights / sigma**2, prior_precision)
    for _ in range(iterations):
        scale = np.maximum(_spread(fit.residuals, usable), sigma_floor)
        u = np.abs(fit.residuals) / scale
        huber = np.where(u <= HUBER_LIMIT, 1.0, HUBER_LIMIT / np.maximum(u, HUBER_LIMIT))
        weights = usable * np.where(u <= REJECTION_LIMIT, huber, 0.0)
        squares = (weights * fit.residuals**2).sum(axis=0) / np.maximum(weights.sum(axis=0), 1.0)
        sigma = np.maximum(np.sqrt(squares), sigma_floor)
        fit = weighted_fit(X, tau, weights / sigma**2, prior_precision)
    return RobustFit(fit, sigma, usable & (weights == 0.0))


def rms(values: NDArray[np.float64]) -> float:
    """Returns the root mean square, 0 for an empty array."""
    return float(np.sqrt(np.mean(values**2))) if len(values) else 0.0


def _spread(values: NDArray[np.float64], usable: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Returns a robust standard deviation about zero of each column: 1.4826 median |x|, with a lower limit.

    The lower limit is half of the estimate from the 90 % quantile. Friction keeps many torques of a wrist near zero, so
    the median alone may be 0.
    """
    masked = np.where(usable, np.abs(values), np.nan)
    enough = usable.sum(axis=0) >= 3
    spread = np.ones(values.shape[1])
    if np.any(enough):
        median, high = np.nanquantile(masked[:, enough], [0.5, 0.9], axis=0)
        spread[enough] = np.maximum(1.4826 * median, 0.5 * high / 1.645)
    return spread
