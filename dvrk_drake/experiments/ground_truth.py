"""Simulated arms whose links differ from their model file, and static poses that are recorded on a simulated arm."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydrake.multibody.tree import SpatialInertia, UnitInertia
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import TrajectorySource
from pydrake.trajectories import PiecewisePolynomial

from dvrk_drake.analysis.excitation.pose_file import offset_pose
from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.dynamics.inertial_parameters import LinkInertia, link_inertias
from dvrk_drake.export.model_writer import to_text, with_inertias
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.models.files import atomic_write
from dvrk_drake.recordings.recording import Recording
from dvrk_drake.systems.arm_station import ArmStation
from dvrk_drake.systems.closed_loop import add_closed_loop
from dvrk_drake.systems.gravity_pid_controller import GravityPidController
from dvrk_drake.workers import await_results

#: Smallest and largest ratio of the mass of a link to its mass in the model file, unless stated otherwise.
MASS_RATIOS = 0.8, 1.2


def perturbed_arm(
    arm: Arm,
    path: str | Path,
    seed: int | np.random.Generator,
    *,
    mass_ratios: tuple[float, float] = MASS_RATIOS,
    max_shift: float = 0.0,
    unchanged_links: Sequence[str] = (),
    without: Sequence[str] = (),
) -> Arm:
    """Makes an arm whose links differ randomly from those of `arm`, as those of a real arm do.

    Args:
        arm: Arm with the nominal links.
        path: SDF file to write. The returned arm uses it.
        seed: Seed, or source, of the random numbers.
        mass_ratios: Smallest and largest ratio of the mass of a link to its nominal mass.
        max_shift: Maximum displacement of a centre of mass along each axis [m].
        unchanged_links: Names of links that keep their nominal inertia, e.g. counterweights.
        without: Names of effects of `arm` that the new arm does not have, e.g. "springs" for a spring that balances
            other links than those of the model file.

    Example:
        >>> import dvrk_drake as dvrk
        >>> arm = dvrk.load_arm("mtml")
        >>> simulated_arm = dvrk.perturbed_arm(arm, "simulated_mtml.sdf", seed=1, without=["springs"])
        >>> run = dvrk.simulate(simulated_arm, controller=dvrk.IdentifiedModel.from_arm(arm), duration=0.1)
        >>> len(run.recording)
        11
    """
    generator, links = np.random.default_rng(seed), []
    for link in link_inertias(arm):
        changed = link.parameters
        if max_shift:
            M = link.to_spatial_inertia()
            com = M.get_com() + generator.uniform(-max_shift, max_shift, 3)
            # The inertia about the centre of mass is unchanged, so the body remains physically consistent.
            G = M.Shift(M.get_com()).get_unit_inertia().ShiftFromCenterOfMass(-com)
            shifted = SpatialInertia(M.get_mass(), com, UnitInertia(G))
            changed = LinkInertia.from_spatial_inertia(link.link, shifted).parameters
        changed = changed * generator.uniform(*mass_ratios)
        links.append(link if link.link in unchanged_links else LinkInertia(link.link, changed))
    perturbed = with_links(arm, links, path, "a simulated arm with random links")
    effects = arm.effects
    for name in without:
        effects = effects.without(name)
    return dataclasses.replace(perturbed, effects=effects)


def with_links(arm: Arm, links: Sequence[LinkInertia], path: str | Path, origin: str) -> Arm:
    """Returns the arm with the given links; writes its SDF to `path`. A comment in the SDF states `origin`."""
    with atomic_write(Path(path)) as stream:
        stream.write(to_text(with_inertias(arm, links), f"{arm.name}, inertial parameters of {origin}."))
    return dataclasses.replace(arm, sdf=(str(Path(path).resolve()),))


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


def simulate_poses(
    station: ArmStation,
    model: IdentifiedModel,
    poses: NDArray[np.float64],
    *,
    approach: NDArray[np.float64] | None = None,
    settle: float = SETTLE,
    progress: Callable[[float], object] = lambda share: None,
) -> Recording:
    """Moves a simulated arm to poses under position control and records the holding effort at each pose.

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

    Example:
        >>> import dvrk_drake as dvrk
        >>> import numpy as np
        >>> arm = dvrk.load_arm("psm")
        >>> q = arm.sample_poses(2, np.random.default_rng(0), margin=0.1)
        >>> recording = dvrk.simulate_poses(dvrk.ArmStation(arm), dvrk.IdentifiedModel.from_arm(arm), q)
        >>> bool(np.allclose(recording.q, q, atol=1e-3))
        True
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


#: Distance between a pose and the start of an approach to it [rad], [m]. In the mean over two opposite approaches, dry
#: friction cancels.
APPROACH = 0.2, 0.02
#: Margin at both ends of each joint range, as a share of the range; maximum angle of multi-turn joints [rad].
MARGIN, MAX_MULTI_TURN_ANGLE = 0.05, 1.6
#: Number of poses that one worker collects at a time.
_CHUNK = 10


def collect(
    arm: Arm, count: int, seed: int, executor: Executor, progress: Callable[[float], object] = lambda share: None
) -> Recording:
    """Collects static poses of a perturbed arm with all its effects.

    The arm approaches each pose from two opposite directions, and the recording contains the mean. The controller uses
    the nominal model. The workers of the executor collect chunks of poses in parallel. Each chunk has a separate start
    pose and separate noise, so the result does not depend on the number of workers.
    """
    poses = arm.sample_poses(count, np.random.default_rng(seed), margin=MARGIN)
    multi_turn = (arm.position_upper - arm.position_lower > 4 * np.pi) & ~arm.prismatic
    poses[:, multi_turn] = np.clip(poses[:, multi_turn], -MAX_MULTI_TURN_ANGLE, MAX_MULTI_TURN_ANGLE)
    chunks = np.array_split(poses, -(-count // _CHUNK))
    futures = [executor.submit(_collect_chunk, arm, c, seed + i) for i, c in enumerate(chunks)]
    rows = np.concatenate(await_results(futures, progress))
    q, tau = np.split(rows, 2, axis=1)
    return Recording(q=q, tau=tau, source=f"{count} poses of the simulated {arm.name}")


def _collect_chunk(arm: Arm, poses: NDArray[np.float64], seed: int) -> NDArray[np.float64]:
    """Returns rows (m, 2n) of q and tau, one per pose: means over two opposite approaches to the pose."""
    offset = arm.per_joint(*APPROACH)
    visited = np.concatenate([[offset_pose(arm, q, -offset), q, offset_pose(arm, q, offset), q] for q in poses])
    station = ArmStation(arm, effects=arm.effects, seed=seed)
    recording = simulate_poses(station, IdentifiedModel.from_arm(load_arm(arm.source)), visited)
    rows = np.hstack([recording.q, recording.measured_effort()])
    return (rows[1::4] + rows[3::4]) / 2
