"""Identification of an arm from static poses, once per process of pytest. Tests must not change these objects."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import pytest

import dvrk_drake as dvrk

if TYPE_CHECKING:
    from dvrk_drake.analysis.pose_identification import StaticIdentification


@dataclass(frozen=True)
class IdentifiedPoses:
    """Recordings of static poses and the result of the first.

    Attributes:
        nominal: Model whose holding torques the recordings contain, with noise of 0.3 % of the effort limits.
        recording, other: Recordings of 40 and 12 poses.
        result: Identification from the first recording.
        progress: Steps and shares that the identification reported, in order.
    """

    arm: dvrk.Arm
    nominal: dvrk.IdentifiedModel
    recording: dvrk.Recording
    other: dvrk.Recording
    result: StaticIdentification
    progress: tuple[tuple[str, float], ...]


@pytest.fixture(scope="session")
def identified_poses() -> IdentifiedPoses:
    """Returns the recordings and the result."""
    import numpy as np  # not before conftest.py has set the number of threads

    arm, generator = dvrk.load_arm("mtmr"), np.random.default_rng(0)
    nominal = dvrk.IdentifiedModel.from_arm(arm)
    recordings = []
    for k, (name, count) in enumerate((("poses", 40), ("other", 12))):
        q = arm.sample_poses(count, generator, margin=0.05)
        tau = nominal.holding_torque(q) + 0.003 * arm.effort_limits * generator.normal(size=q.shape)
        recordings.append(dvrk.Recording(q=q, tau=tau, source=f"{name}.csv", sha256=64 * str(k)))
    steps = []
    result = dvrk.identify(recordings[0], arm, progress=lambda step, share: steps.append((step, share)))
    return IdentifiedPoses(arm, nominal, *recordings, result, tuple(steps))
