"""MCAP bags of recordings: exact round trips, and readers that are independent of this package."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from mcap.reader import make_reader
from recordings import random_recording
from rosbags.highlevel import AnyReader

from dvrk_drake.errors import RecordingError
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.recordings.formats import read_recording, write_recording
from dvrk_drake.recordings.recording import Recording
from dvrk_drake.recordings.writer_mcap import CHUNK_TIME, ArmMessages, GrowingMcap

ARMS = {name: load_arm(name) for name in ("mtml", "psm")}
TOPICS = {"mtml": ["/MTML/measured_js"], "psm": ["/PSM/jaw/measured_js", "/PSM/measured_js"]}


@pytest.mark.parametrize("name", ARMS)
@pytest.mark.parametrize("absent", [(), ("qd",), ("tau",), ("qd", "tau")])
def test_round_trip_is_exact(tmp_path, name, absent):
    arm, recording = ARMS[name], random_recording(**dict.fromkeys(absent))
    recording.q[0, :3] = [5e-324, -0.0, 0.1 + 0.2]
    write_recording(recording, tmp_path / "a.mcap", arm)
    again = read_recording(tmp_path / "a.mcap", arm)
    assert not again.notes
    assert again.coordinates == "joint"
    np.testing.assert_allclose(again.t, recording.t, rtol=0, atol=1e-9)  # stamps are whole nanoseconds
    for block in ("q", "qd", "tau"):
        if block in absent:
            assert getattr(again, block) is None
        else:
            np.testing.assert_array_equal(getattr(again, block), getattr(recording, block))


@pytest.mark.parametrize("name", ARMS)
def test_independent_readers_accept_the_bag(tmp_path, name):
    """`mcap` checks the checksums of chunks and summary; rosbags compiles the message type from the schema."""
    arm, path, num_rows = ARMS[name], tmp_path / "a.mcap", 5000
    recording = random_recording(num_rows, t=3.5 + 0.002 * np.arange(num_rows))
    write_recording(recording, path, arm)
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        assert reader.get_header().profile == "ros2"
        summary = reader.get_summary()
        assert {schema.encoding for schema in summary.schemas.values()} == {"ros2msg"}
        (schema,) = (schema for schema in summary.schemas.values() if schema.name == "sensor_msgs/msg/JointState")
        definitions = schema.data.decode().split("=" * 80 + "\n")
        assert [text.partition("\n")[0] for text in definitions[1:]] == [
            f"MSG: {dependency}" for dependency in ("std_msgs/Header", "builtin_interfaces/Time")
        ]
        assert {channel.message_encoding for channel in summary.channels.values()} == {"cdr"}
        counts = {summary.channels[k].topic: n for k, n in summary.statistics.channel_message_counts.items()}
        assert counts == dict.fromkeys(TOPICS[name], num_rows) | {
            "/tf": num_rows // 10,  # 500 Hz, reduced to 50 Hz
            "/tf_static": 1,
            f"/{arm.name}/robot_description": 1,
        }
        assert len(summary.chunk_indexes) > 1
        log_times = [message.log_time for _, channel, message in reader.iter_messages(topics=TOPICS[name][-1:])]
    with AnyReader([path]) as bag:  # without a default type store: the types come from the schema
        assert set(TOPICS[name]) < bag.topics.keys()
        decoded = [
            (connection.topic, time, bag.deserialize(data, connection.msgtype))
            for connection, time, data in bag.messages()
        ]
    messages = [(time, message) for topic, time, message in decoded if topic == f"/{arm.name}/measured_js"]
    stamps = [message.header.stamp.sec * 10**9 + message.header.stamp.nanosec for _, message in messages]
    assert stamps == [time for time, _ in messages] == log_times
    np.testing.assert_array_equal(np.diff(stamps), 2_000_000)
    joints = [joint for joint in arm.joint_names if joint != "jaw"]
    assert all(message.name == joints for _, message in messages)
    np.testing.assert_array_equal([message.effort for _, message in messages], recording.tau[:, : len(joints)])


def test_poses_without_times_remain_poses(tmp_path):
    poses = random_recording(200, t=None, qd=None)
    write_recording(poses, tmp_path / "poses.mcap", ARMS["mtml"])
    again = read_recording(tmp_path / "poses.mcap", ARMS["mtml"])
    np.testing.assert_allclose(again.t, np.arange(200), rtol=0, atol=1e-9)
    assert not again.is_motion
    assert again.motion(ARMS["mtml"]) == ""
    np.testing.assert_array_equal(again.tau, poses.tau)


def test_actuator_coordinates_are_converted(tmp_path):
    arm = ARMS["mtml"]
    recording = random_recording(coordinates="actuator")
    write_recording(recording, tmp_path / "a.mcap", arm)
    again = read_recording(tmp_path / "a.mcap", arm)
    np.testing.assert_array_equal(again.tau, recording.in_joint_coordinates(arm).tau)
    np.testing.assert_allclose(again.in_actuator_coordinates(arm).q, recording.q, atol=1e-12)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"t": np.zeros(20)}, r"a\.csv, line 3: t = 0 s is not later than the previous row; .* at least 1 ns"),
        ({"t": np.arange(20) * 1e-10}, r"line 3: t = 1e-10 s is not later"),
        ({"t": np.append(np.arange(19), np.nan)}, r"x\.mcap was not written: .* finite times"),
        ({"t": np.arange(20) * 1e9}, r"x\.mcap was not written: .* up to 2\.14748e\+09 s"),
        ({"q": np.zeros((0, 7)), "t": None, "qd": None, "tau": None}, "has no rows"),
        ({"q": np.zeros((20, 6)), "qd": None, "tau": None}, r"a\.csv has 6 joints, but MTML has 7"),
    ],
)
def test_what_a_bag_cannot_hold_is_refused(tmp_path, change, message):
    recording = replace(random_recording(), source="a.csv", lines=np.arange(20) + 2, **change)
    with pytest.raises(RecordingError, match=message):
        write_recording(recording, tmp_path / "x.mcap", ARMS["mtml"])
    assert list(tmp_path.iterdir()) == []


def test_bag_states_another_instrument(tmp_path):
    arm = load_arm("psm", "CADIERE_FORCEPS_400049")
    recording = Recording(q=np.zeros((3, arm.num_joints)))
    write_recording(recording, tmp_path / "x.mcap", arm)
    same, other = (read_recording(tmp_path / "x.mcap", which) for which in (arm, ARMS["psm"]))
    assert same.arm_name == arm.full_name and not any("instrument" in note for note in same.notes)
    assert any("recorded with the instrument CADIERE_FORCEPS_400049" in note for note in other.notes)


def test_bag_needs_an_arm(tmp_path):
    with pytest.raises(RecordingError, match=r"x\.mcap: an MCAP bag contains joint names, .*: --arm"):
        write_recording(Recording(q=np.zeros((3, 7))), tmp_path / "x.mcap")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("tool", ["mcap", pytest.param("pymcap-cli", marks=pytest.mark.slow)])
def test_command_lines_accept_and_recover_bags(tmp_path, tool):
    """`mcap` is the tool of the format's authors, `pymcap-cli` an independent one with the same commands, from PyPI."""
    program = shutil.which(tool, path=os.pathsep.join([os.path.dirname(sys.executable), os.environ.get("PATH", "")]))
    if program is None:
        pytest.skip(f"the command line {tool} is not installed")

    def run(*arguments):
        return subprocess.run([program, *arguments], cwd=tmp_path, capture_output=True, text=True, check=False)

    arm, recording = ARMS["psm"], random_recording(300)
    write_recording(recording, tmp_path / "once.mcap", arm)
    messages = ArmMessages(arm)
    growing = GrowingMcap(tmp_path / "grown.mcap", messages.topics)
    for k in range(len(recording)):
        # The last row has no transforms.
        stamp = 10**9 + min(k, len(recording) - 2) * 20_000_000 + (k == len(recording) - 1)
        messages.write(growing, stamp, (recording.q[k], recording.qd[k], recording.tau[k]))
    (tmp_path / "killed.mcap").write_bytes((tmp_path / "grown.mcap").read_bytes()[:-1])
    growing.close()
    for name in ("once.mcap", "grown.mcap"):
        assert "measured_js" in run("info", name).stdout
        doctor = run("doctor", name)
        assert doctor.returncode == 0, doctor.stdout + doctor.stderr
    assert run("doctor", "killed.mcap").returncode != 0
    run("recover", "killed.mcap", "-o", "recovered.mcap")  # pymcap-cli returns 3, because data are lost
    # The last chunk was not written, the one before it is damaged, and each chunk ends between arm and jaw.
    recovered = read_recording(tmp_path / "recovered.mcap", arm)
    rows = len(recovered)
    assert rows >= len(recording) - 2 * CHUNK_TIME // 20_000_000
    np.testing.assert_array_equal(recovered.q[:-1], recording.q[: rows - 1])
    np.testing.assert_array_equal(recovered.q[-1, :6], recording.q[rows - 1, :6])
