"""One joint of the honest simulated arm, tried with its own gains while the others are held with theirs."""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.experiments.tuning.bench import NOMINAL, Bench, Condition
from dvrk_drake.experiments.tuning.settings import band, counts, effort_limits, middle_pose, step_size
from dvrk_drake.models.arm import load_arm
from dvrk_drake.models.arm_schema import Gains


@cache
def bench_of(arm: str, condition: Condition = NOMINAL) -> Bench:
    """The bench of an arm, by its name or file: one a process."""
    return Bench(load_arm(arm), condition)


class JointOnBench:
    """A `procedure.JointUnderTest`: the joint is released at `step` from the arm's middle pose, where it is wanted."""

    def __init__(self, bench: Bench, joint: int) -> None:
        """Of the arm's joint with this index; the others are held with the arm's own gains."""
        arm = bench.arm
        self._bench, self._joint = bench, joint
        self._q_desired = middle_pose(arm)
        self.step, self.count = float(step_size(arm)[joint]), float(counts(arm)[joint])
        self.band, self.effort_limit = float(band(arm)[joint]), float(effort_limits(arm)[joint])

    def respond(self, kp: float, kd: float, ki: float, duration: float) -> tuple[NDArray, NDArray]:
        """See `JointUnderTest`."""
        own, j = self._bench.arm.gains, self._joint
        columns = [list(values) for values in (own.kp, own.kd, own.ki)]
        for values, value in zip(columns, (kp, kd, ki), strict=True):
            values[j] = value
        q = self._q_desired.copy()
        q[j] += self.step
        response = self._bench.step(q, self._q_desired, Gains(*columns), duration)
        return response.t, np.asarray(response.q_measured[:, j] - self._q_desired[j])
