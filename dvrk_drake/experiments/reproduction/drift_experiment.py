"""Drift of an arm that is released under gravity compensation, as in the paper's Fig. 5 and 6, for many poses."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from functools import cache
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import BasicVector, Context, DiagramBuilder, LeafSystem
from pydrake.systems.primitives import LogVectorOutput, TrajectorySource
from pydrake.trajectories import PiecewisePolynomial

from dvrk_drake.dynamics.friction_compensation import Friction
from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.experiments.simulation import samples
from dvrk_drake.models.approach import offset_pose
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.systems.arm_station import ArmStation
from dvrk_drake.systems.closed_loop import add_closed_loop
from dvrk_drake.systems.friction_compensator import FrictionCompensator
from dvrk_drake.systems.gravity_pid_controller import GravityPidController, Mode
from dvrk_drake.workers import await_results

#: Sample period [s].
SAMPLE_PERIOD = 0.02
#: Duration of the motion after a release [s]; maximum distance of a held joint from its release position [rad], [m].
DURATION = 10.0
BAND = 0.015, 0.0015
#: Distance from which an arm approaches its release pose [rad], [m].
APPROACH = 0.2, 0.02
#: Approach to the release pose: none, regulated by the controller, or led by a hand.
Approach = Literal["none", "regulated", "hand"]
#: Duration of each approach, and settling time at the release pose [s].
APPROACH_TIMES: dict[Approach, tuple[float, float]] = {"none": (1.0, 0.0), "regulated": (1.0, 1.0), "hand": (3.0, 0.5)}
#: Ratios of the stiffness and damping of a hand that leads an arm to the gains of the arm. The hand follows its path
#: within about 0.01 rad against the friction of the arm, and a larger damping would be unstable at 1 kHz.
_HAND_STIFFNESS, _HAND_DAMPING = 10.0, 3.0


@dataclass(frozen=True, eq=False)
class Release:
    """Release of an arm at one pose.

    Attributes:
        arm: Name of the arm whose file the controller uses.
        ground_truth_arm: Arm to simulate.
        parts: Names of the simulated effects, see `ArmEffects.only`.
        model: Path of the controller's model file.
        start: Release pose (n,) [rad, m]. Without an approach, the presliding springs carry no force at this pose.
        mode: Mode of the controller after the release, and while a hand leads the arm.
        approach: How the arm moves to the pose, from a distance of `APPROACH`. The motion loads the presliding springs.
        hysteresis_ratio: Compensated share of the wide hysteresis. After an approach, this hysteresis moves the
            released arm back.
        duration: Duration of the motion after the release [s].
        seed: Seed of the effects' noise.
    """

    arm: str
    ground_truth_arm: Arm
    parts: tuple[str, ...]
    model: str
    start: NDArray[np.float64]
    mode: Mode = "gravity"
    approach: Approach = "none"
    hysteresis_ratio: float = 0.0
    duration: float = DURATION
    seed: int = 0


def release(case: Release) -> NDArray[np.float64]:
    """Simulates a release; returns the true positions (samples, n) [rad, m] after it, every `SAMPLE_PERIOD` [s]."""
    arm = load_arm(case.arm)
    name = arm.name.lower()
    effects = case.ground_truth_arm.effects.only(case.parts)
    station = ArmStation(arm, plant_arm=case.ground_truth_arm, effects=effects, seed=case.seed)
    builder = DiagramBuilder()
    trajectory = _approach_trajectory(case, arm)
    controller = GravityPidController(_model(case.model), mode="hold" if case.approach == "regulated" else case.mode)
    friction = None
    if case.hysteresis_ratio:
        friction = FrictionCompensator(Friction.of_arm(arm), ratio=0.0, hysteresis_ratio=case.hysteresis_ratio)
    add_closed_loop(builder, station, controller, TrajectorySource(trajectory, output_derivative_order=1), friction)
    start_time = sum(APPROACH_TIMES[case.approach]) if case.approach != "none" else 0.0
    if case.approach == "hand":
        hand = builder.AddSystem(_JointHand(arm, trajectory, start_time))
        builder.Connect(station.GetOutputPort(f"{name}.state_true"), hand.get_input_port())
        builder.Connect(hand.get_output_port(), station.GetInputPort(f"{name}.effort_disturbance"))
    log = LogVectorOutput(station.GetOutputPort(f"{name}.state_true"), builder, SAMPLE_PERIOD)
    simulator = Simulator(builder.Build())
    context = simulator.get_mutable_context()
    station.SetPositions(station.GetMyMutableContextFromRoot(context), trajectory.value(0.0).ravel())
    if case.approach == "regulated":
        simulator.AdvanceTo(start_time)
        controller.SetMode(controller.GetMyMutableContextFromRoot(context), case.mode)
    simulator.AdvanceTo(start_time + case.duration)
    return samples(log, simulator)[round(start_time / SAMPLE_PERIOD) :, : arm.num_joints]


class _JointHand(LeafSystem):
    """Hand that leads each joint of an arm along a trajectory with a spring and a damper, and lets go at a time [s]."""

    def __init__(self, arm: Arm, trajectory: PiecewisePolynomial, release_time: float) -> None:
        super().__init__()
        self._trajectory, self._velocity = trajectory, trajectory.MakeDerivative()
        self._stiffness = _HAND_STIFFNESS * np.array(arm.gains.kp)
        self._damping = _HAND_DAMPING * np.array(arm.gains.kd)
        self._release_time = release_time
        self.DeclareVectorInputPort("state_estimated", 2 * arm.num_joints)
        self.DeclareVectorOutputPort("effort_disturbance", arm.num_joints, self._calc_effort)

    def _calc_effort(self, context: Context, output: BasicVector) -> None:
        time = min(context.get_time(), self._trajectory.end_time())
        if context.get_time() >= self._release_time:
            output.SetZero()
            return
        q, v = np.split(self.get_input_port().Eval(context), 2)
        error, error_rate = self._trajectory.value(time).ravel() - q, self._velocity.value(time).ravel() - v
        output.SetFromVector(self._stiffness * error + self._damping * error_rate)


def _approach_trajectory(case: Release, arm: Arm) -> PiecewisePolynomial:
    """Returns the trajectory to the release pose; it is constant without an approach."""
    q = first = np.asarray(case.start, float)
    if case.approach != "none":
        sides = np.random.default_rng(case.seed).choice([-1.0, 1.0], arm.num_joints)
        first = offset_pose(arm, q, sides * arm.per_joint(*APPROACH))
    knots = np.column_stack([first, q])
    return PiecewisePolynomial.CubicHermite([0.0, APPROACH_TIMES[case.approach][0]], knots, np.zeros_like(knots))


@cache
def _model(path: str) -> IdentifiedModel:
    return IdentifiedModel.load(path)


def release_all(
    cases: Sequence[Release], executor: Executor, progress: Callable[[float], object] = lambda share: None
) -> NDArray[np.float64]:
    """Simulates all releases; returns the positions (cases, samples, n). They do not depend on the executor."""
    futures = [executor.submit(release, case) for case in cases]
    return np.array(await_results(futures, progress))


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
