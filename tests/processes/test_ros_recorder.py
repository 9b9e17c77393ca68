"""`record --transport ros`: real processes over DDS on the loopback interface, and messages of a substitute domain."""

import os
import subprocess
import sys
import time
from types import SimpleNamespace
from unittest.mock import ANY

import numpy as np
import pytest
from arm_processes import dvrk_drake
from command_output import assert_refused
from ros_publisher import DOMAIN_FILE, PERIOD, START, rows
from rosbags.highlevel import AnyReader
from waiting import TIMEOUT

from dvrk_drake.errors import DvrkDrakeError, RecordingError
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.processes import recorder as module
from dvrk_drake.processes.recorder import RosRecorder, missing_messages
from dvrk_drake.recordings.formats import read_recording
from dvrk_drake.systems.ros import discovery
from dvrk_drake.systems.ros.open_domain import domain_number

messages_module = pytest.importorskip("dvrk_drake.systems.ros.messages", reason="needs cyclonedds")
pytestmark = pytest.mark.network

JointState, Header, Time = messages_module.JointState, messages_module.Header, messages_module.Time

PSM = load_arm("psm")
JOINTS = list(PSM.joint_names)
TOPIC, JAW = "/PSM1/measured_js", "/PSM1/jaw/measured_js"


@pytest.fixture(params=["reliable", "best effort"])
def publisher(request, monkeypatch):
    """Starts a publisher in a domain of its own, and returns the number of the domain."""
    monkeypatch.setenv("CYCLONEDDS_URI", DOMAIN_FILE)
    domain = 1
    script = os.path.join(os.path.dirname(__file__), "../support/ros_publisher.py")
    process = subprocess.Popen([sys.executable, script, str(domain), request.param], stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout.readline() == "publishing\n"
        yield domain
    finally:
        process.kill()
        process.communicate(timeout=TIMEOUT)


def test_recording_has_the_published_numbers(publisher, tmp_path):
    path = tmp_path / "reach.mcap"
    done = dvrk_drake("record", path, "--arm", "psm", "--transport", "ros", "--duration", "1", "--domain", publisher)
    assert done.wait() == 0, done.output()
    assert f"recording PSM on ROS domain {publisher}" in done.output()
    assert "messages with header stamp 0, which marks invalid data: " in done.output()
    recording = read_recording(path, PSM)
    assert len(recording) > 100
    first = next(k for k in range(100_000) if np.array_equal(rows(k)[0, :6], recording.q[0, :6]))
    numbers = first + np.rint(recording.t / (PERIOD / 1e9)).astype(int)
    np.testing.assert_allclose(recording.t, (numbers - first) * PERIOD / 1e9, rtol=0, atol=1e-9)
    published = np.array([rows(k) for k in numbers])
    for block, name in enumerate(("q", "qd", "tau")):
        recorded = getattr(recording, name)
        np.testing.assert_array_equal(recorded[:, :6], published[:, block, :6])
        # Within 50 ms of the ends, a message of the arm may have no message of its jaw.
        np.testing.assert_array_equal(recorded[10:-10, 6], published[10:-10, block, 6])
    # Nothing is lost on the loopback unless the computer is overloaded.
    assert len(recording) >= 0.95 * (numbers[-1] - numbers[0] + 1)


def test_messages_that_dds_overwrites_are_counted(publisher, tmp_path, monkeypatch):
    """The recorder is stopped several times, so that messages arrive that do not fit into the history of DDS."""
    monkeypatch.setattr(module, "_DEPTH", 5)
    recorder, pauses = RosRecorder(PSM, tmp_path / "a.mcap", "/dvrk/PSM1", publisher), iter((40, 80, 81, 120))
    pause, last = next(pauses), 160

    def show(text):
        nonlocal pause
        if recorder.num_rows >= pause:
            pause = next(pauses, np.inf)
            time.sleep(0.2)  # 40 messages of each topic

    recorder.run(np.inf, lambda: recorder.num_rows >= last, show)
    missing = 0
    with AnyReader([tmp_path / "a.mcap"]) as bag:
        for topic in ("/dvrk/PSM1/measured_js", "/dvrk/PSM1/jaw/measured_js"):
            connections = [each for each in bag.connections if each.topic == topic]
            stamps = [bag.deserialize(data, c.msgtype).header.stamp for c, _, data in bag.messages(connections)]
            k = [(stamp.sec * 10**9 + stamp.nanosec - START) / PERIOD for stamp in stamps if stamp.sec]
            missing += round(k[-1] - k[0]) + 1 - len(k)
    assert missing > 4 * 2 * 20
    line = f"messages missing (gaps of the time stamps): {missing}, longest gap 0."
    assert recorder.notes()[0].startswith(line)


def stamps(count, period=1_000_000, jitter=0.0, loop=1):
    """Returns time stamps [ns] of messages that a loop of another period publishes with jitter."""
    late = np.random.default_rng(0).uniform(0, jitter, count)
    return (np.floor(np.arange(count) * period / loop) * loop + period * late).astype(int) + START


@pytest.mark.parametrize(
    "times",
    [stamps(1000), stamps(1000, jitter=0.4), stamps(1000, loop=666_667), stamps(1000, loop=400_000), stamps(2)],
    ids=["exact", "jitter", "slow loop", "loop", "two"],
)
def test_missing_messages_are_counted_with_jitter(times):
    removed = {*range(300, 345), 500, 700, 702} if len(times) > 2 else set()
    received = np.repeat([time for k, time in enumerate(times) if k not in removed], 2)
    assert (missing_messages(times)[0], missing_messages(received)[0]) == (0, len(removed))


def test_clock_that_is_set_back_is_no_gap():
    assert missing_messages([*stamps(50), *(stamps(50) - 10**12)]) == (0, pytest.approx(1e-3, abs=1e-9))


def message(k, joints=slice(0, 6), names=JOINTS, stamp=None):
    """Returns message k of `ros_publisher` and its time of publication."""
    stamp = START + k * PERIOD if stamp is None else stamp
    q, qd, tau = rows(k)[:, joints].tolist()
    return JointState(Header(Time(*divmod(stamp, 10**9)), ""), list(names[joints]), q, qd, tau), START + k * PERIOD


class SubstituteDomain:
    """Delivers one message of each topic per call of `take`."""

    name = "ROS domain 0"

    def __init__(self, messages):
        self._messages = messages

    def joint_state_topics(self):
        return dict.fromkeys(self._messages, True)

    def subscribe(self, topic, message_type, *, depth, reliable):
        pending = iter(self._messages.get(topic, ()))
        return SimpleNamespace(topic=topic, take=lambda: [m for m in [next(pending, None)] if m])

    def wait(self, seconds):
        pass

    def wait_until(self, condition, seconds):
        return condition()

    def close(self):
        pass


@pytest.fixture
def record(tmp_path, monkeypatch):
    """Records the messages of a substitute domain and returns the recorder and the status lines."""
    monkeypatch.setattr(discovery, "_OTHERS", 0.0)
    monkeypatch.setattr(discovery, "_DISCOVERY", 1.0)
    monkeypatch.setattr(module, "FIRST_STATUS", 0.5)

    def run(messages, **options):
        monkeypatch.setattr(module, "open_ros_domain", lambda domain: SubstituteDomain(messages))
        recorder = RosRecorder(PSM, tmp_path / "a.mcap", **options)
        lines = []
        recorder.run(0.3, lambda: False, lambda text: lines.append(text()))
        return recorder, lines

    return run


def test_invalid_messages_do_not_start_the_recording(record, tmp_path):
    invalid = (JointState(), START)
    recorder, lines = record(
        {TOPIC: [invalid, invalid, *map(message, range(9))], JAW: [message(k, slice(6, 7)) for k in range(-2, 9)]}
    )
    assert lines[0] == f"waiting for a valid message on {TOPIC}"
    assert recorder.num_rows == 9
    assert recorder.notes() == ["messages with header stamp 0, which marks invalid data: 2"]
    assert len(read_recording(tmp_path / "a.mcap", PSM)) == 9
    with AnyReader([tmp_path / "a.mcap"]) as bag:
        counts = {topic: info.msgcount for topic, info in bag.topics.items()}
    assert counts == {TOPIC: 9, JAW: 9, "/tf": ANY, "/tf_static": 1, "/PSM1/robot_description": 1}
    assert 1 <= counts["/tf"] <= 9


def test_missing_jaw_is_noted(record):
    recorder, lines = record({TOPIC: [message(k) for k in range(9)]})
    assert any(line.endswith(f" Hz, no message on {JAW}") for line in lines)
    assert recorder.notes() == [f"no message on {JAW}; commands of dvrk-drake need this topic"]


@pytest.mark.parametrize(
    ("messages", "options", "error"),
    [
        ({TOPIC: [message(0, names=["disc"] * 7)]}, {}, "has the joints disc, .*; PSM also needs yaw, pitch"),
        ({TOPIC: [(JointState(), 1)] * 4}, {}, "all 4 messages have header stamp 0 .* Home the arm first"),
        ({TOPIC: []}, {}, f"no message within 0 s on {TOPIC} of ROS domain 0"),
        ({TOPIC: [], "/PSM2/measured_js": []}, {}, "several topics fit PSM: /PSM1/measured_js, /PSM2/measured_js"),
        ({TOPIC: []}, {"topic": "/PSM3"}, r"has no JointState topic /PSM3\. Topics .*: /PSM1/measured_js\."),
        ({TOPIC: []}, {"topic": "/MTML"}, "/MTML is the namespace of the arm MTML, not of PSM. Choose --arm mtml"),
        ({}, {}, "no topic /PSM/measured_js within 1 s. Start the dVRK's console"),
    ],
)
def test_what_cannot_be_recorded_is_refused(record, tmp_path, messages, options, error):
    assert_refused(RecordingError, error, record, messages, **options)
    assert list(tmp_path.iterdir()) == []


def test_wrong_arguments_are_refused(tmp_path, monkeypatch):
    assert_refused(RecordingError, r"a\.csv: the file name must end in \.mcap", RosRecorder, PSM, tmp_path / "a.csv")
    for domain in ("-1", "233", "x"):
        monkeypatch.setenv("ROS_DOMAIN_ID", domain)
        assert_refused(DvrkDrakeError, f"ROS domain {domain}: allowed: 0 to 232", domain_number)
    monkeypatch.setitem(sys.modules, "cyclonedds", None)
    with pytest.raises(DvrkDrakeError, match=r"needs the package cyclonedds: pip install cyclonedds"):
        RosRecorder(PSM, tmp_path / "a.mcap")
