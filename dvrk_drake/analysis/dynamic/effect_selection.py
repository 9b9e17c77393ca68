"""Effects in the drives and the direction of gravity, as a motion shows them; how well phases predict each other."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.analysis.dynamic.normal_equations import NormalEquations
from dvrk_drake.analysis.dynamic.problem import ConsistentProgram, DynamicProblem
from dvrk_drake.analysis.dynamic.stepwise_selection import StepwiseSelection

#: Times that a lean base and the parameters of the links are found in turn; a third changes no error by 0.01 %.
NUM_TILT_ITERATIONS = 2
#: Folds that are left out together where a model is judged: what a motion does for longer is more like another motion.
MIN_CORRELATION = 2


@dataclass(frozen=True, eq=False)
class EffectSelection:
    """Effects and direction of gravity that fit a motion best.

    Attributes:
        problem: with gravity as found.
        selection: that chose; its unknowns end with the tilt, if the base may tilt.
        start: (s,) its unknowns that need no choice, as it counts them: from the first effect on.
        found: (f,) those and what was chosen.
        x: (k,) all its unknowns.
    """

    problem: DynamicProblem
    selection: StepwiseSelection
    start: NDArray[np.int_]
    found: NDArray[np.int_]
    x: NDArray[np.float64]

    @property
    def chosen(self) -> NDArray[np.int_]:
        """(e,) indices of the effects."""
        return self.found[self.found < self.problem.num_effects]

    @property
    def weights(self) -> NDArray[np.float64]:
        """(n,) one over the variance that each actuator's effort keeps."""
        return self.selection.weights


def select_effects(problem: DynamicProblem, progress: Callable[[float], object] = lambda _: None) -> EffectSelection:
    """Finds the direction of gravity with what every drive has; adds effects that the motion asks for."""
    tilts = len(problem.columns.tilts)
    start = np.append(np.arange(problem.num_always), problem.num_effects + np.arange(tilts))
    phi = problem.prior
    # The tilt times the links' parameters is no linear unknown.
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
    """(n,) sum of squares that models leave of phases of which they know nothing.

    Every `MIN_CORRELATION` folds are predicted by the effects, the direction of gravity and the consistent parameters that the
    others give.

    Args:
        choice: on all phases.
        phi: (p,) parameters of the rigid body, about which the tilt of a part is linearised.
        progress: called with the finished share, 0..1.

    Raises:
        IdentificationError: the solver did not converge.
    """
    problem, tilts = choice.problem, len(choice.problem.columns.tilts)
    firsts = range(0, choice.selection.equations.folds, MIN_CORRELATION)
    parts = []
    for first in firsts:
        parts.append(_part(choice, first))
        progress(0.3 * len(parts) / len(firsts))
    used = np.unique(np.concatenate([chosen for chosen, _, _ in parts]))
    leaning = problem.columns.tilts @ (problem.columns.base @ phi)
    columns = (problem.chosen_columns(i, used, leaning) for i in range(len(problem.efforts)))
    size, b = problem.rigid.shape[2] + len(used) + tilts, problem.rigid.shape[2]
    equations = NormalEquations.of(columns, size, problem.columns.tau, problem.fold, problem.edge)
    errors = np.zeros(len(problem.efforts))
    for first, (chosen, weights, tilt) in zip(firsts, parts, strict=True):
        progress(0.4 + 0.6 * first / equations.folds)
        # What gravity does that leans as these phases say, is taken from the efforts.
        T = np.zeros((size + 1, problem.num_rigid + len(chosen) + 1))
        T[:b, : problem.num_rigid] = problem.columns.base
        T[b + np.searchsorted(used, chosen), problem.num_rigid + np.arange(len(chosen))] = 1.0
        T[-1 - tilts :, -1] = np.append(problem.tilt[:tilts] - tilt, 1.0)
        learnt = equations.without_fold(first, MIN_CORRELATION).weighted(weights)
        y = ConsistentProgram(problem, chosen).solve(T.T @ learnt @ T)
        errors += equations.of_fold(first, MIN_CORRELATION).squares(T @ np.append(-y, 1.0))
    return errors


def _part(choice: EffectSelection, first: int) -> tuple[NDArray[np.int_], NDArray[np.float64], NDArray[np.float64]]:
    """Indices of the effects, weights of the actuators and tilt that the phases without a part say."""
    problem = choice.problem
    selection = choice.selection.without(first, MIN_CORRELATION)
    found = selection.choose(choice.start, problem.candidates)
    x = selection.fit(found)
    return found[found < problem.num_effects], selection.weights, x[len(x) - len(problem.columns.tilts) :]
