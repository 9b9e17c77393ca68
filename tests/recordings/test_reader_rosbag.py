"""ROS bags: the same numbers as were written, joints by name, the jaw by time, and one line for what cannot be read."""

import re

import numpy as np
import pytest
import yaml
from bags import KINDS, joint_states, write_bag
from command_output import assert_refused
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import CompressionFormat, CompressionMode

from dvrk_drake.errors import RecordingError
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.models.locked_joints import lock_joints
from dvrk_drake.recordings.formats import detect_format, read_recording

START = 1_700_000_000_000_000_000


MTM = load_arm("mtml")
PSM = load_arm("psm")


def blocks(rows, joints, seed=0):
    return np.random.default_rng(seed).uniform(-0.2, 0.2, (3, rows, joints))


def stamps(rows, period=0.01):
    return START + np.arange(rows) * round(1e9 * period)


def mtm_bag(folder, rows=5, kind="mcap", names=MTM.joint_names, times=None, **options):
    """Writes a bag of an MTM with random numbers. Returns its path and the numbers (3, rows, n)."""
    numbers, times = blocks(rows, len(names)), stamps(rows) if times is None else times
    return write_bag(folder, kind, {"/MTML/measured_js": joint_states(times, names, *numbers)}, **options), numbers


COMPRESSIONS = [
    ("ros1", (Ros1Writer.CompressionFormat.LZ4,)),
    ("ros1", (Ros1Writer.CompressionFormat.BZ2,)),
    ("sqlite3", (CompressionMode.MESSAGE, CompressionFormat.ZSTD)),
    ("mcap", (CompressionMode.STORAGE, CompressionFormat.ZSTD)),
]


@pytest.mark.parametrize(("kind", "compression"), [*((kind, None) for kind in KINDS), *COMPRESSIONS])
def test_reads_the_numbers_that_were_written(tmp_path, kind, compression):
    options = {} if compression is None else {"compression": compression}
    path, (q, qd, tau) = mtm_bag(tmp_path, 20, kind, **options)
    assert detect_format(path).name == "a ROS bag"
    states = read_recording(path, MTM)
    np.testing.assert_array_equal(states.q, q)
    np.testing.assert_array_equal(states.qd, qd)
    np.testing.assert_array_equal(states.tau, tau)
    np.testing.assert_allclose(states.t, 0.01 * np.arange(20), atol=1e-12)
    assert not states.notes


def test_orders_joints_by_name_and_ignores_others(tmp_path):
    path, (q, _, _) = mtm_bag(tmp_path, names=("gripper", *MTM.joint_names[::-1]))
    np.testing.assert_array_equal(read_recording(path, MTM).q, q[:, :0:-1])


def test_joins_the_jaw_of_a_psm_by_time(tmp_path):
    q, qd, tau = blocks(40, 6)
    arm = joint_states(stamps(40), PSM.joint_names[:6], q, qd, tau)
    # A jaw whose position is the time, at another rate and phase: linear interpolation is exact.
    jaw_stamps = START + 3_000_000 + np.arange(20) * 15_000_000
    ramp = 1e-9 * (jaw_stamps - START)[:, None]
    jaw = joint_states(jaw_stamps, ["jaw"], ramp, ramp, ramp)
    path = write_bag(tmp_path, "mcap", {"/PSM1/measured_js": arm, "/PSM1/jaw/measured_js": jaw})
    states = read_recording(path, PSM)
    inside = slice(1, 29)
    row = np.searchsorted(states.lines, np.arange(40)[inside] + 1)
    np.testing.assert_allclose(states.q[row, 6], 0.01 * np.arange(40)[inside], atol=1e-9)
    np.testing.assert_array_equal(states.q[row, :6], q[inside])
    assert any("no message of the jaw" in note for note in states.notes)


