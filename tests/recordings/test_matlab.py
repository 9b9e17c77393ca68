"""MATLAB files and NumPy archives: named arrays in any orientation, structures, and one line for what cannot be read."""

import h5py
import numpy as np
import pytest
import scipy.io

from dvrk_drake.errors import RecordingError
from dvrk_drake.recordings.matlab import looks_like_arrays, read_arrays, select_arrays


def write(path, kind, arrays):
    if kind == "npz":
        np.savez(path, **{name: value for name, value in arrays.items() if not isinstance(value, dict)})
    elif kind == "v5":
        scipy.io.savemat(path, arrays)
    else:
        with h5py.File(path, "w", userblock_size=512) as file:
            store(file, arrays)
        content = bytearray(path.read_bytes())
        content[:128] = b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM"
        path.write_bytes(bytes(content))
    return path


def store(group, arrays):
    for name, value in arrays.items():
        if isinstance(value, dict):
            store(group.create_group(name), value)
        else:
            group[name] = np.asarray(value).T


def read(path, names=None, num_joints=7):
    content = path.read_bytes()
    assert looks_like_arrays(path, content)
    return select_arrays(path, read_arrays(path, content), num_joints, names)


def blocks(rows=20):
    return np.random.default_rng(0).normal(size=(3, rows, 7))


@pytest.mark.parametrize("kind", ["v5", "v7.3", "npz"])
@pytest.mark.parametrize("transposed", [False, True])
def test_reads_recognised_names_in_both_orientations(tmp_path, kind, transposed):
    q, qd, tau = blocks()
    arrays = {"position": q, "velocity": qd, "effort": tau, "other": np.zeros((3, 3))}
    if transposed:
        arrays = {name: value.T for name, value in arrays.items()}
    suffix = "npz" if kind == "npz" else "mat"
    found = read(write(tmp_path / f"r.{suffix}", kind, arrays | {"time": np.arange(20.0)[None]}))
    np.testing.assert_array_equal(found.q, q)
    np.testing.assert_array_equal(found.qd, qd)
    np.testing.assert_array_equal(found.tau, tau)
    np.testing.assert_array_equal(found.t, np.arange(20.0))


@pytest.mark.parametrize("kind", ["v5", "v7.3"])
def test_reads_members_of_structures_by_name(tmp_path, kind):
    q, _, tau = blocks()
    path = write(tmp_path / "r.mat", kind, {"log": {"joints": {"q": q}, "motor_current": tau}})
    found = read(path, {"q": "log.joints.q", "tau": "log.motor_current"})
    np.testing.assert_array_equal(found.q, q)
    np.testing.assert_array_equal(found.tau, tau)


@pytest.mark.parametrize("kind", ["v5", "v7.3", "npz"])
def test_reads_the_public_gravity_collection(tmp_path, kind):
    # Arrays of the collection script: joint x pose x sample.
    position, effort = np.random.default_rng(1).normal(size=(2, 7, 5, 3))
    arrays = {
        "current_position": position,
        "desired_effort": effort,
        "joint_trajectory": position[:, :, 0],
        "Theta": 10,
    }
    found = read(write(tmp_path / f"theta10.{'npz' if kind == 'npz' else 'mat'}", kind, arrays))
    assert found.q.shape == (15, 7)
    for pose in range(5):
        for sample in range(3):
            np.testing.assert_array_equal(found.q[3 * pose + sample], position[:, pose, sample])
            np.testing.assert_array_equal(found.tau[3 * pose + sample], effort[:, pose, sample])


@pytest.mark.parametrize(
    "arrays, names, text",
    [
        ({"A": np.zeros((9, 7)), "B": np.zeros((9, 7))}, None, r"no array of 7 joints.*A \(9 x 7\), B \(9 x 7\)"),
        ({"q": np.zeros((9, 6))}, None, "no array of 7 joints"),
        ({"q": np.zeros((9, 7)), "position": np.zeros((9, 7))}, None, "several arrays may be q: q, position"),
        ({"q": np.zeros((9, 7)), "tau": np.zeros((8, 7))}, None, "tau has 8 rows, but q has 9"),
        ({"A": np.zeros((9, 7))}, {"q": "C"}, r"has no array C for q. Its arrays: A \(9 x 7\)"),
        ({"A": np.zeros((9, 5))}, {"q": "A"}, "A is 9 x 5; allowed: m x 7"),
        ({"A": np.zeros((9, 7))}, {"position": "A"}, "unknown quantity position; allowed: q, qd, tau, t"),
        ({"name": "text"}, None, "Its arrays: none"),
    ],
)
def test_refuses_ambiguous_and_unfit_arrays(tmp_path, arrays, names, text):
    with pytest.raises(RecordingError, match=text) as caught:
        read(write(tmp_path / "r.mat", "v5", arrays), names)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("kind", ["v5", "v7.3", "npz"])
def test_refuses_damaged_files(tmp_path, kind):
    path = write(tmp_path / f"r.{'npz' if kind == 'npz' else 'mat'}", kind, {"q": blocks()[0], "tau": blocks()[2]})
    content = path.read_bytes()
    for cut in (200, len(content) // 2):
        path.write_bytes(content[:cut])
        with pytest.raises(RecordingError) as caught:
            read(path)
        assert "\n" not in str(caught.value)
