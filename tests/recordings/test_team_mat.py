"""Tests reading arrays of 8 x 2 x N from MATLAB files."""

from __future__ import annotations

import struct
import warnings

import numpy as np
import pytest
import scipy.io
from public_files import assert_refused, team_array, write_mat

from dvrk_drake.recordings.conversion import convert, detect_format
from dvrk_drake.recordings.public_formats import read_team_mat


@pytest.mark.parametrize("compressed", [False, True])
def test_team_mat_axes(tmp_path, compressed):
    path = tmp_path / "poses.mat"
    scipy.io.savemat(path, {"any_name": team_array(), "n": 5, "label": "x"}, do_compression=compressed)
    recording = read_team_mat(path)
    assert recording.q.shape == recording.tau.shape == (5, 7)
    assert recording.q[2, 3] == 4.03
    assert recording.tau[4, 6] == -10 * 7.05
    assert recording.t is None
    assert recording.qd is None
    assert recording.coordinates == "joint"
    assert recording.where(2) == f"{path}, pose 3"
    assert len(recording.sha256) == 64


@pytest.mark.parametrize("poses", [team_array(1), team_array(1)[:, :, 0]])
def test_team_mat_of_one_pose(tmp_path, poses):
    np.testing.assert_array_equal(read_team_mat(write_mat(tmp_path, a=poses)).q, [np.arange(1, 8) + 0.01])


@pytest.mark.parametrize("kind", [np.float32, np.int16, np.uint8])
def test_team_mat_of_other_real_types(tmp_path, kind):
    array = np.arange(1, 33).reshape(8, 2, 2).astype(kind)
    np.testing.assert_array_equal(read_team_mat(write_mat(tmp_path, a=array)).tau, array[:7, 1].T)


def test_matlab_4_file_is_detected_by_its_name(tmp_path):
    path = tmp_path / "old.mat"
    scipy.io.savemat(path, {"a": team_array(1)[:, :, 0]}, format="4")
    assert detect_format(path) == "team-mat"
    assert len(read_team_mat(path)) == 1


def test_team_mat_with_several_candidates_requires_a_choice(tmp_path):
    path = write_mat(tmp_path, data=team_array(10), saved_data=team_array(3), n=10)
    assert_refused(
        r"poses\.mat: several variables have the layout .*: data, saved_data\. .*--variable NAME", read_team_mat, path
    )
    assert len(read_team_mat(path, variable="saved_data")) == 3


def test_team_mat_refuses_absent_or_unsuitable_variables(tmp_path):
    path = write_mat(tmp_path, a=team_array(), b=np.ones((8, 10, 4)))
    assert_refused(
        r"has no variable c\. Variables in the file: a \(8 x 2 x 5 double\)", read_team_mat, path, variable="c"
    )
    assert_refused(r"variable b must be 8 x 2 x N .* b \(8 x 10 x 4 double\)", read_team_mat, path, variable="b")


@pytest.mark.parametrize(
    "wrong",
    [
        np.ones((7, 2, 5)),
        np.ones((8, 3, 5)),
        np.ones((2, 8, 5)),
        np.ones((8, 2, 5, 2)),
        np.ones((8, 2, 5), bool),
        "text",
    ],
)
def test_team_mat_refuses_other_shapes_and_types(tmp_path, wrong):
    assert_refused(
        r"no variable has the layout 8 x 2 x N real numbers .*\. Variables in the file: a \(",
        read_team_mat,
        write_mat(tmp_path, a=wrong),
    )


def test_team_mat_refuses_complex_and_empty_arrays(tmp_path):
    assert_refused("variable a is complex", read_team_mat, write_mat(tmp_path, a=1j * team_array()))
    assert_refused("variable a has no poses", read_team_mat, write_mat(tmp_path, a=np.ones((8, 2, 0))))
    assert_refused("no variable has the layout 8 x 2 x N.*: no variables", read_team_mat, write_mat(tmp_path))