def test_names_the_missing_topic_of_the_jaw(tmp_path):
    q, qd, tau = blocks(5, 6)
    path = write_bag(tmp_path, "mcap", {"/PSM1/measured_js": joint_states(stamps(5), PSM.joint_names[:6], q, qd, tau)})
    assert_refused(RecordingError, r"also needs jaw\. Record /PSM1/jaw/measured_js as well", read_recording, path, PSM)


def test_locked_joints_are_absent_or_held(tmp_path):
    locked = lock_joints(PSM, {"roll": 0, "wrist_pitch": 0, "wrist_yaw": 0, "jaw": 0})
    q, qd, tau = blocks(5, 3)
    path = write_bag(tmp_path, "mcap", {"/PSM1/measured_js": joint_states(stamps(5), PSM.joint_names[:3], q, qd, tau)})
    np.testing.assert_array_equal(read_recording(path, locked).q, q)
    assert_refused(RecordingError, "--locked roll=0 wrist_pitch=0 wrist_yaw=0 jaw=0", read_recording, path, PSM)
    q, qd, tau = blocks(5, 6)
    for name, wrist in (("held", 0.01), ("moved", 0.1)):
        q[:, 3:] = wrist * np.sin(np.arange(15).reshape(5, 3))
        (tmp_path / name).mkdir()
        rows = joint_states(stamps(5), PSM.joint_names[:6], q, qd, tau)
        path = write_bag(tmp_path / name, "mcap", {"/PSM1/measured_js": rows})
        if name == "held":
            np.testing.assert_array_equal(read_recording(path, locked).tau, tau[:, :3])
            assert_refused(RecordingError, "--locked wrist_pitch=0 wrist_yaw=0 jaw=0", read_recording, path, PSM)
        else:
            with pytest.raises(RecordingError, match=r"--locked states .*=0, but the recorded positions are"):
                read_recording(path, locked)


def test_reads_the_named_arm_of_several(tmp_path):
    first, second = blocks(5, 7, seed=1), blocks(5, 7, seed=2)
    topics = {
        "/PSM1/measured_js": joint_states(stamps(5), PSM.joint_names, *first),
        "/PSM2/measured_js": joint_states(stamps(5), PSM.joint_names, *second),
    }
    path = write_bag(tmp_path, "mcap", topics)
    with pytest.raises(RecordingError, match=r"several topics fit PSM: /PSM1/measured_js, /PSM2/measured_js"):
        read_recording(path, PSM)
    for topic in ("/PSM2", "/PSM2/measured_js"):
        np.testing.assert_array_equal(read_recording(path, PSM, topic=topic).q, second[0])


@pytest.mark.parametrize("absent", [[0], [3, 7], [9]])
def test_velocities_of_some_messages_are_noted(tmp_path, absent):
    q, qd, tau = blocks(10, 7)
    rows = joint_states(stamps(10), MTM.joint_names, q, qd, tau)
    for row in absent:
        rows[row] = (*rows[row][:3], np.empty(0), rows[row][4])
    states = read_recording(write_bag(tmp_path, "mcap", {"/MTML/measured_js": rows}), MTM)
    assert states.qd is None
    np.testing.assert_array_equal(states.tau, tau)
    assert states.notes == (f"velocities of /MTML/measured_js not used: {len(absent)} of 10 messages have none",)


def test_velocities_of_only_the_arm_are_noted(tmp_path):
    q, qd, tau = blocks(5, 7)
    arm = joint_states(stamps(5), PSM.joint_names[:6], q[:, :6], qd[:, :6], tau[:, :6])
    jaw = joint_states(stamps(5), ["jaw"], q[:, 6:], tau=tau[:, 6:])
    states = read_recording(write_bag(tmp_path, "mcap", {"/PSM1/measured_js": arm, "/PSM1/jaw/measured_js": jaw}), PSM)
    assert states.qd is None and states.notes == (
        "velocities of /PSM1/measured_js not used: the topic of the jaw has none",
    )


