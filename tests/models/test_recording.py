"""Recordings as CSV: what is read and refused, coordinates, and writing at once or not at all."""

from __future__ import annotations

import errno
import os
import stat
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dvrk_drake.errors import DvrkDrakeError, RecordingError
from dvrk_drake.models.arm import load_arm
from dvrk_drake.models.atomic_file import atomic_write
from dvrk_drake.models.recording import Recording, read_recording, write_csv, write_recording

Q_NAMES = [f"q{i}" for i in range(1, 8)]
TAU_NAMES = [f"tau{i}" for i in range(1, 8)]
HEADER = ",".join([*Q_NAMES, *TAU_NAMES])
ROW = ",".join(f"0.{i}" for i in range(1, 15))

# q_joint = M_MTM q_actuator for joints 2..4, as published; written out, not taken from the project.
M_MTM = np.eye(7)
M_MTM[1:4, 1:4] = [[1, 0, 0], [-1, 1, 0], [0.6697, -0.6697, 1]]


def write_text(folder: Path, text: str | bytes) -> Path:
    path = folder / "recording.csv"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


def random_recording(num_rows: int = 20, **changes: object) -> Recording:
    q, qd, tau = np.random.default_rng(7).uniform(-0.2, 0.2, (3, num_rows, 7))
    return replace(Recording(q=q, tau=tau, qd=qd, t=np.arange(num_rows) / 3), **changes)


# Reading.


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
    assert recording.where(0) == f"{path}:2"


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
    ],
    ids=["plain", "BOM", "CRLF", "CR", "spaces", "empty columns", "quotes"],
)
def test_reads_what_other_programs_write(tmp_path, text):
    recording = read_recording(write_text(tmp_path, text))
    np.testing.assert_array_equal(recording.lines, [2, 3])
    np.testing.assert_array_equal(recording.tau[1], [0.8, 0.9, 0.10, 0.11, 0.12, 0.13, 0.14])


def test_blank_lines_do_not_shift_line_numbers(tmp_path):
    path = write_text(tmp_path, f"\n{HEADER}\n\n , ,\n{ROW}\n\n{ROW}\n\n")
    np.testing.assert_array_equal(read_recording(path).lines, [5, 7])
    path = write_text(tmp_path, f"\n{HEADER}\n\n{ROW}\n\n{ROW.replace('0.1,', 'x,')}\n")
    with pytest.raises(RecordingError, match=r"recording\.csv:6: q1 is not a number: 'x'"):
        read_recording(path)


def test_reads_positions_only_and_says_so_when_efforts_are_wanted(tmp_path):
    path = write_text(tmp_path, ",".join(Q_NAMES) + "\n" + ",".join(["0"] * 7) + "\n")
    recording = read_recording(path)
    with pytest.raises(RecordingError, match=r"recording\.csv: has no efforts; needs columns tau1\.\.tau7"):
        recording.measured_effort()
    with pytest.raises(RecordingError, match=r"^recording: has no efforts"):
        replace(recording, source="").measured_effort()


def test_the_source_of_a_row_without_a_file():
    assert random_recording().where(2) == "recording: row 3"
    assert random_recording(source="simulated").where(2) == "simulated: row 3"


