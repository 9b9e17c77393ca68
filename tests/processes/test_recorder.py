"""Rows that a recorder writes from the messages of an arm, with a clock that the test sets."""

from types import SimpleNamespace

import numpy as np
import pytest
from rosbags.highlevel import AnyReader
from status_logs import ARM, statuses

from dvrk_drake.models.lcm_messages import MessageKey, status_channel
from dvrk_drake.processes import recorder as module
from dvrk_drake.processes.recorder import LcmRecorder
from dvrk_drake.recordings.formats import read_recording

KEY = MessageKey(bytes(range(32)))


@pytest.fixture(params=[".csv", ".log", ".mcap"])
def recorder(request, tmp_path, monkeypatch):
    """Returns a factory of recorders with a function `receive` for a message and its time of arrival [s]."""
    clock = SimpleNamespace(now=100.0)
    monkeypatch.setattr(module.time, "monotonic", lambda: clock.now)

    def make(key=None):
        made = LcmRecorder(ARM, tmp_path / f"a{request.param}", "memq://", key)
        made.path = tmp_path / f"a{request.param}"

        def receive(message, seconds):
            clock.now = 100.0 + seconds
            made._on_message(status_channel(ARM), message if isinstance(message, bytes) else message.encode())

        made.receive = receive
        return made

    return make


def recording_of(recorder):
    recorder._file.close()
    return read_recording(recorder.path, ARM)


def test_first_of_two_arms_with_one_name_is_recorded(recorder):
    made = recorder()
    for k, (first, second) in enumerate(zip(statuses(50), statuses(50, session_id=5), strict=True)):
        made.receive(first, 1e-3 * k)
        made.receive(second, 1e-3 * k)
    assert len(recording_of(made)) == 50
    assert made.notes() == ["messages not recorded, of another session: 50"]


@pytest.mark.parametrize("field", ["sequence", "utime", "session_id"])
def test_spoofed_status_does_not_end_recording(recorder, field):
    made = recorder()
    for k, status in enumerate(statuses(50)):
        made.receive(status, 1e-3 * k)
        if k == 20:
            (spoofed,) = statuses(1, sequence=status.sequence + 1, utime=status.utime + 500)
            setattr(spoofed, field, 2**62)
            made.receive(spoofed, 1e-3 * k)
    assert len(recording_of(made)) == 50
    assert sum(made.foreign.values()) == 1


@pytest.mark.parametrize(("silence", "rows"), [(0.9, 20), (1.1, 40)])
def test_restarted_arm_is_recorded_after_one_second(recorder, silence, rows):
    made, messages = recorder(), statuses(40)
    for k, status in enumerate(messages[:20]):
        made.receive(status, 1e-3 * k)
    for k, status in enumerate(messages[20:]):
        status.session_id = 78
        made.receive(status, 0.019 + silence + 1e-3 * k)
    assert len(recording_of(made)) == rows
    assert made.foreign.total() == 40 - rows


def test_key_accepts_only_signed_statuses(recorder):
    made = recorder(KEY)
    for k, status in enumerate(statuses(50)):
        made.receive(status, 1e-3 * k)
        made.receive(KEY.sign(status.encode()), 1e-3 * k)
    assert len(recording_of(made)) == 50
    assert made.notes() == ["messages not recorded, not signed with this key: 50"]


def test_bag_has_the_commands_and_the_transforms(tmp_path):
    made, sent = LcmRecorder(ARM, tmp_path / "a.mcap", "memq://"), statuses(100)
    for status in sent:
        status.effort_commanded = [2 * effort for effort in status.effort_measured]
        made._on_message(status_channel(ARM), status.encode())
    made._file.close()
    with AnyReader([tmp_path / "a.mcap"]) as bag:
        counts = {topic: info.msgcount for topic, info in bag.topics.items()}
        commands = [
            bag.deserialize(data, connection.msgtype)
            for connection, _, data in bag.messages()
            if connection.topic == "/MTML/setpoint_js"
        ]
    # 100 statuses are 0.1 s: five transforms at 50 Hz.
    assert counts.pop("/tf") == 5
    assert counts == {"/MTML/measured_js": 100, "/MTML/setpoint_js": 100, "/tf_static": 1, "/MTML/robot_description": 1}
    np.testing.assert_array_equal([one.position for one in commands], [one.position_commanded for one in sent])
    np.testing.assert_array_equal([one.effort for one in commands], [one.effort_commanded for one in sent])
