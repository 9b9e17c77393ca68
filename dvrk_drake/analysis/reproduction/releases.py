"""An arm that is let go at a pose, under gravity compensation alone: the paper's Fig. 5 and 6, many times."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Executor, as_completed
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import LogVectorOutput

from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.models.arm import Arm, load_arm
from dvrk_drake.models.arm_schema import Gains
from dvrk_drake.systems.arm_station import ArmStation
from dvrk_drake.systems.closed_loop import add_closed_loop
from dvrk_drake.systems.gravity_pid_controller import GravityPidController

#: Between two samples [s].
SAMPLE_PERIOD = 0.02
#: How long it is watched [s], and within how much of where it was let go it is held [rad], [m].
DURATION = 10.0
BAND = 0.015, 0.0015


@dataclass(frozen=True, eq=False)
class Release:
    """One of them.

    Attributes:
        arm: name of the arm that the controller knows.
        true_arm: what is simulated.
        parts: of the true arm's effects that it has, as `ArmEffects.only` takes them.
        model: file of the controller's model.
        start: (n,) pose at which it rests when it is let go, its friction unloaded [rad, m].
        damped: whether the controller brakes with the damping gains of the arm beside carrying its weight.
        duration: [s].
        seed: of the effects' noise.
    """

    arm: str
    true_arm: Arm
    parts: tuple[str, ...]
    model: str
    start: NDArray[np.float64]
    damped: bool = False
    duration: float = DURATION
    seed: int = 0


def release(case: Release) -> NDArray[np.float64]:
    """True positions (samples, n) every `SAMPLE_PERIOD`, the start first."""
    arm = load_arm(case.arm)
    name = arm.name.lower()
    effects = case.true_arm.effects.only(case.parts)
    station = ArmStation(arm, plant_arm=case.true_arm, effects=effects, seed=case.seed)
    builder = DiagramBuilder()
    add_closed_loop(builder, station, _controller(case, arm))
    log = LogVectorOutput(station.GetOutputPort(f"{name}.state_true"), builder, SAMPLE_PERIOD)
    simulator = Simulator(builder.Build())
    station.set_positions(station.GetMyMutableContextFromRoot(simulator.get_mutable_context()), case.start)
    simulator.AdvanceTo(case.duration)
    positions: NDArray[np.float64] = log.FindLog(simulator.get_context()).data()[: arm.num_joints].T
    return positions.copy()


def _controller(case: Release, arm: Arm) -> GravityPidController:
    none = [0.0] * arm.num_joints
    return GravityPidController(
        _model(case.model), gains=Gains(none, arm.gains.kd, none), mode="hold" if case.damped else "gravity"
    )


@cache
def _model(path: str) -> IdentifiedModel:
    return IdentifiedModel.load(path)


def release_all(
    cases: Sequence[Release], executor: Executor, progress: Callable[[float], None] = lambda share: None
) -> NDArray[np.float64]:
    """Positions (cases, samples, n) of each; they do not depend on the executor."""
    futures = [executor.submit(release, case) for case in cases]
    for done, _ in enumerate(as_completed(futures), 1):
        progress(done / len(futures))
    return np.array([future.result() for future in futures])


@dataclass(frozen=True, eq=False)
class Drifts:
    """What releases gave: `positions` (cases, samples, n) of `arm`."""

    arm: Arm
    positions: NDArray[np.float64]

    @property
    def final(self) -> NDArray[np.float64]:
        """(cases, n) where it ended, from where it was let go."""
        return self.positions[:, -1] - self.positions[:, 0]

    @property
    def largest(self) -> NDArray[np.float64]:
        """(cases, n) furthest that it ever was from where it was let go."""
        return np.abs(self.positions - self.positions[:, :1]).max(axis=1)

    @property
    def held(self) -> NDArray[np.bool_]:
        """(cases, n) whether the joint stayed within `BAND` all the time."""
        return self.largest <= self.arm.per_joint(*BAND)

    @property
    def num_held(self) -> int:
        """Cases in which every joint was held."""
        return int(np.count_nonzero(np.all(self.held, axis=1)))