SIX = ",".join([*Q_NAMES[:6], *TAU_NAMES[:6]])
WANTED = r"needs (a header with )?q1\.\.q7 and tau1\.\.tau7 \(t and qd1\.\.qd7 optional\)"
MULTI_LINE = '"a\nb"'
ERRORS = {
    "empty": ("", r"recording\.csv: is empty; " + WANTED),
    "blank": ("\n\n  \n", r"recording\.csv: is empty; " + WANTED),
    "header only": (HEADER + "\n", r"recording\.csv: has a header but no rows"),
    "no header": (f"{ROW}\n{ROW}\n", r":1: has no header; .*q1\.\.q7 .*dvrk-drake convert"),
    "missing q": (f"{HEADER.replace('q3', 'p3')}\n{ROW}", r":1: missing column q3; " + WANTED),
    "missing taus": (
        f"{HEADER.replace('tau4', 'x').replace('tau6', 'y')}\n{ROW}",
        r":1: missing columns tau4, tau6; " + WANTED,
    ),
    "some qd": (f"{HEADER},qd1,qd2\n{ROW},0,0", r":1: missing columns qd3, qd4, qd5, qd6, qd7; "),
    "other names": ("a,b\n1,2\n", r":1: missing columns q1, q2, q3, q4, q5, q6, q7; "),
    "duplicate": (f"{HEADER},q2\n{ROW},0", r":1: column q2 is named twice"),
    "q8": (f"{HEADER},q8\n{ROW},0", r":1: has q8, but the arm has 7 joints"),
    "tau8": (f"{HEADER},tau8\n{ROW},0", r":1: has tau8, but the arm has 7 joints"),
    "NaN": (f"{HEADER}\n{ROW}\n{ROW.replace('0.11', 'NaN')}\n", r":3: tau4 is NaN; only finite numbers"),
    "inf": (f"{HEADER}\n{ROW.replace('0.11', '-inf')}\n", r":2: tau4 is -inf; only finite numbers"),
    "overflow": (f"{HEADER}\n{ROW.replace('0.11', '1e999')}\n", r":2: tau4 is 1e999; only finite numbers"),
    "text": (f"{HEADER}\n{ROW.replace('0.11', 'off')}\n", r":2: tau4 is not a number: 'off'"),
    "underscore": (f"{HEADER}\n{ROW.replace('0.11', '1_1')}\n", r":2: tau4 is not a number: '1_1'"),
    "empty cell": (f"{HEADER}\n{ROW.replace('0.11', '')}\n", r":2: tau4 is empty"),
    "line break": (f"{HEADER}\n{ROW.replace('0.11', MULTI_LINE)}\n", r":3: tau4 is not a number: 'a\\nb'"),
    "time": (f"t,{HEADER}\nnow,{ROW}\n", r":2: t is not a number: 'now'"),
    "too few": (f"{HEADER}\n{ROW}\n{ROW[:-5]}\n", r":3: has 13 cells, the header names 14 columns"),
    "too many": (f"{HEADER}\n{ROW},\n", r":2: has 15 cells, the header names 14 columns"),
    "semicolons": (
        f"{HEADER}\n{ROW}".replace(",", ";"),
        r":1: no comma in the first row; cells must be separated by",
    ),
    "tabs": (f"{HEADER}\n{ROW}".replace(",", "\t"), r":1: no comma in the first row"),
    "open quote": (f'{HEADER}\n"{ROW}\n{ROW}\n', r":3: not CSV: unexpected end of data"),
    "UTF-16": (
        f"{HEADER}\n{ROW}\n".encode("utf-16"),
        r"recording\.csv: not a CSV text file in UTF-8: .* at byte 0",
    ),
    "binary": (bytes(range(256)), r"recording\.csv: not a CSV text file in UTF-8: .* at byte 128"),
}


@pytest.mark.parametrize("case", ERRORS)
def test_errors_name_file_line_and_column_in_one_line(tmp_path, case):
    text, match = ERRORS[case]
    with pytest.raises(RecordingError, match=match) as caught:
        read_recording(write_text(tmp_path, text))
    assert "\n" not in str(caught.value)
    assert str(caught.value).startswith(str(tmp_path))


def six_joint_arm():
    return replace(load_arm("psm"), joint_names=load_arm("psm").joint_names[:6])


def test_six_joints(tmp_path):
    path = write_text(tmp_path, f"{SIX}\n" + ",".join(["0"] * 12))
    assert read_recording(path, arm=six_joint_arm()).q.shape == (1, 6)
    with pytest.raises(RecordingError, match="missing column q7"):
        read_recording(path)
    with pytest.raises(RecordingError, match="has q7, but the arm has 6 joints; of PSM these are yaw, pitch"):
        read_recording(write_text(tmp_path, f"{HEADER}\n{ROW}"), arm=six_joint_arm())


