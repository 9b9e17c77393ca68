"""Least-squares problem of dynamic identification: unknowns, their priors, and the fit."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from dvrk_drake.analysis.dynamic.columns import DynamicColumns
from dvrk_drake.analysis.dynamic.normal_equations import NormalEquations, OwnColumns
from dvrk_drake.analysis.dynamic.stepwise_selection import StepwiseSelection
from dvrk_drake.dynamics.actuator_effects import POSITION_KINDS
from dvrk_drake.dynamics.dynamic_regressor import DynamicRegressor
from dvrk_drake.dynamics.inertial_parameters import rotor_links
from dvrk_drake.dynamics.physical_consistency import (
    BoundingBox,
    LinkScale,
    bounding_boxes,
    consistent_parameters,
    log_det_curvature,
)

#: Prior deviation of an inertial parameter from the SDF, as a share of the link's scale. Chosen by cross-validation.
LINK_DEVIATION = 0.3
#: Least prior deviation of a rotor inertia [kg m^2], and its least value as a share of the value in the SDF.
MIN_ROTOR_DEVIATION, MIN_ROTOR_SHARE = 3e-6, 0.1
#: Prior deviations of an effect about 0, as shares of the RMS effort that it acts on. The first is for friction, where
#: several shapes add up. The second is for known position-dependent torques, which may balance gravity. The third is
#: for all other effects.
FRICTION_DEVIATION, KNOWN_DEVIATION, EFFECT_DEVIATION = 0.1, 1.0, 0.3
#: Prior deviation of the direction of gravity [rad], from the accuracy of levelling a base.
TILT_DEVIATION = 0.05
#: Directions in parameter space with less information than this, relative to the prior, keep the values of the SDF.
_NEGLIGIBLE = 1e-2
#: Deviation of the first moments of rotors that the SDF models as links, relative to other links. Rotors are balanced.
_BALANCE = 1e-6
#: Relative error for weighting the efforts before the first fit.
_FIRST_ERROR = 0.1


@dataclass(frozen=True, eq=False)
class DynamicProblem:
    """Columns of one motion with the prior of all unknowns.

    Attributes:
        columns: Filtered columns of the rigid-body parameters and the candidate effects.
        regressor: Regressor of the arm. The prior is centred on its SDF.
        tilt: (2,) change of the x and y components of gravity that is included in the columns [m/s^2].
        fold: Fold of each row, see `phase_folds`.
        edge: Edges of the folds, see `phase_folds`.
        independent: Number of rows that are independent measurements of an effort.
        num_mandatory: Number of effects, the first ones, that are in every model. The others are candidates.
    """

    columns: DynamicColumns
    regressor: DynamicRegressor
    fold: NDArray[np.int_]
    edge: NDArray[np.bool_]
    independent: float
    num_mandatory: int
    tilt: NDArray[np.float64] = field(default_factory=lambda: np.zeros(2))

    @property
    def num_rigid(self) -> int:
        """Number of rigid-body parameters, including one rotor per actuator."""
        return self.columns.base.shape[1]

    @property
    def num_effects(self) -> int:
        """Number of candidate effects."""
        return len(self.columns.effects)

    @property
    def candidates(self) -> NDArray[np.int_]:
        """Indices of the effects that are included only if they reduce the error."""
        return np.arange(self.num_mandatory, self.num_effects)

    @cached_property
    def efforts(self) -> NDArray[np.float64]:
        """Sums of squares (n,) of the measured efforts."""
        return np.asarray(np.sum(self.columns.tau**2, axis=0))

    @cached_property
    def rigid(self) -> NDArray[np.float64]:
        """Columns (r, n, b) of the rigid-body base parameters, with the tilt."""
        tilts = self.columns.tilts
        return self.columns.rigid + np.tensordot(self.tilt[: len(tilts)], tilts, axes=(0, 0))

    @cached_property
    def prior(self) -> NDArray[np.float64]:
        """Prior mean (p,) of the rigid-body parameters, from the SDF."""
        return self.regressor.values[: self.num_rigid]

    @cached_property
    def deviation(self) -> NDArray[np.float64]:
        """Prior standard deviations (p,) of the rigid-body parameters."""
        balanced = rotor_links(self.regressor.arm)
        links = [LINK_DEVIATION * LinkScale.of(link).deviations for link in self.regressor.links]
        for link, deviation in zip(self.regressor.links, links, strict=True):
            if link.link in balanced:
                deviation[1:4] *= _BALANCE
        rotors = np.maximum(LINK_DEVIATION * self.prior[10 * len(links) :], MIN_ROTOR_DEVIATION)
        return np.asarray(np.concatenate([*links, rotors]), dtype=float)

    @cached_property
    def boxes(self) -> dict[str, BoundingBox]:
        """Bounding box of the mass of each link."""
        return bounding_boxes(self.regressor.arm)

    @cached_property
    def effect_precision(self) -> NDArray[np.float64]:
        """Reciprocal prior variances (e,) of the effect coefficients about 0."""
        size = sum(
            np.mean((self.columns.shapes[i] * self.columns.rows[:, i]) ** 2, axis=0) / (self.efforts[i] / self.num_rows)
            for i in range(len(self.efforts))
        )
        deviation = np.full(self.num_effects, EFFECT_DEVIATION)
        for k, effect in enumerate(self.columns.effects):
            if effect.dissipative:
                deviation[k] = FRICTION_DEVIATION
            elif k < self.num_mandatory and effect.kind in POSITION_KINDS and effect.kind != "offset":
                deviation[k] = KNOWN_DEVIATION
        return np.asarray(size) / deviation**2 + 1e-9

    @property
    def num_rows(self) -> int:
        """Number of rows."""
        return len(self.columns.tau)

    def selection(self, phi: NDArray[np.float64] | None = None, *, folds: bool = True) -> StepwiseSelection:
        """Returns the stepwise selection of effects, with the rigid body reduced to its identifiable directions.

        Args:
            phi: (p,) parameters about which the tilt is linearised. If given and the arm's base may tilt, the tilt adds
                two unknowns after the effects. By default the tilt is constant.
            folds: False uses a single fold, for fits to the whole motion only.
        """
        base, tilts = self.columns.base, len(self.columns.tilts) if phi is not None else 0
        left = self.columns.tau - self.rigid @ (base @ self.prior)
        tilt_efforts = self.columns.tilts[:tilts] @ (base @ (self.prior if phi is None else phi))
        left += np.tensordot(self.tilt[:tilts], tilt_efforts, axes=(0, 0))
        directions = base @ (self.deviation[:, None] * self._informative)
        informative = directions.shape[1]
        columns = (
            self._own_columns(i, self.rigid[:, i] @ directions, np.arange(self.num_effects), tilt_efforts)
            for i in range(len(self.efforts))
        )
        fold, edge = (self.fold, self.edge) if folds else (np.zeros_like(self.fold), None)
        precision = [np.ones(informative), self.effect_precision, np.full(tilts, 1 / (9.81 * TILT_DEVIATION) ** 2)]
        non_negative = [effect.dissipative for effect in self.columns.effects]
        return StepwiseSelection(
            equations=NormalEquations.of(columns, informative + self.num_effects + tilts, left, fold, edge),
            efforts=np.array([np.sum(self.columns.tau[fold == f] ** 2, axis=0) for f in range(fold.max() + 1)]),
            rows=np.bincount(fold),
            num_rigid=informative,
            precision=np.concatenate(precision),
            non_negative=np.array([False] * informative + non_negative + [False] * tilts),
            independent=self.independent / self.num_rows,
        )

    def _own_columns(
        self, i: int, rigid: NDArray[np.float64], chosen: NDArray[np.int_], tilt_efforts: NDArray[np.float64]
    ) -> OwnColumns:
        """Returns the columns of one actuator for the rigid body (r, k), the chosen effects and the tilts (t, r, n)."""
        moved = np.flatnonzero(np.any(rigid, axis=0))
        acting = np.flatnonzero(self.columns.rows[chosen, i])
        effects = self.columns.shapes[i][:, chosen[acting]] * self.columns.rows[chosen[acting], i]
        first = rigid.shape[1]
        own = np.concatenate([moved, first + acting, first + len(chosen) + np.arange(len(tilt_efforts))])
        return own, np.column_stack([rigid[:, moved], effects, *(x[:, i] for x in tilt_efforts)])

    def actuator_columns(
        self, i: int, chosen: NDArray[np.int_], tilt_efforts: NDArray[np.float64] | None = None
    ) -> OwnColumns:
        """Returns the columns of one actuator: rigid-body base parameters, then chosen effects, b + e in all.

        With `tilt_efforts` (t, r, n), the derivatives of the efforts with respect to the tilts, t columns are appended.
        """
        return self._own_columns(
            i,
            self.rigid[:, i],
            chosen,
            np.empty((0, *self.columns.tau.shape)) if tilt_efforts is None else tilt_efforts,
        )

    def to_base(self, num_effects: int) -> NDArray[np.float64]:
        """Returns the matrix (b + e, p + e) from all parameters and effects to base parameters and effects."""
        return scipy.linalg.block_diag(self.columns.base, np.eye(num_effects))

    def rigid_parameters(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """Returns the rigid-body parameters phi (p,) for the unknowns x (k,) of a selection."""
        V = self._informative
        return self.prior + self.deviation * (V @ x[: V.shape[1]])

    def subset(self, rows: NDArray[np.bool_]) -> DynamicProblem:
        """Returns the problem for a subset of the rows (r,), with the folds renumbered."""
        c = self.columns
        shapes = tuple(shape[rows] for shape in c.shapes)
        columns = replace(c, tau=c.tau[rows], rigid=c.rigid[rows], tilts=c.tilts[:, rows], shapes=shapes)
        fold = np.unique(self.fold[rows], return_inverse=True)[1]
        independent = self.independent * float(np.mean(rows))
        return replace(self, columns=columns, fold=fold, edge=self.edge[rows], independent=independent)

    def consistent(self, chosen: NDArray[np.int_], weights: NDArray[np.float64]) -> ConsistentFit:
        """Returns the physically consistent fit with the chosen effects.

        Raises:
            IdentificationError: The solver did not converge.
        """
        return ConsistentFit(self, chosen, weights)

    @cached_property
    def _informative(self) -> NDArray[np.float64]:
        """Orthonormal directions (p, k) of the scaled rigid-body parameters that the recording is informative about."""
        weights = self.independent / self.num_rows / (self.efforts / self.num_rows * _FIRST_ERROR**2)
        H = sum(weight * self.rigid[:, i].T @ self.rigid[:, i] for i, weight in enumerate(weights))
        scaled = self.columns.base * self.deviation
        values, vectors = np.linalg.eigh(scaled.T @ H @ scaled)
        return np.asarray(vectors[:, values > _NEGLIGIBLE])


class ConsistentFit:
    """Physically consistent fit of one problem with chosen effects.

    Attributes:
        chosen: (e,) indices of the effects.
        weights: (n,) weights of the actuators' squared errors.
        x: (p + e,) rigid-body parameters, then coefficients of the chosen effects.
        lower: (p + e,) lower bounds of x, -inf if there is none.
        errors: (n,) sums of squared residuals.
        information: (p + e, p + e) weighted sum of X' X.
        prior_precision: (p + e, p + e) Hessian of both priors at x.
    """

    def __init__(self, problem: DynamicProblem, chosen: NDArray[np.int_], weights: NDArray[np.float64]) -> None:
        self.chosen, self.weights = chosen, weights
        program = ConsistentProgram(problem, chosen)
        self.lower = program.lower
        tau, effects = problem.columns.tau, len(chosen)
        columns = (problem.actuator_columns(i, chosen) for i in range(tau.shape[1]))
        total = NormalEquations.of(columns, problem.rigid.shape[2] + effects, tau).total
        to_base = problem.to_base(effects + 1)
        sums = to_base.T @ total.weighted(weights) @ to_base
        self.x = program.solve(sums)
        self.errors = total.squared_errors(to_base[:-1, :-1] @ self.x)
        self.information = sums[:-1, :-1]
        self.prior_precision = np.diag(program.precision) + log_det_curvature(self.x, problem.regressor.links)


class ConsistentProgram:
    """Convex program of one problem with chosen effects.

    Attributes:
        precision: (p + e,) reciprocal prior variances of the parameters and effects.
        lower: (p + e,) lower bounds, -inf if there is none.
    """

    def __init__(self, problem: DynamicProblem, chosen: NDArray[np.int_]) -> None:
        self._problem = problem
        links = problem.regressor.links
        effects = [problem.columns.effects[k] for k in chosen]
        rotors = MIN_ROTOR_SHARE * problem.prior[10 * len(links) :]
        dissipative = [0.0 if effect.dissipative else -np.inf for effect in effects]
        self.lower = np.concatenate([np.full(10 * len(links), -np.inf), rotors, dissipative])
        self.precision = np.concatenate([problem.deviation**-2, problem.effect_precision[chosen]])
        self._mean = np.concatenate([problem.prior, np.zeros(len(chosen))])

    def solve(self, sums: NDArray[np.float64]) -> NDArray[np.float64]:
        """Returns x (p + e,) for weighted sums of squares (p + e + 1, p + e + 1), the measured effort last.

        The sums of squares are reduced to a triangular matrix by a Cholesky decomposition in units of the prior
        deviation. No eigenvalue is below 1 there, so the result is as accurate as a QR decomposition of the rows, at
        lower cost.

        Raises:
            IdentificationError: The solver did not converge.
        """
        scale = 1 / np.sqrt(self.precision)
        H = sums[:-1, :-1] + np.diag(self.precision)
        R = np.linalg.cholesky(H * np.outer(scale, scale)).T
        b = np.linalg.solve(R.T, (sums[:-1, -1] + self.precision * self._mean) * scale)
        problem = self._problem
        return consistent_parameters(R / scale, b, problem.regressor.links, problem.boxes, self.lower)
