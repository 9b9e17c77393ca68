"""Gains side by side: the same steps from all over the joint box, on an arm that is not quite the modelled one."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.experiments.tuning.bench import NOMINAL, Bench, Condition, Response
from dvrk_drake.experiments.tuning.settings import band, step_size
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.arm_schema import Gains

#: How long a step is watched [s], and the part of it at the end in which nothing should move any more.
DURATION, REST = 2.0, 0.4
CONDITIONS = (
    NOMINAL,
    Condition("G +20 %", gravity=1.2),
    Condition("G -20 %", gravity=0.8),
    Condition("M +20 %", inertia=1.2),
    Condition("M -20 %", inertia=0.8),
    Condition("+1 tick", ticks=1),
)
#: Poses of the joint box, and the seed that draws them.
POSES, SEED = 6, 3


@dataclass(frozen=True, eq=False)
class StepMeasures:
    """Of the n joints in one step, from the positions that the joints truly have.

    Attributes:
        settling: (n,) time after which the joint stays inside its `band` [s]; infinite if it does not, or not for
            the last `REST`.
        overshoot: (n,) farthest beyond the goal, as a share of the step; 0 if it does not get there.
        steady_error: (n,) mean distance from the goal over the last `REST` [rad, m].
        unrest: (n,) peak to peak of the commanded effort over the last `REST`, as a share of the effort limit.
    """

    settling: NDArray[np.float64]
    overshoot: NDArray[np.float64]
    steady_error: NDArray[np.float64]
    unrest: NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Comparison:
    """What gains do.

    Attributes:
        arm: whose gains they are.
        gains: name -> gains.
        conditions: (c,) of the arm.
        poses: (p, n) where the steps begin.
        measures: name -> condition by condition, pose by pose.
        responses: name -> the step from the first pose, arm as modelled.
    """

    arm: Arm
    gains: Mapping[str, Gains]
    conditions: tuple[Condition, ...]
    poses: NDArray[np.float64]
    measures: Mapping[str, list[list[StepMeasures]]]
    responses: Mapping[str, Response]

    def table(self, name: str, measure: str) -> NDArray[np.float64]:
        """(c, p, n) one of the fields of `StepMeasures`."""
        return np.array([[getattr(m, measure) for m in poses] for poses in self.measures[name]])

    def best(self, names: Iterable[str]) -> str:
        """Of these gains those with which joints fail to settle least often; of equal ones the fastest."""

        def rank(name: str) -> tuple[int, float]:
            settling = self.table(name, "settling")
            failed = ~np.isfinite(settling)
            return int(failed.sum()), float(np.where(failed, DURATION, settling).mean())

        return min(names, key=rank)


def step_goal(arm: Arm, q: NDArray[np.float64]) -> NDArray[np.float64]:
    """(n,) every joint one step from q (n,), to the side where the middle of its range is."""
    middle = 0.5 * (arm.position_lower + arm.position_upper)
    goal: NDArray[np.float64] = q + np.where(q < middle, 1.0, -1.0) * step_size(arm)
    return goal


def measure_step(arm: Arm, response: Response) -> StepMeasures:
    """What a response to a step from where it begins says."""
    t, error = response.t, response.q - response.q_desired
    way = error[0]
    outside = np.abs(error) > band(arm)
    last_outside = np.where(outside.any(axis=0), len(t) - 1 - np.argmax(outside[::-1], axis=0), -1)
    settling = np.append(t, np.inf)[last_outside + 1]
    late = t > t[-1] - REST
    return StepMeasures(
        settling=np.where(settling > t[-1] - REST, np.inf, settling),
        overshoot=np.maximum(np.max(-error / way, axis=0), 0.0),
        steady_error=np.abs(error[late]).mean(axis=0),
        unrest=np.ptp(response.effort[late], axis=0) / arm.effort_limits,
    )


def run_step(bench: Bench, q: NDArray[np.float64], gains: Gains) -> Response:
    """All joints step at once: each also has to bear what the others do."""
    return bench.step(q, step_goal(bench.arm, q), gains, DURATION)