def test_files_that_are_none(tmp_path):
    with pytest.raises(RecordingError, match=r"absent\.csv: no such file"):
        read_recording(tmp_path / "absent.csv")
    with pytest.raises(RecordingError, match="is not a file"):
        read_recording(tmp_path)


@pytest.mark.skipif(os.geteuid() == 0, reason="root may read everything")
def test_a_file_that_may_not_be_read(tmp_path):
    path = write_text(tmp_path, HEADER)
    path.chmod(0)
    with pytest.raises(RecordingError, match=r"cannot be read: Permission denied"):
        read_recording(path)


def test_unknown_coordinates(tmp_path):
    with pytest.raises(RecordingError, match='unknown coordinates "motor"; allowed: joint, actuator'):
        read_recording(tmp_path / "any.csv", coordinates="motor")


# Whether it fits an arm.


def test_poses_inside_the_limits_fit():
    arm = load_arm("mtmr")
    q = np.vstack([arm.position_lower - 0.14, arm.position_upper + 0.14])
    Recording(q=q).check_fits(arm)


def test_degrees_are_suspected():
    arm = load_arm("mtml")
    q = np.degrees(arm.sample_poses(20, np.random.default_rng(0)))
    with pytest.raises(
        RecordingError, match=r"of MTML; are these degrees, or is it another arm\? Positions must be in rad"
    ):
        Recording(q=q).check_fits(arm)


def test_a_psm_counts_six_joints_and_the_jaw(tmp_path):
    path = write_text(tmp_path, f"{SIX}\n" + ",".join(["0"] * 12))
    with pytest.raises(RecordingError, match=r"missing column q7; .*of PSM these are yaw, pitch, .*, wrist_yaw, jaw"):
        read_recording(path, load_arm("psm"))


def test_a_prismatic_joint_in_millimetres_is_suspected():
    arm = load_arm("psm")
    q = arm.sample_poses(20, np.random.default_rng(0))
    Recording(q=q).check_fits(arm)
    q[:, 2] *= 1000
    with pytest.raises(
        RecordingError, match=r"insertion \(q3\) = .* 0\.\.0\.24 m of PSM; are these millimetres or centimetres\?"
    ):
        Recording(q=q).check_fits(arm)


def test_a_prismatic_joint_is_given_millimetres_of_tolerance_where_others_have_milliradians():
    arm = load_arm("psm")
    q = np.zeros((1, 7))
    q[0, 2] = 0.25
    Recording(q=q).check_fits(arm)
    q[0, 2] = 0.27
    with pytest.raises(RecordingError, match=r"insertion \(q3\) = 0\.27 is outside"):
        Recording(q=q).check_fits(arm)


def test_motion_is_judged_by_the_joints_own_kind():
    arm = load_arm("psm")
    qd = np.zeros((10, 7))
    qd[:, 2] = 0.01
    assert Recording(q=np.zeros((10, 7)), qd=qd).motion(arm) == "joint 3 at 0.01 m/s RMS"
    assert Recording(q=np.zeros((10, 7)), qd=qd[:, ::-1][:, [0, 1, 2, 4, 3, 5, 6]]).motion(arm) == ""


def test_one_bad_pose_is_named_and_not_taken_for_degrees():
    q = np.zeros((10, 7))
    q[3, 1] = 1.5
    recording = Recording(q=q, source="day.csv", lines=np.arange(2, 12))
    match = r"^day\.csv:5: shoulder_pitch \(q2\) = 1\.5 is outside -0\.3142\.\.1\.134 of MTMR; is this the"
    with pytest.raises(RecordingError, match=match):
        recording.check_fits(load_arm("mtmr"))