def test_team_mat_of_version_7_3_is_refused_with_a_remedy(tmp_path):
    path = tmp_path / "new.mat"
    header = b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM"
    for content in (header.ljust(512, b"\0") + b"\x89HDF\r\n\x1a\n", b"\x89HDF\r\n\x1a\n" + b"\0" * 600):
        path.write_bytes(content)
        assert detect_format(path) == "team-mat"
        assert_refused(r"new\.mat is a MATLAB v7\.3 \(HDF5\) file.*-v7'", read_team_mat, path)


def test_team_mat_with_foreign_number_format_is_refused(tmp_path):
    """Uses a MATLAB 4 file of a VAX. scipy warns that the data may be corrupt."""
    path = tmp_path / "data.mat"
    path.write_bytes(struct.pack("<5i", 2000, 8, 2, 0, 2) + b"a\0" + bytes(8 * 2 * 8))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert_refused("invalid MATLAB file: .*may be corrupt", read_team_mat, path)


@pytest.mark.parametrize("damage", ["empty", "cut", "short", "text", "noise"])
def test_damaged_team_mat_is_refused(tmp_path, damage):
    path = tmp_path / "poses.mat"
    scipy.io.savemat(path, {"a": team_array(50)}, do_compression=True)
    whole = path.read_bytes()
    noise = bytes(np.random.default_rng(1).integers(0, 256, len(whole) - 200, np.uint8))
    path.write_bytes(
        {
            "empty": b"",
            "cut": whole[:-30],
            "short": whole[:100],
            "text": b"q1,q2\n1,2\n" * 50,
            "noise": whole[:200] + noise,
        }[damage]
    )
    assert_refused(r"poses\.mat: (invalid MATLAB file|no variable)", read_team_mat, path)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_team_mat_refuses_or_skips_invalid_poses(tmp_path, value):
    array = team_array(6)
    array[4, 1, 2] = value
    array[0, 0, 5] = np.nan
    path = write_mat(tmp_path, a=array)
    pattern = rf"poses\.mat, pose 3: tau5 is {value}; only finite.*--skip-invalid .*2 of 6 poses"
    assert_refused(pattern, read_team_mat, path)
    assert not (tmp_path / "out.csv").exists()
    recording = convert(path, tmp_path / "out.csv", skip_invalid=True)
    notes = recording.notes
    np.testing.assert_array_equal(recording.lines, [1, 2, 4, 5])
    np.testing.assert_array_equal(recording.q, array[:7, 0][:, [0, 1, 3, 4]].T)
    assert "2 of 6 poses skipped (NaN, infinite or all zeros): 3, 6" in notes


def test_team_mat_refuses_poses_that_were_never_recorded(tmp_path):
    array = team_array(30)
    array[:, :, 12:] = 0
    path = write_mat(tmp_path, a=array)
    assert_refused(r"poses\.mat, pose 13: all numbers are zero.*18 of 30 poses", read_team_mat, path)
    recording = convert(path, tmp_path / "out.csv", skip_invalid=True)
    notes = recording.notes
    assert len(recording) == 12
    assert notes[-1].endswith("13, 14, 15, 16, 17, 18, 19, 20, 21, 22, ...")
    nothing = write_mat(tmp_path, a=np.zeros((8, 2, 3)))
    assert_refused("variable a has 3 poses, but none is valid", read_team_mat, nothing, skip_invalid=True)


def test_team_mat_ignores_the_gripper(tmp_path):
    array = team_array()
    array[7] = np.nan
    assert len(read_team_mat(write_mat(tmp_path, a=array))) == 5


def test_a_home_pose_is_valid_if_it_has_an_effort(tmp_path):
    array = np.zeros((8, 2, 1))
    array[1, 1, 0] = 0.4
    assert len(read_team_mat(write_mat(tmp_path, a=array))) == 1
