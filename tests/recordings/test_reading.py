"""One interface for all formats: detection by content, options that apply, and coordinates that a file states."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.io
from public_files import assert_refused, team_array, wpi_rows, write_mat, write_text, write_wpi

from dvrk_drake.analysis.excitation.pose_file import CollectionFile
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.recordings.formats import detect_format, read_recording, write_recording
from dvrk_drake.recordings.recording import Recording

ARRAYS, CSV = "a MATLAB file or NumPy archive", "a CSV"


def test_formats_are_detected_by_content_and_name(tmp_path):
    assert detect_format(write_mat(tmp_path, a=1.0)).name == ARRAYS
    renamed = write_mat(tmp_path, a=1.0).rename(tmp_path / "poses.bin")
    assert detect_format(renamed).name == ARRAYS
    old = tmp_path / "old.mat"
    scipy.io.savemat(old, {"a": team_array(1)[:, :, 0]}, format="4")
    assert detect_format(old).name == ARRAYS
    motion = write_wpi(tmp_path, wpi_rows())
    assert detect_format(motion).name == CSV
    motion.with_suffix(".desc").write_text("motion.csv\n")
    assert detect_format(motion).name == "a file of the cisst collector"


def test_other_files_and_folders_are_refused(tmp_path):
    binary = tmp_path / "model.pkl"
    binary.write_bytes(b"\x80\x04\x95\0\0\0")
    assert_refused(r"model\.pkl: unknown format; allowed: CSV .*MATLAB file, NumPy", read_recording, binary)
    assert_refused("nowhere: no such file", read_recording, tmp_path / "nowhere")
    assert_refused("is a folder without a recording; allowed: ROS bag", read_recording, tmp_path)
    assert_refused("not a valid file name", read_recording, "a\0.csv")


def test_options_of_other_formats_are_refused(tmp_path):
    arrays, text = write_mat(tmp_path, a=team_array()), write_wpi(tmp_path, wpi_rows())
    assert_refused(f"--topic does not apply to {ARRAYS}", read_recording, arrays, topic="/MTML")
    assert_refused(f"--arrays does not apply to {CSV}", read_recording, text, arrays={"q": "a"})
    assert_refused(
        'unknown coordinates "motor"; allowed: joint, actuator, wpi', read_recording, text, coordinates="motor"
    )


def test_coordinates_are_those_of_the_user_or_the_default(tmp_path):
    path = tmp_path / "poses.csv"
    write_recording(Recording(q=wpi_rows()[:, :7]), path)
    assert read_recording(path).coordinates == "joint"
    assert_refused(
        "poses.csv, line 2: the file states joint coordinates, not actuator. Omit --coordinates",
        *(read_recording, path, None, "actuator"),
    )
    path = write_text(tmp_path, path.read_text().replace("joint", "motor"))
    assert_refused('line 2: coordinates is "motor"; allowed: joint, actuator, wpi', read_recording, path)
    path = write_text(tmp_path, "q1,q2,q3,q4,q5,q6,q7\n1,2,3,4,5,6,7\n")
    assert read_recording(path, coordinates="actuator").coordinates == "actuator"
    assert read_recording(write_mat(tmp_path, a=team_array()), coordinates="actuator").coordinates == "actuator"


def test_efforts_are_scaled(tmp_path):
    arm, path = load_arm("psm"), tmp_path / "poses.csv"
    write_recording(Recording(q=np.zeros((3, 7)), tau=np.ones((3, 7)), coordinates="actuator"), path)
    recording = read_recording(path, arm, effort_scale=2.0)
    np.testing.assert_allclose(recording.tau, 2.0, atol=1e-12)
    assert recording.notes[-1] == "efforts multiplied by (2, 2, 2, 2, 2, 2, 2)"
    some = read_recording(path, arm, effort_scale={"pitch": -3.0, "jaw": 0.5})
    np.testing.assert_allclose(some.tau[0], [1, -3, 1, 1, 1, 1, 0.5], atol=1e-12)
    for scale, message in (
        ({"elbow": 2.0}, "--effort-scale: unknown joint elbow; allowed: yaw, pitch, "),
        (0.0, "--effort-scale is 0; allowed: "),
        ({"yaw": np.nan}, "--effort-scale is nan; allowed: "),
    ):
        assert_refused(message, read_recording, path, arm, effort_scale=scale)
    assert_refused("unknown joint yaw; allowed: none without an arm", read_recording, path, effort_scale={"yaw": 1.0})
    np.savetxt(tmp_path / "wpi.csv", np.random.default_rng(0).normal(size=(200, 21)), delimiter=",")
    assert_refused("does not apply to wpi", read_recording, tmp_path / "wpi.csv", arm, effort_scale=2.0)
    write_recording(Recording(q=np.zeros((3, 7))), path)
    assert_refused("because the file has no efforts", read_recording, path, arm, effort_scale=2.0)


def test_a_rate_gives_times_to_files_without_times_only(tmp_path):
    q = wpi_rows(3)[:, :7]
    path = tmp_path / "motion.csv"
    write_recording(Recording(q=q, t=np.arange(3.0)), path)
    assert read_recording(path).times_from == "column"
    assert_refused("--rate does not apply, because the file has times", read_recording, path, rate=200.0)
    write_recording(Recording(q=q), path)
    recording = read_recording(path, rate=50.0)
    np.testing.assert_array_equal(recording.t, [0, 0.02, 0.04])
    assert recording.times_from == "rate"
    assert recording.notes == ("3 samples; the file has no times, so t = row / 50 Hz",)


def test_ignored_columns_are_noted_if_there_is_no_time(tmp_path):
    header = "time,q1,q2,q3,q4,q5,q6,q7,temperature"
    path = write_text(tmp_path, f"{header}\n0,1,2,3,4,5,6,7,40\n1,2,3,4,5,6,7,8,41\n")
    assert read_recording(path).notes == ("no column t, read as static poses; ignored columns: time, temperature",)


def test_poses_of_a_collection_have_no_note(tmp_path):
    file = CollectionFile(tmp_path / "poses.csv", load_arm("mtml"), both_sides=True)
    file.append(np.zeros(7), np.zeros(7), np.ones(7), np.ones(7))
    file.close()
    recording = read_recording(tmp_path / "poses.csv")
    assert recording.t is None and recording.notes == ()


def test_joints_of_files_without_names_can_be_stated(tmp_path):
    arm = load_arm("mtml")
    numbers = dict(zip(arm.joint_names, "2134567", strict=True))
    order = [1, 0, 2, 3, 4, 5, 6]
    q = np.random.default_rng(0).normal(size=(5, 7))
    path = tmp_path / "poses.csv"
    write_recording(Recording(q=q, tau=-q), path)
    bare = write_text(tmp_path, "".join(",".join(map(repr, row)) + "\n" for row in np.hstack([q, -q]).tolist()))
    for file in (path, bare, write_mat(tmp_path, q=q, tau=-q)):
        read = read_recording(file, arm, joints=numbers)
        np.testing.assert_array_equal(read.q, q[:, order])
        np.testing.assert_array_equal(read.tau, -q[:, order])
        for number, match in (("2", "--joints: 2 is used for two joints of MTML"), ("8", "column q8|no joint 8; it")):
            assert_refused(match, read_recording, file, arm, joints={"outer_yaw": number})
    named = write_text(tmp_path, "".join(f"q_{name}," for name in arm.joint_names) + "t\n1,2,3,4,5,6,7,0\n")
    names = {name: f"_{name}" for name in arm.joint_names}
    np.testing.assert_array_equal(read_recording(named, arm, joints=names).q, [range(1, 8)])


@pytest.mark.parametrize("coordinates", ["joint", "actuator"])
def test_written_recordings_state_coordinates_arm_and_units(tmp_path, coordinates):
    arm, path = load_arm("psm"), tmp_path / "motion.csv"
    q = np.random.default_rng(0).uniform(0.1, 0.2, (3, 7))
    write_recording(Recording(q=q, qd=q, tau=q, t=np.arange(3.0), coordinates=coordinates), path, arm)
    header = path.read_text().splitlines()[0].split(",")
    assert [header[i] for i in (0, 3, 10, 17, -2, -1)] == [
        "t [s]",
        "q3 [m]",
        "qd3 [m/s]",
        "tau3 [N]",
        "coordinates",
        "arm",
    ]
    assert [header[i] for i in (1, 8, 15)] == ["q1 [rad]", "qd1 [rad/s]", "tau1 [N m]"]
    for selected in (None, arm):
        again = read_recording(path, selected)
        assert (again.coordinates, again.arm_name) == (coordinates, "PSM")
        np.testing.assert_array_equal(again.tau, q)
    assert_refused("line 2: the row is of PSM, but the selected arm is MTML", read_recording, path, load_arm("mtml"))
    write_recording(again, tmp_path / "again.csv")
    assert read_recording(tmp_path / "again.csv").arm_name == "PSM"


def named_csv(folder, names, rows):
    return write_text(folder, "\n".join([",".join(names), *(",".join(map(str, row)) for row in rows)]))


def test_columns_may_have_the_names_of_joints(tmp_path):
    """In any order, with units; the quantity may be abbreviated or the first word."""
    psm = load_arm("psm")
    values = np.random.default_rng(0).uniform(-0.1, 0.1, (4, 15))
    q = [f"{name} position [{'m' if name == 'insertion' else 'rad'}]" for name in psm.joint_names]
    tau = [f"Effort_{name}" for name in psm.joint_names]
    names, order = ["Time (s)", *q, *tau], np.random.default_rng(1).permutation(15)
    values[:, 0] = 0.1 * np.arange(4)
    path = named_csv(tmp_path, [names[i] for i in order], values[:, order])
    recording = read_recording(path, psm)
    np.testing.assert_array_equal(recording.t, values[:, 0])
    np.testing.assert_array_equal(recording.q, values[:, 1:8])
    np.testing.assert_array_equal(recording.tau, values[:, 8:])
    assert recording.qd is None


def test_joint_of_a_named_column_is_mapped_or_missed(tmp_path):
    psm = load_arm("psm")
    names = [f"{name}.pos" for name in psm.joint_names]
    names[2] = "z.pos"
    path = named_csv(tmp_path, names, np.arange(14.0).reshape(2, 7) / 100)
    assert_refused(
        r"line 1: missing column insertion position; needs .* --joints states other", read_recording, path, psm
    )
    recording = read_recording(path, psm, joints={"insertion": "z"})
    np.testing.assert_array_equal(recording.q[:, 2], [0.02, 0.09])
    both = named_csv(tmp_path, [*(f"q{i}" for i in range(1, 8)), "yaw.pos"], np.arange(16.0).reshape(2, 8) / 100)
    assert read_recording(both, psm).q[0, 0] == 0.0  # other columns are ignored
    names[2] = "insertion position [mm]"
    for more, message in (
        (["roll velocity", "jaw.vel"], "missing columns yaw velocity, pitch velocity, .*; needs the velocity of each"),
        (["time", "Timestamp"], "columns time and Timestamp are the same quantity; remove one"),
        (["roll torque", "force roll"], "columns roll torque and force roll are the same quantity"),
    ):
        named_csv(tmp_path, [*names, *more], np.zeros((2, 9)))
        assert_refused(message, read_recording, path, psm)
    named_csv(tmp_path, names, np.zeros((2, 7)))
    assert_refused("the unit of insertion position is mm; allowed: m", read_recording, path, psm)


@pytest.mark.parametrize(
    "name, unit, match",
    [
        ("q1", "deg", "the unit of q1 is deg; allowed: rad. Convert the numbers"),
        ("q3", "mm", "the unit of q3 is mm; allowed: m"),
        ("q3", "rad", "the unit of q3 is rad; allowed: m"),
        ("tau1", "N", "the unit of tau1 is N; allowed: N m"),
        ("t", "ms", "the unit of t is ms; allowed: s"),
        ("tau1", "Nm", ""),
        ("tau1", "N*m", ""),
        ("qd1", "rad/s", ""),
    ],
)
def test_units_in_the_header_are_checked(tmp_path, name, unit, match):
    names = ["t", *(f"{block}{i}" for block in ("q", "qd", "tau") for i in range(1, 8))]
    header = [f"{column} ({unit})" if column == name else column for column in names]
    path = write_text(tmp_path, ",".join(header) + "\n" + ",".join(["0.1"] * 22) + "\n")
    if match:
        assert_refused(f"motion.csv, line 1: {match}", read_recording, path, load_arm("psm"))
    else:
        assert len(read_recording(path, load_arm("psm"))) == 1
