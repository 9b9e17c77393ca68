"""Static segments of synthetic motions and the poses that are extracted from them."""

from dataclasses import replace

import numpy as np
import pytest
from static_poses import motion_with_pauses

from dvrk_drake.analysis.observations.observations import Observations
from dvrk_drake.analysis.observations.static_poses import smooth_velocity, static_poses, stationary_runs
from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.errors import RecordingError
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.recordings.recording import SAME_POSE, Recording

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
    assert few.moves and len(few.recording) > 100
    table = Recording(q=poses, tau=np.zeros_like(poses))
    assert Observations(table, ARM).poses().recording is table


def test_motion_with_decreasing_times_is_rejected():
    _, recording = moving()
    t = recording.t.copy()
    t[150] = t[148]
    with pytest.raises(RecordingError, match=r"row 151: t = .* is not greater than"):
        Observations(replace(recording, t=t), ARM).poses()


def test_static_segment_ends_at_a_gap_in_the_times():
    """The motion is unknown where samples are missing."""
    a, b = ARM.sample_poses(2, np.random.default_rng(1), margin=0.1)
    recording = motion_with_pauses(ARM, [a, b], np.random.default_rng(2), rest=2.0)
    late = recording.t >= 5.0  # in the middle of the rest at b
    sag = 0.9 * ARM.per_joint(*SAME_POSE)
    split = replace(recording, t=recording.t + 5.0 * late, q=recording.q + sag * late[:, None])
    rests = static_poses(split, ARM)
    assert len(rests) == 2
    # Both halves are averaged as samples of one pose, each over its own second half.
    np.testing.assert_allclose(rests.q[1], b + 0.5 * sag, atol=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("rate", [100.0, 1000.0])
@pytest.mark.parametrize("with_speeds", [True, False])
def test_static_segments_are_poses_of_all_joints(rate, with_speeds):
    generator = np.random.default_rng(3)
    poses = ARM.sample_poses(12, generator, margin=0.1)
    recording = motion_with_pauses(ARM, [*poses, poses[0]], generator, rest=1.0, rate=rate)
    noisy = recording.qd + ARM.per_joint(0.01, 0.001) * generator.normal(size=recording.q.shape)
    rests = static_poses(replace(recording, qd=noisy if with_speeds else None), ARM)
    assert len(rests) == len(poses), "the last pose is the first again"
    # A static segment begins when the speed is low, before the arm stops.
    np.testing.assert_allclose(rests.q, poses, atol=1e-4)
    truth = IdentifiedModel.from_arm(ARM).holding_torque(poses)
    assert np.all(np.abs(rests.tau - truth) < 1e-3 * ARM.effort_limits)
    found = Observations(recording, ARM).poses()
    assert found.note == f"Static poses found in the motion: 12, in {len(recording)} rows."


def test_recording_without_static_segments_is_unchanged():
    generator = np.random.default_rng(4)
    poses = ARM.sample_poses(12, generator, margin=0.1)
    moving = motion_with_pauses(ARM, poses, generator, rest=0.0)
    assert len(static_poses(moving, ARM)) == 0
    assert Observations(moving, ARM).poses().recording is moving
    assert static_poses(replace(moving, t=None, qd=None), ARM) is None
    assert static_poses(replace(moving, t=0.1 * np.arange(len(moving))), ARM) is None
