"""Fits a point mass on a link to the difference of the efforts of two recordings.

The efforts are not linear in the mass and its position, so that this fit shares only the normal equations with
`Estimator`. A linear fit of the ten inertial parameters would not determine the mass on a link that rotates about a
fixed point.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from dvrk_drake.analysis.estimation.normal_equations import NormalEquations
from dvrk_drake.dynamics.inertial_parameters import PARAMETER_NAMES

#: Largest standard error of an identifiable coordinate, as a share of the largest distance. A larger error
#: does not determine the side of the link on which the payload is.
MAX_STANDARD_ERROR = 0.5
#: Distances of the initial positions from the link's own centre of mass, as shares of the largest distance. The centre
#: of mass is also an initial position. The payload is near the link or on a tool, and the best of all fits is used.
_INITIAL_DISTANCES = (0.15, 0.4)
#: Number of inertial parameters of a rigid body.
_RIGID = len(PARAMETER_NAMES)
#: Relative size of the eigenvalues of a matrix with a unit diagonal that are rounding errors. The matrices are sums
#: over at most `MAX_ROWS` rows, whose relative rounding errors are below 1e-12.
_NEGLIGIBLE = 1e-11
#: Replaces 0 as a divisor. All sums of squared efforts are many orders of magnitude larger.
_TINY = 1e-30


@dataclass(frozen=True, eq=False)
class PointMass:
    """Point mass on a link.

    Attributes:
        mass: Mass [kg].
        position: Position (3,) in the link frame [m].
        determined: Mask (3,) of the identifiable coordinates. All other coordinates are those of the link's centre of
            mass.
    """

    mass: float
    position: NDArray[np.float64]
    determined: NDArray[np.bool_]

    @property
    def parameters(self) -> NDArray[np.float64]:
        """Inertial parameters (10,) about the link's origin, in the order of `PARAMETER_NAMES`."""
        return point_mass_parameters(self.mass, self.position)


