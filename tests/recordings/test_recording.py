"""Tests reading recordings from CSV."""

from __future__ import annotations

import gzip
from dataclasses import replace

import numpy as np
import pytest
from command_output import assert_refused
from forked import public_folder, run_unprivileged
from recordings import HEADER, M_MTM, Q_NAMES, ROW, SIX, TAU_NAMES, random_recording, six_joint_arm, write_text

from dvrk_drake.analysis.check.recording_check import check_recording
from dvrk_drake.analysis.observations.observations import Observations
from dvrk_drake.errors import RecordingError
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.recordings import csv_files
from dvrk_drake.recordings.formats import read_recording
from dvrk_drake.recordings.recording import Recording


def test_reads_columns_by_name_in_any_order_and_ignores_others(tmp_path):
    header = ["note", *reversed(TAU_NAMES), "t", *Q_NAMES, "temperature"]
    cells = ["warm", *(f"{10 + i}" for i in range(7, 0, -1)), "2.5", *(f"{i}" for i in range(1, 8)), "nan"]
    path = write_text(tmp_path, f"{','.join(header)}\n{','.join(cells)}\n")
    recording = read_recording(path)
    np.testing.assert_array_equal(recording.q, [[1, 2, 3, 4, 5, 6, 7]])
    np.testing.assert_array_equal(recording.measured_effort(), [[11, 12, 13, 14, 15, 16, 17]])
    np.testing.assert_array_equal(recording.t, [2.5])
    assert recording.qd is None
    assert recording.coordinates == "joint"
    assert recording.where(0) == f"{path}, line 2"


@pytest.mark.parametrize(
    "text",
    [
        f"{HEADER}\n{ROW}\n{ROW}",
        f"\ufeff{HEADER}\n{ROW}\n{ROW}\n",
        f"{HEADER}\r\n{ROW}\r\n{ROW}\r\n",
        f"{HEADER}\r{ROW}\r{ROW}\r",
        f" {HEADER.replace(',', ' , ')} \n{ROW.replace(',', ', ')}\n{ROW}\n",
        f"{HEADER},,\n{ROW},,\n{ROW},,\n",
        '"' + HEADER.replace(",", '","') + f'"\n{ROW}\n{ROW}\n',
        f"{HEADER}\n{ROW}\n{ROW}\n".encode("utf-16"),
        ("\ufeff" + f"{HEADER}\r\n{ROW}\r\n{ROW}\r\n").encode("utf-16-be"),
        gzip.compress(f"{HEADER}\n{ROW}\n{ROW}\n".encode()),
    ],
    ids=["plain", "BOM", "CRLF", "CR", "spaces", "columns", "quotes", "UTF-16", "UTF-16-BE", "gzip"],
)
def test_reads_csv_variants_of_other_programs(tmp_path, text):
    recording = read_recording(write_text(tmp_path, text))
    np.testing.assert_array_equal(recording.lines, [2, 3])
    np.testing.assert_array_equal(recording.tau[1], [0.8, 0.9, 0.10, 0.11, 0.12, 0.13, 0.14])


def test_blank_lines_do_not_shift_line_numbers(tmp_path):
    path = write_text(tmp_path, f"\n{HEADER}\n\n , ,\n{ROW}\n\n{ROW}\n\n")
    np.testing.assert_array_equal(read_recording(path).lines, [5, 7])
    path = write_text(tmp_path, f"\n{HEADER}\n\n{ROW}\n\n{ROW.replace('0.1,', 'x,')}\n")
    assert_refused(RecordingError, r"recording\.csv, line 6: q1 is not a number: 'x'", read_recording, path)


def test_missing_efforts_are_reported_when_required(tmp_path):
    path = write_text(tmp_path, ",".join(Q_NAMES) + "\n" + ",".join(["0"] * 7) + "\n")
    recording = read_recording(path)
    with pytest.raises(
        RecordingError, match=r"recording\.csv: the recording has no efforts; needs columns tau1\.\.tau7"
    ):
        recording.measured_effort()
    assert_refused(RecordingError, r"^the recording has no efforts", replace(recording, source="").measured_effort)


