"""An arm that is let go at a pose, under gravity compensation alone: the paper's Fig. 5 and 6, many times."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import LogVectorOutput, TrajectorySource
from pydrake.trajectories import PiecewisePolynomial

from dvrk_drake.dynamics.friction_compensation import Friction
from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.experiments.simulation import samples
from dvrk_drake.experiments.study.study import await_results
from dvrk_drake.models.arm import Arm, load_arm
from dvrk_drake.models.coupled_limits import beside
from dvrk_drake.systems.arm_station import ArmStation
from dvrk_drake.systems.closed_loop import add_closed_loop
from dvrk_drake.systems.friction_compensator import FrictionCompensator
from dvrk_drake.systems.gravity_pid_controller import GravityPidController, Mode

#: Between two samples [s].
SAMPLE_PERIOD = 0.02
#: How long it is watched [s], and within how much of where it was let go it is held [rad], [m].
DURATION = 10.0
BAND = 0.015, 0.0015
#: From how far it is led to where it is let go [rad], [m], in what time, and how long it is held there [s].
APPROACH, LEADING, RESTING = (0.2, 0.02), 1.0, 1.0


@dataclass(frozen=True, eq=False)
class Release:
    """One of them.

    Attributes:
        arm: name of the arm that the controller knows.
        ground_truth_arm: what is simulated.
        parts: of the true arm's effects that it has, as `ArmEffects.only` takes them.
        model: file of the controller's model.
        start: (n,) pose at which it rests when it is let go [rad, m], its friction unloaded.
        led: the arm first comes there from `APPROACH` beside it, held until it rests, so that its friction is loaded.
        damped: whether the controller brakes beside carrying the weight, in mode "damped".
        hysteresis_ratio: share that the controller compensates of the hysteresis that moves a led arm back.
        duration: [s].
        seed: of the effects' noise.
    """

    arm: str
    ground_truth_arm: Arm
    parts: tuple[str, ...]
    model: str
    start: NDArray[np.float64]
    damped: bool = False
    led: bool = False
    hysteresis_ratio: float = 0.0
    duration: float = DURATION
    seed: int = 0


def release(case: Release) -> NDArray[np.float64]:
    """True positions (samples, n) every `SAMPLE_PERIOD` from the release on."""
    arm = load_arm(case.arm)
    name = arm.name.lower()
    effects = case.ground_truth_arm.effects.only(case.parts)
    station = ArmStation(arm, plant_arm=case.ground_truth_arm, effects=effects, seed=case.seed)
    builder = DiagramBuilder()
    way = _way(case, arm)
    controller = GravityPidController(_model(case.model), mode="hold" if case.led else _mode(case))
    friction = None
    if case.hysteresis_ratio:
        friction = FrictionCompensator(Friction.of_arm(arm), ratio=0.0, hysteresis_ratio=case.hysteresis_ratio)
    add_closed_loop(builder, station, controller, TrajectorySource(way, output_derivative_order=1), friction)
    log = LogVectorOutput(station.GetOutputPort(f"{name}.state_true"), builder, SAMPLE_PERIOD)
    simulator = Simulator(builder.Build())
    context = simulator.get_mutable_context()
    station.SetPositions(station.GetMyMutableContextFromRoot(context), way.value(0.0).ravel())
    before = 0.0
    if case.led:
        before = LEADING + RESTING
        simulator.AdvanceTo(before)
        controller.SetMode(controller.GetMyMutableContextFromRoot(context), _mode(case))
    simulator.AdvanceTo(before + case.duration)
    return samples(log, simulator)[round(before / SAMPLE_PERIOD) :, : arm.num_joints]


def _mode(case: Release) -> Mode:
    """From the release on."""
    return "damped" if case.damped else "gravity"


def _way(case: Release, arm: Arm) -> PiecewisePolynomial:
    """To where it is let go, in `LEADING`."""
    q = from_where = np.asarray(case.start, float)
    if case.led:
        sides = np.random.default_rng(case.seed).choice([-1.0, 1.0], arm.num_joints)
        from_where = beside(arm, q, sides * arm.per_joint(*APPROACH))
    knots = np.column_stack([from_where, q])
    return PiecewisePolynomial.CubicHermite([0.0, LEADING], knots, np.zeros_like(knots))


@cache
def _model(path: str) -> IdentifiedModel:
    return IdentifiedModel.load(path)


def release_all(
    cases: Sequence[Release], executor: Executor, progress: Callable[[float], object] = lambda share: None
) -> NDArray[np.float64]:
    """Positions (cases, samples, n) of each; they do not depend on the executor."""
    futures = [executor.submit(release, case) for case in cases]
    return np.array(await_results(futures, progress))


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