def point_mass_parameters(mass: float, position: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns the inertial parameters (10,) of a point mass about the link's origin, in the order of `PARAMETER_NAMES`.

    Args:
        mass: Mass m [kg].
        position: Position p (3,) in the link frame [m].
    """
    x, y, z = position
    moments = [y * y + z * z, x * x + z * z, x * x + y * y]
    return mass * np.array([1.0, x, y, z, *moments, -x * y, -x * z, -y * z])


@dataclass(frozen=True, eq=False)
class PointMassProblem:
    """Regression tau_i = Y_i phi(m, p) + N_i x_i for every actuator i.

    tau_i is the difference of the efforts, Y_i is the regressor of the link, and phi(m, p) are the inertial parameters
    of the point mass. The columns N_i describe possible changes of the drive. Their coefficients x_i are nuisance
    parameters with normal priors of mean 0.

    Attributes:
        equations: Normal equations. The ten columns of the link come first, then the nuisance parameters.
        independent: Number of independent measurements of each effort.
        com: Centre of mass (3,) of the link in the link frame [m].
        precision: Reciprocal prior variances (n, k) of the nuisance parameters, 0 if there is no prior.
        max_mass: Largest mass of the point mass [kg].
        max_distance: Largest distance of the point mass from `com` along each axis [m].
    """

    equations: NormalEquations
    independent: float
    com: NDArray[np.float64]
    precision: NDArray[np.float64]
    max_mass: float
    max_distance: float

    @cached_property
    def _total(self) -> NDArray[np.float64]:
        return self.equations.total.dense()

    def _without(self, fold: int) -> NDArray[np.float64]:
        """Returns the products of all rows except those of one fold."""
        return self._total - self.equations.of_fold(fold).dense()

    def fit(self, start: PointMass | None = None) -> tuple[PointMass, NDArray[np.float64], NDArray[np.float64]]:
        """Fits the point mass.

        Each actuator is weighted by the reciprocal of its residual variance. If position coordinates are not
        identifiable, the one with the largest standard error is set to that of the link's centre of mass, and the fit
        is repeated.

        Args:
            start: Initial value. None: several initial values are used, because the cost has several local minima.

        Returns:
            Point mass, weights (n,) of the actuators, and standard errors (4,) of mass and position, assuming
            independent noise.
        """
        weights = self.independent / np.maximum(self._total[:, -1, -1], _TINY)
        determined = np.ones(3, dtype=bool) if start is None else start.determined
        while True:
            body = start or self._search(self._reduced(self._total, weights), weights, determined)
            for _ in range(10):
                reduced = self._reduced(self._total, weights)
                body = self._refine(reduced, weights, body)
                weights = self.independent / np.maximum(_squared_residuals(reduced, body), _TINY)
            errors = self._standard_errors(self._reduced(self._total, weights), weights, body)
            # A coordinate at the boundary of the search region is not identifiable.
            at_boundary = np.abs(body.position - self.com) > (1 - 1e-6) * self.max_distance
            position_errors = np.where(at_boundary, np.inf, errors[1:])
            worst = int(np.argmax(np.where(determined, position_errors, 0.0)))
            if not determined[worst] or not position_errors[worst] > MAX_STANDARD_ERROR * self.max_distance:
                return body, weights, errors
            start, determined = None, determined & (np.arange(3) != worst)

    def without_fold(self, fold: int, weights: NDArray[np.float64], start: PointMass) -> PointMass:
        """Returns the point mass fitted without one fold, for the weights (n,) and the initial value `start`."""
        return self._refine(self._reduced(self._without(fold), weights), weights, start)

    def mass_at_com(self, weights: NDArray[np.float64], fold: int | None = None) -> tuple[float, float]:
        """Returns the estimated mass of a payload at the link's centre of mass and the standard error [kg].

        The standard error is valid for independent noise.

        Args:
            weights: Weights (n,) of the actuators.
            fold: Fold to exclude, or None.
        """
        products = self._total if fold is None else self._without(fold)
        H, b = _weighted(self._reduced(products, weights), weights)
        unit = point_mass_parameters(1.0, self.com)
        information = max(float(unit @ H @ unit), _TINY)
        return float(unit @ b) / information, information**-0.5

    def coefficients(self, body: PointMass, weights: NDArray[np.float64]) -> NDArray[np.float64]:
        """Returns the coefficients (n, 10 + k) of all columns for a given point mass, with fitted nuisances."""
        return self._coefficients(self._total, body.parameters, weights)

    def fold_errors(self, fold: int, weights: NDArray[np.float64], start: PointMass | None) -> NDArray[np.float64]:
        """Returns the sums of squared prediction errors (n,) of one held-out fold.

        The point mass is fitted to the other folds with the initial value `start`. If `start` is None, the prediction
        has no point mass.
        """
        others, own = self.equations.without_fold(fold).dense(), self.equations.of_fold(fold).dense()
        phi = np.zeros(_RIGID)
        if start is not None:
            phi = self._refine(self._reduced(others, weights), weights, start).parameters
        return self._residual_squares(others, own, phi, weights)

    def budget(
        self, body: PointMass, weights: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Returns the sums of squares (n,) of tau, of the efforts of the point mass, and of the residuals."""
        phi, total = body.parameters, self._total
        of_body = np.einsum("a,nab,b->n", phi, total[:, :_RIGID, :_RIGID], phi)
        return total[:, -1, -1], np.maximum(of_body, 0.0), self._residual_squares(total, total, phi, weights)

    def _residual_squares(
        self,
        training: NDArray[np.float64],
        held_out: NDArray[np.float64],
        phi: NDArray[np.float64],
        weights: NDArray[np.float64],
    ) -> NDArray[np.float64]:
        """Returns the sums of squared residuals (n,) of the held-out rows for phi (10,).

        The nuisance parameters are fitted to the training rows.
        """
        residual = np.hstack([-self._coefficients(training, phi, weights), np.ones((len(training), 1))])
        return np.maximum(np.einsum("na,nab,nb->n", residual, held_out, residual), 0.0)

    def _coefficients(
        self, products: NDArray[np.float64], phi: NDArray[np.float64], weights: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Returns phi (10,) and the nuisance parameters (k,) that are fitted to the products, for each actuator."""
        nuisances = [
            _pseudo_solve(
                H[_RIGID:-1, _RIGID:-1] + np.diag(precision / weight), H[_RIGID:-1, -1] - H[_RIGID:-1, :_RIGID] @ phi
            )
            for H, precision, weight in zip(products, self.precision, weights, strict=True)
        ]
        return np.hstack([np.tile(phi, (len(products), 1)), nuisances])

    def _reduced(self, products: NDArray[np.float64], weights: NDArray[np.float64]) -> NDArray[np.float64]:
        """Returns the products (n, 11, 11) of the link's columns and the effort.

        The nuisance parameters are eliminated.
        """
        keep = np.append(np.arange(_RIGID), products.shape[-1] - 1)
        reduced = np.empty((len(products), _RIGID + 1, _RIGID + 1))
        for i, full in enumerate(products):
            H = full[_RIGID:-1, _RIGID:-1] + np.diag(self.precision[i] / weights[i])
            coupling = full[_RIGID:-1, keep]
            reduced[i] = full[np.ix_(keep, keep)] - coupling.T @ _pseudo_solve(H, coupling)
        return reduced

    def _search(
        self, reduced: NDArray[np.float64], weights: NDArray[np.float64], determined: NDArray[np.bool_]
    ) -> PointMass:
        """Returns the best of several fits with different initial values."""
        offsets = [np.zeros(3)] + [
            s * d * self.max_distance * axis
            for d in _INITIAL_DISTANCES
            for axis in np.eye(3)[determined]
            for s in (1, -1)
        ]
        H, b = _weighted(reduced, weights)
        bodies = []
        for offset in offsets:
            unit = point_mass_parameters(1.0, self.com + offset)
            mass = float(
                np.clip(float(unit @ b) / max(float(unit @ H @ unit), _TINY), 1e-4 * self.max_mass, self.max_mass / 2)
            )
            bodies.append(self._refine(reduced, weights, PointMass(mass, self.com + offset, determined)))
        return min(bodies, key=lambda body: float(weights @ _squared_residuals(reduced, body)))

    def _refine(self, reduced: NDArray[np.float64], weights: NDArray[np.float64], start: PointMass) -> PointMass:
        A, b = _rows(reduced, weights)
        free = np.concatenate([[True], start.determined])
        lower = np.concatenate([[0.0], self.com - self.max_distance])[free]
        upper = np.concatenate([[self.max_mass], self.com + self.max_distance])[free]
        values = np.concatenate([[start.mass], start.position])

        def residual(x: NDArray[np.float64]) -> NDArray[np.float64]:
            values[free] = x
            return A @ point_mass_parameters(values[0], values[1:]) - b

        def jacobian(x: NDArray[np.float64]) -> NDArray[np.float64]:
            values[free] = x
            return (A @ _derivatives(values[0], values[1:]))[:, free]

        start_x = np.clip(values[free], lower + 1e-9, upper - 1e-9)
        result = least_squares(residual, start_x, jac=jacobian, bounds=(lower, upper), x_scale=0.1)
        values[free] = result.x
        return PointMass(float(values[0]), values[1:], start.determined)

    def _standard_errors(
        self, reduced: NDArray[np.float64], weights: NDArray[np.float64], body: PointMass
    ) -> NDArray[np.float64]:
        """Returns the standard errors (4,) of mass and position.

        A standard error is very large if the mass or coordinate is not identifiable, and 0 if the coordinate is not
        estimated.
        """
        A, _ = _rows(reduced, weights)
        jacobian = A @ _derivatives(body.mass, body.position)
        errors = np.zeros(4)
        free = np.flatnonzero(np.concatenate([[True], body.determined]))
        for k in free:
            others = jacobian[:, free[free != k]]
            own = jacobian[:, k]
            orthogonal = own - others @ np.linalg.lstsq(others, own, rcond=1e-9)[0]
            errors[k] = 1 / max(float(np.linalg.norm(orthogonal)), _TINY)
        return errors


def _squared_residuals(reduced: NDArray[np.float64], body: PointMass) -> NDArray[np.float64]:
    """Returns the sums of squared residuals (n,) for a point mass and fitted nuisance parameters."""
    residual = np.append(-body.parameters, 1.0)
    return np.maximum(np.einsum("a,nab,b->n", residual, reduced, residual), 0.0)


def _derivatives(mass: float, position: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns the derivatives (10, 4) of the inertial parameters with respect to mass and position.

    Central differences are exact because the parameters are quadratic in the position.
    """
    by_position = [
        (point_mass_parameters(mass, position + step) - point_mass_parameters(mass, position - step)) / 2
        for step in np.eye(3)
    ]
    return np.column_stack([point_mass_parameters(1.0, position), *by_position])


def _pseudo_solve(H: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns H^+ b for a symmetric positive semidefinite H, which is scaled to a unit diagonal."""
    scale = 1 / np.sqrt(np.maximum(np.diag(H), _TINY))
    inverse = np.linalg.pinv(H * np.outer(scale, scale), rcond=_NEGLIGIBLE, hermitian=True)
    return np.asarray((inverse * np.outer(scale, scale)) @ b)


def _weighted(
    reduced: NDArray[np.float64], weights: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    sums = np.tensordot(weights, reduced, axes=(0, 0))
    return sums[:-1, :-1], sums[:-1, -1]


def _rows(
    reduced: NDArray[np.float64], weights: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Returns A (k, 10) and b (k,) for which |A phi - b|^2 is the weighted cost up to a constant."""
    H, b = _weighted(reduced, weights)
    scale = 1 / np.sqrt(np.maximum(np.diag(H), _TINY))
    values, vectors = np.linalg.eigh(H * np.outer(scale, scale))
    nonzero = values > _NEGLIGIBLE * max(values[-1], _TINY)
    root = np.sqrt(values[nonzero])
    return (vectors[:, nonzero] * root).T / scale, vectors[:, nonzero].T @ (b * scale) / root
