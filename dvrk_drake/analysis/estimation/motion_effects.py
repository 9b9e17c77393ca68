"""Selects effects by cross-validation over the phase of a motion, and estimates the base tilt and a common delay."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.analysis.estimation.estimator import StepwiseSelection
from dvrk_drake.analysis.estimation.motion_problem import ConsistentFit, ConsistentProgram, DynamicProblem
from dvrk_drake.analysis.estimation.normal_equations import NormalEquations
from dvrk_drake.analysis.observations.motion_grid import MotionGrid
from dvrk_drake.analysis.observations.observations import Observations
from dvrk_drake.analysis.observations.signals import minimiser, resample
from dvrk_drake.models.arm_files import has_converted_model

#: Number of iterations that estimate the base tilt and the loads of the drives. Each iteration uses the parameters of
#: the previous iteration. A third iteration changes the errors by less than 0.01 %.
NUM_ITERATIONS = 2
#: Number of adjacent folds of one motion that `cross_validate` holds out together. Long held-out segments are more
#: similar to another motion than short ones.
NUM_HELD_OUT_FOLDS = 2
#: Factors of the prior standard deviations of the links, for the links of a model file. With the first, the deviations
#: are those for the links of this package. With the last, the centre of mass of a link may be anywhere near the link.
LINK_SCALES = (1.0, 3.0, 10.0)


@dataclass(frozen=True, eq=False)
class EffectSelection:
    """Result of the selection of effects for one motion.

    Attributes:
        problem: Regression problem with the estimated gravity direction.
        selection: Stepwise selection that uses all folds. If the base may tilt, the last two unknowns are the
            components of the tilt.
        mandatory: Indices (s,) of the mandatory effects and of the tilt, in this order.
        selected: Indices (f,) of all included effects and of the tilt, in ascending order.
    """

    problem: DynamicProblem
    selection: StepwiseSelection
    mandatory: NDArray[np.int_]
    selected: NDArray[np.int_]

    @property
    def effects(self) -> NDArray[np.int_]:
        """Indices (e,) of all included effects, without the tilt."""
        return self.selected[self.selected < self.problem.num_effects]

    def consistent(self) -> tuple[EffectSelection, ConsistentFit]:
        """Returns the physically consistent fit, and the selection with the loads of the drives that follow from it.

        Raises:
            IdentificationError: The solver did not converge.
        """
        selection, fit = self, ConsistentFit(self.problem, self.effects, self.selection.weights)
        if self.problem.is_loaded:
            selection = replace(self, problem=self.problem.with_fit(fit))
            fit = ConsistentFit(selection.problem, self.effects, self.selection.weights)
        return selection, fit


def select_effects(problem: DynamicProblem, progress: Callable[[float], object] = lambda _: None) -> EffectSelection:
    """Estimates gravity direction and drive loads with the mandatory effects, then selects candidate effects.

    A candidate is added if it reduces the cross-validated error.

    Args:
        problem: Regression problem of the motion.
        progress: Callback that receives the finished share, 0 to 1.
    """
    tilts = len(problem.columns.tilts)
    mandatory = np.append(np.arange(problem.num_mandatory), problem.num_effects + np.arange(tilts))
    phi = problem.prior
    if has_converted_model(problem.regressor.arm):
        problem = _with_link_scale(problem, mandatory)
        linear = problem.selection(problem.prior, folds=False)
        coefficients = linear.fit_with(mandatory)[linear.num_rigid :][: problem.num_effects]
        problem = replace(problem, friction=problem.friction_efforts(np.arange(problem.num_effects), coefficients))
    # The efforts contain products of the tilt or a friction coefficient and the link parameters. Each iteration is
    # linear, because it uses the previous link parameters in these products.
    for iteration in range(NUM_ITERATIONS if tilts or problem.is_loaded else 0):
        progress(0.5 * iteration / NUM_ITERATIONS)
        linear = problem.selection(phi, folds=False)
        x = linear.fit_with(mandatory)
        phi = problem.rigid_parameters(x)
        if tilts:
            problem = replace(problem, tilt=x[-tilts:])
        effects = np.arange(problem.num_effects)
        problem = problem.with_load(phi, effects, x[linear.num_rigid + effects])
    selection = problem.selection(phi)
    selected = selection.select(mandatory, problem.candidates, lambda share: progress(0.5 + 0.5 * share))
    x = selection.fit_with(selected)
    return EffectSelection(replace(problem, tilt=x[-tilts:]) if tilts else problem, selection, mandatory, selected)


def _with_link_scale(problem: DynamicProblem, mandatory: NDArray[np.int_]) -> DynamicProblem:
    """Returns the problem with the scale from `LINK_SCALES` that has the smallest cross-validated error.

    The masses and centres of mass of a model file may come from CAD, or be placeholders.
    """

    def error(trial: DynamicProblem) -> float:
        selection = trial.selection(problem.prior)
        selection.fit_with(mandatory)
        return float(selection.errors(mandatory, np.empty(0, dtype=int))[0])

    return min((replace(problem, link_scale=scale) for scale in LINK_SCALES), key=error)


def cross_validate(
    selection: EffectSelection, phi: NDArray[np.float64], progress: Callable[[float], object] = lambda _: None
) -> NDArray[np.float64]:
    """Returns the predicted efforts (r, n) of the actuators, each from a fit without the fold of its row [N m, N].

    One group of `NUM_HELD_OUT_FOLDS` adjacent folds is held out at a time, or one motion of several motions. The
    effects are selected again without the held-out folds. The direction of gravity and the physically consistent
    parameters are also estimated again. The offsets and the friction of a held-out motion are the means over the other
    motions (`RecordingEffect`).

    Args:
        selection: Selection that uses all folds.
        phi: Rigid-body parameters (p,), for the products of tilt and link parameters in the efforts.
        progress: Callback that receives the finished share, 0 to 1.

    Raises:
        IdentificationError: The solver did not converge.
    """
    problem, tilts = selection.problem, len(selection.problem.columns.tilts)
    groups = _held_out_groups(problem)
    results = []
    for group in groups:
        results.append(_select_without(selection, *group))
        progress(0.3 * len(results) / len(groups))
    used = np.unique(np.concatenate([effects for effects, _, _ in results]))
    tilt_efforts = problem.columns.tilts @ (problem.columns.base @ phi)
    columns = (problem.actuator_columns(i, used, tilt_efforts) for i in range(len(problem.efforts)))
    size, b = problem.rigid.shape[2] + len(used) + tilts, problem.rigid.shape[2]
    equations = NormalEquations.of(columns, size, problem.columns.tau, problem.fold, problem.edge, problem.recording)
    predicted = np.empty_like(problem.columns.tau)
    for (first, count), (effects, weights, tilt) in zip(groups, results, strict=True):
        progress(0.4 + 0.6 * first / equations.folds)
        # Correct the efforts for the difference between the tilt estimated from all folds and the tilt estimated
        # without the held-out folds.
        T = np.zeros((size + 1, problem.num_rigid + len(effects) + 1))
        T[:b, : problem.num_rigid] = problem.columns.base
        T[b + np.searchsorted(used, effects), problem.num_rigid + np.arange(len(effects))] = 1.0
        T[-1 - tilts :, -1] = np.append(problem.tilt[:tilts] - tilt, 1.0)
        training = equations.without_fold(first, count).weighted(weights)
        y = ConsistentProgram(problem, effects).solve(T.T @ training @ T)
        rows = np.isin(problem.fold, np.arange(first, first + count) % equations.folds)
        predicted[rows] = problem.predict(effects, y, rows)
        predicted[rows] += np.tensordot(tilt - problem.tilt[:tilts], tilt_efforts[:, rows], axes=(0, 0))
    return predicted


def _held_out_groups(problem: DynamicProblem) -> list[tuple[int, int]]:
    """Returns the first fold and the number of folds of each group that `cross_validate` holds out."""
    num_motions = len(problem.grids)
    if num_motions == 1:
        return [(first, NUM_HELD_OUT_FOLDS) for first in range(0, int(problem.fold.max()) + 1, NUM_HELD_OUT_FOLDS)]
    folds = [np.unique(problem.fold[problem.recording == i]) for i in range(num_motions)]
    return [(int(own[0]), len(own)) for own in folds]


def _select_without(
    whole: EffectSelection, first: int, count: int
) -> tuple[NDArray[np.int_], NDArray[np.float64], NDArray[np.float64]]:
    """Returns effect indices, actuator weights and tilt, estimated without `count` folds that start at `first`."""
    problem = whole.problem
    selection = whole.selection.without(first, count)
    selected = selection.select(whole.mandatory, problem.candidates)
    x = selection.fit_with(selected)
    return selected[selected < problem.num_effects], selection.weights, x[len(x) - len(problem.columns.tilts) :]


#: Tested delays [s]. Those of the public robots are at most 12 ms.
DELAYS = np.arange(-4, 5) * 0.005
#: A delay is significant if two ratios exceed these numbers: the ratio of the residual variances without and with the
#: delay, and the ratio of the delay to its standard error. Half or twice these values changes only notes on delays of
#: the public recordings.
MIN_GAIN, MIN_ERRORS = 1.12, 5.0


def common_delay(problem: DynamicProblem, observations: Sequence[Observations]) -> float:
    """Returns the delay of all efforts relative to the positions [s], or 0 if it is not significant.

    The delay minimises the squared errors on held-out folds, each relative to the smallest one of the same effort. Its
    standard error follows from the delays without one fold each (jackknife). It is significant as in
    `check`. All efforts have one delay, because that of a single one resembles its friction and inertia.

    Args:
        problem: Regression problem without delays.
        observations: Motions of the problem.
    """
    errors = []
    for delay in DELAYS:
        shifted = [_delayed(grid, own.tau, delay) for grid, own in zip(problem.grids, observations, strict=True)]
        columns = replace(problem.columns, tau=np.concatenate(shifted)[problem.kept])
        selection = replace(problem, columns=columns).selection()
        used = np.arange(selection.num_rigid + problem.num_mandatory)
        selection.fit(used)
        errors.append(selection.fold_errors(used))
    curves, total = np.array(errors), np.sum(errors, axis=1)
    size = np.min(total, axis=0)
    relative = np.sum(np.divide(curves, size, out=np.zeros_like(curves), where=size > 0), axis=(2, 3))
    summed = np.sum(relative, axis=1)
    delay = minimiser(DELAYS, summed)
    others = [minimiser(DELAYS, summed - own) for own in relative.T]
    error = np.sqrt((len(others) - 1) * np.var(others))
    gain = summed[np.argmin(np.abs(DELAYS))] / np.min(summed)
    return delay if gain > MIN_GAIN and abs(delay) > MIN_ERRORS * error else 0.0


def _delayed(grid: MotionGrid, tau: NDArray[np.float64], delay: float) -> NDArray[np.float64]:
    """Returns the filtered efforts (r, n) at later times, of efforts (m, n) at all rows [N m, N]."""
    later = np.empty_like(tau)
    for own, _, rows in grid.each_segment():
        later[rows] = resample(own.clock.t, tau[rows][own.clock.rows], own.row_times + delay)
    return grid.filter_efforts(later @ grid.channels.T)
