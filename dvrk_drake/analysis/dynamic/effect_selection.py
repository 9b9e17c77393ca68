"""Selects joint effects and estimates the base tilt by cross-validation over the phase of a motion."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.analysis.dynamic.normal_equations import NormalEquations
from dvrk_drake.analysis.dynamic.problem import ConsistentProgram, DynamicProblem
from dvrk_drake.analysis.dynamic.stepwise_selection import StepwiseSelection

#: Alternations between estimating the base tilt and the link parameters. A third changes errors by less than 0.01 %.
NUM_TILT_ITERATIONS = 2
#: Adjacent folds that are held out together in `cross_validate`. Longer segments resemble another motion more closely.
NUM_HELD_OUT_FOLDS = 2


@dataclass(frozen=True, eq=False)
class EffectSelection:
    """Result of selecting joint effects for one motion.

    Attributes:
        problem: Regression problem with the estimated gravity direction.
        selection: Stepwise selection that was used. Its unknowns end with the tilt, if the base may tilt.
        start: (s,) indices of the unknowns that are always included, counted from the first effect.
        found: (f,) indices of all included unknowns.
        x: (k,) estimates of all unknowns of `selection`.
    """

    problem: DynamicProblem
    selection: StepwiseSelection
    start: NDArray[np.int_]
    found: NDArray[np.int_]
    x: NDArray[np.float64]

    @property
    def chosen(self) -> NDArray[np.int_]:
        """Indices (e,) of the selected effects."""
        return self.found[self.found < self.problem.num_effects]

    @property
    def weights(self) -> NDArray[np.float64]:
        """Reciprocal residual variances (n,) of the actuators' efforts."""
        return self.selection.weights


def select_effects(problem: DynamicProblem, progress: Callable[[float], object] = lambda _: None) -> EffectSelection:
    """Estimates the direction of gravity with the mandatory effects, then adds effects that reduce the error."""
    tilts = len(problem.columns.tilts)
    start = np.append(np.arange(problem.num_always), problem.num_effects + np.arange(tilts))
    phi = problem.prior
    # The tilt multiplies the link parameters, so the problem is not linear in both.
    for turn in range(NUM_TILT_ITERATIONS if tilts else 0):
        progress(0.5 * turn / NUM_TILT_ITERATIONS)
        x = problem.selection(phi, folds=False).fit(start)
        phi = problem.rigid_parameters(x)
        problem = replace(problem, tilt=x[-tilts:])
    selection = problem.selection(phi)
    found = selection.choose(start, problem.candidates, lambda share: progress(0.5 + 0.5 * share))
    x = selection.fit(found)
    return EffectSelection(replace(problem, tilt=x[-tilts:]) if tilts else problem, selection, start, found, x)


def cross_validate(
    choice: EffectSelection, phi: NDArray[np.float64], progress: Callable[[float], object] = lambda _: None
) -> NDArray[np.float64]:
    """Returns the squared prediction errors (n,) of the actuators, summed over held-out phases.

    Groups of `NUM_HELD_OUT_FOLDS` adjacent folds are held out. The effects, the direction of gravity and the consistent
    parameters are estimated anew without them.

    Args:
        choice: Selection on all phases.
        phi: (p,) rigid-body parameters about which the tilt is linearised.
        progress: Callback that receives the finished share, 0 to 1.

    Raises:
        IdentificationError: The solver did not converge.
    """
    problem, tilts = choice.problem, len(choice.problem.columns.tilts)
    firsts = range(0, choice.selection.equations.folds, NUM_HELD_OUT_FOLDS)
    parts = []
    for first in firsts:
        parts.append(_part(choice, first))
        progress(0.3 * len(parts) / len(firsts))
    used = np.unique(np.concatenate([chosen for chosen, _, _ in parts]))
    tilt_efforts = problem.columns.tilts @ (problem.columns.base @ phi)
    columns = (problem.chosen_columns(i, used, tilt_efforts) for i in range(len(problem.efforts)))
    size, b = problem.rigid.shape[2] + len(used) + tilts, problem.rigid.shape[2]
    equations = NormalEquations.of(columns, size, problem.columns.tau, problem.fold, problem.edge)
    errors = np.zeros(len(problem.efforts))
    for first, (chosen, weights, tilt) in zip(firsts, parts, strict=True):
        progress(0.4 + 0.6 * first / equations.folds)
        # Correct the efforts for the tilt that is estimated without the held-out phases.
        T = np.zeros((size + 1, problem.num_rigid + len(chosen) + 1))
        T[:b, : problem.num_rigid] = problem.columns.base
        T[b + np.searchsorted(used, chosen), problem.num_rigid + np.arange(len(chosen))] = 1.0
        T[-1 - tilts :, -1] = np.append(problem.tilt[:tilts] - tilt, 1.0)
        learnt = equations.without_fold(first, NUM_HELD_OUT_FOLDS).weighted(weights)
        y = ConsistentProgram(problem, chosen).solve(T.T @ learnt @ T)
        errors += equations.of_fold(first, NUM_HELD_OUT_FOLDS).squares(T @ np.append(-y, 1.0))
    return errors


def _part(choice: EffectSelection, first: int) -> tuple[NDArray[np.int_], NDArray[np.float64], NDArray[np.float64]]:
    """Returns effect indices, actuator weights and tilt, estimated without the folds from `first` on."""
    problem = choice.problem
    selection = choice.selection.without(first, NUM_HELD_OUT_FOLDS)
    found = selection.choose(choice.start, problem.candidates)
    x = selection.fit(found)
    return found[found < problem.num_effects], selection.weights, x[len(x) - len(problem.columns.tilts) :]
