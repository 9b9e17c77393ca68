"""Tunes an arm and compares the gains, on all cores."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.experiments.study.study import await_results, local_executor
from dvrk_drake.experiments.tuning.bench import (
    NOMINAL,
    Bench,
    Condition,
    JointOnBench,
    Response,
    band,
    bench_of,
    published_gains,
    rounded_gains,
    step_size,
    tuning_poses,
)
from dvrk_drake.experiments.tuning.model_based import ArmDesign, design_arm
from dvrk_drake.experiments.tuning.procedure import JointProcedure, tune_joint
from dvrk_drake.models.arm import Arm, load_arm
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
        oscillation: (n,) peak to peak of the commanded effort over the last `REST`, as a share of the effort limit.
    """

    settling: NDArray[np.float64]
    overshoot: NDArray[np.float64]
    steady_error: NDArray[np.float64]
    oscillation: NDArray[np.float64]


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
        oscillation=np.ptp(response.effort[late], axis=0) / arm.effort_limits,
    )


def run_step(bench: Bench, q: NDArray[np.float64], gains: Gains) -> Response:
    """All joints step at once: each also has to bear what the others do."""
    return bench.step(q, step_goal(bench.arm, q), gains, DURATION)


Method = Literal["paper", "model"]
#: What gains are called in tables that no method has found.
OWN, PUBLISHED = "the arm's own", "published"
#: Called with the finished share, 0..1.
Progress = Callable[[float], object]
#: Of the time that a run takes, the share of the procedure.
PROCEDURE_SHARE = 0.5


@dataclass(frozen=True, eq=False)
class Tuning:
    """What tuning an arm gave.

    Attributes:
        arm: that was tuned.
        procedure: of each joint by the paper's procedure, if that was asked for.
        design: by the model, if that was asked for.
        comparison: of these gains, the arm's own and published ones.
    """

    arm: Arm
    procedure: tuple[JointProcedure, ...] | None
    design: ArmDesign | None
    comparison: Comparison

    @property
    def found(self) -> dict[str, Gains]:
        """Gains that were found here, by method."""
        gains = self.comparison.gains
        return {name: gains[name] for name in gains if name not in (OWN, PUBLISHED)}


def tune_arm(
    name: str,
    methods: Sequence[Method],
    progress: Progress = lambda share: None,
    conditions: tuple[Condition, ...] = CONDITIONS,
    poses: int = POSES,
) -> Tuning:
    """Finds gains and compares them; the same arm gives the same numbers.

    Args:
        name: of an arm, or the path of its YAML file.
        methods: how to find gains.
        progress: of all of it.
        conditions: of the arm in the comparison; the first is the arm as modelled.
        poses: of the joint box, in the comparison.

    Raises:
        ArmError: no such arm, or its motors hardly hold it.
    """
    arm = load_arm(name)
    share = PROCEDURE_SHARE if "paper" in methods else 0.0
    gains = {OWN: arm.gains}
    if (published := published_gains(arm)) is not None:
        gains[PUBLISHED] = published
    procedure = design = None
    with local_executor() as executor:
        if "paper" in methods:
            trials = [executor.submit(_tune_joint, name, j) for j in range(arm.num_joints)]
            procedure = tuple(await_results(trials, lambda done: progress(share * done)))
            gains["paper"] = rounded_gains((joint.kp, joint.kd, joint.ki) for joint in procedure)
        if "model" in methods:
            design = design_arm(arm)
            gains["model"] = design.gains
        comparison = _compare(executor, name, gains, conditions, poses, lambda x: progress(share + (1 - share) * x))
    return Tuning(arm, procedure, design, comparison)


def _compare(
    executor: Executor,
    name: str,
    gains: dict[str, Gains],
    conditions: tuple[Condition, ...],
    poses: int,
    progress: Progress,
) -> Comparison:
    arm = load_arm(name)
    # Condition by condition: a process builds an arm for each that it meets.
    runs = {
        (which, c, p): executor.submit(_step, name, condition, poses, p, gains[which])
        for c, condition in enumerate(conditions)
        for which in gains
        for p in range(poses)
    }
    await_results(list(runs.values()), progress)
    columns = range(len(conditions))
    measures = {which: [[runs[which, c, p].result()[0] for p in range(poses)] for c in columns] for which in gains}
    responses = {which: runs[which, 0, 0].result()[1] for which in gains}
    return Comparison(arm, gains, conditions, tuning_poses(arm, poses, SEED), measures, responses)


def _tune_joint(name: str, joint: int) -> JointProcedure:
    return tune_joint(JointOnBench(bench_of(name), joint))


def _step(name: str, condition: Condition, poses: int, pose: int, gains: Gains) -> tuple[StepMeasures, Response]:
    bench = bench_of(name, condition)
    response = run_step(bench, tuning_poses(bench.arm, poses, SEED)[pose], gains)
    return measure_step(bench.arm, response), response
