"""LeRobot data sets: joints by name, gaps between episodes, and one line for what cannot be read."""

from __future__ import annotations

import json

import numpy as np
import pytest
from public_files import assert_refused

from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.recordings.reading import detect_format, read_recording

parquet = pytest.importorskip("pyarrow.parquet")
pyarrow = pytest.importorskip("pyarrow")

ARM = load_arm("mtml")


def write_data_set(folder, names, files, **features):
    """Writes a data set. Each file is a list of episodes, and each episode a list of positions, efforts and times."""
    (folder / "meta").mkdir()
    (folder / "data" / "chunk-000").mkdir(parents=True)
    info = {"codebase_version": "v3.0", "features": {"observation.state": {"dtype": "float32", "names": names}}}
    (folder / "meta" / "info.json").write_text(json.dumps(info))
    for number, episodes in enumerate(files):
        rows = [
            {"observation.state": q, "observation.effort": tau, "timestamp": t, "episode_index": index, "action": q}
            for index, (positions, efforts, times) in episodes
            for q, tau, t in zip(positions.tolist(), efforts.tolist(), times.tolist(), strict=True)
        ]
        parquet.write_table(pyarrow.Table.from_pylist(rows), folder / "data/chunk-000" / f"file-{number:03d}.parquet")
    return folder


def episode(index, rows=5):
    q, tau = np.random.default_rng(index).normal(size=(2, rows, 7))
    return index, (q, tau, 0.02 * np.arange(rows))


@pytest.mark.parametrize("form", ["list", "nested list", "motors", "none"])
def test_joints_have_names_and_episodes_have_gaps(tmp_path, form):
    order = list(range(7)) if form == "none" else [6, 5, 4, 3, 2, 1, 0]
    names = [f"{ARM.joint_names[i]}.pos" for i in order]
    names = {"list": names, "nested list": [names], "motors": {"motors": names}, "none": None}[form]
    episodes = [episode(index) for index in range(3)]
    path = write_data_set(tmp_path, names, [episodes[:2], episodes[2:]])
    assert detect_format(path).name == "a LeRobot data set"
    read = read_recording(path, ARM)
    np.testing.assert_array_equal(read.q, np.vstack([q for _, (q, _, _) in episodes])[:, order])
    np.testing.assert_array_equal(read.tau, np.vstack([tau for _, (_, tau, _) in episodes])[:, order])
    np.testing.assert_allclose(read.t, np.concatenate([k * 1.08 + 0.02 * np.arange(5) for k in range(3)]), atol=1e-9)
    assert [(part.start, part.stop) for part in read.segments()] == [(0, 5), (5, 10), (10, 15)]
    assert (read.qd, read.where(6), len(read.sha256)) == (None, f"{path}, row 7", 64)


def test_faults_are_refused(tmp_path):
    index, (q, tau, t) = episode(0)
    q[2, 3] = np.nan
    path = write_data_set(tmp_path, [*ARM.joint_names[:6], "hand"], [[(index, (q, tau, t))]])
    assert_refused(r"row 3 of observation.state: the position of .* is nan; only finite", read_recording, path, ARM)
    assert_refused("has the joints .*hand; MTML also needs .*--joints", read_recording, path, ARM, skip_invalid=True)
    joints = {ARM.joint_names[6]: "hand"}
    assert len(read_recording(path, ARM, joints=joints, skip_invalid=True)) == 4
    assert_refused("needs the arm", read_recording, path, skip_invalid=True)
    file = next(path.glob("data/*/*"))
    parquet.write_table(pyarrow.table({"observation.state": q.tolist(), "timestamp": t}), file)
    assert_refused(r"row 1 is not a sample with time and episode \('episode_index'\)", read_recording, path, ARM)
    file.write_bytes(b"PAR1")
    assert_refused(r"file-000\.parquet: the file is damaged \(", read_recording, path, ARM)
    file.unlink()
    assert_refused("has no usable message", read_recording, path, ARM)
