"""Ground-truth arms, and functions that record static poses of a simulated arm.

The links and effects of a ground-truth arm differ from those of the model that its controller uses.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydrake.multibody.tree import SpatialInertia, UnitInertia
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import TrajectorySource
from pydrake.trajectories import PiecewisePolynomial

from dvrk_drake.analysis.pose_identification import identify_static
from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.dynamics.inertial_parameters import LinkInertia, link_inertias
from dvrk_drake.dynamics.model_links import model_bodies
from dvrk_drake.experiments.reproduction.published import PAPER_ARM
from dvrk_drake.export.model_writer import to_text, with_inertias
from dvrk_drake.models.approach import offset_pose
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.models.files import atomic_write
from dvrk_drake.recordings.recording import Recording
from dvrk_drake.systems.arm_station import ArmStation
from dvrk_drake.systems.closed_loop import add_closed_loop
from dvrk_drake.systems.gravity_pid_controller import GravityPidController
from dvrk_drake.workers import await_results

#: Maximum joint speed between poses [rad/s], [m/s].
TRAVEL_SPEED = 1.7, 0.2
#: Minimum travel time [s], settling time [s], samples per pose.
MIN_TRAVEL, SETTLE, SAMPLES = 0.8, 1.0, 10
#: Minimum duration of the motion to the start of an approach, and of the approach [s].
MIN_APPROACH = 0.3
#: Time between two samples of a pose [s].
SAMPLE_SPACING = 0.01


def pose_visit_trajectory(
    arm: Arm, poses: NDArray[np.float64], approach: NDArray[np.float64] | None = None, settle: float = SETTLE
) -> tuple[PiecewisePolynomial, NDArray[np.float64]]:
    """Makes a trajectory through all poses, which stops at each pose for settling and sampling.

    Between two poses, the trajectory is a straight line in joint space. If the poses satisfy the limits of the
    arm, which are linear, the trajectory also satisfies these limits.

    Args:
        arm: Arm whose joint types determine the maximum speeds.
        poses: Poses (m, n) [rad, m] in the order of the trajectory.
        approach: Distance (n,) [rad, m] from which the arm approaches each pose, first from below and then from above
            in all joints. Near a limit, the distance is shorter. None: the arm visits each pose once.
        settle: Settling time at a pose [s].

    Returns:
        Trajectory of q (n,), and times at which the arm has settled at the poses [s]: one per pose, with `approach` two
        per pose.
    """
    first = poses[0] if approach is None else offset_pose(arm, poses[0], -approach)
    times, knots, settled = [0.0], [first], []
    speed = arm.per_joint(*TRAVEL_SPEED)

    def move(q: NDArray[np.float64], min_duration: float) -> None:
        # The maximum speed of a cubic from rest to rest is 1.5 times its mean speed.
        duration = max(min_duration, 1.5 * float(np.max(np.abs(q - knots[-1]) / speed)))
        times.append(times[-1] + duration)
        knots.append(q)

    def stop() -> None:
        settled.append(times[-1] + settle)
        times.append(settled[-1] + SAMPLES * SAMPLE_SPACING)
        knots.append(knots[-1])

    for i, pose in enumerate(poses):
        if approach is None:
            if i:
                move(pose, MIN_TRAVEL)
            stop()
            continue
        for side in (-1, 1):
            move(offset_pose(arm, pose, side * approach), MIN_APPROACH)
            move(pose, MIN_APPROACH)
            stop()
    zero = np.zeros((poses.shape[1], len(knots)))
    return PiecewisePolynomial.CubicHermite(times, np.array(knots).T, zero), np.array(settled)


def collect_static_poses(
    station: ArmStation,
    model: IdentifiedModel,
    poses: NDArray[np.float64],
    *,
    approach: NDArray[np.float64] | None = None,
    settle: float = SETTLE,
    progress: Callable[[float], object] = lambda share: None,
) -> Recording:
    """Moves an arm to poses under position control and records the holding effort at each pose.

    These are steps 4 to 6 of section III.G of the paper (Rutfield et al., WPI 2015).

    Args:
        station: Simulated arm. It becomes part of a Diagram and cannot be used in another one.
        model: Model used by the controller. The integrator of the controller compensates the errors of this model.
        poses: Poses (m, n) [rad, m] inside the limits (steps 1 to 3 of section III.G).
        approach: Distance (n,) [rad, m] from which the arm approaches each pose, from below and from above. In the mean
            over both directions, dry friction cancels. None: the arm approaches each pose from the previous one.
        settle: Settling time at a pose [s].
        progress: Function called with the finished share, 0..1.

    Returns:
        Recording with one row per pose: means of position and effort over `SAMPLES` samples and both approaches.
    """
    arm = station.arm
    name = arm.name.lower()
    trajectory, settled = pose_visit_trajectory(arm, poses, approach, settle)
    builder = DiagramBuilder()
    desired = TrajectorySource(trajectory, output_derivative_order=1)
    add_closed_loop(builder, station, GravityPidController(model), desired)
    simulator = Simulator(builder.Build())
    context = station.GetMyMutableContextFromRoot(simulator.get_mutable_context())
    station.SetPositions(context, trajectory.value(0.0).ravel())
    position = station.GetOutputPort(f"{name}.position_measured")
    effort = station.GetOutputPort(f"{name}.effort_measured")
    visits = np.zeros((len(settled), 2, arm.num_joints))
    for i, t in enumerate(settled):
        for sample in range(SAMPLES):
            simulator.AdvanceTo(t + sample * SAMPLE_SPACING)
            visits[i] += np.array([position.Eval(context), effort.Eval(context)]) / SAMPLES
        progress((i + 1) / len(settled))
    q, tau = visits.reshape(len(poses), -1, 2, arm.num_joints).mean(axis=1).transpose(1, 0, 2)
    return Recording(q=q, tau=tau, source="simulated poses")


#: Maximum relative change of a link's mass in a perturbed ground-truth arm.
SPREAD = 0.2


@dataclass(frozen=True, eq=False)
class GroundTruth:
    """Ground-truth arm with all effects of a real arm, and the exact model of its holding torque.

    Attributes:
        arm: Arm to simulate, with an SDF in the output folder and the `effects` of the real arm.
        model: Exact model of the gravity, cable and spring torques, used only for evaluation.
        is_paper_arm: Whether the parameters of the arm were identified from the paper's recording.
        origin: Text that states the source of the arm's links and effects.
    """

    arm: Arm
    model: IdentifiedModel
    is_paper_arm: bool
    origin: str


def paper_arm(recording: Recording, folder: Path) -> GroundTruth:
    """Identifies the paper's MTM from its recording and writes its SDF into `folder`.

    The links are physically consistent and have the identified gravity torque. They are as close as possible to the
    links of the SDF of this package. Cables and springs are those of the identified model. Friction, stops, encoders,
    motors and delays are those of `mechanisms/mtm.yaml`, because static poses do not determine them. Friction that is
    larger in one direction causes a constant torque in static poses, which is identified as an offset. The simulated
    friction already contains this torque. Therefore the identified offset of a joint with such friction is omitted.

    Raises:
        RecordingError, IdentificationError, ModelError: The recording is not of an MTM at rest.
    """
    arm = load_arm(PAPER_ARM)
    model = identify_static(recording, arm).model
    direction_dependent = {law.coordinate for law in arm.effects.friction if law.kind == "presliding forward"}
    kept_effects = [
        e for e in model.effects if not (e.kind == "offset" and _at_actuator(e.coordinate) in direction_dependent)
    ]
    statistics = [dataclasses.replace(joint, feedforward_scale=1.0) for joint in model.joints]
    model = dataclasses.replace(model, joints=statistics, effects=kept_effects)
    laws = model.effects
    effects = dataclasses.replace(arm.effects, cables=laws, springs=[])
    ground_truth_arm = with_links(arm, model_bodies(model).links, folder / "true_mtm.sdf", "the paper's recording")
    origin = (
        "The ground-truth arm is the paper's MTM. Its gravity, cables and springs are identified from the paper's 72 "
        "poses. Its friction, stops, encoders, motors and delays are those of another MTM (`mechanisms/mtm.yaml`). In "
        "the paper's recording, joint 6 has only friction torque. Joint 7 has a constant torque, which is the "
        "difference of its friction between both directions. Therefore the ground-truth arm probably needs less "
        "compensation at these joints than the real arm."
    )
    return GroundTruth(dataclasses.replace(ground_truth_arm, effects=effects), model, True, origin)


def _at_actuator(coordinate: str) -> str:
    return "actuator." + coordinate.partition(".")[2]


def perturbed_ground_truth(name: str, folder: Path, seed: int) -> GroundTruth:
    """Makes a ground-truth arm whose link masses differ randomly from the SDF by up to `SPREAD`; writes its SDF.

    An MTM made by this function has no wrist spring. The spring in the arm file balances a heavier wrist than that of
    the SDF. With the wrist of the SDF, the torque of the spring would exceed the motor torque at many poses.
    """
    arm = load_arm(name)
    links = perturbed_links(arm, np.random.default_rng(seed))
    ground_truth_arm = with_links(arm, links, folder / f"true_{name}.sdf", "a simulated arm with random link masses")
    if name == PAPER_ARM:
        ground_truth_arm = dataclasses.replace(ground_truth_arm, effects=arm.effects.without("springs"))
    laws = [*ground_truth_arm.effects.cables, *ground_truth_arm.effects.springs]
    model = dataclasses.replace(IdentifiedModel.from_arm(ground_truth_arm, laws), arm=arm)
    origin = (
        f"The ground-truth arm has the links of the SDF with random changes of their masses by up to "
        f"{100 * SPREAD:.0f} % (seed {seed}). Its effects are those of `mechanisms/`: friction, cables, encoders, "
        f"motors and delays."
    )
    return GroundTruth(ground_truth_arm, model, False, origin)


def perturbed_links(
    arm: Arm,
    generator: np.random.Generator,
    shift: float = 0.0,
    mass_ratios: tuple[float, float] = (1 - SPREAD, 1 + SPREAD),
) -> list[LinkInertia]:
    """Returns the links with random masses and centres of mass.

    Args:
        arm: Arm with the nominal links.
        generator: Source of the random numbers.
        shift: Maximum displacement of a centre of mass along each axis [m].
        mass_ratios: Smallest and largest ratio of the mass of a link to its nominal mass.
    """
    links = []
    for link in link_inertias(arm):
        parameters = link.parameters
        if shift:
            M = link.to_spatial_inertia()
            com = M.get_com() + generator.uniform(-shift, shift, 3)
            # The inertia about the centre of mass is unchanged, so the body remains physically consistent.
            G = M.Shift(M.get_com()).get_unit_inertia().ShiftFromCenterOfMass(-com)
            shifted = SpatialInertia(M.get_mass(), com, UnitInertia(G))
            parameters = LinkInertia.from_spatial_inertia(link.link, shifted).parameters
        links.append(LinkInertia(link.link, parameters * generator.uniform(*mass_ratios)))
    return links


def with_links(arm: Arm, links: Sequence[LinkInertia], path: Path, origin: str) -> Arm:
    """Returns the arm with the given links; writes its SDF to `path`. A comment in the SDF states `origin`."""
    with atomic_write(path) as stream:
        stream.write(to_text(with_inertias(arm, links), f"{arm.name}, inertial parameters of {origin}."))
    return dataclasses.replace(arm, sdf=(str(path.resolve()),))


#: Distance between a pose and the start of an approach to it [rad], [m]. In the mean over two opposite approaches, dry
#: friction cancels.
APPROACH = 0.2, 0.02
#: Margin at both ends of each joint range, as a share of the range; maximum angle of multi-turn joints [rad].
MARGIN, MAX_MULTI_TURN_ANGLE = 0.05, 1.6
#: Number of poses that one worker collects at a time.
_CHUNK = 10


def collect(
    truth: GroundTruth,
    name: str,
    count: int,
    seed: int,
    executor: Executor,
    progress: Callable[[float], object] = lambda share: None,
) -> Recording:
    """Collects static poses of a ground-truth arm with all its effects.

    The arm approaches each pose from two opposite directions, and the recording contains the mean. The controller uses
    the nominal model. The workers of the executor collect chunks of poses in parallel. Each chunk has a separate start
    pose and separate noise, so the result does not depend on the number of workers.
    """
    arm = load_arm(name)
    poses = arm.sample_poses(count, np.random.default_rng(seed), margin=MARGIN)
    multi_turn = (arm.position_upper - arm.position_lower > 4 * np.pi) & ~arm.prismatic
    poses[:, multi_turn] = np.clip(poses[:, multi_turn], -MAX_MULTI_TURN_ANGLE, MAX_MULTI_TURN_ANGLE)
    chunks = np.array_split(poses, -(-count // _CHUNK))
    futures = [executor.submit(_collect_chunk, name, truth.arm, c, seed + i) for i, c in enumerate(chunks)]
    rows = np.concatenate(await_results(futures, progress))
    q, tau = np.split(rows, 2, axis=1)
    return Recording(q=q, tau=tau, source=f"{count} poses of the simulated {arm.name}")


def _collect_chunk(name: str, ground_truth_arm: Arm, poses: NDArray[np.float64], seed: int) -> NDArray[np.float64]:
    """Returns rows (m, 2n) of q and tau, one per pose: means over two opposite approaches to the pose."""
    arm = load_arm(name)
    offset = arm.per_joint(*APPROACH)
    visited = np.concatenate([[offset_pose(arm, q, -offset), q, offset_pose(arm, q, offset), q] for q in poses])
    station = ArmStation(arm, plant_arm=ground_truth_arm, effects=ground_truth_arm.effects, seed=seed)
    recording = collect_static_poses(station, IdentifiedModel.from_arm(arm), visited)
    rows = np.hstack([recording.q, recording.measured_effort()])
    return (rows[1::4] + rows[3::4]) / 2