WANTED = r"needs (a header with )?q1\.\.q7 and tau1\.\.tau7 \(t and qd1\.\.qd7 optional\)"
MULTI_LINE = '"a\nb"'
ERRORS = {
    "empty": ("", r"recording\.csv is empty; " + WANTED),
    "blank": ("\n\n  \n", r"recording\.csv is empty; " + WANTED),
    "header only": (HEADER + "\n", r"recording\.csv has a header but no rows"),
    "missing q": (f"{HEADER.replace('q3', 'p3')}\n{ROW}", r", line 1: missing column q3; " + WANTED),
    "missing taus": (
        f"{HEADER.replace('tau4', 'x').replace('tau6', 'y')}\n{ROW}",
        r", line 1: missing columns tau4, tau6; " + WANTED,
    ),
    "some qd": (f"{HEADER},qd1,qd2\n{ROW},0,0", r", line 1: missing columns qd3, qd4, qd5, qd6, qd7; "),
    "other names": ("a,b\n1,2\n", r", line 1: missing columns q1, q2, q3, q4, q5, q6, q7; "),
    "duplicate": (f"{HEADER},q2\n{ROW},0", r", line 1: column q2 occurs twice"),
    "q8": (f"{HEADER},q8\n{ROW},0", r", line 1: unexpected column q8; the arm has 7 joints"),
    "tau8": (f"{HEADER},tau8\n{ROW},0", r", line 1: unexpected column tau8; the arm has 7 joints"),
    "NaN": (f"{HEADER}\n{ROW}\n{ROW.replace('0.11', 'NaN')}\n", r", line 3: tau4 is NaN; only finite numbers"),
    "inf": (f"{HEADER}\n{ROW.replace('0.11', '-inf')}\n", r", line 2: tau4 is -inf; only finite numbers"),
    "overflow": (f"{HEADER}\n{ROW.replace('0.11', '1e999')}\n", r", line 2: tau4 is 1e999; only finite numbers"),
    "text": (f"{HEADER}\n{ROW.replace('0.11', 'off')}\n", r", line 2: tau4 is not a number: 'off'"),
    "underscore": (f"{HEADER}\n{ROW.replace('0.11', '1_1')}\n", r", line 2: tau4 is not a number: '1_1'"),
    "empty cell": (f"{HEADER}\n{ROW.replace('0.11', '')}\n", r", line 2: tau4 is empty"),
    "line break": (f"{HEADER}\n{ROW.replace('0.11', MULTI_LINE)}\n", r", line 3: tau4 is not a number: 'a\\nb'"),
    "time": (f"t,{HEADER}\nnow,{ROW}\n", r", line 2: t is not a number: 'now'"),
    "too few": (f"{HEADER}\n{ROW}\n{ROW[:-5]}\n", r", line 3: the row has 13 cells, the header has 14"),
    "too many": (f"{HEADER}\n{ROW},\n", r", line 2: the row has 15 cells, the header has 14"),
    "semicolons": (f"{HEADER}\n{ROW}".replace(",", ";"), r", line 1: the first row has no comma\. Separate cells by"),
    "tabs": (f"{HEADER}\n{ROW}".replace(",", "\t"), r", line 1: the first row has no comma"),
    "open quote": (f'{HEADER}\n"{ROW}\n{ROW}\n', r", line 3: invalid CSV: unexpected end of data"),
    "UTF-16": (f"{HEADER}\n{ROW}\n".encode("utf-16-le"), r"recording\.csv: unknown format; allowed: CSV .*ROS bag"),
    "cut UTF-16": (f"{HEADER}\n{ROW}\n".encode("utf-16")[:-1], r"recording\.csv is not a UTF-16 text file: truncated"),
    "cut gzip": (gzip.compress(f"{HEADER}\n{ROW}\n".encode())[:-9], r"recording\.csv cannot be read: damaged or"),
    "gzip of a bag": (gzip.compress(b"\x89MCAP0\r\n\0"), r"recording\.csv: unknown format; allowed: CSV \(also"),
    "no gzip": (b"\x1f\x8b" + 20 * b"\0", r"recording\.csv cannot be read: damaged or incomplete gzip file"),
    "binary": (bytes(range(1, 256)), r"recording\.csv is not a UTF-8 text file: .* at byte 127"),
}


@pytest.mark.parametrize("case", ERRORS)
def test_errors_name_file_line_and_column_in_one_line(tmp_path, case):
    text, match = ERRORS[case]
    with pytest.raises(RecordingError, match=match) as caught:
        read_recording(write_text(tmp_path, text))
    assert "\n" not in str(caught.value)
    assert str(caught.value).startswith(str(tmp_path))


def test_recording_with_six_joints(tmp_path):
    path = write_text(tmp_path, f"{SIX}\n" + ",".join(["0"] * 12))
    assert read_recording(path, arm=six_joint_arm()).q.shape == (1, 6)
    assert_refused(RecordingError, "missing column q7", read_recording, path)
    with pytest.raises(RecordingError, match="unexpected column q7; the arm has 6 joints; joints of PSM: yaw, pitch"):
        read_recording(write_text(tmp_path, f"{HEADER}\n{ROW}"), arm=six_joint_arm())


def test_file_without_read_permission_is_refused():
    with public_folder() as folder:
        path = write_text(folder, HEADER)
        path.chmod(0)

        def check():
            assert_refused(RecordingError, r"cannot be read: Permission denied", read_recording, path)

        run_unprivileged(check)


