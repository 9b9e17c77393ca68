"""Low-speed segments of a motion as static poses, and models that are identified from them."""

from dataclasses import replace

import numpy as np
import pytest
from static_poses import RATE, motion_with_pauses

from dvrk_drake.analysis.observations.observations import Observations
from dvrk_drake.analysis.observations.static_segments import SAME_REST, low_speed_segments, static_poses
from dvrk_drake.analysis.static.static_identification import MIN_POSES, identify_static
from dvrk_drake.analysis.static.validation import validate_static
from dvrk_drake.cli import main
from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.errors import IdentificationError, RecordingError
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.recordings.conversion import convert
from dvrk_drake.recordings.reading import read_recording
from dvrk_drake.recordings.recording import Recording

pytestmark = [pytest.mark.numeric, pytest.mark.slow]


@pytest.fixture(scope="module")
def arm():
    return load_arm("psm")


def test_static_segments_identify_the_arm(arm):
    generator = np.random.default_rng(0)
    poses = arm.sample_poses(16, generator, margin=0.1)
    recording = motion_with_pauses(arm, poses, generator)
    parts, measured = low_speed_segments(recording, arm)
    assert np.all(measured.sum(axis=1) == 1)
    # A joint that hardly moves between two poses is always slow. Both static segments are then one low-speed segment.
    assert np.all(measured.sum(axis=0) >= 0.7 * len(poses))
    truth = IdentifiedModel.from_arm(arm)
    fresh = arm.sample_poses(200, generator)
    result = identify_static(parts, arm, measured=measured)
    error = np.sqrt(np.mean((result.model.holding_torque(fresh) - truth.holding_torque(fresh)) ** 2, axis=0))
    torque = np.sqrt(np.mean(truth.holding_torque(fresh) ** 2, axis=0))
    # Yaw, pitch and insertion carry weight. The small torques of the wrist are below its noise, as on a real arm.
    assert np.all(error[:3] < 0.05 * torque[:3])
    assert np.all(error <= torque + 2e-3 * arm.effort_limits)
    with pytest.raises(IdentificationError, match=r"the arm moves \(joint \d at .* or the low-speed segments"):
        identify_static(recording, arm)


def test_repetitions_are_joined_to_one_segment(arm):
    generator = np.random.default_rng(1)
    a, b = arm.sample_poses(2, generator, margin=0.1)
    once, thrice = (
        low_speed_segments(motion_with_pauses(arm, [a, b] * count + [a], generator), arm) for count in (1, 3)
    )
    np.testing.assert_array_equal(once.measured, thrice.measured)
    np.testing.assert_allclose(once.recording.q, thrice.recording.q, atol=1e-3)


def test_segments_at_1_khz_equal_those_at_200_hz(arm):
    poses = arm.sample_poses(6, np.random.default_rng(1), margin=0.1)
    motions = (motion_with_pauses(arm, poses, np.random.default_rng(2), rate=rate) for rate in (200.0, 1000.0))
    slow, fast = (low_speed_segments(motion, arm) for motion in motions)
    assert abs(len(slow.measured) - len(fast.measured)) <= 0.1 * len(slow.measured)
    assert fast.measured.sum(axis=0).min() >= 0.6 * len(poses)


def test_static_segment_ends_at_a_gap_in_the_times(arm):
    """The motion is unknown where samples are missing."""
    a, b = arm.sample_poses(2, np.random.default_rng(1), margin=0.1)
    recording = motion_with_pauses(arm, [a, b], np.random.default_rng(2), rest=2.0)
    late = recording.t >= 5.0  # in the middle of the rest at b
    sag = 0.9 * arm.per_joint(*SAME_REST)
    split = replace(recording, t=recording.t + 5.0 * late, q=recording.q + sag * late[:, None])
    rests = static_poses(split, arm)
    assert len(rests) == 2
    # Both halves are averaged as samples of one pose, each over its own second half.
    np.testing.assert_allclose(rests.q[1], b + 0.5 * sag, atol=1e-4)


@pytest.mark.parametrize("rate", [100.0, 1000.0])
@pytest.mark.parametrize("with_speeds", [True, False])
def test_static_segments_are_poses_of_all_joints(arm, rate, with_speeds):
    generator = np.random.default_rng(3)
    poses = arm.sample_poses(12, generator, margin=0.1)
    recording = motion_with_pauses(arm, [*poses, poses[0]], generator, rest=1.0, rate=rate)
    noisy = recording.qd + arm.per_joint(0.01, 0.001) * generator.normal(size=recording.q.shape)
    rests = static_poses(replace(recording, qd=noisy if with_speeds else None), arm)
    assert len(rests) == len(poses), "the last pose is the first again"
    # A static segment begins when the speed is low, before the arm stops.
    np.testing.assert_allclose(rests.q, poses, atol=1e-4)
    truth = IdentifiedModel.from_arm(arm).holding_torque(poses)
    assert np.all(np.abs(rests.tau - truth) < 1e-3 * arm.effort_limits)
    found = Observations(recording, arm).poses()
    assert found.measured is None
    assert found.note == f"Static poses found in the motion: 12, in {len(recording)} rows."


