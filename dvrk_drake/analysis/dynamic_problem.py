"""The identification of an arm's dynamics as least squares: unknowns, what is known of them before, and their fit."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.analysis.dynamic_columns import DynamicColumns
from dvrk_drake.analysis.dynamic_selection import EffectSelection
from dvrk_drake.analysis.normal_equations import NormalEquations, squared_errors
from dvrk_drake.dynamics.dynamic_regressor import DynamicRegressor
from dvrk_drake.dynamics.physical_consistency import LinkScale, consistent_parameters

#: Deviation of an inertial parameter from the SDF's, as a share of the link's own size; chosen by cross-validation.
LINK_DEVIATION = 0.3
#: Least deviation of a rotor's inertia, and its least value as a share of the SDF's [kg m^2].
LEAST_ROTOR_DEVIATION, LEAST_ROTOR_SHARE = 3e-6, 0.1
#: Deviation of an effect about 0, as a share of the RMS efforts it acts on.
EFFECT_DEVIATION = 0.3
#: Deviation of gravity's direction [rad]: how level a base stands.
TILT_DEVIATION = 0.05
#: The SDF says all about directions of the rigid body's parameters that the recording knows this much less of.
_NEGLIGIBLE = 1e-2
#: Relative error that weighs the efforts before anything is fitted.
_FIRST_ERROR = 0.1


@dataclass(frozen=True, eq=False)
class DynamicProblem:
    """One motion's columns with the prior of all unknowns.

    Attributes:
        columns: candidate effects and the rigid body's parameters, behind the filter.
        regressor: whose SDF the prior is around.
        tilt: (2,) change of gravity's x and y [m/s^2] that the columns are made for.
        fold, edge: see `phase_folds`.
        independent: how many rows are independent measurements of an effort; the others repeat them.
    """

    columns: DynamicColumns
    regressor: DynamicRegressor
    fold: NDArray[np.int_]
    edge: NDArray[np.bool_]
    independent: float
    tilt: NDArray[np.float64] = field(default_factory=lambda: np.zeros(2))

    @property
    def num_rigid(self) -> int:
        """Number of the rigid body's parameters, one rotor an actuator included."""
        return self.columns.rigid.shape[2]

    @property
    def num_effects(self) -> int:
        """Number of candidate effects."""
        return len(self.columns.effects)

    @cached_property
    def efforts(self) -> NDArray[np.float64]:
        """(n,) sum of squares of the measured efforts."""
        return np.asarray(np.sum(self.columns.tau**2, axis=0))

    @cached_property
    def rigid(self) -> NDArray[np.float64]:
        """(r, n, p) columns of the rigid body, tilted."""
        tilts = self.columns.tilts
        return self.columns.rigid + np.tensordot(self.tilt[: len(tilts)], tilts, axes=(0, 0))

    @cached_property
    def prior(self) -> NDArray[np.float64]:
        """(p,) what the SDF states."""
        return self.regressor.values[: self.num_rigid]

    @cached_property
    def deviation(self) -> NDArray[np.float64]:
        """(p,) by which the truth may differ from it."""
        links = [LINK_DEVIATION * LinkScale.of(link).deviations for link in self.regressor.links]
        rotors = np.maximum(LINK_DEVIATION * self.prior[10 * len(links) :], LEAST_ROTOR_DEVIATION)
        return np.concatenate([*links, rotors])

    @cached_property
    def effect_precision(self) -> NDArray[np.float64]:
        """(e,) one over the variance of each effect's coefficient about 0."""
        size = sum(
            np.mean((self.columns.shapes[i] * self.columns.rows[:, i]) ** 2, axis=0) / (self.efforts[i] / self.num_rows)
            for i in range(len(self.efforts))
        )
        return np.asarray(size) / EFFECT_DEVIATION**2 + 1e-9

    @property
    def num_rows(self) -> int:
        """Number of rows."""
        return len(self.columns.tau)

    def selection(self, phi: NDArray[np.float64] | None = None) -> EffectSelection:
        """The choice of effects, with the rigid body reduced to what the recording can tell.

        Args:
            phi: (p,) the parameters about which a tilt is linearised: two more columns follow the effects'. By default
                there is no tilt.
        """
        V = self._informative
        columns = []
        for i in range(len(self.efforts)):
            blocks = [(self.rigid[:, i] * self.deviation) @ V, self.columns.shapes[i] * self.columns.rows[:, i]]
            if phi is not None:
                blocks.append((self.columns.tilts[:, :, i] @ phi).T)
            columns.append(np.hstack(blocks))
        left = self.columns.tau - self.rigid @ self.prior
        tilts = len(self.columns.tilts) if phi is not None else 0
        precision = [np.ones(V.shape[1]), self.effect_precision, np.full(tilts, 1 / (9.81 * TILT_DEVIATION) ** 2)]
        non_negative = [effect.dissipative for effect in self.columns.effects]
        return EffectSelection(
            equations=NormalEquations.of(columns, left, self.fold, self.edge),
            efforts=self.efforts,
            num_rigid=V.shape[1],
            precision=np.concatenate(precision),
            non_negative=np.array([False] * V.shape[1] + non_negative + [False] * tilts),
            independent=self.independent,
            rows=self.num_rows,
        )

    def rigid_parameters(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """(p,) phi of a selection's unknowns x (k,)."""
        V = self._informative
        return self.prior + self.deviation * (V @ x[: V.shape[1]])

    def consistent(self, chosen: NDArray[np.int_], weights: NDArray[np.float64]) -> ConsistentFit:
        """The physically consistent fit with some of the effects, and its cross-validation.

        Raises:
            IdentificationError: the solver did not converge.
        """
        return ConsistentFit(self, chosen, weights)

    @cached_property
    def _informative(self) -> NDArray[np.float64]:
        """(p, k) orthonormal directions of the scaled rigid body's parameters that the recording says something of."""
        H = np.zeros((self.num_rigid, self.num_rigid))
        weights = self.independent / self.num_rows / (self.efforts / self.num_rows * _FIRST_ERROR**2)
        for i, weight in enumerate(weights):
            X = self.rigid[:, i] * self.deviation
            H += weight * X.T @ X
        values, vectors = np.linalg.eigh(H)
        return np.asarray(vectors[:, values > _NEGLIGIBLE])


class ConsistentFit:
    """The convex program on one problem with chosen effects.

    Attributes:
        x: (p + e,) parameters of the rigid body, then coefficients of the chosen effects.
        covariance: (p + e, p + e) of x, the prior's knowledge included, inequalities not.
        errors: (n,) sum of squares that x leaves.
    """

    def __init__(self, problem: DynamicProblem, chosen: NDArray[np.int_], weights: NDArray[np.float64]) -> None:
        self._problem, self._weights = problem, weights
        columns = problem.columns
        effects = [columns.effects[k] for k in chosen]
        rotors = LEAST_ROTOR_SHARE * problem.prior[10 * len(problem.regressor.links) :]
        self._lower = np.concatenate(
            [
                np.full(10 * len(problem.regressor.links), -np.inf),
                rotors,
                [0.0 if effect.dissipative else -np.inf for effect in effects],
            ]
        )
        self._mean = np.concatenate([problem.prior, np.zeros(len(chosen))])
        self._precision = np.concatenate([problem.deviation**-2, problem.effect_precision[chosen]])
        stacked = [
            np.hstack([problem.rigid[:, i], columns.shapes[i][:, chosen] * columns.rows[chosen, i]])
            for i in range(len(problem.efforts))
        ]
        self._equations = NormalEquations.of(stacked, columns.tau, problem.fold, problem.edge)
        total = self._equations.total()
        self.x, H = self._solve(total)
        self.covariance = np.linalg.inv(H)
        self.errors = squared_errors(total, self.x)

    @property
    def folds(self) -> int:
        """Number of folds."""
        return self._equations.folds

    def fold_errors(self, fold: int) -> NDArray[np.float64]:
        """(n,) sum of squares that the program leaves of a fold when it knows only the others.

        Raises:
            IdentificationError: the solver did not converge.
        """
        x, _ = self._solve(self._equations.without_fold(fold))
        return squared_errors(self._equations.of_fold(fold), x)

    def _solve(self, products: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """x, and the Hessian of the cost.

        The sums of squares are compressed to a triangle by Cholesky's decomposition in units of the prior's deviation,
        where no eigenvalue is below 1: as exact as the QR decomposition of the rows, and a hundred times shorter.
        """
        scale = 1 / np.sqrt(self._precision)
        sums = np.tensordot(self._weights, products, axes=(0, 0))
        H = sums[:-1, :-1] + np.diag(self._precision)
        R = np.linalg.cholesky(H * np.outer(scale, scale)).T
        b = np.linalg.solve(R.T, (sums[:-1, -1] + self._precision * self._mean) * scale)
        links = self._problem.regressor.links
        return consistent_parameters(R / scale, b, links, self._lower, scale), H
