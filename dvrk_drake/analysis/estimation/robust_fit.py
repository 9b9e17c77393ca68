"""Weighted least squares over poses, with Gaussian priors, robust weights and closed-form leave-one-out residuals.

Poses are not fitted with `Estimator`, which is for motions. A pose can be an outlier, so that each of its efforts has a
weight of its own, and each pose is predicted from all others, for which `Estimator` would need one fit per pose.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

#: Residuals above the first number of robust standard deviations get a smaller weight (Huber). Residuals above the
#: second number get a weight of zero. Of normal errors, 0.3 % exceed the first number, which costs 0.04 % of the
#: information, and 2e-9 exceed the second one.
HUBER_LIMIT, REJECTION_LIMIT = 3.0, 6.0
#: Number of folds for cross-validation, see `blocks`. Each fit then uses 90 % of the poses, almost as many as the
#: model.
FOLDS = 10
#: Largest degrees of freedom. Student's t distribution with more is the normal distribution within 1e-6.
MAX_FREEDOM = 1e6


@dataclass(frozen=True)
class LinearFit:
    """Fit of tau = X theta over m poses of n joints.

    Attributes:
        theta: Estimates (p,) of the parameters.
        covariance: Covariance (p, p) of theta, for unit variance of the weighted residuals.
        residuals: Measured minus fitted values (m, n) of all measurements, including measurements with zero weight.
        leave_one_out_residuals: Measured values minus predictions (m, n) of a fit to all other poses.
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
        sigma: Standard deviations (n,) of the errors of each joint, with a correction for the degrees of freedom.
        outliers: Mask (m, n) of the outliers, which have zero weight.
        degrees_of_freedom: Degrees of freedom (p,) of Student's t distribution of each parameter's error, divided by
            its standard error.
    """

    fit: LinearFit
    sigma: NDArray[np.float64]
    outliers: NDArray[np.bool_]
    degrees_of_freedom: NDArray[np.float64]


def weighted_fit(
    X: NDArray[np.float64],
    tau: NDArray[np.float64],
    weights: NDArray[np.float64],
    prior_precision: NDArray[np.float64],
) -> LinearFit:
    """Minimizes sum(weights (tau - X theta)^2) + sum(prior_precision theta^2).

    The leave-one-out residuals of pose i are exactly (I - H_i)^-1 e_i. Here e_i are the residuals and W_i the weights
    of pose i, A^-1 is the covariance of theta, and H_i = X_i A^-1 X_i' W_i is a block of the hat matrix.

    Args:
        X: Regressor (m, n, p).
        tau: Measured torques (m, n).
        weights: Inverse variances (m, n); 0 excludes a measurement.
        prior_precision: Inverse prior variances (p,) of the parameters about zero; 0 means no prior.

    Raises:
        numpy.linalg.LinAlgError: Theta is not identifiable from the data and the prior.
    """
    theta, covariance = _estimate(X, tau, weights, prior_precision)
    residuals = tau - X @ theta
    hat = X @ covariance @ (weights[..., None] * X).transpose(0, 2, 1)
    leave_one_out = np.linalg.solve(np.eye(tau.shape[1]) - hat, residuals[..., None])[..., 0]
    return LinearFit(theta, covariance, residuals, np.asarray(leave_one_out))


def _estimate(
    X: NDArray[np.float64],
    tau: NDArray[np.float64],
    weights: NDArray[np.float64],
    prior_precision: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Returns the parameters (p,) and their covariance (p, p), see `weighted_fit`."""
    rows = X.reshape(-1, X.shape[2])
    weighted = (weights[..., None] * X).reshape(rows.shape)
    A = rows.T @ weighted + np.diag(prior_precision)
    # The matrix is scaled to a unit diagonal, because the parameters differ by orders of magnitude.
    scale = 1 / np.sqrt(np.diag(A))
    covariance = np.linalg.inv(A * np.outer(scale, scale)) * np.outer(scale, scale)
    return covariance @ (weighted.T @ tau.ravel()), covariance


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
        X: Regressor (m, n, p).
        tau: Measured torques (m, n).
        usable: Mask (m, n) of the measurements that are not excluded.
        prior_precision: Inverse prior variances (p,), see `weighted_fit`.
        sigma_floor: Smallest standard deviations (n,) of the joints.
        iterations: Number of reweighting iterations.
        start: Initial standard deviations (n,). None: the robust standard deviations of tau.
    """
    sigma = np.maximum(_spread(tau, usable) if start is None else start, sigma_floor)
    weights = usable.astype(float)
    for _ in range(iterations):
        theta, covariance = _estimate(X, tau, weights / sigma**2, prior_precision)
        # Number of parameters that the efforts of each joint determine: the trace of its part of the hat matrix.
        fitted = (weights / sigma**2 * np.sum((X @ covariance) * X, axis=2)).sum(axis=0)
        residuals = tau - X @ theta
        scale = np.maximum(_spread(residuals, usable), sigma_floor)
        u = np.abs(residuals) / scale
        huber = np.where(u <= HUBER_LIMIT, 1.0, HUBER_LIMIT / np.maximum(u, HUBER_LIMIT))
        weights = usable * np.where(u <= REJECTION_LIMIT, huber, 0.0)
        free = np.maximum(weights.sum(axis=0) - fitted, 1.0)
        sigma = np.maximum(np.sqrt((weights * residuals**2).sum(axis=0) / free), sigma_floor)
    fit = weighted_fit(X, tau, weights / sigma**2, prior_precision)
    # Variances (p, n) of the parameters due to the errors of each joint. Their sum has the degrees of freedom of
    # Satterthwaite, "An approximate distribution of estimates of variance components" (1946). The variance that the
    # prior adds is known.
    variances = np.einsum("mn,mnp->pn", weights / sigma**2, (X @ fit.covariance) ** 2)
    squares = np.sum(variances**2 / free, axis=1)
    freedom = np.minimum(np.diag(fit.covariance) ** 2 / np.maximum(squares, np.finfo(float).tiny), MAX_FREEDOM)
    return RobustFit(fit, sigma, usable & (weights == 0.0), freedom)


def blocks(count: int, number: int) -> NDArray[np.int_]:
    """Returns the index (count,) of the block of successive poses to which each pose belongs.

    Successive poses are often neighbours, for example in a sweep, and have similar errors. If they are in different
    folds, the errors of the model repeat in the held-out fold, and cross-validation does not find them.
    """
    return np.arange(count) * min(number, count) // count


def rms(values: NDArray[np.float64]) -> float:
    """Returns the root mean square of an array, 0 if the array is empty."""
    return float(np.sqrt(np.mean(values**2))) if len(values) else 0.0


def _spread(values: NDArray[np.float64], usable: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Returns the robust standard deviations about zero (n,), one per column: 1.4826 median |x|, with a lower limit.

    The lower limit is half of the estimate from the 90 % quantile of |x|. Without this limit, the result could be 0,
    because friction keeps many torques of a wrist near zero.
    """
    count = usable.sum(axis=0)
    enough = np.flatnonzero(count >= 3)
    spread = np.ones(values.shape[1])
    # numpy.nanquantile gives the same quantiles, but needs ten times as long for small arrays.
    ordered = np.sort(np.where(usable, np.abs(values), np.inf)[:, enough], axis=0)
    median, high = (_quantiles(ordered, count[enough], share) for share in (0.5, 0.9))
    spread[enough] = np.maximum(1.4826 * median, 0.5 * high / 1.645)
    return spread


def _quantiles(ordered: NDArray[np.float64], count: NDArray[np.int_], share: float) -> NDArray[np.float64]:
    """Returns the quantile (n,) of the first `count` (n,) rows of each column of sorted values (m, n)."""
    place, column = share * (count - 1), np.arange(len(count))
    below = place.astype(int)
    low, high = ordered[below, column], ordered[np.minimum(below + 1, count - 1), column]
    return np.asarray(low + (place - below) * (high - low))
