"""Tunes an arm and compares the gains, on all cores."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Executor, Future, as_completed
from dataclasses import dataclass
from typing import Literal

from dvrk_drake.experiments.study.executors import local_executor
from dvrk_drake.experiments.tuning.bench import Condition, JointOnBench, Response, bench_of
from dvrk_drake.experiments.tuning.comparison import (
    CONDITIONS,
    POSES,
    SEED,
    Comparison,
    StepMeasures,
    measure_step,
    run_step,
)
from dvrk_drake.experiments.tuning.model_based import ArmDesign, design_arm
from dvrk_drake.experiments.tuning.procedure import JointProcedure, tune_joint
from dvrk_drake.experiments.tuning.settings import published_gains, rounded_gains, tuning_poses
from dvrk_drake.models.arm import Arm, load_arm
from dvrk_drake.models.arm_schema import Gains

Method = Literal["paper", "model"]
#: What gains are called in tables that no method has found.
OWN, PUBLISHED = "the arm's own", "published"
#: Called with the finished share, 0..1.
Progress = Callable[[float], None]
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
            _await(trials, lambda done: progress(share * done))
            procedure = tuple(trial.result() for trial in trials)
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
    _await(list(runs.values()), progress)
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


def _await(futures: Sequence[Future], progress: Progress) -> None:
    for done, future in enumerate(as_completed(futures), start=1):
        future.result()
        progress(done / len(futures))
