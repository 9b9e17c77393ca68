"""Transparency: interaction force and torque at the handle when an operator moves an arm along a path."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import LogVectorOutput
from pydrake.trajectories import PiecewisePolynomial, PiecewisePose

from dvrk_drake.dynamics.friction_compensation import Friction, check_ratios
from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.dynamics.kinematics import ArmFrame
from dvrk_drake.errors import ModelError, ScenarioError
from dvrk_drake.experiments.simulation import advance, friction_compensator, samples
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.effects_schema import ArmEffects
from dvrk_drake.recordings.recording import Recording
from dvrk_drake.systems.arm_station import ArmStation
from dvrk_drake.systems.closed_loop import add_closed_loop
from dvrk_drake.systems.gravity_pid_controller import GravityPidController, Mode
from dvrk_drake.systems.hand import Grip, Hand, PoseTrajectorySource

#: Sample period of the recorded signals [s].
SAMPLE_PERIOD = 5e-3
#: Duration of the initial transient of the grasp, which is excluded from the evaluation [s].
GRASP_TIME = 1.0
#: Least duration of the evaluation [s], for 20 samples of the force.
LEAST_TIME = 0.1
#: Maximum excess over the joint limits [rad], [m]. A recording with a larger excess is rejected.
MAX_LIMIT_EXCESS = 0.1, 0.01


@dataclass(frozen=True)
class Compensation:
    """Compensation by the motors: none, gravity only, or gravity and a share of the friction.

    Attributes:
        name: Name in tables and plots.
        model: Model of the gravity torque. None for unpowered motors.
        friction_ratio: Requested share of the friction to compensate. `safe_ratios` limits it.
        friction: Friction model. None for the friction of the arm file.
        mode: Mode of the controller, "gravity" or "guide".
    """

    name: str
    model: IdentifiedModel | None = None
    friction_ratio: float = 0.0
    friction: Friction | None = None
    mode: Mode = "gravity"


@dataclass(frozen=True, eq=False)
class OperatorForces:
    """Interaction force and torque between the hand of an operator and the handle along a path, from `GRASP_TIME` on.

    Attributes:
        name: Name of the compensation.
        time: Times (m,) [s].
        torque, force: Torque and force (m, 3) of the hand on the arm at the handle, in the base frame [N m], [N].
        deviation: Distances (m,) of the handle from its desired positions [m].
    """

    name: str
    time: NDArray[np.float64]
    torque: NDArray[np.float64]
    force: NDArray[np.float64]
    deviation: NDArray[np.float64]

    @property
    def measures(self) -> dict[str, float]:
        """RMS and 95th percentile of force [N] and torque [N m], and largest deviation [m], by name."""
        found = {}
        for name, vectors in (("force", self.force), ("torque", self.torque)):
            sizes = np.linalg.norm(vectors, axis=1)
            found[f"rms_{name}"] = float(np.sqrt(np.mean(sizes**2)))
            found[f"{name}_95"] = float(np.percentile(sizes, 95))
        return {**found, "largest_deviation": float(self.deviation.max())}

    @property
    def rms_force(self) -> float:
        """RMS force [N]."""
        return self.measures["rms_force"]


def random_path(arm: Arm, poses: int = 6, seconds_each: float = 2.5, seed: int = 0) -> PiecewisePolynomial:
    """Makes a smooth joint motion through random poses.

    Args:
        arm: Arm whose limits apply.
        poses: Number of poses.
        seconds_each: Time between consecutive poses [s].
        seed: Seed of the poses.
    """
    q = arm.sample_poses(poses, np.random.default_rng(seed), margin=0.25)
    times = seconds_each * np.arange(poses, dtype=float)
    return PiecewisePolynomial.CubicWithContinuousSecondDerivatives(
        times, q.T, np.zeros(arm.num_joints), np.zeros(arm.num_joints)
    )


def recorded_path(arm: Arm, recording: Recording, speed: float = 1.0) -> PiecewisePolynomial:
    """Returns the motion of a recording at `speed` times its original speed. Positions are clipped to the joint limits.

    Raises:
        ScenarioError: The recording has no times, the speed is out of range, or the motion exceeds the limits by more
            than `MAX_LIMIT_EXCESS`.
        RecordingError: The number of joints differs from that of the arm.
    """
    recording = recording.in_joint_coordinates(arm)
    if recording.t is None:
        raise ScenarioError(f"{recording.source}: the recording has no times; t [s] is required")
    if not 0 < speed <= 10:
        raise ScenarioError(f"speed is {speed:g}; allowed: above 0, up to 10")
    A, lower, upper = arm.limit_matrix()
    excess = np.max(np.maximum(lower - recording.q @ A.T, recording.q @ A.T - upper), axis=0)
    shares = excess / arm.per_limit(*MAX_LIMIT_EXCESS)
    if np.any(shares > 1):
        j = int(np.argmax(shares))
        name = [*arm.joint_names, *(limit.name for limit in arm.coupled_limits)][j]
        unit = "m" if j < arm.num_joints and arm.prismatic[j] else "rad"
        raise ScenarioError(
            f"{recording.source}: {name} exceeds the limits of {arm.name} by {excess[j]:.2g} {unit}. Check that the "
            "recording is of this arm and contains joint positions, not actuator positions."
        )
    t, keep = np.unique(recording.t, return_index=True)
    if len(t) < 3:
        raise ScenarioError(f"{recording.source}: the recording has {len(t)} different times; 3 or more are required")
    q = np.clip(recording.q[keep], arm.position_lower, arm.position_upper)
    return PiecewisePolynomial.CubicShapePreserving((t - t[0]) / speed, q.T, zero_end_point_derivatives=True)


def simulate_operator(
    arm: Arm,
    path: PiecewisePolynomial,
    compensation: Compensation,
    *,
    effects: ArmEffects | None = None,
    grip: Grip | None = None,
    frame_name: str = "",
    seed: int = 0,
    progress: Callable[[float], object] = lambda share: None,
) -> OperatorForces:
    """Simulates an operator who moves the handle of an arm along a path.

    Args:
        arm: Arm to simulate.
        path: Joint positions [rad, m] as a function of time [s], from time 0. The hand follows the pose that the handle
            has at these joint positions.
        compensation: Compensation by the motors.
        effects: Simulated effects of the real arm, e.g. `arm.effects`. None for no effects.
        grip: Grip of the hand. None for the default grip.
        frame_name: Name of the handle's frame. Default: `arm.frames.hand`.
        seed: Seed of the effects' noise.
        progress: Function called with the finished share, 0..1.

    Raises:
        ScenarioError: The path is too short.
    """
    if path.end_time() < GRASP_TIME + LEAST_TIME:
        raise ScenarioError(
            f"the path takes {path.end_time():.2g} s; allowed: {GRASP_TIME + LEAST_TIME:g} s or more, because the "
            f"first {GRASP_TIME:g} s of the grasp are not evaluated"
        )
    name, frame = arm.name.lower(), ArmFrame(arm, frame_name)
    knots = np.arange(path.start_time(), path.end_time(), 0.02)
    poses = [frame.pose(path.value(t).ravel()) for t in knots]
    builder = DiagramBuilder()
    station = builder.AddSystem(ArmStation(arm, effects=effects, seed=seed))
    if compensation.model is not None:
        controller = GravityPidController(compensation.model, mode=compensation.mode)
        friction = friction_compensator(
            arm, compensation.model, compensation.friction_ratio, friction=compensation.friction
        )
        add_closed_loop(builder, station, controller, friction=friction)
    hand = builder.AddSystem(Hand(arm, frame_name, grip))
    handle_path = PiecewisePose.MakeLinear(knots, poses)
    source = builder.AddSystem(PoseTrajectorySource(handle_path))
    builder.Connect(station.GetOutputPort(f"{name}.state_true"), hand.GetInputPort("state_estimated"))
    builder.Connect(source.get_output_port(), hand.GetInputPort("X_BG_desired"))
    builder.Connect(hand.GetOutputPort("effort_disturbance"), station.GetInputPort(f"{name}.effort_disturbance"))
    outputs = hand.GetOutputPort("spatial_force"), station.GetOutputPort(f"{name}.state_true")
    logs = [LogVectorOutput(output, builder, SAMPLE_PERIOD) for output in outputs]
    simulator = Simulator(builder.Build())
    root = simulator.get_mutable_context()
    station.SetPositions(station.GetMyMutableContextFromRoot(root), path.value(0.0).ravel())
    times = SAMPLE_PERIOD * np.arange(1, int(path.end_time() / SAMPLE_PERIOD), dtype=np.float64)
    advance(simulator, times, progress)
    forces, state = (samples(log, simulator)[1:] for log in logs)
    positions = np.array([frame.pose(q).translation() for q in state[:, : arm.num_joints]])
    desired = np.array([handle_path.GetPose(min(t, handle_path.end_time())).translation() for t in times])
    deviation = np.linalg.norm(desired - positions, axis=1)
    late = times >= GRASP_TIME
    return OperatorForces(compensation.name, times[late], forces[late, :3], forces[late, 3:], deviation[late])


def listed_compensations(arm: Arm, paths: Sequence[str], friction_ratio: float) -> list[Compensation]:
    """Returns the compensations to compare: none, each model, and each model with friction compensation.

    Args:
        arm: Arm that is moved.
        paths: Paths of the model files. Empty: the nominal model is used.
        friction_ratio: Share of the friction to compensate, 0 to 0.6.

    Raises:
        ModelError: A model belongs to another arm, or two models have the same name.
        ControllerError: The friction ratio is out of range.
    """
    check_ratios(friction_ratio)
    models = {}
    for path in paths:
        name = Path(path).stem
        if name in models:
            raise ModelError(f"--model {path}: two models have the file name {name}; rename one of the files")
        models[name] = IdentifiedModel.load(path, arm)
    if not models:
        models["SDF"] = IdentifiedModel.from_arm(arm)
    listed = [Compensation("nothing")]
    for name, model in models.items():
        listed.append(Compensation(name, model))
        if friction_ratio:
            listed.append(Compensation(f"{name}, friction {friction_ratio:g}", model, friction_ratio))
        listed.append(Compensation(f"{name}, friction {friction_ratio:g}, guide", model, friction_ratio, mode="guide"))
    return listed