def test_messages_that_are_not_in_order_are_sorted(tmp_path):
    """Each message is delayed by up to 60 ms, as by a network."""
    q, qd, tau = blocks(200, 7)
    times = stamps(200)
    order = np.argsort(times + np.random.default_rng(0).integers(0, 60_000_000, 200))
    rows = joint_states(times, MTM.joint_names, q, qd, tau)
    states = read_recording(write_bag(tmp_path, "mcap", {"/MTML/measured_js": [rows[i] for i in order]}), MTM)
    np.testing.assert_array_equal(states.q, q)
    np.testing.assert_array_equal(states.tau, tau)
    np.testing.assert_array_equal(states.lines, np.argsort(order) + 1)
    late = np.sum(times[order] < np.maximum.accumulate(times[order]))
    assert late > 40
    assert states.notes == (
        f"{late} messages of /MTML/measured_js were not in order, and are sorted by their header stamps",
    )


def test_reads_a_bag_of_two_files(tmp_path):
    """`ros2 bag record --max-bag-size` splits a bag. The file metadata.yaml lists its parts."""
    q, qd, tau = blocks(20, 7)
    rows, parts = joint_states(stamps(20), MTM.joint_names, q, qd, tau), []
    for number, part in enumerate((rows[:12], rows[12:])):
        (tmp_path / f"{number}").mkdir()
        parts.append(write_bag(tmp_path / f"{number}", "mcap", {"/MTML/measured_js": part}, begin=12 * number))
    folder = parts[0].parent
    parts[1].rename(folder / "poses_1.mcap")
    metadata = yaml.safe_load((folder / "metadata.yaml").read_text())
    metadata["rosbag2_bagfile_information"]["relative_file_paths"].append("poses_1.mcap")
    (folder / "metadata.yaml").write_text(yaml.safe_dump(metadata))
    np.testing.assert_array_equal(read_recording(folder, MTM).tau, tau)
    (folder / "metadata.yaml").unlink()  # the recorder was killed
    merged = read_recording(folder, MTM)
    np.testing.assert_array_equal(merged.tau, tau)
    assert merged.notes[0] == "no metadata.yaml: poses.mcap, poses_1.mcap were read as parts of one bag"
    (folder / "poses_2.mcap").write_bytes((folder / "poses_1.mcap").read_bytes()[:500])
    assert_refused(RecordingError, "the bag cannot be read", read_recording, folder, MTM)


def test_joint_names_of_a_psm_before_2024(tmp_path):
    q, qd, tau = blocks(5, 7)
    names = [f"outer_{name}" for name in PSM.joint_names[:6]]
    topics = {
        "/PSM2/measured_js": joint_states(stamps(5), names, q[:, :6], qd[:, :6], tau[:, :6]),
        "/PSM2/jaw/measured_js": joint_states(stamps(5), ["jaw"], q[:, 6:], qd[:, 6:], tau[:, 6:]),
    }
    states = read_recording(write_bag(tmp_path, "ros1", topics), PSM)
    np.testing.assert_allclose(states.q, q, atol=1e-12)
    assert len(states.notes) == 1
    assert states.notes[0].startswith("joints outer_yaw, outer_pitch,") and "read as yaw, pitch," in states.notes[0]


def test_joint_names_can_be_stated(tmp_path):
    names = [f"joint{i}" for i in range(7)]
    path, (q, _, _) = mtm_bag(tmp_path, names=names)
    stated = dict(zip(MTM.joint_names, names[::-1], strict=True))
    np.testing.assert_array_equal(read_recording(path, MTM, joints=stated).q, q[:, ::-1])
    for joints, match in (
        ({"outer_yaw": "joint9"}, "has no joint joint9 of --joints; its joints: joint0, joint1"),
        ({"yaw": "joint0"}, "--joints yaw=joint0: MTML has no joint yaw; allowed: outer_yaw"),
        ({"outer_yaw": "joint0", "elbow_pitch": "joint0"}, "joint0 is used for two joints of MTML"),
    ):
        assert_refused(RecordingError, match, read_recording, path, MTM, joints=joints)


