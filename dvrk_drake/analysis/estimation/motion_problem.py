"""Defines the least-squares problem of dynamic identification: its unknowns, their priors and the fit."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from dvrk_drake.analysis.estimation.estimator import (
    ASSUMED_ERROR,
    KNOWN_SHARE,
    TILT_DEVIATION,
    Prior,
    StepwiseSelection,
    rigid_deviations,
)
from dvrk_drake.analysis.estimation.motion_columns import DynamicColumns, RecordingEffect
from dvrk_drake.analysis.estimation.normal_equations import NormalEquations, OwnColumns, fold_sums
from dvrk_drake.analysis.observations.motion_grid import MotionGrid
from dvrk_drake.dynamics.dynamic_model import is_loaded, transmitted_effort
from dvrk_drake.dynamics.dynamic_regressor import DynamicRegressor
from dvrk_drake.dynamics.physical_consistency import (
    MASS_RANGE,
    BoundingBox,
    bounding_boxes,
    consistent_parameters,
    log_det_curvature,
)
from dvrk_drake.models.effects_schema import EFFECT_KINDS

#: Prior standard deviation of the torque of the second harmonic of a known cable with a first harmonic, as a share of
#: the RMS effort. It is a correction; a wide prior would let it diverge outside the range of the motion.
HARMONIC_SHARE = 0.1
#: Prior standard deviation of the torque of a `RecordingEffect`, as a share of the RMS effort. Half or twice the value
#: changes the mean error of two motions of an MTM by 0.03 percentage points, and that of a PSM by -0.2 and +0.4.
RECORDING_DEVIATION = 0.02
#: Prior standard deviation of the torque of one presliding element, as a share of the RMS friction, if the friction is
#: known. With a share of 0.3, an element with a long travel replaces part of the gravity of a joint whose friction is
#: much smaller than its gravity. Shares of 0.1 and 0.03 have errors of four robots that differ by less than 1 %.
PRESLIDING_SHARE = 0.1
#: Smallest information about a direction in parameter space, relative to the prior. Along directions with less
#: information, the estimates are the values of the SDF. Half or twice the value changes the errors of the public
#: motions `mtm_one` and `psm_one` by at most 0.001 percentage points.
MIN_INFORMATION = 1e-2


@dataclass(frozen=True, eq=False)
class DynamicProblem:
    """Regression problem of one or more motions, with the regressor columns and the priors of all unknowns.

    Attributes:
        grids: Resampled motions.
        kept: Mask of the inner rows of the motions (`MotionGrid.inner`) that the problem contains.
        recording: Index (r,) of the motion of each row.
        columns: Filtered regressor columns of the rigid-body parameters and of all effects.
        regressor: Regressor of the arm. The parameters of the SDF (`regressor.values`) are the prior means.
        tilt: Change (2,) of the x and y components of gravity [m/s^2]. The change is included in `rigid`, but not in
            `columns`.
        fold: Fold (r,) of each row, see `phase_folds`. Each fold belongs to one motion.
        edge: Masks (r, 2) of the rows at the edges of the folds, see `phase_folds`.
        independent: Effective number of independent rows. It can be less than r, because filtered and repeated efforts
            are correlated.
        num_mandatory: Number of mandatory effects, which come first. The remaining effects are candidates.
        link_scale: Factor of the prior standard deviations of the links.
        friction: RMS friction (n,) of the actuators [N m, N] for the prior of the presliding friction, or None if it is
            unknown.
    """

    grids: tuple[MotionGrid, ...]
    kept: NDArray[np.bool_]
    recording: NDArray[np.int_]
    columns: DynamicColumns
    regressor: DynamicRegressor
    fold: NDArray[np.int_]
    edge: NDArray[np.bool_]
    independent: float
    num_mandatory: int
    tilt: NDArray[np.float64] = field(default_factory=lambda: np.zeros(2))
    link_scale: float = 1.0
    friction: NDArray[np.float64] | None = None

    @property
    def num_rigid(self) -> int:
        """Number of rigid-body parameters, including one rotor per actuator."""
        return self.columns.base.shape[1]

    @property
    def num_effects(self) -> int:
        """Number of mandatory and candidate effects."""
        return len(self.columns.effects)

    @property
    def candidates(self) -> NDArray[np.int_]:
        """Indices of the candidate effects, which are included only if they reduce the error."""
        return np.arange(self.num_mandatory, self.num_effects)

    @cached_property
    def efforts(self) -> NDArray[np.float64]:
        """Sums of squares (n,) of the measured efforts."""
        return np.asarray(np.sum(self.columns.tau**2, axis=0))

    @cached_property
    def rigid(self) -> NDArray[np.float64]:
        """Regressor columns (r, n, b) of the base parameters for gravity including the change `tilt`."""
        tilts = self.columns.tilts
        if not len(tilts):
            return self.columns.rigid
        return self.columns.rigid + np.tensordot(self.tilt, tilts, axes=(0, 0))

    @cached_property
    def prior(self) -> NDArray[np.float64]:
        """Prior mean (p,) of the rigid-body parameters, from the SDF."""
        return self.regressor.values[: self.num_rigid]

    @cached_property
    def deviation(self) -> NDArray[np.float64]:
        """Prior standard deviations (p,) of the rigid-body parameters."""
        return rigid_deviations(self.regressor, self.num_rigid, self.link_scale)

    @cached_property
    def boxes(self) -> dict[str, BoundingBox]:
        """Bounding box of each link."""
        return bounding_boxes(self.regressor.arm)

    @cached_property
    def effect_precision(self) -> NDArray[np.float64]:
        """Reciprocals (e,) of the prior variances of the effect coefficients. The prior means are 0."""
        size = self._effect_sizes(np.sqrt(self.efforts / self.num_rows))
        share = np.array([EFFECT_KINDS[effect.kind].prior_share for effect in self.columns.effects])
        mandatory = {(e.coordinate, e.kind, e.scale) for e in self.columns.effects[: self.num_mandatory]}
        for k, effect in enumerate(self.columns.effects):
            if isinstance(effect, RecordingEffect):
                rows = float(np.mean(self.recording == effect.recording))
                share[k] = RECORDING_DEVIATION * np.sqrt(max(rows, 1 / self.num_rows))
            elif k < self.num_mandatory and EFFECT_KINDS[effect.kind].role == "position":
                is_second = effect.kind.startswith("cable") and effect.scale > 1
                first = (effect.coordinate, effect.kind, 1.0)
                share[k] = HARMONIC_SHARE if is_second and first in mandatory else KNOWN_SHARE
        precision = size / share**2 + 1e-9
        if self.friction is not None:
            of_friction = self._effect_sizes(self.friction) / PRESLIDING_SHARE**2
            is_presliding = np.array([effect.kind == "presliding" for effect in self.columns.effects])
            precision[is_presliding] = np.maximum(precision, of_friction)[is_presliding]
        return precision

    def _effect_sizes(self, units: NDArray[np.float64]) -> NDArray[np.float64]:
        """Returns the mean squares (e,) of the effects for coefficients of 1, in units (n,) of the actuators' efforts.

        Actuators with a unit of 0 are omitted.
        """
        own = ((self.columns.shapes[i] * self.columns.rows[:, i] / units[i]) ** 2 for i in np.flatnonzero(units))
        return sum((np.mean(x, axis=0) for x in own), np.zeros(self.num_effects))

    def friction_efforts(self, effects: NDArray[np.int_], coefficients: NDArray[np.float64]) -> NDArray[np.float64]:
        """Returns the RMS friction (n,) of the actuators for some effects (e,) and their coefficients (e,) [N m, N]."""
        of_all = np.zeros(self.num_effects)
        of_all[effects] = coefficients
        dissipative = np.array([effect.dissipative for effect in self.columns.effects])
        shares = (of_all * dissipative)[:, None] * self.columns.rows
        efforts = (shape @ own for shape, own in zip(self.columns.shapes, shares.T, strict=True))
        return np.array([np.sqrt(np.mean(effort**2)) for effort in efforts])

    @property
    def num_rows(self) -> int:
        """Number of rows."""
        return len(self.columns.tau)

    def selection(self, phi: NDArray[np.float64] | None = None, *, folds: bool = True) -> StepwiseSelection:
        """Returns the stepwise selection of effects, with rigid-body unknowns in identifiable directions only.

        Args:
            phi: Rigid-body parameters (p,), for the products of tilt and link parameters in the efforts. If the base
                may tilt, the two components of the tilt are unknowns after the effects. If `phi` is None, the tilt is
                constant.
            folds: If False, each motion is one fold. This is sufficient for fits to all rows.
        """
        base, tilts = self.columns.base, len(self.columns.tilts) if phi is not None else 0
        residual = self.columns.tau - self.rigid @ (base @ self.prior)
        tilt_efforts = self.columns.tilts[:tilts] @ (base @ (self.prior if phi is None else phi))
        residual += np.tensordot(self.tilt[:tilts], tilt_efforts, axes=(0, 0))
        directions = base @ (self.deviation[:, None] * self._identifiable)
        num_rigid = directions.shape[1]
        columns = (
            self._own_columns(i, self.rigid[:, i] @ directions, np.arange(self.num_effects), tilt_efforts)
            for i in range(len(self.efforts))
        )
        fold, edge = (self.fold, self.edge) if folds else (self.recording, None)
        precision = np.concatenate(
            [np.ones(num_rigid), self.effect_precision, np.full(tilts, 1 / (9.81 * TILT_DEVIATION) ** 2)]
        )
        dissipative = [effect.dissipative for effect in self.columns.effects]
        non_negative = np.array([False] * num_rigid + dissipative + [False] * tilts)
        return StepwiseSelection(
            equations=NormalEquations.of(
                columns, num_rigid + self.num_effects + tilts, residual, fold, edge, self.recording
            ),
            prior=Prior(np.zeros(len(precision)), precision, non_negative),
            efforts=fold_sums(self.columns.tau**2, fold),
            independent=fold_sums(np.full(residual.shape, self.independent / self.num_rows), fold),
            num_rigid=num_rigid,
        )

    def _own_columns(
        self, i: int, rigid: NDArray[np.float64], effects: NDArray[np.int_], tilt_efforts: NDArray[np.float64]
    ) -> OwnColumns:
        """Returns the nonzero columns of actuator i, in the order rigid body (r, k), effects (e), tilts (t)."""
        nonzero = np.flatnonzero(np.any(rigid, axis=0))
        acting = np.flatnonzero(self.columns.rows[effects, i])
        of_effects = self.columns.shapes[i][:, effects[acting]] * self.columns.rows[effects[acting], i]
        first = rigid.shape[1]
        own = np.concatenate([nonzero, first + acting, first + len(effects) + np.arange(len(tilt_efforts))])
        return own, np.column_stack([rigid[:, nonzero], of_effects, *(x[:, i] for x in tilt_efforts)])

    def actuator_columns(
        self, i: int, effects: NDArray[np.int_], tilt_efforts: NDArray[np.float64] | None = None
    ) -> OwnColumns:
        """Returns the nonzero columns of one actuator, in the order base parameters (b), effects (e), tilts (t).

        Args:
            i: Index of the actuator.
            effects: Indices (e,) of the effects.
            tilt_efforts: Derivatives (t, r, n) of the efforts with respect to the tilts. If None, the columns of the
                tilts are omitted.
        """
        return self._own_columns(
            i,
            self.rigid[:, i],
            effects,
            np.empty((0, *self.columns.tau.shape)) if tilt_efforts is None else tilt_efforts,
        )

    def predict(
        self, effects: NDArray[np.int_], x: NDArray[np.float64], rows: slice | NDArray[np.bool_] = slice(None)
    ) -> NDArray[np.float64]:
        """Returns the predicted efforts (r, n) of the actuators at some of the rows [N m, N].

        Args:
            effects: Indices (e,) of the effects.
            x: Rigid-body parameters and effect coefficients (p + e,).
            rows: Rows of the result, a slice or a mask.
        """
        columns, p = self.columns, self.num_rigid
        coefficients = columns.rows[effects] * x[p:, None]
        drive = [shape[rows][:, effects] @ own for shape, own in zip(columns.shapes, coefficients.T, strict=True)]
        return np.asarray(self.rigid[rows] @ (columns.base @ x[:p]) + np.column_stack(drive))

    def to_base(self, num_effects: int) -> NDArray[np.float64]:
        """Returns the matrix (b + e, p + e) that maps x (p + e,) to base parameters and effect coefficients."""
        return scipy.linalg.block_diag(self.columns.base, np.eye(num_effects))

    def rigid_parameters(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """Returns the rigid-body parameters phi (p,) for the unknowns x (k,) of a `StepwiseSelection`."""
        V = self._identifiable
        return self.prior + self.deviation * (V @ x[: V.shape[1]])

    def subset(self, rows: NDArray[np.bool_]) -> DynamicProblem:
        """Returns the problem for the rows in the mask `rows` (r,). The folds are renumbered."""
        c = self.columns
        shapes = tuple(shape[rows] for shape in c.shapes)
        columns = replace(c, tau=c.tau[rows], rigid=c.rigid[rows], tilts=c.tilts[:, rows], shapes=shapes)
        fold = np.unique(self.fold[rows], return_inverse=True)[1]
        independent = self.independent * float(np.mean(rows))
        kept = self.kept.copy()
        kept[kept] = rows
        return replace(
            self,
            kept=kept,
            recording=self.recording[rows],
            columns=columns,
            fold=fold,
            edge=self.edge[rows],
            independent=independent,
        )

    @property
    def is_loaded(self) -> bool:
        """True if an effect depends on the load of its drive."""
        return is_loaded(self.columns.effects)

    def with_load(
        self, phi: NDArray[np.float64], effects: NDArray[np.int_], coefficients: NDArray[np.float64]
    ) -> DynamicProblem:
        """Returns the problem with the loads of the drives that follow from given estimates.

        Load-dependent friction is a product of a coefficient and the load, which depends on the other parameters. With
        given loads, the problem is linear.

        Args:
            phi: Rigid-body parameters (p,).
            effects: Indices (e,) of the effects.
            coefficients: Coefficients (e,) of these effects.
        """
        if not self.is_loaded:
            return self
        regressor = self.regressor
        tilted = regressor.with_gravity([float(g) for g in regressor.arm.gravity + np.append(self.tilt, 0.0)])
        of_effects = [self.columns.effects[k] for k in effects]
        parameters = np.concatenate([phi, np.zeros(len(regressor.values) - len(phi))])
        transmitted = []
        for grid in self.grids:
            tau = tilted.torque(grid.q, grid.v, grid.vd, parameters)
            rigid = grid.arm.transmission.inverse.pull_back_effort(tau)
            transmitted.append(transmitted_effort(grid.arm, rigid, of_effects, coefficients, grid.q))
        return replace(self, columns=self.columns.with_load(self.grids, regressor, transmitted, self.kept))

    def with_fit(self, fit: ConsistentFit) -> DynamicProblem:
        """Returns the problem with the loads of the drives that follow from a fit, see `with_load`."""
        p = self.num_rigid
        return self.with_load(fit.x[:p], fit.effects, fit.x[p:])

    @cached_property
    def _identifiable(self) -> NDArray[np.float64]:
        """Orthonormal identifiable directions (p, k) of the rigid-body parameters divided by their deviations."""
        efforts = np.where(self.efforts > 0, self.efforts, np.inf)
        weights = self.independent / self.num_rows / (efforts / self.num_rows * ASSUMED_ERROR**2)
        H = sum(weight * self.rigid[:, i].T @ self.rigid[:, i] for i, weight in enumerate(weights))
        scaled = self.columns.base * self.deviation
        values, vectors = np.linalg.eigh(scaled.T @ H @ scaled)
        return np.asarray(vectors[:, values > MIN_INFORMATION])


class ConsistentFit:
    """Physically consistent fit of one problem with given effects.

    Attributes:
        effects: Indices (e,) of the effects.
        weights: Weights (s, n) of the actuators' squared errors in each of s recordings.
        x: Rigid-body parameters and effect coefficients (p + e,).
        lower: Lower bounds (p + e,) of x, -inf if there is none.
        errors: Sums of squared residuals (n,) of the actuators over all recordings.
        information: Weighted sum (p + e, p + e) of X' X over the actuators and recordings.
        prior_precision: Hessian (p + e, p + e) of the Gaussian prior plus the log-det prior at x, see
            `consistent_parameters`.
    """

    def __init__(self, problem: DynamicProblem, effects: NDArray[np.int_], weights: NDArray[np.float64]) -> None:
        """Solves the problem.

        Raises:
            IdentificationError: The solver did not converge.
        """
        self.effects, self.weights = effects, weights
        program = ConsistentProgram(problem, effects)
        self.lower = program.lower
        tau = problem.columns.tau
        columns = (problem.actuator_columns(i, effects) for i in range(tau.shape[1]))
        size = problem.rigid.shape[2] + len(effects)
        total = NormalEquations.of(columns, size, tau, recording=problem.recording).total
        to_base = problem.to_base(len(effects) + 1)
        sums = to_base.T @ total.weighted(weights) @ to_base
        self.x = program.solve(sums)
        self.errors = np.sum(total.squared_errors(to_base[:-1, :-1] @ self.x), axis=0)
        self.information = sums[:-1, :-1]
        self.prior_precision = np.diag(program.precision) + log_det_curvature(self.x, problem.regressor.links)


class ConsistentProgram:
    """Convex program for the physically consistent fit of one problem with given effects.

    Attributes:
        precision: Reciprocals (p + e,) of the Gaussian prior variances of the parameters and effects.
        lower: Lower bounds (p + e,) of the parameters and effects, -inf if there is none.
    """

    def __init__(self, problem: DynamicProblem, effects: NDArray[np.int_]) -> None:
        self._problem = problem
        links = problem.regressor.links
        rotors = MASS_RANGE[0] * problem.prior[10 * len(links) :]
        coefficients = [0.0 if problem.columns.effects[k].dissipative else -np.inf for k in effects]
        self.lower = np.concatenate([np.full(10 * len(links), -np.inf), rotors, coefficients])
        self.precision = np.concatenate([problem.deviation**-2, problem.effect_precision[effects]])
        self._mean = np.concatenate([problem.prior, np.zeros(len(effects))])

    def solve(self, sums: NDArray[np.float64]) -> NDArray[np.float64]:
        """Returns x (p + e,) for weighted sums (p + e + 1, p + e + 1) of products of the columns [X tau].

        The sums are scaled to units of the prior standard deviations. A Cholesky decomposition then reduces them to a
        triangular matrix. In these units, the normal matrix has no eigenvalue below 1. Therefore, the result is as
        accurate as that of a QR decomposition of the rows.

        Raises:
            IdentificationError: The solver did not converge.
        """
        scale = 1 / np.sqrt(self.precision)
        H = sums[:-1, :-1] + np.diag(self.precision)
        R = np.linalg.cholesky(H * np.outer(scale, scale)).T
        b = np.linalg.solve(R.T, (sums[:-1, -1] + self.precision * self._mean) * scale)
        problem = self._problem
        return consistent_parameters(R / scale, b, problem.regressor.links, problem.boxes, self.lower)