def test_rows_after_simple_blocks_keep_line_numbers(tmp_path, monkeypatch):
    """Blocks of simple rows are parsed together. Rows with quotes and blank lines are parsed one by one."""
    monkeypatch.setattr(csv_files, "_BLOCK", 4 * len(ROW))
    quoted = '"0.1"' + ROW[3:]
    text = f"{HEADER},guard_state\n" + 20 * f"{ROW},3\n" + f"\n{quoted},3\n" + 10 * f"{ROW},3\n"
    recording = read_recording(write_text(tmp_path, text))
    np.testing.assert_array_equal(recording.lines, [*range(2, 22), *range(23, 34)])
    np.testing.assert_array_equal(recording.q, np.tile(recording.q[0], (31, 1)))
    bad = text + f"{ROW.replace('0.11', '1_1')},3\n"
    assert_refused(RecordingError, r"line 34: tau4 is not a number: '1_1'", read_recording, write_text(tmp_path, bad))


def test_an_empty_recording_is_refused_with_one_line():
    empty = Recording(q=np.empty((0, 7)), tau=np.empty((0, 7)))
    assert_refused(RecordingError, r"^recording has no rows$", empty.check_fits, load_arm("mtml"))
    assert [finding.what for finding in check_recording(Observations(empty, load_arm("mtml"))).refusals] == [
        "has no rows"
    ]


# Tests whether recordings, including real ones, match an arm in joint or actuator coordinates.


def test_poses_inside_the_limits_fit():
    arm = load_arm("mtmr")
    q = np.vstack([arm.position_lower - 0.14, arm.position_upper + 0.14])
    Recording(q=q).check_fits(arm)


def test_prismatic_joint_in_millimetres_is_refused():
    arm = load_arm("psm")
    q = arm.sample_poses(20, np.random.default_rng(0))
    Recording(q=q).check_fits(arm)
    q[:, 2] *= 1000
    q[:3, 2] = 0.0
    first, largest = f"{q[3, 2]:.4g}", f"{q[:, 2].max():.4g}"
    match = (
        rf"^recording, row 4: insertion \(q3\) = {first} is outside 0\.\.0\.24 m of PSM "
        rf"\(first of 17 rows, furthest {largest}\)\. Are the positions in millimetres"
    )
    with pytest.raises(RecordingError, match=match):
        Recording(q=q).check_fits(arm)


def test_tolerance_of_a_prismatic_joint_is_in_millimetres():
    arm = load_arm("psm")
    q = np.zeros((1, 7))
    q[0, 2] = 0.25
    Recording(q=q).check_fits(arm)
    q[0, 2] = 0.27
    assert_refused(RecordingError, r"insertion \(q3\) = 0\.27 is outside", Recording(q=q).check_fits, arm)


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
    assert_refused(RecordingError, match, recording.check_fits, load_arm("mtmr"))


def test_recording_of_a_right_arm_does_not_fit_a_left_arm():
    q = np.zeros((3, 7))
    q[:, 3] = 3.4
    Recording(q=q).check_fits(load_arm("mtmr"))
    with pytest.raises(RecordingError, match=r"wrist_platform \(q4\) = 3\.4 .* of MTML .*\. Is the arm"):
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
        assert_refused(RecordingError, r"psm\.csv has 6 joints, but MTMR has 7", function, load_arm("mtmr"))


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


@pytest.mark.parametrize(("name", "joint"), [("psm", 6), ("psm", 5), ("mtmr", 3), ("mtmr", 1), ("mtmr", 6)])
def test_channels_use_only_measured_efforts(name, joint):
    """The channels are the same for every effort of the joint that was not measured, and contain all other efforts."""
    arm = load_arm(name)
    tau = np.random.default_rng(5).normal(size=(2, 7)) + np.zeros((7, 1, 1))
    tau = tau[0]
    recording = Recording(q=np.zeros((2, 7)), tau=np.where(np.arange(7) == joint, 0.0, tau))
    channels = recording.measured_channels(arm)
    seen = [
        (arm.transmission.inverse.pull_back_effort(tau + change * np.eye(7)[joint]) @ channels.T) for change in (0, 1)
    ]
    np.testing.assert_allclose(seen[0], seen[1], rtol=0, atol=1e-12)
    assert np.linalg.matrix_rank(channels) == 6 and not channels[joint].any()
    np.testing.assert_array_equal(recording.measured_joints(arm), np.arange(7) != joint)
    motors = replace(recording, coordinates="actuator")
    np.testing.assert_array_equal(motors.measured_channels(arm), np.diag(np.arange(7) != joint))


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
    assert_refused(RecordingError, r"of MTML .*\. Is the arm", recording.check_fits, load_arm("mtml"))
    joint = recording.in_joint_coordinates(load_arm("mtmr"))
    np.testing.assert_allclose(joint.q, recording.q @ M_MTM.T, atol=1e-12)
    power = np.einsum("ij,ij->i", recording.qd, recording.tau)
    np.testing.assert_allclose(np.einsum("ij,ij->i", joint.qd, joint.tau), power, atol=1e-12)
