"""Tunes an arm and compares the resulting gains with other gains. Uses all cores."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.experiments.tuning_bench import (
    NOMINAL,
    Bench,
    Condition,
    JointOnBench,
    Response,
    band,
    bench_of,
    rounded_gains,
    step_size,
    tuning_poses,
)
from dvrk_drake.experiments.tuning_model_based import ArmDesign, design_arm
from dvrk_drake.experiments.tuning_procedure import JointProcedure, tune_joint
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.models.arm_schema import Gains
from dvrk_drake.models.files import Reportable
from dvrk_drake.workers import await_results, local_executor

#: Duration of a step test, and of its final part in which the joints should be at rest [s].
DURATION, REST_TIME = 2.0, 0.4
CONDITIONS = (
    NOMINAL,
    Condition("G +20 %", gravity=1.2),
    Condition("G -20 %", gravity=0.8),
    Condition("M +20 %", inertia=1.2),
    Condition("M -20 %", inertia=0.8),
    Condition("+1 tick", ticks=1),
)
#: Number of random start poses of the steps, and their seed.
POSES, SEED = 6, 3


@dataclass(frozen=True, eq=False)
class Comparison:
    """Comparison of several sets of gains for one arm.

    Attributes:
        arm: Arm to which the gains apply.
        gains: Gains by name.
        conditions: Conditions (c,) of the arm.
        poses: Start poses (p, n) of the steps.
        settling: Settling times (c, p, n) of the joints [s], by name of the gains, see `settling_times`.
        responses: Step responses from the first pose in the first condition, by name of the gains.
    """

    arm: Arm
    gains: Mapping[str, Gains]
    conditions: tuple[Condition, ...]
    poses: NDArray[np.float64]
    settling: Mapping[str, NDArray[np.float64]]
    responses: Mapping[str, Response]

    def best(self, names: Iterable[str]) -> str:
        """Returns the name of the gains for which the fewest joints do not settle.

        If several gains have the same number, the name of those with the smallest mean settling time is returned.
        """

        def rank(name: str) -> tuple[int, float]:
            settling = self.settling[name]
            failed = ~np.isfinite(settling)
            return int(failed.sum()), float(np.where(failed, DURATION, settling).mean())

        return min(names, key=rank)


def step_goal(arm: Arm, q: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns the goal (n,) of a step of all joints from q (n,) towards the middle of their ranges."""
    middle = 0.5 * (arm.position_lower + arm.position_upper)
    goal: NDArray[np.float64] = q + np.where(q < middle, 1.0, -1.0) * step_size(arm)
    return goal


def settling_times(arm: Arm, response: Response) -> NDArray[np.float64]:
    """Returns the times (n,) after which the joints stay inside the settling band of their true positions [s].

    The time is infinite for a joint that is outside the band during the last `REST_TIME`.
    """
    t = response.t
    outside = np.abs(response.q - response.q_desired) > band(arm)
    last_outside = np.where(outside.any(axis=0), len(t) - 1 - np.argmax(outside[::-1], axis=0), -1)
    settling = np.append(t, np.inf)[last_outside + 1]
    return np.where(settling > t[-1] - REST_TIME, np.inf, settling)


def run_step(bench: Bench, q: NDArray[np.float64], gains: Gains) -> Response:
    """Simulates a simultaneous step of all joints from q (n,), so that the joints disturb each other."""
    return bench.step(q, step_goal(bench.arm, q), gains, DURATION)


Method = Literal["paper", "model"]
#: Names of gains that are not results of a tuning method.
OWN, PUBLISHED = "the arm's own", "published"
#: Function called with the finished share, 0..1.
Progress = Callable[[float], object]
#: Share of the paper's procedure in the total progress of a run.
PROCEDURE_SHARE = 0.5


@dataclass(frozen=True, eq=False)
class Tuning(Reportable):
    """Result of tuning an arm.

    Attributes:
        arm: Arm that was tuned.
        procedure: Results of the paper's procedure for the joints. None if not requested.
        design: Result of the model-based design. None if not requested.
        comparison: Comparison of the resulting gains with the gains of the arm file and the published gains.
    """

    arm: Arm
    procedure: tuple[JointProcedure, ...] | None
    design: ArmDesign | None
    comparison: Comparison

    @property
    def found(self) -> dict[str, Gains]:
        """Gains by tuning method."""
        gains = self.comparison.gains
        return {name: gains[name] for name in gains if name not in (OWN, PUBLISHED)}


def tune_arm(
    name: str,
    methods: Sequence[Method],
    progress: Progress = lambda share: None,
    conditions: tuple[Condition, ...] = CONDITIONS,
    poses: int = POSES,
) -> Tuning:
    """Tunes an arm and compares the resulting gains with other gains, see `Tuning`. The result is deterministic.

    Args:
        name: Name of an arm, or path of its YAML file.
        methods: Tuning methods.
        progress: Function called with the finished share of the run, 0..1.
        conditions: Conditions of the arm in the comparison. The first condition must have no model errors.
        poses: Number of start poses in the comparison.

    Raises:
        ArmError: The arm does not exist, or its motors are too weak to compensate gravity.
    """
    arm = load_arm(name)
    share = PROCEDURE_SHARE if "paper" in methods else 0.0
    gains = {OWN: arm.gains}
    if arm.published_gains.kp:
        gains[PUBLISHED] = arm.published_gains
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
    # Order the runs by condition, since each process caches one closed loop per condition.
    runs = {
        (which, c, p): executor.submit(_step, name, condition, poses, p, gains[which])
        for c, condition in enumerate(conditions)
        for which in gains
        for p in range(poses)
    }
    await_results(list(runs.values()), progress)
    columns = range(len(conditions))
    settling = {
        which: np.array([[runs[which, c, p].result()[0] for p in range(poses)] for c in columns]) for which in gains
    }
    responses = {which: runs[which, 0, 0].result()[1] for which in gains}
    return Comparison(arm, gains, conditions, tuning_poses(arm, poses, SEED), settling, responses)


def _tune_joint(name: str, joint: int) -> JointProcedure:
    return tune_joint(JointOnBench(bench_of(name), joint))


def _step(name: str, condition: Condition, poses: int, pose: int, gains: Gains) -> tuple[NDArray[np.float64], Response]:
    bench = bench_of(name, condition)
    response = run_step(bench, tuning_poses(bench.arm, poses, SEED)[pose], gains)
    return settling_times(bench.arm, response), response
