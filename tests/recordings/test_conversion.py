"""Tests the conversion of public recordings: exact values, format detection, protection of existing files."""

from __future__ import annotations

import numpy as np
import pytest
from public_files import NUMBERS, assert_refused, team_array, wpi_rows, write_mat, write_text, write_wpi

from dvrk_drake.errors import DvrkDrakeError
from dvrk_drake.models.arm import load_arm
from dvrk_drake.recordings.conversion import convert, detect_format
from dvrk_drake.recordings.recording import Recording, read_recording, write_recording


def test_convert_team_mat_round_trip_is_exact(tmp_path):
    array = np.random.default_rng(2).normal(size=(8, 2, 72))
    path = write_mat(tmp_path, saved=array)
    recording = convert(path, tmp_path / "out.csv")
    notes = recording.notes
    again = read_recording(tmp_path / "out.csv")
    np.testing.assert_array_equal(again.q, array[:7, 0].T)
    np.testing.assert_array_equal(again.tau, recording.tau)
    assert again.t is None
    assert again.qd is None
    assert list(notes) == [
        "72 static poses from variable saved, in joint coordinates",
        "the eighth row (gripper, not actuated) is dropped",
    ]


def test_convert_wpi_csv_round_trip_is_exact(tmp_path):
    rows = np.random.default_rng(3).normal(size=(50, 21))
    rows[[10, 11]] = rows[9]
    path = write_wpi(tmp_path, rows)
    recording = convert(path, tmp_path / "out.csv", rate=100)
    notes = recording.notes
    again = read_recording(tmp_path / "out.csv", coordinates="actuator")
    for name in ("t", "q", "qd", "tau"):
        np.testing.assert_array_equal(getattr(again, name), getattr(recording, name))
    np.testing.assert_array_equal(np.hstack([again.q, again.qd, again.tau]), rows)
    assert notes[0] == "50 samples; the file has no time stamps, so t = row / 100 Hz"
    assert "--coordinates actuator" in notes[1]
    assert notes[2].startswith("2 of 50 rows repeat the previous row")


def test_detect_format(tmp_path):
    assert detect_format(write_mat(tmp_path, a=1.0)) == "team-mat"
    renamed = write_mat(tmp_path, a=1.0).rename(tmp_path / "poses.bin")
    assert detect_format(renamed) == "team-mat"
    assert detect_format(write_wpi(tmp_path, wpi_rows())) == "wpi-csv"
    assert detect_format(write_text(tmp_path, f'\ufeff\n "tau1" ,"q1",x\n{NUMBERS}\n')) == "csv"
    binary = tmp_path / "model.pkl"
    binary.write_bytes(b"\x80\x04\x95\0\0\0")
    assert_refused(
        r"model\.pkl: unknown format; allowed: ROS bag, LCM log, MATLAB file .*, UTF-8 text file", detect_format, binary
    )
    assert_refused("nowhere: no such file", detect_format, tmp_path / "nowhere")
    assert_refused("is not a file", detect_format, tmp_path)


@pytest.mark.parametrize("content", ["", " \n"])
def test_an_empty_file_has_no_format(tmp_path, content):
    path = write_text(tmp_path, content)
    assert_refused(r"motion\.csv is empty", convert, path, tmp_path / "out.csv", coordinates="joint")


def test_explicit_format_overrides_the_file_name(tmp_path):
    path = write_wpi(tmp_path, wpi_rows()).rename(tmp_path / "motion.mat")
    assert len(convert(path, tmp_path / "out.csv", format="wpi-csv")) == 4


def test_convert_refuses_unsuitable_options_and_unknown_formats(tmp_path):
    mat, text, output = (
        write_mat(tmp_path, a=team_array()),
        write_wpi(tmp_path, wpi_rows()),
        tmp_path / "out.csv",
    )
    assert_refused("--rate does not apply to team-mat", convert, mat, output, rate=100)
    assert_refused("--variable does not apply to wpi-csv", convert, text, output, variable="a")
    assert_refused(
        'unknown format "rosbag"; known formats: csv, team-mat, wpi-csv', convert, text, output, format="rosbag"
    )
    assert not output.exists()


def test_convert_does_not_overwrite_its_input(tmp_path):
    path = write_wpi(tmp_path, wpi_rows())
    before = path.read_bytes()
    assert_refused("is the input recording", convert, path, tmp_path / "." / "motion.csv")
    assert path.read_bytes() == before


