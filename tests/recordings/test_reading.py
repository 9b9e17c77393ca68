"""One interface for all formats: detection by content, options that apply, and coordinates that a file states."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.io
from public_files import assert_refused, team_array, wpi_rows, write_mat, write_text, write_wpi

from dvrk_drake.errors import RecordingError
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.recordings.pose_file import CollectionFile
from dvrk_drake.recordings.reading import detect_format, read_recording
from dvrk_drake.recordings.recording import Recording, write_recording

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
    assert_refused(r"model\.pkl: unknown format; allowed: CSV, ROS bag, MATLAB file, NumPy", read_recording, binary)
    assert_refused("nowhere: no such file", read_recording, tmp_path / "nowhere")
    assert_refused("is a folder without a recording; allowed: ROS 2 bag", read_recording, tmp_path)
    assert_refused("not a valid file name", read_recording, "a\0.csv")


@pytest.mark.parametrize("content", ["", " \n"])
def test_an_empty_file_is_refused(tmp_path, content):
    assert_refused(r"motion\.csv is empty", read_recording, write_text(tmp_path, content))


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
    assert read_recording(path, coordinates="actuator").coordinates == "actuator"
    assert read_recording(write_mat(tmp_path, a=team_array()), coordinates="actuator").coordinates == "actuator"


def test_a_rate_gives_times_to_files_without_times_only(tmp_path):
    q = wpi_rows(3)[:, :7]
    path = tmp_path / "motion.csv"
    write_recording(Recording(q=q, t=np.arange(3.0)), path)
    assert_refused("--rate does not apply, because the file has times", read_recording, path, rate=200.0)
    write_recording(Recording(q=q), path)
    recording = read_recording(path, rate=50.0)
    np.testing.assert_array_equal(recording.t, [0, 0.02, 0.04])
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


def test_row_of_another_arm_is_rejected(tmp_path):
    arm, path = load_arm("mtmr"), tmp_path / "poses.csv"
    names = [f"{block}{i}" for block in ("q", "tau") for i in range(1, 8)]
    path.write_text(",".join([*names, "arm"]) + "\n" + 2 * (14 * "0," + "MTML\n"))
    with pytest.raises(RecordingError, match=r"poses\.csv, line 2: the row is of MTML, but the selected arm is MTMR"):
        read_recording(path, arm)
    assert len(read_recording(path, load_arm("mtml"))) == len(read_recording(path)) == 2
