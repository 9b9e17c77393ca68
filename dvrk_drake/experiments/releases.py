"""Releases of a simulated arm under gravity compensation from several poses, as in the paper's Fig. 5 and 6."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Executor
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.analysis.excitation.pose_file import offset_pose
from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.experiments.scenario import ControllerScenario
from dvrk_drake.experiments.simulation import scenario_of_arm, simulate
from dvrk_drake.models.arm import Arm
from dvrk_drake.systems.gravity_pid_controller import Mode
from dvrk_drake.workers import await_results

#: Sample period [s].
SAMPLE_PERIOD = 0.02
#: Duration of the motion after a release [s]; maximum distance of a held joint from its release position [rad], [m].
DURATION = 10.0
BAND = 0.015, 0.0015
#: Distance from which an arm approaches its release pose [rad], [m]. Duration of the approach, and time at which the
#: arm is released after it has settled [s].
APPROACH, APPROACH_TIME, APPROACHED_RELEASE = (0.2, 0.02), 1.0, 2.0


def release(
    arm: Arm,
    model: IdentifiedModel,
    start: NDArray[np.float64],
    *,
    mode: Mode = "gravity",
    approach: bool = False,
    effects: tuple[str, ...] = ("all",),
    hysteresis_ratio: float = 0.0,
    duration: float = DURATION,
    seed: int = 0,
) -> NDArray[np.float64]:
    """Simulates a release; returns the true positions (samples, n) [rad, m] after it, every `SAMPLE_PERIOD` [s].

    Args:
        arm: Arm to simulate.
        model: Model of the controller.
        start: Release pose (n,) [rad, m]. Without an approach, the presliding springs carry no force at this pose.
        mode: Mode of the controller after the release.
        approach: Whether the controller first moves the arm to the pose, from a distance of `APPROACH` in all joints.
            This motion loads the presliding springs of the friction.
        effects: Names of the simulated effects, see `ArmEffects.only`.
        hysteresis_ratio: Compensated share of the wide hysteresis. After an approach, this hysteresis moves the
            released arm back.
        duration: Duration of the motion after the release [s].
        seed: Seed of the directions of the approach and of the effects' noise.
    """
    first = approach_start(arm, start, seed) if approach else start
    released = APPROACHED_RELEASE if approach else 0.0
    scenario = scenario_of_arm(arm, effects, first, [(APPROACH_TIME, start)] if approach else [])
    scenario.closure, scenario.seed = "mimic", seed
    scenario.duration, scenario.sample_period = released + duration, SAMPLE_PERIOD
    scenario.controller = ControllerScenario(mode, released, hysteresis_ratio=hysteresis_ratio)
    scenario.model = model
    return simulate(scenario).state_true[round(released / SAMPLE_PERIOD) :, : arm.num_joints]


def approach_start(arm: Arm, pose: NDArray[np.float64], seed: int) -> NDArray[np.float64]:
    """Returns the pose (n,) at the distance `APPROACH` from `pose` (n,), in a random direction of each joint."""
    sides = np.random.default_rng(seed).choice([-1.0, 1.0], arm.num_joints)
    return offset_pose(arm, pose, sides * arm.per_joint(*APPROACH))


@dataclass(frozen=True, eq=False)
class Drifts:
    """Positions (cases, samples, n) of `arm` after several releases [rad, m]."""

    arm: Arm
    positions: NDArray[np.float64]

    @property
    def final(self) -> NDArray[np.float64]:
        """Final displacements (cases, n) from the release poses [rad, m]."""
        return self.positions[:, -1] - self.positions[:, 0]

    @property
    def largest(self) -> NDArray[np.float64]:
        """Largest distances (cases, n) from the release poses [rad, m]."""
        return np.abs(self.positions - self.positions[:, :1]).max(axis=1)

    @property
    def held(self) -> NDArray[np.bool_]:
        """Mask (cases, n): True for a joint that always stayed within `BAND` of its release position."""
        return self.largest <= self.arm.per_joint(*BAND)

    @property
    def num_held(self) -> int:
        """Number of cases in which all joints were held."""
        return int(np.count_nonzero(np.all(self.held, axis=1)))


def release_all(
    arm: Arm,
    model: IdentifiedModel,
    poses: NDArray[np.float64],
    executor: Executor,
    progress: Callable[[float], object] = lambda share: None,
    *,
    seed: int = 0,
    **options: Any,
) -> Drifts:
    """Releases an arm at each pose (cases, n). The result does not depend on the executor.

    Case i has the seed `seed` + i. `options` are those of `release`.
    """
    futures = [executor.submit(release, arm, model, q, seed=seed + i, **options) for i, q in enumerate(poses)]
    return Drifts(arm, np.array(await_results(futures, progress)))
