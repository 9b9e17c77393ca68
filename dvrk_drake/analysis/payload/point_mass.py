"""Fits a point mass on a link to a difference of efforts, using the normal equations."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from dvrk_drake.analysis.dynamic.normal_equations import NormalEquations

#: Largest distance from the link's own centre of mass along each axis [m]. No arm is longer.
REACH = 1.0
#: Largest mass [kg].
MAX_MASS = 10.0
#: Smallest standard error at which a coordinate is not identifiable [m].
MIN_KNOWN = 0.5
#: Distances of initial values from the link's own centre of mass, in addition to the centre itself [m].
_STARTS = (0.15, 0.4)
_RIGID = 10
_NEGLIGIBLE = 1e-11
_TINY = 1e-30


@dataclass(frozen=True, eq=False)
class PointMass:
    """Mass [kg] at `place` (3,) in the link frame [m]. `determined` (3,) is true for coordinates that are estimated."""

    mass: float
    place: NDArray[np.float64]
    determined: NDArray[np.bool_]

    @property
    def parameters(self) -> NDArray[np.float64]:
        """Returns the inertial parameters (10,) about the link's origin."""
        return point_mass_parameters(self.mass, self.place)


def point_mass_parameters(mass: float, place: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns m, m p and m (|p|^2 1 - p p') (10,) in the order of `PARAMETER_NAMES`.

    The corresponding pseudo-inertia is m (p, 1)(p, 1)'.
    """
    x, y, z = place
    moments = [y * y + z * z, x * x + z * z, x * x + y * y]
    return mass * np.array([1.0, x, y, z, *moments, -x * y, -x * z, -y * z])


class PointMassProblem:
    """Regression tau_i ~ Y_i phi(m, p) + N_i x_i for every actuator i, with nuisances x_i that are normal about 0.

    Attributes:
        equations: Normal equations, with the ten columns of the link first, then the nuisances.
        independent: Share of the `rows` that are independent measurements.
        com: Centre of mass (3,) of the link [m]. It is used for coordinates that are not identifiable.
        precision: Inverse prior variances (n, k) of the nuisances, 0 where there is no prior.
    """

    def __init__(
        self,
        equations: NormalEquations,
        independent: float,
        com: NDArray[np.float64],
        precision: NDArray[np.float64],
        rows: int,
    ) -> None:
        self.equations, self.com = equations, com
        self._total = equations.total.dense()
        self._count, self._precision = rows * independent, precision

    def fit(self, start: PointMass | None = None) -> tuple[PointMass, NDArray[np.float64], NDArray[np.float64]]:
        """Returns the point mass, the actuators' weights (n,), and standard errors (4,) for equal noise in all rows.

        Each actuator is weighted by its residual variance. Coordinates that are not identifiable are set to the link's
        centre of mass, one by one.

        Args:
            start: Initial value. By default, several are tried because the cost has several minima in the position.
        """
        weights = self._count / np.maximum(self._total[:, -1, -1], _TINY)
        determined = np.ones(3, dtype=bool) if start is None else start.determined
        while True:
            body = start or self._search(self._reduced(self._total, weights), weights, determined)
            for _ in range(10):
                reduced = self._reduced(self._total, weights)
                body = self._refine(reduced, weights, body)
                weights = self._count / np.maximum(_left_by(reduced, body), _TINY)
            errors = self._standard_errors(self._reduced(self._total, weights), weights, body)
            # A coordinate at the boundary of the search is not identifiable.
            unknown = np.where(np.abs(body.place - self.com) > REACH - 1e-6, np.inf, errors[1:])
            worst = int(np.argmax(np.where(determined, unknown, 0.0)))
            if not determined[worst] or not unknown[worst] > MIN_KNOWN:
                return body, weights, errors
            start, determined = None, determined & (np.arange(3) != worst)

    def without_fold(self, fold: int, weights: NDArray[np.float64], start: PointMass) -> PointMass:
        """Fits the point mass to the other folds."""
        others = self._total - self.equations.of_fold(fold).dense()
        return self._refine(self._reduced(others, weights), weights, start)

    def mass_at_com(self, weights: NDArray[np.float64], fold: int | None = None) -> tuple[float, float]:
        """Returns the mass at the link's centre of mass and its standard error for equal noise in all rows [kg].

        Args:
            weights: Weights of the actuators.
            fold: Fold that is excluded. None excludes none.
        """
        products = self._total if fold is None else self._total - self.equations.of_fold(fold).dense()
        H, b = _weighted(self._reduced(products, weights), weights)
        unit = point_mass_parameters(1.0, self.com)
        information = max(float(unit @ H @ unit), _TINY)
        return float(unit @ b) / information, information**-0.5

    def nuisances(self, body: PointMass, weights: NDArray[np.float64]) -> NDArray[np.float64]:
        """Returns the nuisances (n, k) for a point mass."""
        return np.array([self._own_nuisances(i, self._total[i], body.parameters, weights) for i in range(len(weights))])

    def fold_errors(self, fold: int, weights: NDArray[np.float64], start: PointMass | None) -> NDArray[np.float64]:
        """Returns the sum of squared errors (n,) of a fold that is predicted, with nuisances, from the other folds.

        If `start` is None, the prediction has no point mass.
        """
        others, own = self.equations.without_fold(fold).dense(), self.equations.of_fold(fold).dense()
        phi = np.zeros(_RIGID)
        if start is not None:
            phi = self._refine(self._reduced(others, weights), weights, start).parameters
        return self._left(others, own, phi, weights)

    def budget(
        self, body: PointMass, weights: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Returns sums of squares (n,) of the efforts, of the part of the body, and of the residual with nuisances."""
        phi, total = body.parameters, self._total
        adds = np.einsum("a,nab,b->n", phi, total[:, :_RIGID, :_RIGID], phi)
        return total[:, -1, -1], np.maximum(adds, 0.0), self._left(total, total, phi, weights)

    def _left(
        self,
        learnt: NDArray[np.float64],
        predicted: NDArray[np.float64],
        phi: NDArray[np.float64],
        weights: NDArray[np.float64],
    ) -> NDArray[np.float64]:
        """Returns the sum of squared residuals (n,) of some rows for phi (10,) and nuisances fitted to other rows."""
        left = np.empty(len(learnt))
        for i, (H, own) in enumerate(zip(learnt, predicted, strict=True)):
            residual = np.concatenate([-phi, -self._own_nuisances(i, H, phi, weights), [1.0]])
            left[i] = max(residual @ own @ residual, 0.0)
        return left

    def _own_nuisances(
        self, i: int, H: NDArray[np.float64], phi: NDArray[np.float64], weights: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Returns the nuisances (k,) of actuator i for phi (10,), from products H of some rows."""
        right = H[_RIGID:-1, -1] - H[_RIGID:-1, :_RIGID] @ phi
        return _pseudo_solve(H[_RIGID:-1, _RIGID:-1] + np.diag(self._precision[i] / weights[i]), right)

    def _reduced(self, products: NDArray[np.float64], weights: NDArray[np.float64]) -> NDArray[np.float64]:
        """Returns the products (n, 11, 11) of the link's columns and the effort after eliminating the nuisances."""
        keep = np.append(np.arange(_RIGID), products.shape[-1] - 1)
        reduced = np.empty((len(products), _RIGID + 1, _RIGID + 1))
        for i, full in enumerate(products):
            H = full[_RIGID:-1, _RIGID:-1] + np.diag(self._precision[i] / weights[i])
            coupling = full[_RIGID:-1, keep]
            reduced[i] = full[np.ix_(keep, keep)] - coupling.T @ _pseudo_solve(H, coupling)
        return reduced

    def _search(
        self, reduced: NDArray[np.float64], weights: NDArray[np.float64], determined: NDArray[np.bool_]
    ) -> PointMass:
        """Searches from several initial values."""
        offsets = [np.zeros(3)] + [s * d * axis for d in _STARTS for axis in np.eye(3)[determined] for s in (1, -1)]
        H, b = _weighted(reduced, weights)
        bodies = []
        for offset in offsets:
            unit = point_mass_parameters(1.0, self.com + offset)
            mass = float(np.clip(float(unit @ b) / max(float(unit @ H @ unit), _TINY), 1e-3, MAX_MASS / 2))
            bodies.append(self._refine(reduced, weights, PointMass(mass, self.com + offset, determined)))
        return min(bodies, key=lambda body: float(weights @ _left_by(reduced, body)))

    def _refine(self, reduced: NDArray[np.float64], weights: NDArray[np.float64], start: PointMass) -> PointMass:
        A, b = _rows(reduced, weights)
        free = np.concatenate([[True], start.determined])
        lower = np.concatenate([[0.0], self.com - REACH])[free]
        upper = np.concatenate([[MAX_MASS], self.com + REACH])[free]
        full = np.concatenate([[start.mass], start.place])

        def whole(x: NDArray[np.float64]) -> NDArray[np.float64]:
            values = full.copy()
            values[free] = x
            return values

        def residual(x: NDArray[np.float64]) -> NDArray[np.float64]:
            values = whole(x)
            return A @ point_mass_parameters(values[0], values[1:]) - b

        def jacobian(x: NDArray[np.float64]) -> NDArray[np.float64]:
            values = whole(x)
            return (A @ _derivatives(values[0], values[1:]))[:, free]

        start_x = np.clip(full[free], lower + 1e-9, upper - 1e-9)
        result = least_squares(residual, start_x, jac=jacobian, bounds=(lower, upper), x_scale=0.1)
        values = whole(result.x)
        return PointMass(float(values[0]), values[1:], start.determined)

    def _standard_errors(
        self, reduced: NDArray[np.float64], weights: NDArray[np.float64], body: PointMass
    ) -> NDArray[np.float64]:
        """Returns the standard errors (4,) of mass and position.

        They are infinite for quantities that are not identifiable, and 0 for coordinates that are not estimated.
        """
        A, _ = _rows(reduced, weights)
        jacobian = A @ _derivatives(body.mass, body.place)
        errors = np.zeros(4)
        free = np.flatnonzero(np.concatenate([[True], body.determined]))
        for k in free:
            others = jacobian[:, free[free != k]]
            own = jacobian[:, k]
            beside = own - others @ np.linalg.lstsq(others, own, rcond=1e-9)[0]
            errors[k] = 1 / max(float(np.linalg.norm(beside)), _TINY)
        return errors


def _left_by(reduced: NDArray[np.float64], body: PointMass) -> NDArray[np.float64]:
    """Returns the sum of squared residuals (n,) of a point mass, with fitted nuisances."""
    residual = np.append(-body.parameters, 1.0)
    return np.maximum(np.einsum("a,nab,b->n", residual, reduced, residual), 0.0)


def _derivatives(mass: float, place: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns the derivatives (10, 4) of the parameters with respect to mass and position.

    Central differences are exact because the parameters are quadratic in the position.
    """
    by_place = [
        (point_mass_parameters(mass, place + step) - point_mass_parameters(mass, place - step)) / 2
        for step in np.eye(3)
    ]
    return np.column_stack([point_mass_parameters(1.0, place), *by_place])


def _pseudo_solve(H: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns H^+ b for a symmetric positive semidefinite H whose columns are scaled to equal size."""
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
    """Returns A (k, 10), b (k,) with |A phi - b|^2 equal to the weighted cost, up to a constant."""
    H, b = _weighted(reduced, weights)
    scale = 1 / np.sqrt(np.maximum(np.diag(H), _TINY))
    values, vectors = np.linalg.eigh(H * np.outer(scale, scale))
    known = values > _NEGLIGIBLE * max(values[-1], _TINY)
    root = np.sqrt(values[known])
    return (vectors[:, known] * root).T / scale, vectors[:, known].T @ (b * scale) / root