def test_a_right_arm_is_not_a_left_arm():
    q = np.zeros((3, 7))
    q[:, 3] = 3.4
    Recording(q=q).check_fits(load_arm("mtmr"))
    with pytest.raises(RecordingError, match=r"wrist_platform \(q4\) = 3\.4 .* of MTML; is this the right arm"):
        Recording(q=q).check_fits(load_arm("mtml"))


@pytest.mark.parametrize("coordinates", ["joint", "actuator"])
def test_the_number_of_joints_must_be_the_arms(coordinates):
    recording = Recording(q=np.zeros((2, 6)), source="psm.csv", coordinates=coordinates)
    for function in (recording.check_fits, recording.in_joint_coordinates):
        with pytest.raises(RecordingError, match=r"psm\.csv: has 6 joints, MTMR has 7"):
            function(load_arm("mtmr"))


# Coordinates.


@pytest.mark.parametrize("arm", ["mtml", "mtmr"])
def test_actuator_coordinates_become_joint_coordinates(arm):
    actuator = random_recording(coordinates="actuator", source="a.csv")
    joint = actuator.in_joint_coordinates(load_arm(arm))
    np.testing.assert_allclose(joint.q, actuator.q @ M_MTM.T, atol=1e-15)
    np.testing.assert_allclose(joint.qd, actuator.qd @ M_MTM.T, atol=1e-15)
    np.testing.assert_allclose(joint.tau @ M_MTM, actuator.tau, atol=1e-15)
    assert joint.coordinates == "joint"
    assert joint.source == "a.csv"
    np.testing.assert_array_equal(joint.t, actuator.t)


def test_a_pose_in_actuator_coordinates_by_hand():
    q = np.array([[0.1, 0.2, 0.5, 0.3, -0.1, 0.4, 1.0]])
    tau = np.array([[1, 2, 3, 4, 5, 6, 7.0]])
    joint = Recording(q=q, tau=tau, coordinates="actuator").in_joint_coordinates(load_arm("mtmr"))
    np.testing.assert_allclose(joint.q, [[0.1, 0.2, 0.3, 0.3 - 0.6697 * 0.3, -0.1, 0.4, 1.0]], atol=1e-15)
    np.testing.assert_allclose(joint.tau, [[1, 2 + 3, 3 + 0.6697 * 4, 4, 5, 6, 7]], atol=1e-14)
    assert joint.qd is None


def test_power_does_not_depend_on_the_coordinates():
    actuator = random_recording(coordinates="actuator")
    joint = actuator.in_joint_coordinates(load_arm("mtmr"))
    power = np.einsum("ij,ij->i", actuator.qd, actuator.tau)
    np.testing.assert_allclose(np.einsum("ij,ij->i", joint.qd, joint.tau), power, atol=1e-15)


def test_joint_coordinates_stay():
    recording = random_recording()
    assert recording.in_joint_coordinates(load_arm("mtmr")) is recording


# Writing.


@pytest.mark.parametrize("absent", [(), ("t",), ("qd",), ("tau",), ("t", "qd", "tau")])
def test_what_is_written_reads_back_exactly(tmp_path, absent):
    recording = random_recording(**dict.fromkeys(absent))
    recording.q[0, :4] = [5e-324, 1.7976931348623157e308, -0.0, 0.1 + 0.2]
    write_recording(recording, tmp_path / "out.csv")
    again = read_recording(tmp_path / "out.csv")
    for name in ("t", "q", "qd", "tau"):
        if name in absent:
            assert getattr(again, name) is None
        else:
            assert getattr(again, name).tobytes() == np.ascontiguousarray(getattr(recording, name)).tobytes()
    assert (tmp_path / "out.csv").read_bytes().count(b"\r") == 0