def test_refuses_the_namespace_of_another_arm(tmp_path):
    q, qd, tau = blocks(5, 7)
    topics = {f"{name}/measured_js": joint_states(stamps(5), MTM.joint_names, q, qd, tau) for name in ("/MTML", "/m")}
    path = write_bag(tmp_path, "mcap", topics)
    other = load_arm("mtmr")
    for topic in ("/MTML", "/MTML/measured_js"):
        with pytest.raises(RecordingError, match=r"/MTML is the namespace of the arm MTML, not of MTMR"):
            read_recording(path, other, topic=topic)
    np.testing.assert_array_equal(read_recording(path, other, topic="/m").q, q)


def test_omits_invalid_and_repeated_stamps(tmp_path):
    times = stamps(10)
    times[0], times[5] = 0, times[4]
    path, (q, _, _) = mtm_bag(tmp_path, 10, times=times)
    states = read_recording(path, MTM)
    np.testing.assert_array_equal(states.lines, [2, 3, 4, 5, 7, 8, 9, 10])
    np.testing.assert_array_equal(states.q, q[states.lines - 1])
    assert [note.partition(" omitted")[0] for note in states.notes] == [
        "1 messages of /MTML/measured_js",
        "1 messages of /MTML/measured_js",
    ]


def damaged(mtm):
    """(topics, expected text) of bags that must be refused."""
    q, qd, tau = blocks(10, 7)
    names, topic = mtm.joint_names, "/MTML/measured_js"
    bad = tau.copy()
    bad[3, 6] = np.nan
    still = np.full(10, START)
    yield (
        {"/MTMR/measured_js": joint_states(stamps(10), names, q, qd, tau)},
        r"no topic /MTML/measured_js.*MTMR/measured_js \(10\)",
    )
    yield {topic: joint_states(stamps(10), names, q, qd, bad)}, "message 4 .*effort of wrist_roll is nan"
    yield {topic: joint_states(stamps(10), names[:6], q[:, :6])}, "also needs wrist_roll"
    yield {topic: joint_states(stamps(10), [f"joint{i}" for i in range(7)], q)}, "Check --arm and --topic"
    yield {topic: joint_states(stamps(10), names, (), qd, tau)}, "has no positions"
    yield {topic: joint_states(stamps(10), names, q[:, :5], qd, tau)}, "5 numbers in `position`, but 7 joints"
    yield {topic: joint_states(stamps(10), (), q)}, "names no joints"
    yield {topic: joint_states(stamps(10), [names[0]] * 7, q)}, "names a joint twice"
    yield ({topic: joint_states(still, names, q, qd, tau)}, "do not increase in 9 of 10 messages")
    yield {topic: joint_states(np.zeros(10), names, q, qd, tau)}, "no usable message.*header stamp 0"
    yield {topic: []}, "no messages"
    yield {}, "JointState messages: none"
    mixed = joint_states(stamps(10), names, q, qd, tau)
    mixed[7] = (*mixed[7][:1], list(names[::-1]), *mixed[7][2:])
    yield {topic: mixed}, "message 8 .*Choose a topic with one publisher"


@pytest.mark.parametrize("case", range(13))
def test_refuses_unusable_bags_with_one_line(tmp_path, case):
    topics, text = list(damaged(MTM))[case]
    path = write_bag(tmp_path, "mcap", topics)
    with pytest.raises(RecordingError, match=text) as caught:
        read_recording(path, MTM)
    assert "\n" not in str(caught.value) and str(path) in str(caught.value)


def test_can_omit_numbers_that_are_not_finite(tmp_path):
    q, qd, tau = blocks(10, 7)
    tau[3, 6] = np.inf
    path = write_bag(tmp_path, "mcap", {"/MTML/measured_js": joint_states(stamps(10), MTM.joint_names, q, qd, tau)})
    states = read_recording(path, MTM, skip_invalid=True)
    assert 4 not in states.lines and len(states.t) == 9


