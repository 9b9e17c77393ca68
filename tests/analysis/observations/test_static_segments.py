"""Static segments of synthetic motions and the poses that are extracted from them."""

from dataclasses import replace

import numpy as np
import pytest
from static_poses import motion_with_pauses

from dvrk_drake.analysis.observations.observations import Observations
from dvrk_drake.analysis.observations.static_segments import (
    smooth_velocity,
    static_poses,
    stationary_runs,
)
from dvrk_drake.errors import RecordingError
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.recordings.recording import Recording

pytestmark = pytest.mark.numeric

ARM = load_arm("psm")


def moving(count=3, rest=0.5, travel=0.5):
    generator = np.random.default_rng(0)
    poses = ARM.sample_poses(count, generator, margin=0.1)
    return poses, motion_with_pauses(ARM, poses, generator, travel=travel, rest=rest)


def test_runs_end_at_motion_or_drift():
    still = np.array([0, 1, 1, 1, 0, 1, 1, 0, 1, 1, 1, 1, 1, 1], bool)
    q = np.zeros((14, 2))
    q[11:, 1] = 0.2  # beyond `same` of the first row of the run
    runs = [list(run) for run in stationary_runs(still, q, np.array([0.1, 0.1]), 3)]
    assert runs == [[1, 2, 3], [8, 9, 10], [11, 12, 13]]
    assert [list(run) for run in stationary_runs(still, q, np.array([0.1, 0.3]), 4)] == [[8, 9, 10, 11, 12, 13]]


def test_velocities_are_smoothed_without_delay():
    t = np.arange(1000) / 200
    slow, fast = np.sin(2 * np.pi * t), 0.05 * np.sin(2 * np.pi * 60 * t)
    for recording in (
        Recording(q=slow[:, None], t=t),
        Recording(q=slow[:, None], qd=(2 * np.pi * np.cos(2 * np.pi * t) + fast)[:, None], t=t),
    ):
        v = smooth_velocity(recording)[:, 0]
        np.testing.assert_allclose(v[200:-200], (2 * np.pi * np.cos(2 * np.pi * t))[200:-200], atol=0.01)


def test_static_segments_are_at_the_commanded_poses():
    poses, recording = moving()
    rests = static_poses(recording, ARM)
    np.testing.assert_allclose(rests.q, poses, atol=1e-3)
    assert rests.t is None and rests.qd is None
    # A stop of 0.25 s is too short for a static segment.
    assert len(static_poses(moving(rest=0.15)[1], ARM)) == 0


def test_poses_and_short_recordings_have_no_segments():
    _, recording = moving()
    t = recording.t
    assert recording.is_motion and recording.has_increasing_times
    for other in (None, 20 * t, t[::-1], np.where(np.arange(len(t)) == 50, t[49], t)):
        poses = replace(recording, t=other)
        assert not (poses.is_motion and poses.has_increasing_times)
        assert static_poses(replace(recording, t=other), ARM) is None
    assert not Recording(q=recording.q[:99], t=t[:99]).is_motion


def test_poses_are_extracted_or_unchanged():
    poses, recording = moving(count=12)
    found = Observations(recording, ARM).poses()
    np.testing.assert_allclose(found.recording.q, poses, atol=1e-3)
    assert "found in the motion: 12" in found.note and not found.moves
    few = Observations(moving(count=3)[1], ARM).poses()
    assert few.moves and few.measured is None and len(few.recording) > 100
    slow = Observations(moving(count=3)[1], ARM).poses(with_low_speed_segments=True)
    assert np.all(slow.measured.sum(axis=1) == 1) and slow.note
    table = Recording(q=poses, tau=np.zeros_like(poses))
    assert Observations(table, ARM).poses().recording is table


def test_motion_with_decreasing_times_is_rejected():
    _, recording = moving()
    t = recording.t.copy()
    t[150] = t[148]
    with pytest.raises(RecordingError, match="row 151: time t does not increase"):
        Observations(replace(recording, t=t), ARM).poses()
