"""MATLAB files and NumPy archives: named arrays in any orientation, structures, poses, and one line for each fault."""

from __future__ import annotations

import struct
import warnings

import h5py
import numpy as np
import pytest
import scipy.io
from array_files import KINDS, with_objects, write_arrays
from public_files import assert_refused, team_array, write_mat

from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.recordings import reader_matlab
from dvrk_drake.recordings.formats import read_recording


def blocks(rows=20):
    return np.random.default_rng(0).normal(size=(3, rows, 7))


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("transposed", [False, True])
def test_recognised_names_in_both_orientations(tmp_path, kind, transposed):
    q, qd, tau = blocks()
    arrays = {"position": q, "velocity": qd, "effort": tau, "other": np.zeros((3, 3))}
    if transposed:
        arrays = {name: value.T for name, value in arrays.items()}
    read = read_recording(write_arrays(tmp_path, kind, arrays | {"time": np.arange(20.0)[None]}))
    np.testing.assert_array_equal(read.q, q)
    np.testing.assert_array_equal(read.qd, qd)
    np.testing.assert_array_equal(read.tau, tau)
    np.testing.assert_array_equal(read.t, np.arange(20.0))
    assert read.where(4).endswith(", row 5")
    assert read.notes == ("q from array position, qd from array velocity, tau from array effort, t from array time",)


@pytest.mark.parametrize("kind", ["v5", "v7.3"])
def test_members_of_structures_have_names_with_dots(tmp_path, kind):
    q, _, tau = blocks()
    arrays = {"log": {"joints": {"q": q}, "motor": tau, "name": "7 joint"}, "title": "a title"}
    read = read_recording(
        write_arrays(tmp_path, kind, arrays), arrays={"q": "log.joints.q", "tau": "log.motor"}, rate=100.0
    )
    np.testing.assert_array_equal(read.q, q)
    np.testing.assert_array_equal(read.tau, tau)
    np.testing.assert_array_equal(read.t, np.arange(20) / 100)


def gravity_collection(seed, poses=5):
    """Returns the arrays of a file of the gravity collection of JHU and CUHK: joint x pose x sample."""
    position, effort = np.random.default_rng(seed).normal(size=(2, 7, poses, 3))
    return {"current_position": position, "desired_effort": effort, "joint_trajectory": position[:, :, 0], "Theta": 10}


@pytest.mark.parametrize("kind", KINDS)
def test_gravity_collection_has_one_row_per_sample(tmp_path, kind):
    arrays = gravity_collection(1)
    read = read_recording(write_arrays(tmp_path, kind, arrays))
    assert read.q.shape == (15, 7)
    for pose in range(5):
        for sample in range(3):
            np.testing.assert_array_equal(read.q[3 * pose + sample], arrays["current_position"][:, pose, sample])
            np.testing.assert_array_equal(read.tau[3 * pose + sample], arrays["desired_effort"][:, pose, sample])


def test_a_folder_of_the_gravity_collection_is_one_recording(tmp_path):
    for number in range(3):
        folder = tmp_path / f"Train_Joint{number}" / "data_pos"
        folder.mkdir(parents=True)
        write_arrays(folder, "v5", gravity_collection(number))
    read = read_recording(tmp_path)
    assert read.q.shape == (45, 7)
    np.testing.assert_array_equal(read.q[15], gravity_collection(1)["current_position"][:, 0, 0])
    assert read.notes[0].startswith("3 files; q from array current_position, tau from array desired_effort of each")
    (tmp_path / "Train_Joint1/data_pos/arrays.mat").write_bytes(b"damaged")
    assert_refused(r"Train_Joint1/data_pos/arrays\.mat: the file is damaged", read_recording, tmp_path)


@pytest.mark.parametrize(
    "arrays, names, text",
    [
        ({"A": np.zeros((9, 7)), "B": np.zeros((9, 7))}, None, r"no array of 7 joints.*A \(9 x 7\), B \(9 x 7\)"),
        ({"q": np.zeros((9, 6))}, None, "no array of 7 joints"),
        ({"q": np.zeros((9, 7)), "position": np.zeros((9, 7))}, None, "several arrays may be q: q, position"),
        ({"q": np.zeros((9, 7)), "tau": np.zeros((8, 7))}, None, "tau has 8 rows, but q has 9"),
        ({"A": np.zeros((9, 7))}, {"q": "C"}, r"has no array C for q\. Arrays of real numbers: A \(9 x 7\)"),
        ({"A": np.zeros((9, 5))}, {"q": "A"}, "A is 9 x 5; allowed for 7 joints: m x 7"),
        ({"A": np.zeros((9, 7))}, {"tau": "A"}, "no array of 7 joints has a recognised name"),
        ({"A": np.zeros((9, 7)), "B": np.eye(9)}, {"q": "A", "t": "B"}, "B is 9 x 9; allowed for t: a vector"),
        ({"A": np.zeros((9, 7))}, {"position": "A"}, "unknown quantity position; allowed: q, qd, tau, t, poses"),
        ({"A": team_array(), "q": np.zeros((5, 7))}, {"poses": "A", "q": "q"}, "poses contains positions and efforts"),
        ({"name": "text"}, None, "Arrays of real numbers: none"),
        ({"name": 1j * team_array()}, None, "Arrays of real numbers: none"),
        ({"a": np.ones((8, 2, 0))}, None, "no array of 7 joints"),
    ],
)
def test_ambiguous_and_unsuitable_arrays_are_refused(tmp_path, arrays, names, text):
    assert_refused(text, read_recording, write_arrays(tmp_path, "v5", arrays), arrays=names)