def test_recording_without_static_segments_is_unchanged(arm):
    generator = np.random.default_rng(4)
    poses = arm.sample_poses(12, generator, margin=0.1)
    moving = motion_with_pauses(arm, poses, generator, rest=0.0)
    assert len(static_poses(moving, arm)) == 0
    assert Observations(moving, arm).poses().recording is moving
    assert Observations(moving, arm).poses(with_low_speed_segments=True).measured.sum(axis=1).max() == 1
    assert static_poses(replace(moving, t=None, qd=None), arm) is None
    assert static_poses(replace(moving, t=0.1 * np.arange(len(moving))), arm) is None


def test_recording_without_low_speed_segments_is_rejected(arm):
    q = np.zeros((50, 7))
    with pytest.raises(
        IdentificationError,
        match=r"not a motion with velocities\. .* qd1\.\.qd7, times t .* less than 0\.05 s, and at least 100 rows",
    ):
        low_speed_segments(Recording(q=q, tau=q), arm)
    t = np.arange(400) * 0.1
    q = np.zeros((400, 7))
    with pytest.raises(IdentificationError, match=r"times t that increase by less than 0\.05 s"):
        low_speed_segments(Recording(q=q, qd=q, tau=q, t=t), arm)
    with pytest.raises(RecordingError, match="has no efforts"):
        low_speed_segments(Recording(q=q, qd=q, t=t), arm)
    t = np.arange(2000) / RATE
    qd = np.tile(np.cos(2 * np.pi * t)[:, None], (1, 7))
    with pytest.raises(IdentificationError, match="has no low-speed segments"):
        low_speed_segments(Recording(q=np.sin(2 * np.pi * t)[:, None] + 0 * qd, qd=qd, tau=qd, t=t), arm)


def test_few_segments_give_no_feedforward(arm):
    poses = arm.sample_poses(MIN_POSES - 1, np.random.default_rng(0), margin=0.1)
    parts, measured = low_speed_segments(motion_with_pauses(arm, poses, np.random.default_rng(1)), arm)
    assert 0 < measured.sum(axis=0).max() < MIN_POSES
    model = identify_static(parts, arm, measured=measured).model
    assert [joint.feedforward_scale for joint in model.joints] == [0.0] * arm.num_joints


@pytest.fixture(scope="module")
def real_parts(arm, shared_data, tmp_path_factory):
    """Returns low-speed segments of two real motions: on one day, and on another day with a weight."""

    def parts_of(name):
        path = tmp_path_factory.mktemp("converted") / f"{name}.csv"
        convert(shared_data / f"trajectories/{name}.csv", path, arm=arm, coordinates="wpi")
        return path, low_speed_segments(read_recording(path, arm), arm)

    return {name: parts_of(name) for name in ("psm_one", "psm_one_205g_insertion")}


def test_segments_of_a_real_motion_do_not_increase_errors(arm, real_parts):
    """No joint of a model from segments is worse than zero torque on another day, with or without a weight."""
    for name, other in (("psm_one", "psm_one_205g_insertion"), ("psm_one_205g_insertion", "psm_one")):
        parts, measured = real_parts[name][1]
        model = identify_static(parts, arm, measured=measured).model
        assert measured[:, 0].sum() == 0
        assert model.joints[0].feedforward_scale == model.joints[2].feedforward_scale == 0.0
        assert np.all(model.holding_torque(np.array([0.5, 0.4, 0.1, 0, 0, 0, 0]))[[0, 2]] == 0.0)
        for joint in validate_static(model, real_parts[other][1].recording, real_parts[other][1].measured).joints:
            assert joint.rms_error_included <= joint.rms_torque_included + 1e-12, (name, joint.name)


def test_identify_warns_of_torques_from_segments(real_parts, tmp_path, capsys):
    path = real_parts["psm_one"][0]
    output = str(tmp_path / "model.yaml")
    assert main(["identify", str(path), "--arm", "psm", "--low-speed-segments", "--output", output]) == 0
    warnings = [line for line in capsys.readouterr().err.splitlines() if "low-speed segments" in line]
    commanded = [joint.name for joint in IdentifiedModel.load(output).joints if joint.feedforward_scale > 0]
    assert len(warnings) == 1 and ", ".join(commanded) in warnings[0]