def test_a_write_that_fails_leaves_the_old_file_and_nothing_else(tmp_path):
    path = tmp_path / "out.csv"
    write_csv(path, ["a"], np.ones((1, 1)))
    before = path.read_bytes()

    def rows():
        yield [1.0]
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_csv(path, ["a"], rows())
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


def test_a_write_that_fails_makes_no_file(tmp_path):
    with pytest.raises(ZeroDivisionError), atomic_write(tmp_path / "out.csv") as stream:
        stream.write("half")
        stream.flush()
        assert not (tmp_path / "out.csv").exists()
        _ = 1 / 0
    assert list(tmp_path.iterdir()) == []


def test_places_that_cannot_be_written(tmp_path):
    for path, match in (
        (tmp_path / "no" / "out.csv", r"no/out\.csv: cannot be written: No such file or directory"),
        (tmp_path, "is not a regular file"),
        (os.devnull, "/dev/null: is not a regular file, so it cannot be replaced; name a file"),
    ):
        with pytest.raises(DvrkDrakeError, match=match), atomic_write(path) as stream:
            stream.write("x")
    assert list(tmp_path.iterdir()) == []
    assert stat.S_ISCHR(os.stat(os.devnull).st_mode)


def test_a_full_disk_is_an_error_of_ours(tmp_path):
    match = r"out\.csv: cannot be written: No space left"
    with pytest.raises(DvrkDrakeError, match=match), atomic_write(tmp_path / "out.csv"):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    assert list(tmp_path.iterdir()) == []


def test_other_errors_of_the_caller_stay_what_they_are(tmp_path):
    with pytest.raises(FileNotFoundError), atomic_write(tmp_path / "out.csv"):
        (tmp_path / "absent").read_text()


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everything")
def test_a_read_only_file_is_not_replaced(tmp_path):
    path = write_text(tmp_path, "old")
    path.chmod(0o444)
    with pytest.raises(DvrkDrakeError, match="cannot be written: it is read-only"), atomic_write(path):
        pass
    assert path.read_text() == "old"


def test_links_and_permissions_survive(tmp_path):
    path, link = write_text(tmp_path, "old"), tmp_path / "link.csv"
    path.chmod(0o640)
    link.symlink_to(path)
    with atomic_write(link) as stream:
        stream.write("new\r\n")
    assert link.is_symlink()
    assert path.read_bytes() == b"new\r\n"
    assert stat.S_IMODE(path.stat().st_mode) == 0o640


def test_a_new_file_has_the_permissions_that_the_user_wants(tmp_path):
    old = os.umask(0o027)
    try:
        with atomic_write(tmp_path / "out.bin", "wb") as stream:
            stream.write(b"\x00\xff")
    finally:
        os.umask(old)
    assert (tmp_path / "out.bin").read_bytes() == b"\x00\xff"
    assert stat.S_IMODE((tmp_path / "out.bin").stat().st_mode) == 0o640


# Recordings of real arms.


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
    with pytest.raises(RecordingError, match="are these degrees"):
        replace(recording, q=np.degrees(recording.q)).check_fits(load_arm("mtmr"))


def test_a_real_motion_fits_its_arm_only(shared_data):
    path = shared_data / "trajectories" / "mtm_one.csv"
    recording = read_recording(path, coordinates="actuator")
    assert recording.q.shape == recording.qd.shape == recording.tau.shape == (5999, 7)
    np.testing.assert_allclose(recording.t, np.arange(5999) / 200, atol=1e-9)
    recording.check_fits(load_arm("mtmr"))
    with pytest.raises(RecordingError, match="of MTML; is this the right arm"):
        recording.check_fits(load_arm("mtml"))
    joint = recording.in_joint_coordinates(load_arm("mtmr"))
    np.testing.assert_allclose(joint.q, recording.q @ M_MTM.T, atol=1e-14)
    power = np.einsum("ij,ij->i", recording.qd, recording.tau)
    np.testing.assert_allclose(np.einsum("ij,ij->i", joint.qd, joint.tau), power, atol=1e-13)