def test_failed_conversion_keeps_the_old_output(tmp_path):
    output = tmp_path / "out.csv"
    output.write_text("old")
    assert_refused("has 1 valid row", convert, write_text(tmp_path, NUMBERS), output)
    assert output.read_text() == "old"
    with pytest.raises(DvrkDrakeError, match="cannot be written: No such file or directory"):
        convert(write_wpi(tmp_path, wpi_rows()), tmp_path / "no" / "out.csv")


def test_real_motion_without_header_and_time_is_restored(shared_data, tmp_path):
    original = (shared_data / "trajectories" / "mtm_one.csv").read_text().splitlines()[1:]
    path = write_text(tmp_path, "\n".join(line.split(",", 1)[1] for line in original))
    notes = convert(path, tmp_path / "out.csv").notes
    converted = read_recording(tmp_path / "out.csv", coordinates="actuator")
    expected = read_recording(shared_data / "trajectories" / "mtm_one.csv", coordinates="actuator")
    for name in ("q", "qd", "tau"):
        np.testing.assert_array_equal(getattr(converted, name), getattr(expected, name))
    np.testing.assert_allclose(converted.t, expected.t, rtol=0, atol=1e-12)
    assert notes[-1].startswith("795 of 5999 rows repeat")


TIMED = "t,q1,q2,q3,q4,q5,q6,q7,qd1,qd2,qd3,qd4,qd5,qd6,qd7,tau1,tau2,tau3,tau4,tau5,tau6,tau7"


def write_timed(folder, times, header=TIMED):
    """Writes a CSV with a header and one row per element of `times`. Returns the path and the other columns."""
    rows = wpi_rows(len(times))
    lines = [",".join([str(t), *(repr(float(x)) for x in row)]) for t, row in zip(times, rows, strict=True)]
    return write_text(folder, "\n".join([header, *lines]) + "\n"), rows


@pytest.mark.parametrize("coordinates", ["joint", "actuator"])
def test_csv_keeps_time_stamps_columns_and_coordinates(tmp_path, coordinates):
    """Uses a recording of one minute at 100 Hz."""
    path, rows = write_timed(tmp_path, [0.01 * k for k in range(5999)])
    recording = convert(path, tmp_path / "out.csv", coordinates=coordinates)
    assert recording.coordinates == coordinates
    again = read_recording(tmp_path / "out.csv", coordinates=coordinates)
    np.testing.assert_array_equal(again.t, [0.01 * k for k in range(5999)])
    assert again.t[-1] == pytest.approx(59.98)
    np.testing.assert_array_equal(np.hstack([again.q, again.qd, again.tau]), rows)
    assert recording.notes[0] == "5999 rows, t from 0 to 59.98 s as in the file, median interval 10 ms"
    assert any("pass --coordinates actuator" in note for note in recording.notes) == (coordinates == "actuator")


def test_coordinates_are_required_if_undefined(tmp_path):
    path, _ = write_timed(tmp_path, [0, 0.01])
    for format in (None, "csv"):
        assert_refused(
            r"motion\.csv: .*does not define.*--coordinates joint or --coordinates actuator",
            convert,
            path,
            tmp_path / "out.csv",
            format=format,
        )
    assert_refused('unknown coordinates "motor"', convert, path, tmp_path / "out.csv", coordinates="motor")
    assert not (tmp_path / "out.csv").exists()


def test_a_format_that_defines_its_coordinates_keeps_them(tmp_path):
    mat, text, output = write_mat(tmp_path, a=team_array()), write_wpi(tmp_path, wpi_rows()), tmp_path / "out.csv"
    assert_refused(
        "team-mat file is in joint coordinates, not in actuator", convert, mat, output, coordinates="actuator"
    )
    assert_refused("wpi-csv file is in actuator coordinates, not in joint", convert, text, output, coordinates="joint")
    assert convert(mat, output, coordinates="joint").coordinates == "joint"
    assert convert(text, output, coordinates="actuator").coordinates == "actuator"


