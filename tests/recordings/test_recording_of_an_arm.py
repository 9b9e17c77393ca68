"""Tests whether recordings, including real ones, match an arm in joint or actuator coordinates."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from recordings import M_MTM, SIX, random_recording, write_text

from dvrk_drake.errors import RecordingError
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.recordings.reading import read_recording
from dvrk_drake.recordings.recording import Recording


def test_poses_inside_the_limits_fit():
    arm = load_arm("mtmr")
    q = np.vstack([arm.position_lower - 0.14, arm.position_upper + 0.14])
    Recording(q=q).check_fits(arm)


def test_psm_has_six_joints_and_the_jaw(tmp_path):
    path = write_text(tmp_path, f"{SIX}\n" + ",".join(["0"] * 12))
    with pytest.raises(RecordingError, match=r"missing column q7; .*joints of PSM: yaw, pitch, .*, wrist_yaw, jaw"):
        read_recording(path, load_arm("psm"))


def test_prismatic_joint_in_millimetres_is_refused():
    arm = load_arm("psm")
    q = arm.sample_poses(20, np.random.default_rng(0))
    Recording(q=q).check_fits(arm)
    q[:, 2] *= 1000
    with pytest.raises(
        RecordingError, match=r"insertion \(q3\) = .* 0\.\.0\.24 m of PSM\. Are the positions in millimetres"
    ):
        Recording(q=q).check_fits(arm)


def test_tolerance_of_a_prismatic_joint_is_in_millimetres():
    arm = load_arm("psm")
    q = np.zeros((1, 7))
    q[0, 2] = 0.25
    Recording(q=q).check_fits(arm)
    q[0, 2] = 0.27
    with pytest.raises(RecordingError, match=r"insertion \(q3\) = 0\.27 is outside"):
        Recording(q=q).check_fits(arm)


def test_rest_speed_depends_on_the_joint_type():
    arm = load_arm("psm")
    qd = np.zeros((10, 7))
    qd[:, 2] = 0.01
    assert Recording(q=np.zeros((10, 7)), qd=qd).motion(arm) == "joint 3 at 0.01 m/s RMS"
    assert Recording(q=np.zeros((10, 7)), qd=qd[:, ::-1][:, [0, 1, 2, 4, 3, 5, 6]]).motion(arm) == ""


def test_one_bad_pose_is_not_reported_as_degrees():
    q = np.zeros((10, 7))
    q[3, 1] = 1.5
    recording = Recording(q=q, source="day.csv", lines=np.arange(2, 12))
    match = r"^day\.csv, line 5: shoulder_pitch \(q2\) = 1\.5 is outside -0\.3142\.\.1\.134 rad of MTMR\. Is the arm"
    with pytest.raises(RecordingError, match=match):
        recording.check_fits(load_arm("mtmr"))


def test_recording_of_a_right_arm_does_not_fit_a_left_arm():
    q = np.zeros((3, 7))
    q[:, 3] = 3.4
    Recording(q=q).check_fits(load_arm("mtmr"))
    with pytest.raises(RecordingError, match=r"wrist_platform \(q4\) = 3\.4 .* of MTML\. Is the arm"):
        Recording(q=q).check_fits(load_arm("mtml"))


@pytest.mark.parametrize("pair", [(0, 3), (4, 6), (5, 6)])
def test_exchanged_columns_that_exceed_the_limits_are_named(pair):
    arm = load_arm("mtmr")
    q = arm.sample_poses(200, np.random.default_rng(0))
    order = np.arange(7)
    order[list(pair)] = pair[::-1]
    with pytest.raises(RecordingError, match=rf"columns are exchanged:.* q{pair[0] + 1} and q{pair[1] + 1}\b"):
        Recording(q=q[:, order]).check_fits(arm)
    with pytest.raises(RecordingError) as degrees:
        Recording(q=np.degrees(q)).check_fits(arm)
    assert "exchanged" not in str(degrees.value)


def test_coordinates_that_fit_are_named():
    arm = load_arm("psm")
    joint = Recording(q=arm.sample_poses(200, np.random.default_rng(0)))
    stated = replace(joint.in_actuator_coordinates(arm), coordinates="joint")
    with pytest.raises(RecordingError, match=r"within the limits with --coordinates (wpi or )?actuator\.$"):
        stated.check_fits(arm)
    in_file = replace(stated, coordinates="actuator")
    for read in (in_file.in_joint_coordinates(arm), replace(stated, line_label="message")):
        wrong = read.q.copy()
        wrong[0, 1] = 3.0
        with pytest.raises(RecordingError) as error:
            replace(read, q=wrong).check_fits(arm)
        assert "--coordinates" not in str(error.value)


@pytest.mark.parametrize("coordinates", ["joint", "actuator"])
def test_wrong_number_of_joints_is_refused(coordinates):
    recording = Recording(q=np.zeros((2, 6)), source="psm.csv", coordinates=coordinates)
    for function in (recording.check_fits, recording.in_joint_coordinates):
        with pytest.raises(RecordingError, match=r"psm\.csv has 6 joints, but MTMR has 7"):
            function(load_arm("mtmr"))


@pytest.mark.parametrize("arm", ["mtml", "mtmr"])
def test_actuator_coordinates_become_joint_coordinates(arm):
    actuator = random_recording(coordinates="actuator", source="a.csv")
    joint = actuator.in_joint_coordinates(load_arm(arm))
    np.testing.assert_allclose(joint.q, actuator.q @ M_MTM.T, atol=1e-12)
    np.testing.assert_allclose(joint.qd, actuator.qd @ M_MTM.T, atol=1e-12)
    np.testing.assert_allclose(joint.tau @ M_MTM, actuator.tau, atol=1e-12)
    assert joint.coordinates == "joint"
    assert joint.source == "a.csv"
    np.testing.assert_array_equal(joint.t, actuator.t)


def test_actuator_coordinates_of_one_pose():
    q = np.array([[0.1, 0.2, 0.5, 0.3, -0.1, 0.4, 1.0]])
    tau = np.array([[1, 2, 3, 4, 5, 6, 7.0]])
    joint = Recording(q=q, tau=tau, coordinates="actuator").in_joint_coordinates(load_arm("mtmr"))
    np.testing.assert_allclose(joint.q, [[0.1, 0.2, 0.3, 0.3 - 0.6697 * 0.3, -0.1, 0.4, 1.0]], atol=1e-12)
    np.testing.assert_allclose(joint.tau, [[1, 2 + 3, 3 + 0.6697 * 4, 4, 5, 6, 7]], atol=1e-12)
    assert joint.qd is None


def test_power_does_not_depend_on_the_coordinates():
    actuator = random_recording(coordinates="actuator")
    joint = actuator.in_joint_coordinates(load_arm("mtmr"))
    power = np.einsum("ij,ij->i", actuator.qd, actuator.tau)
    np.testing.assert_allclose(np.einsum("ij,ij->i", joint.qd, joint.tau), power, atol=1e-12)


@pytest.mark.parametrize(
    ("name", "num_rows"),
    [
        ("mtm_2015_good72", 72),
        ("mtm_2015_apr18_all80", 80),
        ("mtmr_2017_sweep40", 40),
        ("mtmr_2017_coupled12_may10", 12),
    ],
)
def test_real_static_recordings_fit(shared_data, name, num_rows):
    recording = read_recording(shared_data / "mtm_static" / f"{name}.csv")
    assert recording.measured_effort().shape == (num_rows, 7)
    assert recording.t is None
    recording.check_fits(load_arm("mtmr"))
    with pytest.raises(RecordingError, match="in degrees instead of rad"):
        replace(recording, q=np.degrees(recording.q)).check_fits(load_arm("mtmr"))


def test_a_real_motion_fits_its_arm_only(shared_data):
    path = shared_data / "trajectories" / "mtm_one.csv"
    recording = read_recording(path, coordinates="actuator")
    assert recording.q.shape == recording.qd.shape == recording.tau.shape == (5999, 7)
    np.testing.assert_allclose(recording.t, np.arange(5999) / 200, atol=1e-9)
    recording.check_fits(load_arm("mtmr"))
    with pytest.raises(RecordingError, match=r"of MTML\. Is the arm"):
        recording.check_fits(load_arm("mtml"))
    joint = recording.in_joint_coordinates(load_arm("mtmr"))
    np.testing.assert_allclose(joint.q, recording.q @ M_MTM.T, atol=1e-12)
    power = np.einsum("ij,ij->i", recording.qd, recording.tau)
    np.testing.assert_allclose(np.einsum("ij,ij->i", joint.qd, joint.tau), power, atol=1e-12)
