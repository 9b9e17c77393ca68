"""The identification of an arm's dynamics as least squares: unknowns, what is known of them before, and their fit."""

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

#: Deviation of an inertial parameter from the SDF's, as a share of the link's own size; chosen by cross-validation.
LINK_DEVIATION = 0.3
#: Least deviation of a rotor's inertia, and its least value as a share of the SDF's [kg m^2].
MIN_ROTOR_DEVIATION, MIN_ROTOR_SHARE = 3e-6, 0.1
#: Deviation of an effect about 0, as a share of the RMS efforts it acts on: of friction, of which there are many shapes
#: that add up; of torques by position that a drive is known to have, which gravity may balance; of all others.
FRICTION_DEVIATION, KNOWN_DEVIATION, EFFECT_DEVIATION = 0.1, 1.0, 0.3
#: Deviation of gravity's direction [rad]: how level a base stands.
TILT_DEVIATION = 0.05
#: The SDF says all about directions of the rigid body's parameters that the recording knows this much less of.
_NEGLIGIBLE = 1e-2
#: A rotor that the SDF models as a link is balanced: this share of the deviations of other links' first moments.
_BALANCE = 1e-6
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
        num_always: so many effects, the first ones, are in every model; the others are candidates.
    """

    columns: DynamicColumns
    regressor: DynamicRegressor
    fold: NDArray[np.int_]
    edge: NDArray[np.bool_]
    independent: float
    num_always: int
    tilt: NDArray[np.float64] = field(default_factory=lambda: np.zeros(2))

    @property
    def num_rigid(self) -> int:
        """Number of the rigid body's parameters, one rotor an actuator included."""
        return self.columns.base.shape[1]

    @property
    def num_effects(self) -> int:
        """Number of candidate effects."""
        return len(self.columns.effects)

    @property
    def candidates(self) -> NDArray[np.int_]:
        """Indices of the effects that are chosen only if they help."""
        return np.arange(self.num_always, self.num_effects)

    @cached_property
    def efforts(self) -> NDArray[np.float64]:
        """(n,) sum of squares of the measured efforts."""
        return np.asarray(np.sum(self.columns.tau**2, axis=0))

    @cached_property
    def rigid(self) -> NDArray[np.float64]:
        """(r, n, b) columns of the rigid body's base parameters, tilted."""
        tilts = self.columns.tilts
        return self.columns.rigid + np.tensordot(self.tilt[: len(tilts)], tilts, axes=(0, 0))

    @cached_property
    def prior(self) -> NDArray[np.float64]:
        """(p,) what the SDF states."""
        return self.regressor.values[: self.num_rigid]

    @cached_property
    def deviation(self) -> NDArray[np.float64]:
        """(p,) by which the truth may differ from it."""
        balanced = rotor_links(self.regressor.arm)
        links = [LINK_DEVIATION * LinkScale.of(link).deviations for link in self.regressor.links]
        for link, deviation in zip(self.regressor.links, links, strict=True):
            if link.link in balanced:
                deviation[1:4] *= _BALANCE
        rotors = np.maximum(LINK_DEVIATION * self.prior[10 * len(links) :], MIN_ROTOR_DEVIATION)
        return np.asarray(np.concatenate([*links, rotors]), dtype=float)

    @cached_property
    def boxes(self) -> dict[str, BoundingBox]:
        """Link -> where its mass can be."""
        return bounding_boxes(self.regressor.arm)

    @cached_property
    def effect_precision(self) -> NDArray[np.float64]:
        """(e,) one over the variance of each effect's coefficient about 0."""
        size = sum(
            np.mean((self.columns.shapes[i] * self.columns.rows[:, i]) ** 2, axis=0) / (self.efforts[i] / self.num_rows)
            for i in range(len(self.efforts))
        )
        deviation = np.full(self.num_effects, EFFECT_DEVIATION)
        for k, effect in enumerate(self.columns.effects):
            if effect.dissipative:
                deviation[k] = FRICTION_DEVIATION
            elif k < self.num_always and effect.kind in POSITION_KINDS and effect.kind != "offset":
                deviation[k] = KNOWN_DEVIATION
        return np.asarray(size) / deviation**2 + 1e-9

    @property
    def num_rows(self) -> int:
        """Number of rows."""
        return len(self.columns.tau)

    def selection(self, phi: NDArray[np.float64] | None = None, *, folds: bool = True) -> StepwiseSelection:
        """The choice of effects, with the rigid body reduced to what the recording can tell.

        Args:
            phi: (p,) the parameters about which the tilt is linearised: if the arm's base may tilt, it is two unknowns
                more, which follow the effects'. By default the tilt stays as it is.
            folds: False: for fits to the whole motion only.
        """
        base, tilts = self.columns.base, len(self.columns.tilts) if phi is not None else 0
        left = self.columns.tau - self.rigid @ (base @ self.prior)
        leaning = self.columns.tilts[:tilts] @ (base @ (self.prior if phi is None else phi))
        left += np.tensordot(self.tilt[:tilts], leaning, axes=(0, 0))
        directions = base @ (self.deviation[:, None] * self._informative)
        informative = directions.shape[1]
        columns = (
            self._own_columns(i, self.rigid[:, i] @ directions, np.arange(self.num_effects), leaning)
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
        self, i: int, rigid: NDArray[np.float64], chosen: NDArray[np.int_], leaning: NDArray[np.float64]
    ) -> OwnColumns:
        """Columns of one actuator: of the rigid body (r, k), of the chosen effects on it, and by tilts (2, r, n)."""
        moved = np.flatnonzero(np.any(rigid, axis=0))
        acting = np.flatnonzero(self.columns.rows[chosen, i])
        effects = self.columns.shapes[i][:, chosen[acting]] * self.columns.rows[chosen[acting], i]
        first = rigid.shape[1]
        own = np.concatenate([moved, first + acting, first + len(chosen) + np.arange(len(leaning))])
        return own, np.column_stack([rigid[:, moved], effects, *(x[:, i] for x in leaning)])

    def chosen_columns(
        self, i: int, chosen: NDArray[np.int_], leaning: NDArray[np.float64] | None = None
    ) -> OwnColumns:
        """Columns of one actuator among b + e: of the rigid body's base parameters, then of the chosen effects.

        With `leaning` (t, r, n), what the tilts change per unit, these are t more.
        """
        return self._own_columns(
            i, self.rigid[:, i], chosen, np.empty((0, *self.columns.tau.shape)) if leaning is None else leaning
        )

    def to_base(self, num_effects: int) -> NDArray[np.float64]:
        """(b + e, p + e) base parameters and effects from all parameters and the effects."""
        return scipy.linalg.block_diag(self.columns.base, np.eye(num_effects))

    def rigid_parameters(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """(p,) phi of a selection's unknowns x (k,)."""
        V = self._informative
        return self.prior + self.deviation * (V @ x[: V.shape[1]])

    def subset(self, rows: NDArray[np.bool_]) -> DynamicProblem:
        """The problem of some of the rows (r,), with their folds numbered anew."""
        c = self.columns
        shapes = tuple(shape[rows] for shape in c.shapes)
        columns = replace(c, tau=c.tau[rows], rigid=c.rigid[rows], tilts=c.tilts[:, rows], shapes=shapes)
        fold = np.unique(self.fold[rows], return_inverse=True)[1]
        independent = self.independent * float(np.mean(rows))
        return replace(self, columns=columns, fold=fold, edge=self.edge[rows], independent=independent)

    def consistent(self, chosen: NDArray[np.int_], weights: NDArray[np.float64]) -> ConsistentFit:
        """The physically consistent fit with some of the effects.

        Raises:
            IdentificationError: the solver did not converge.
        """
        return ConsistentFit(self, chosen, weights)

    @cached_property
    def _informative(self) -> NDArray[np.float64]:
        """(p, k) orthonormal directions of the scaled rigid body's parameters that the recording says something of."""
        weights = self.independent / self.num_rows / (self.efforts / self.num_rows * _FIRST_ERROR**2)
        H = sum(weight * self.rigid[:, i].T @ self.rigid[:, i] for i, weight in enumerate(weights))
        scaled = self.columns.base * self.deviation
        values, vectors = np.linalg.eigh(scaled.T @ H @ scaled)
        return np.asarray(vectors[:, values > _NEGLIGIBLE])


class ConsistentFit:
    """The convex program on one problem with chosen effects.

    Attributes:
        chosen: (e,) indices of the effects.
        weights: (n,) of the actuators' squared errors.
        x: (p + e,) parameters of the rigid body, then coefficients of the chosen effects.
        lower: (p + e,) bounds of x, -inf where there is none.
        errors: (n,) sum of squares that x leaves.
        information: (p + e, p + e) sum of weights X' X.
        prior_precision: (p + e, p + e) second derivative of both priors at x.
    """

    def __init__(self, problem: DynamicProblem, chosen: NDArray[np.int_], weights: NDArray[np.float64]) -> None:
        self.chosen, self.weights = chosen, weights
        program = ConsistentProgram(problem, chosen)
        self.lower = program.lower
        tau, effects = problem.columns.tau, len(chosen)
        columns = (problem.chosen_columns(i, chosen) for i in range(tau.shape[1]))
        total = NormalEquations.of(columns, problem.rigid.shape[2] + effects, tau).total
        to_base = problem.to_base(effects + 1)
        sums = to_base.T @ total.weighted(weights) @ to_base
        self.x = program.solve(sums)
        self.errors = total.squared_errors(to_base[:-1, :-1] @ self.x)
        self.information = sums[:-1, :-1]
        self.prior_precision = np.diag(program.precision) + log_det_curvature(self.x, problem.regressor.links)


class ConsistentProgram:
    """What the convex program of one problem knows before the recording, with chosen effects.

    Attributes:
        precision: (p + e,) one over the variance of each parameter and effect.
        lower: (p + e,) bounds, -inf where there is none.
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
        """x (p + e,) from (p + e + 1, p + e + 1) weighted sums of squares, the measured effort last.

        The sums of squares are compressed to a triangle by Cholesky's decomposition in units of the prior's deviation,
        where no eigenvalue is below 1: as exact as the QR decomposition of the rows, and a hundred times shorter.

        Raises:
            IdentificationError: the solver did not converge.
        """
        scale = 1 / np.sqrt(self.precision)
        H = sums[:-1, :-1] + np.diag(self.precision)
        R = np.linalg.cholesky(H * np.outer(scale, scale)).T
        b = np.linalg.solve(R.T, (sums[:-1, -1] + self.precision * self._mean) * scale)
        problem = self._problem
        return consistent_parameters(R / scale, b, problem.regressor.links, problem.boxes, self.lower)