@pytest.mark.parametrize("kind", KINDS)
def test_refuses_truncated_and_damaged_bags_with_one_line(tmp_path, kind):
    path, _ = mtm_bag(tmp_path, 300, kind)
    file = next(path.glob("*.db3")) if path.is_dir() else path
    content = file.read_bytes()
    generator = np.random.default_rng(0)
    for cut in (16, 20, len(content) // 3, len(content) // 2):
        file.write_bytes(content[:cut])
        with pytest.raises(RecordingError) as caught:
            read_recording(path, MTM)
        assert "\n" not in str(caught.value)
    # A damaged byte may be a number that is still valid; anything else must be a refusal.
    for _ in range(40):
        flipped = bytearray(content)
        for place in generator.integers(16, len(content), 3):
            flipped[place] ^= 1 << generator.integers(8)
        file.write_bytes(bytes(flipped))
        try:
            states = read_recording(path, MTM)
        except RecordingError as error:
            assert "\n" not in str(error)
        else:
            assert states.q.shape[1] == 7


@pytest.mark.parametrize("jump", [-0.08, -5.0, -100.0, 3600.0])
def test_refuses_a_clock_that_was_set(tmp_path, jump):
    """A jump forward in one message makes the next message earlier. A small jump backward repeats a time span."""
    times = stamps(40)
    times[26 : 27 if jump > 0 else 40] += round(1e9 * jump) + 3_000_000
    path, _ = mtm_bag(tmp_path, 40, times=times)
    late = 28 if jump > 0 else 27
    with pytest.raises(RecordingError, match=f"message {late} is .* s before that of message {late - 1}"):
        read_recording(path, MTM)


def test_ignores_setup_joints_and_missing_slashes(tmp_path):
    q, qd, tau = blocks(5, 7)
    rows = joint_states(stamps(5), PSM.joint_names, q, qd, tau)
    setup = joint_states(stamps(5), [f"setup_{i}" for i in range(4)], q[:, :4])
    path = write_bag(tmp_path, "mcap", {"/SUJ/PSM1/measured_js": setup, "/PSM1/measured_js": rows})
    for topic in (None, "PSM1", "PSM1/measured_js", "/PSM1/"):
        np.testing.assert_array_equal(read_recording(path, PSM, topic=topic).q, q)


def test_refuses_efforts_of_some_messages_or_joints(tmp_path):
    q, qd, tau = blocks(5, 7)
    rows = joint_states(stamps(5), MTM.joint_names, q, qd, tau)
    rows[0] = (*rows[0][:4], np.empty(0))
    path = write_bag(tmp_path, "ros1", {"/MTML/measured_js": rows})
    with pytest.raises(RecordingError, match=r"message 1 of /MTML/measured_js has no effort, but message 2 has"):
        read_recording(path, MTM)
    arm = joint_states(stamps(5), PSM.joint_names[:6], q[:, :6], qd[:, :6], tau[:, :6])
    jaw = joint_states(stamps(5), ["jaw"], q[:, 6:], qd[:, 6:])
    path = write_bag(tmp_path, "mcap", {"/PSM1/measured_js": arm, "/PSM1/jaw/measured_js": jaw})
    with pytest.raises(RecordingError, match="topic of the jaw has no efforts, but the topic of the arm has"):
        read_recording(path, PSM)


@pytest.mark.parametrize("kind", ["ros1", "mcap"])
@pytest.mark.parametrize("name", ["motion.MCAP", "motion.dat"])
def test_reads_a_bag_with_another_suffix(tmp_path, kind, name):
    path, (q, _, _) = mtm_bag(tmp_path, kind=kind)
    path = path.rename(tmp_path / name)
    np.testing.assert_array_equal(read_recording(path, MTM).q, q)
    path.write_bytes(path.read_bytes()[:100])
    with pytest.raises(RecordingError, match=re.escape(f"{path}: the bag cannot be read")) as caught:
        read_recording(path, MTM)
    assert "bag.bag" not in str(caught.value) and "bag.mcap" not in str(caught.value)  # names of the link
