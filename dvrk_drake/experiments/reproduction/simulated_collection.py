"""Collecting poses on a true arm and identifying it, as a user would."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Executor, as_completed

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.experiments.reproduction.true_arms import KnownTruth
from dvrk_drake.experiments.static_pose_collection import collect_static_poses
from dvrk_drake.models.arm import Arm, load_arm
from dvrk_drake.models.coupled_limits import beside
from dvrk_drake.recordings.recording import Recording
from dvrk_drake.systems.arm_station import ArmStation

#: From how far on either side a pose is approached, so that dry friction cancels [rad], [m].
APPROACH = 0.2, 0.02
#: Free at both ends of each range, as a share of it; and how far a handle is turned that turns more than twice [rad].
MARGIN, REACH = 0.05, 1.6
#: Poses that are collected in one go.
_CHUNK = 10


def collect(
    truth: KnownTruth,
    name: str,
    count: int,
    seed: int,
    executor: Executor,
    progress: Callable[[float], None] = lambda share: None,
) -> Recording:
    """`count` poses of a true arm with all its effects, each approached from both sides and averaged.

    The controller that leads it knows what the SDF says. Chunks of poses run at once on the executor's workers, each
    from a start of its own, with noise of its own; the result does not depend on the workers.
    """
    arm = load_arm(name)
    poses = arm.sample_poses(count, np.random.default_rng(seed), margin=MARGIN)
    wide = (arm.position_upper - arm.position_lower > 4 * np.pi) & ~arm.prismatic
    poses[:, wide] = np.clip(poses[:, wide], -REACH, REACH)
    chunks = np.array_split(poses, -(-count // _CHUNK))
    futures = [executor.submit(_collect_chunk, name, truth.arm, c, seed + i) for i, c in enumerate(chunks)]
    for done, _ in enumerate(as_completed(futures), 1):
        progress(done / len(futures))
    rows = np.concatenate([future.result() for future in futures])
    q, tau = np.split(rows, 2, axis=1)
    return Recording(q=q, tau=tau, source=f"{count} poses of the simulated {arm.name}")


def _collect_chunk(name: str, true_arm: Arm, poses: NDArray[np.float64], seed: int) -> NDArray[np.float64]:
    """(m, 2n) means of q and tau over both sides."""
    arm = load_arm(name)
    offset = arm.per_joint(*APPROACH)
    visited = np.concatenate([[beside(arm, q, -offset), q, beside(arm, q, offset), q] for q in poses])
    station = ArmStation(arm, plant_arm=true_arm, effects=true_arm.effects, seed=seed)
    generator = np.random.default_rng(seed)
    nominal = IdentifiedModel.from_arm(arm)
    recording = collect_static_poses(station, nominal, visited, effort_noise=0.0, generator=generator)
    rows = np.hstack([recording.q, recording.measured_effort()])
    return (rows[1::4] + rows[3::4]) / 2
