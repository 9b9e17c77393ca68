"""Public recordings become ours: exactly, by the right reader, and never over a file that is needed."""

from __future__ import annotations

import numpy as np
import pytest
from public_files import NUMBERS, assert_refused, team_array, wpi_rows, write_mat, write_text, write_wpi

from dvrk_drake.analysis.convert.convert import convert, detect_format
from dvrk_drake.errors import DvrkDrakeError
from dvrk_drake.models.recording import read_recording


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
    assert notes[2].startswith("2 of 50 rows repeat the row before")


def test_detect_format(tmp_path):
    assert detect_format(write_mat(tmp_path, a=1.0)) == "team-mat"
    renamed = write_mat(tmp_path, a=1.0).rename(tmp_path / "poses.bin")
    assert detect_format(renamed) == "team-mat"
    assert detect_format(write_wpi(tmp_path, wpi_rows())) == "wpi-csv"
    binary = tmp_path / "model.pkl"
    binary.write_bytes(b"\x80\x04\x95\0\0\0")
    assert_refused(r"model\.pkl: neither an LCM log, a MATLAB file .* nor a text file", detect_format, binary)
    assert_refused("nowhere: no such file", detect_format, tmp_path / "nowhere")
    assert_refused("is not a file", detect_format, tmp_path)


def test_an_explicit_format_wins_over_the_name(tmp_path):
    path = write_wpi(tmp_path, wpi_rows()).rename(tmp_path / "motion.mat")
    assert len(convert(path, tmp_path / "out.csv", format="wpi-csv")) == 4


def test_convert_refuses_options_that_do_not_apply_and_unknown_formats(tmp_path):
    mat, text, output = (
        write_mat(tmp_path, a=team_array()),
        write_wpi(tmp_path, wpi_rows()),
        tmp_path / "out.csv",
    )
    assert_refused("--rate does not apply to team-mat", convert, mat, output, rate=100)
    assert_refused("--variable does not apply to wpi-csv", convert, text, output, variable="a")
    assert_refused('unknown format "rosbag"; known formats: team-mat, wpi-csv', convert, text, output, format="rosbag")
    assert not output.exists()


def test_convert_does_not_overwrite_its_input(tmp_path):
    path = write_wpi(tmp_path, wpi_rows())
    before = path.read_bytes()
    assert_refused("is the recording itself", convert, path, tmp_path / "." / "motion.csv")
    assert path.read_bytes() == before


def test_convert_leaves_an_old_output_alone_when_it_fails(tmp_path):
    output = tmp_path / "out.csv"
    output.write_text("old")
    assert_refused("has 1 valid row", convert, write_text(tmp_path, NUMBERS), output)
    assert output.read_text() == "old"
    with pytest.raises(DvrkDrakeError, match="cannot be written: No such file or directory"):
        convert(write_wpi(tmp_path, wpi_rows()), tmp_path / "no" / "out.csv")


def test_a_real_motion_without_its_header_and_time_converts_back(shared_data, tmp_path):
    original = (shared_data / "trajectories" / "mtm_one.csv").read_text().splitlines()[1:]
    path = write_text(tmp_path, "\n".join(line.split(",", 1)[1] for line in original))
    notes = convert(path, tmp_path / "out.csv").notes
    ours = read_recording(tmp_path / "out.csv", coordinates="actuator")
    theirs = read_recording(shared_data / "trajectories" / "mtm_one.csv", coordinates="actuator")
    for name in ("q", "qd", "tau"):
        np.testing.assert_array_equal(getattr(ours, name), getattr(theirs, name))
    np.testing.assert_allclose(ours.t, theirs.t, rtol=0, atol=1e-12)
    assert notes[-1].startswith("795 of 5999 rows repeat")
