"""Collecting static poses with a simulated arm: the six steps of the paper's section III.G."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context, DiagramBuilder
from pydrake.systems.primitives import TrajectorySource
from pydrake.trajectories import PiecewisePolynomial

from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.models.arm import Arm
from dvrk_drake.recordings.recording import Recording
from dvrk_drake.systems.arm_station import ArmStation
from dvrk_drake.systems.closed_loop import add_closed_loop
from dvrk_drake.systems.gravity_pid_controller import GravityPidController

#: Highest joint speed between poses [rad/s], [m/s].
TRAVEL_SPEED = 1.7, 0.2
#: Least time on the way [s], time to settle [s], samples a pose.
LEAST_TRAVEL, SETTLE, SAMPLES = 0.8, 1.0, 10
#: Between two samples of a pose [s].
SAMPLE_SPACING = 0.01


def visiting_trajectory(arm: Arm, poses: NDArray[np.float64]) -> tuple[PiecewisePolynomial, NDArray[np.float64]]:
    """A trajectory from poses[0] through all others, at rest at each for as long as settling and sampling take.

    Straight in joint space, so between poses inside linear limits it stays inside of them.

    Args:
        arm: the arm, for how fast its joints may be.
        poses: (m, n).

    Returns:
        The trajectory of q (n,), and the time (m,) at which each pose has settled.
    """
    times, knots, settled = [0.0], [poses[0]], []
    speed = arm.per_joint(*TRAVEL_SPEED)
    rest = SETTLE + SAMPLES * SAMPLE_SPACING
    for i, pose in enumerate(poses):
        if i:
            # A cubic from rest to rest is 1.5 times as fast in its middle as on average.
            travel = max(LEAST_TRAVEL, 1.5 * float(np.max(np.abs(pose - poses[i - 1]) / speed)))
            times.append(times[-1] + travel)
            knots.append(pose)
        settled.append(times[-1] + SETTLE)
        times.append(times[-1] + rest)
        knots.append(pose)
    zero = np.zeros((poses.shape[1], len(knots)))
    return PiecewisePolynomial.CubicHermite(times, np.array(knots).T, zero), np.array(settled)


def collect_static_poses(
    station: ArmStation,
    model: IdentifiedModel,
    poses: NDArray[np.float64],
    *,
    effort_noise: float,
    generator: np.random.Generator,
    prepare: Callable[[ArmStation, Context], None] = lambda station, context: None,
    progress: Callable[[float], None] = lambda share: None,
) -> Recording:
    """Visits hand-picked poses under position control and records the holding effort of each (steps 4 to 6).

    Args:
        station: the simulated arm; it becomes part of a Diagram here and cannot be used in another.
        model: what the controller believes; the integrator makes up for what is wrong with it.
        poses: (m, n) inside the limits (steps 1 to 3).
        effort_noise: standard deviation of one effort sample as a share of the effort limit.
        generator: of the noise.
        prepare: called with the station and its context before the start, e.g. to change inertias.
        progress: called with the finished share, 0..1.

    Returns:
        One row a pose: the mean of `SAMPLES` samples of position and effort.
    """
    arm = station.arm
    name = arm.name.lower()
    trajectory, settled = visiting_trajectory(arm, poses)
    builder = DiagramBuilder()
    desired = TrajectorySource(trajectory, output_derivative_order=1)
    add_closed_loop(builder, station, GravityPidController(model), desired)
    simulator = Simulator(builder.Build())
    context = station.GetMyMutableContextFromRoot(simulator.get_mutable_context())
    prepare(station, context)
    station.SetPositions(context, poses[0])
    position = station.GetOutputPort(f"{name}.position_measured")
    effort = station.GetOutputPort(f"{name}.effort_measured")
    q, tau = np.zeros_like(poses), np.zeros_like(poses)
    for i, t in enumerate(settled):
        for sample in range(SAMPLES):
            simulator.AdvanceTo(t + sample * SAMPLE_SPACING)
            q[i] += position.Eval(context) / SAMPLES
            noise = effort_noise * arm.effort_limits * generator.normal(size=arm.num_joints)
            tau[i] += (effort.Eval(context) + noise) / SAMPLES
        progress((i + 1) / len(poses))
    return Recording(q=q, tau=tau, source="simulated poses")
