"""Conversion of recordings to CSV: exact values, notes on the data, protection of existing files."""

from __future__ import annotations

import numpy as np
import pytest
from public_files import assert_refused, wpi_rows, write_mat, write_wpi

from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.recordings.formats import convert, read_recording, write_recording
from dvrk_drake.recordings.recording import Recording


def assert_equal(first: Recording, second: Recording) -> None:
    for name in ("t", "q", "qd", "tau"):
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name))


def test_converted_poses_are_exact(tmp_path):
    array = np.random.default_rng(2).normal(size=(8, 2, 72))
    recording = convert(write_mat(tmp_path, saved=array), tmp_path / "out.csv")
    again = read_recording(tmp_path / "out.csv")
    np.testing.assert_array_equal(again.q, array[:7, 0].T)
    np.testing.assert_array_equal(again.tau, recording.tau)
    assert (again.t, again.qd) == (None, None)
    assert list(recording.notes) == [
        "static poses from array saved; its eighth row (gripper) is ignored",
        "coordinates were not stated, read as joint coordinates (default)",
        "without times, read as static poses; for a motion, give its sampling rate with --rate HZ",
    ]


def test_converted_motion_is_exact_and_its_times_are_noted(tmp_path):
    rows = np.random.default_rng(3).normal(size=(50, 21))
    recording = convert(write_wpi(tmp_path, rows), tmp_path / "out.csv", rate=100, coordinates="actuator")
    again = read_recording(tmp_path / "out.csv")
    assert again.coordinates == "actuator"
    assert_equal(again, recording)
    np.testing.assert_array_equal(np.hstack([again.q, again.qd, again.tau]), rows)
    assert recording.notes[1] == "50 samples; the file has no times, so t = row / 100 Hz"
    assert recording.notes[2] == "t from 0 to 0.49 s, median interval 10 ms"


def test_actuator_coordinates_become_joint_coordinates_of_an_arm(tmp_path):
    arm = load_arm("mtmr")
    q = arm.sample_poses(5, np.random.default_rng(1), margin=0.1)
    given = Recording(q=q, qd=0.1 * q, tau=0.01 * q, t=0.01 * np.arange(5)).in_actuator_coordinates(arm)
    write_recording(given, tmp_path / "motion.csv")
    stated = convert(tmp_path / "motion.csv", tmp_path / "out.csv", arm=arm)
    assert not any("not stated" in note for note in stated.notes)
    np.testing.assert_allclose(read_recording(tmp_path / "out.csv", arm).q, q, rtol=0, atol=1e-12)


def test_the_input_is_not_overwritten(tmp_path):
    path = write_wpi(tmp_path, wpi_rows())
    before = path.read_bytes()
    assert_refused("is the input recording", convert, path, tmp_path / "." / "motion.csv")
    assert path.read_bytes() == before


@pytest.mark.parametrize("name", ["out.bag", "out.mat", "out", "out.mcap.gz"])
def test_other_outputs_are_refused(tmp_path, name):
    path = write_wpi(tmp_path, wpi_rows())
    assert_refused(r"must end in \.csv or \.mcap", convert, path, tmp_path / name)
    assert not (tmp_path / name).exists()