def test_named_arrays_and_recognised_arrays_are_combined(tmp_path):
    q, qd, tau = blocks()
    t = 0.01 * np.arange(20.0)
    path = write_arrays(tmp_path, "npz", {"q": q, "position": 2 * q, "qd": qd, "tau": tau, "t": t})
    assert_refused("several arrays may be q: q, position. Choose one with --arrays q=NAME", read_recording, path)
    read = read_recording(path, arrays={"q": "position"})
    np.testing.assert_array_equal(read.q, 2 * q)
    np.testing.assert_array_equal(read.tau, tau)
    np.testing.assert_array_equal(read.t, t)
    path = write_arrays(tmp_path, "npz", {"saved": team_array(), "current": tau})
    assert_refused("no array of 7 joints has a recognised name", read_recording, path, arrays={"tau": "current"})
    path = write_arrays(tmp_path, "npz", {"q": q, "tau": tau, "t": np.column_stack([t, t])})
    assert_refused("t is 20 x 2; allowed for t: a vector", read_recording, path)


def test_files_of_a_folder_have_the_same_arrays(tmp_path):
    q, _, tau = blocks()
    for name, arrays in (("a", {"q": q, "tau": tau}), ("b", {"q": q})):
        (tmp_path / name).mkdir()
        write_arrays(tmp_path / name, "v5", arrays)
    (tmp_path / "b" / "._arrays.mat").write_bytes(b"of macOS")
    assert_refused(
        r"b/arrays\.mat: q from array q; .*a/arrays\.mat: q from array q, tau from array tau. All files",
        read_recording,
        tmp_path,
    )
    write_arrays(tmp_path / "b", "v5", {"q": q, "tau": tau})
    assert len(read_recording(tmp_path)) == 40
    assert_refused("--rate does not apply to a folder", read_recording, tmp_path, rate=100.0)