def test_rate_is_refused_if_the_file_has_time_stamps(tmp_path):
    path, _ = write_timed(tmp_path, [0, 0.01, 0.02])
    output = tmp_path / "out.csv"
    for options in ({"coordinates": "joint"}, {"format": "wpi-csv"}):
        assert_refused("--rate does not apply: .*time stamps", convert, path, output, rate=200.0, **options)
    assert not output.exists()
    text = "\n".join(line.split(",", 1)[1] for line in path.read_text().splitlines())
    path = write_text(tmp_path, text)
    recording = convert(path, output, coordinates="joint", rate=50.0)
    np.testing.assert_array_equal(read_recording(output).t, [0, 0.02, 0.04])
    assert "the file has no time stamps, so t = row / 50 Hz" in recording.notes[0]
    assert_refused("rate is 0 Hz; allowed: a positive number", convert, path, output, coordinates="joint", rate=0.0)
    recording = convert(path, output, coordinates="joint")
    assert read_recording(output).t is None
    assert "no column t" in recording.notes[0]


def test_converted_csv_is_read_as_wpi_csv_with_times(tmp_path):
    """Reads a CSV converted without --arm. Only the format wpi-csv defines the coordinates of the roll of a PSM."""
    path, rows = write_timed(tmp_path, [0, 0.011, 0.019])
    recording = convert(path, tmp_path / "out.csv", format="wpi-csv")
    assert recording.coordinates == "actuator"
    np.testing.assert_array_equal(recording.t, [0, 0.011, 0.019])
    np.testing.assert_array_equal(recording.tau, rows[:, 14:])
    assert "as in the file" in recording.notes[0]


def test_irregular_time_stamps_are_kept_and_counted(tmp_path):
    path, _ = write_timed(tmp_path, [0, 0.01, 0.01, 0.013, 0.005, 0.02, 0.02])
    for options in ({"coordinates": "joint"}, {"format": "wpi-csv"}):
        recording = convert(path, tmp_path / "out.csv", **options)
        np.testing.assert_array_equal(recording.t, [0, 0.01, 0.01, 0.013, 0.005, 0.02, 0.02])
        assert (
            "t does not increase in all rows (2 equal, 1 smaller than the previous t; first at line 4). The rows are "
            "kept, but identify refuses a motion with such times." in recording.notes
        )


def test_invalid_time_stamps_are_refused_or_skipped(tmp_path):
    path, rows = write_timed(tmp_path, ["0", "nan", "0.02", "0.03"])
    for options in ({"coordinates": "joint"}, {"format": "wpi-csv"}):
        assert_refused(
            r"motion\.csv, line 3: t( \(column 1\))? is nan; only finite",
            convert,
            path,
            tmp_path / "out.csv",
            **options,
        )
        recording = convert(path, tmp_path / "out.csv", skip_invalid=True, **options)
        np.testing.assert_array_equal(recording.t, [0, 0.02, 0.03])
        np.testing.assert_array_equal(recording.q, rows[[0, 2, 3], :7])
        assert any("1 of 4 rows skipped (empty, NaN or infinite): lines 3" in note for note in recording.notes)


def test_positions_without_efforts_and_ignored_columns(tmp_path):
    header = "time,q1,q2,q3,q4,q5,q6,q7,temperature"
    path = write_text(tmp_path, f"{header}\n0,1,2,3,4,5,6,7,40\n1,2,3,4,5,6,7,8,41\n")
    recording = convert(path, tmp_path / "out.csv", coordinates="joint")
    assert (tmp_path / "out.csv").read_text().splitlines()[0] == "q1,q2,q3,q4,q5,q6,q7"
    assert "ignored columns: time, temperature" in recording.notes


def test_actuator_coordinates_become_joint_coordinates_of_an_arm(tmp_path):
    arm = load_arm("mtmr")
    q = arm.sample_poses(5, np.random.default_rng(1), margin=0.1)
    given = Recording(q=q, qd=0.1 * q, tau=0.01 * q, t=0.01 * np.arange(5)).in_actuator_coordinates(arm)
    write_recording(given, tmp_path / "motion.csv")
    convert(tmp_path / "motion.csv", tmp_path / "out.csv", coordinates="actuator", arm=arm)
    again = read_recording(tmp_path / "out.csv", arm)
    np.testing.assert_allclose(again.q, q, rtol=0, atol=1e-12)
    np.testing.assert_allclose(again.tau, 0.01 * q, rtol=0, atol=1e-12)
