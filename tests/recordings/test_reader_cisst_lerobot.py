"""Files of the cisst collector: columns by their description, joints by name, actuators by the name of the table."""

from __future__ import annotations

import json

import numpy as np
import pytest
from collector_files import joint_state, write_collection
from public_files import assert_refused

from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.recordings.formats import detect_format, read_recording

JOINTS, ACTUATORS = "StateDataCollection-MTML-StateTable-2025-10-06-13", "StateDataCollection-io-MTMLRead-2025-10-06-13"


MTM = load_arm("mtml")
PSM = load_arm("psm")


def blocks(rows, joints):
    return np.random.default_rng(0).normal(size=(3, rows, joints))


def times(rows):
    return 1234.5 + 0.005 * np.arange(rows)


def test_reads_joint_states_and_ignores_the_gripper(tmp_path):
    q, qd, tau = blocks(6, 7)
    arm = joint_state("kin/measured_js", MTM.joint_names, times(6), q, qd, tau)
    gripper = joint_state("gripper/measured_js", ["gripper"], times(6), q[:, :1], qd[:, :1], tau[:, :1])
    path = write_collection(tmp_path, JOINTS, gripper, arm)
    for given in (path, path.with_suffix(".desc")):
        read = read_recording(given, MTM)
        np.testing.assert_array_equal(read.q, q)
        np.testing.assert_array_equal(read.qd, qd)
        np.testing.assert_array_equal(read.tau, tau)
        np.testing.assert_allclose(read.t, 0.005 * np.arange(6), atol=1e-9)
        assert (read.coordinates, read.times_from) == ("joint", "messages")
        assert read.notes == (f"signal kin/measured_js of {JOINTS}.csv, in joint coordinates",)


def test_io_tables_are_in_actuator_coordinates(tmp_path):
    q, qd, tau = blocks(4, 7)
    path = write_collection(tmp_path, ACTUATORS, joint_state("measured_js", [], times(4), q, qd, tau))
    read = read_recording(path, MTM)
    assert read.coordinates == "actuator"
    np.testing.assert_array_equal(read.q, q)
    assert read_recording(path, MTM, "joint").coordinates == "joint"


def test_joins_the_jaw_of_a_psm(tmp_path):
    q, qd, tau = blocks(4, 7)
    arm = joint_state("measured_js", PSM.joint_names[:6], times(4), q[:, :6], qd[:, :6], tau[:, :6])
    jaw = joint_state("jaw/measured_js", ["jaw"], times(4), q[:, 6:], qd[:, 6:], tau[:, 6:])
    path = write_collection(tmp_path, JOINTS, arm, jaw)
    np.testing.assert_array_equal(read_recording(path, PSM).q, q)
    path = write_collection(tmp_path, JOINTS, arm)
    assert_refused(r"PSM also needs jaw\. Record jaw/measured_js as well", read_recording, path, PSM)


def test_omits_invalid_and_repeated_rows(tmp_path):
    q, qd, tau = blocks(8, 7)
    t, valid = times(8), np.ones(8)
    t[4], valid[0] = t[3], 0
    path = write_collection(tmp_path, JOINTS, joint_state("measured_js", MTM.joint_names, t, q, qd, tau, valid))
    read = read_recording(path, MTM)
    np.testing.assert_array_equal(read.lines, [2, 3, 4, 6, 7, 8])
    assert [note.partition(": ")[2] for note in read.notes[:2]] == ["marked invalid", "same time as another one"]


def test_chooses_a_signal(tmp_path):
    q, qd, tau = blocks(4, 7)
    first = joint_state("measured_js", MTM.joint_names, times(4), q, qd, tau)
    second = joint_state("kin/measured_js", MTM.joint_names, times(4), 2 * q, qd, tau)
    path = write_collection(tmp_path, JOINTS, first, second)
    assert_refused(
        "several signals fit. .*: measured_js, kin/measured_js. Choose one with --topic", read_recording, path, MTM
    )
    np.testing.assert_array_equal(read_recording(path, MTM, topic="kin/measured_js").q, 2 * q)
    assert_refused("has no signal other. Signals", read_recording, path, MTM, topic="other")


def test_faults_are_refused(tmp_path):
    q, qd, tau = blocks(4, 7)
    signal = joint_state("measured_js", MTM.joint_names, times(4), q, qd, tau)
    path = write_collection(tmp_path, JOINTS, signal)
    assert_refused(r"needs the arm .*--arm", read_recording, path)
    assert_refused("has the joints outer_yaw.*PSM also needs yaw.*Check --arm", read_recording, path, PSM)
    still = joint_state("measured_js", MTM.joint_names, np.ones(4), q, qd, tau)
    assert_refused(
        "the times do not increase in 3 of 4 rows of measured_js",
        read_recording,
        write_collection(tmp_path, JOINTS, still),
        MTM,
    )
    tau[2, 6] = np.nan
    bad = write_collection(tmp_path, JOINTS, joint_state("measured_js", MTM.joint_names, times(4), q, qd, tau))
    assert_refused(r", line 3: measured_js\.Effort\[6\] is nan; only finite", read_recording, bad, MTM)
    path = write_collection(tmp_path, JOINTS, signal)
    path.write_text(path.read_text()[:-30])
    assert_refused(r", line 4: the row has \d+ cells, .*\.desc has 36", read_recording, path, MTM)
    path.with_suffix(".desc").write_text("a\nb\nCSV\n,\n3\n")
    assert_refused("not a complete description", read_recording, path, MTM)
    path.with_suffix(".desc").unlink()
    assert_refused(r"need their description StateDataCollection.*\.desc", read_recording, path, MTM)


def test_a_clock_that_was_set_and_missing_columns_are_refused(tmp_path):
    q, qd, tau = blocks(6, 7)
    t = times(6)
    t[4:] -= 2.0
    path = write_collection(tmp_path, JOINTS, joint_state("measured_js", MTM.joint_names, t, q, qd, tau))
    assert_refused(r"the time of line 5 is 1\.99\d* s before that of line 4", read_recording, path, MTM)
    path = write_collection(tmp_path, JOINTS, joint_state("measured_js", MTM.joint_names, times(6), q, qd, tau))
    description = path.with_suffix(".desc")
    description.write_text(description.read_text().replace("measured_js.Valid:", "measured_js.Other:"))
    assert_refused(r"has no column measured_js\.Valid", read_recording, path, MTM)


# LeRobot data sets: joints by name, gaps between episodes, and one line for what cannot be read.


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


def test_faults_of_a_data_set_are_refused(tmp_path):
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