@pytest.mark.parametrize("kind", KINDS)
def test_damaged_files_are_refused(tmp_path, kind):
    path = write_arrays(tmp_path, kind, {"q": blocks()[0], "tau": blocks()[2]})
    content = path.read_bytes()
    for cut in (0, 200, len(content) // 2):
        path.write_bytes(content[:cut])
        assert_refused(r"arrays\.(mat|npz)", read_recording, path)


def test_invalid_rows_are_refused_or_skipped(tmp_path):
    q, _, tau = blocks()
    tau[3, 6] = np.inf
    path = write_arrays(tmp_path, "v5", {"q": q, "tau": tau, "t": np.arange(20.0)})
    assert_refused(r"row 4: tau7 is inf; only finite .*--skip-invalid .*1 of 20 rows", read_recording, path)
    read = read_recording(path, skip_invalid=True)
    assert 4 not in read.lines and len(read) == 19 and 3.0 not in read.t


# Arrays of 8 x 2 x N (joint or gripper; position, effort; pose).


@pytest.mark.parametrize("compressed", [False, True])
def test_axes_of_poses(tmp_path, compressed):
    path = tmp_path / "poses.mat"
    scipy.io.savemat(path, {"any_name": team_array(), "n": 5, "label": "x"}, do_compression=compressed)
    recording = read_recording(path)
    assert recording.q.shape == recording.tau.shape == (5, 7)
    assert recording.q[2, 3] == 4.03
    assert recording.tau[4, 6] == -10 * 7.05
    assert (recording.t, recording.qd, recording.coordinates) == (None, None, "joint")
    assert recording.where(2) == f"{path}, pose 3"
    assert len(recording.sha256) == 64


@pytest.mark.parametrize("poses", [team_array(1), team_array(1)[:, :, 0]])
def test_one_pose(tmp_path, poses):
    np.testing.assert_array_equal(read_recording(write_mat(tmp_path, a=poses)).q, [np.arange(1, 8) + 0.01])


@pytest.mark.parametrize("kind", [np.float32, np.int16, np.uint8])
def test_poses_of_other_real_types(tmp_path, kind):
    array = np.arange(1, 33).reshape(8, 2, 2).astype(kind)
    np.testing.assert_array_equal(read_recording(write_mat(tmp_path, a=array)).tau, array[:7, 1].T)


def test_several_arrays_of_poses_require_a_choice(tmp_path):
    path = write_mat(tmp_path, data=team_array(10), saved_data=team_array(3), n=10)
    assert_refused(
        r"poses\.mat: several arrays have the shape 8 x 2 x N .*: data, saved_data\. .*--arrays poses=NAME",
        read_recording,
        path,
    )
    assert len(read_recording(path, arrays={"poses": "saved_data"})) == 3


@pytest.mark.parametrize("wrong", [np.ones((8, 3, 5)), np.ones((2, 8, 5)), np.ones((8, 2, 5, 2))])
def test_other_shapes_are_no_poses(tmp_path, wrong):
    path = write_mat(tmp_path, a=wrong)
    assert_refused("no array of 7 joints has a recognised name", read_recording, path)
    assert_refused("a is .*; allowed: 8 x 2 x N", read_recording, path, arrays={"poses": "a"})


def test_a_foreign_number_format_is_refused(tmp_path):
    """Uses a MATLAB 4 file of a VAX. scipy warns that the data may be corrupt."""
    path = tmp_path / "data.mat"
    path.write_bytes(struct.pack("<5i", 2000, 8, 2, 0, 2) + b"a\0" + bytes(8 * 2 * 8))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert_refused("the file is damaged.*may be corrupt", read_recording, path)


def test_invalid_poses_are_refused_or_skipped(tmp_path):
    array, value = team_array(6), -np.inf
    array[4, 1, 2] = value
    array[0, 0, 5] = np.nan
    path = write_mat(tmp_path, a=array)
    pattern = rf"poses\.mat, pose 3: tau5 is {value}; only finite.*--skip-invalid .*2 of 6 poses"
    assert_refused(pattern, read_recording, path)
    recording = read_recording(path, skip_invalid=True)
    np.testing.assert_array_equal(recording.lines, [1, 2, 4, 5])
    np.testing.assert_array_equal(recording.q, array[:7, 0][:, [0, 1, 3, 4]].T)
    assert "2 of 6 poses skipped (NaN or infinite, or all zeros): 3, 6" in recording.notes


def test_poses_that_were_allocated_but_not_recorded_are_refused(tmp_path):
    array = team_array(30)
    array[:, :, 12:] = 0
    path = write_mat(tmp_path, a=array)
    assert_refused(r"poses\.mat, pose 13: all numbers are zero.*18 of 30 poses", read_recording, path)
    recording = read_recording(path, skip_invalid=True)
    assert len(recording) == 12
    assert recording.notes[-1].endswith("13, 14, 15, 16, 17, 18, 19, 20, 21, 22, ...")
    nothing = write_mat(tmp_path, a=np.zeros((8, 2, 3)))
    assert_refused("has 3 poses, but none is valid", read_recording, nothing, skip_invalid=True)


def test_unusual_poses_are_valid(tmp_path):
    gripper, home = team_array(), np.zeros((8, 2, 1))
    gripper[7] = np.nan  # ignored
    home[1, 1, 0] = 0.4  # all positions are 0, but not all efforts
    assert len(read_recording(write_mat(tmp_path, a=gripper))) == 5
    assert len(read_recording(write_mat(tmp_path, a=home))) == 1


def test_arrays_beside_objects_are_read(tmp_path):
    q, _, tau = blocks()
    path = with_objects(write_arrays(tmp_path, "v5", {"q": q, "tau": tau}), "string", "datetime")
    read = read_recording(path)
    np.testing.assert_array_equal(read.tau, tau)
    assert read.notes[0].startswith("q from array q, tau from array tau; objects of the MATLAB class datetime")


def test_the_case_with_string_and_datetime_is_read(shared_data):
    read = read_recording(shared_data / "cases" / "string_and_datetime.mat", load_arm("mtmr"))
    assert read.q.shape == read.tau.shape == (60, 7)


def test_a_time_series_is_named_as_a_limitation(tmp_path):
    limitation = r"objects of the MATLAB class timeseries are not read; save their numbers as arrays, e\.g\. q = data"
    path = with_objects(write_arrays(tmp_path, "v5", {"gain": np.ones(3)}), "timeseries")
    assert_refused(limitation, read_recording, path)
    other = np.empty((2, 1), object)
    other[:, 0] = "left", np.ones(3)
    path = write_arrays(tmp_path, "v7.3", {"notes": other})
    assert_refused("objects of the MATLAB class cell are not read", read_recording, path)
    path = write_arrays(tmp_path, "v7.3", {"q": np.arange(14, dtype=np.uint32).reshape(2, 7)})
    with h5py.File(path, "r+") as file:
        file["q"].attrs["MATLAB_class"] = np.bytes_("timeseries")
    assert_refused(limitation, read_recording, path)


def test_a_file_that_crashes_the_reader_is_refused(tmp_path, monkeypatch):
    """scipy 1.17 ends the process for some damaged files without checksums, as MATLAB saves them with -v6."""
    path = tmp_path / "v6.mat"
    scipy.io.savemat(path, {"q": np.zeros((3, 7)), "tau": np.ones((3, 7))})
    np.testing.assert_array_equal(read_recording(path).tau, np.ones((3, 7)))
    monkeypatch.setattr(reader_matlab, "_LOADER", "import os; os.abort()")
    assert_refused(r"the file is damaged, or not a MATLAB file .*\(the reader crashed\)", read_recording, path)
