"""Tests LCM logs as recordings: values, notes on omitted messages, and damaged logs."""

import contextlib
import resource

import lcm
import numpy as np
import pytest
from command_output import assert_refused
from mcap.exceptions import EndOfFile
from mcap.reader import make_reader
from mcap.records import Channel, Message
from mcap.stream_reader import StreamReader
from status_logs import ARM, START, N, log_bytes, statuses

from dvrk_drake.errors import RecordingError
from dvrk_drake.lcmtypes import lcmt_dvrk_status as Status
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.recordings import writer_mcap
from dvrk_drake.recordings.formats import read_recording
from dvrk_drake.recordings.reader_lcm import StatusStream, read_events
from dvrk_drake.recordings.writer_stream import check_stream_output, open_recording_file


def write_log(path, *parts):
    path.write_bytes(b"".join(part if isinstance(part, bytes) else log_bytes(part) for part in parts))
    return path


def assert_same_numbers(recording, expected):
    np.testing.assert_array_equal(recording.q, [s.position for s in expected])
    np.testing.assert_array_equal(recording.qd, [s.velocity for s in expected])
    np.testing.assert_array_equal(recording.tau, [s.effort_measured for s in expected])
    np.testing.assert_allclose(recording.t, [1e-6 * (s.utime - expected[0].utime) for s in expected], atol=1e-12)


# Comparison with the reader of LCM.


def test_reads_logs_written_by_lcm(tmp_path):
    log = lcm.EventLog(str(tmp_path / "lcm.log"), "w")
    for status in statuses():
        log.write_event(status.utime + 300, "OTHER", b"noise")
        log.write_event(status.utime + 400, "DVRK_STATUS_MTML", status.encode())
    log.close()
    recording = read_recording(tmp_path / "lcm.log", ARM)
    assert_same_numbers(recording, statuses())
    assert recording.notes == ()
    assert recording.coordinates == "joint"
    assert recording.where(3) == f"{tmp_path}/lcm.log, event 7"
    assert_same_numbers(read_recording(tmp_path / "lcm.log"), statuses())


def test_lcm_reads_logs_of_this_package(tmp_path):
    path = write_log(tmp_path / "a.log", statuses())
    events = list(lcm.EventLog(str(path)))
    own = list(read_events(path, []))
    assert [(e.eventnum, e.timestamp, e.channel, e.data) for e in events] == [tuple(e) for e in own]
    assert [e.data for e in events] == [s.encode() for s in statuses()]


# Damaged logs.


def test_truncated_log_is_read_up_to_its_end(tmp_path):
    whole = log_bytes(statuses(4))
    size = len(whole) // 4
    for length in range(2 * size, 4 * size):
        recording = read_recording(write_log(tmp_path / "cut.log", whole[:length]), ARM)
        assert_same_numbers(recording, statuses(4)[: length // size])
        assert len(recording.notes) == (length % size > 0)
        assert all("incomplete message skipped" in note for note in recording.notes)


@pytest.mark.parametrize(
    ("begin", "replaced", "inserted"),
    [
        (30, 40, b""),
        (20, 4, b"\x7f\xff\xff\xff"),
        (24, 4, b"\x7f\xff\xff\xff"),
        (24, 4, b"\xff\xff\xff\xfb"),
        (0, 4, b"oops"),
    ],
    ids=["bytes missing", "long channel", "long data", "negative length", "no magic"],
)
def test_damaged_event_is_skipped(tmp_path, begin, replaced, inserted):
    whole = log_bytes(statuses(10))
    at = 5 * len(whole) // 10 + begin
    recording = read_recording(write_log(tmp_path / "a.log", whole[:at], inserted, whole[at + replaced :]), ARM)
    # An event is accepted only if another one follows. If the magic number is damaged, the previous event is lost too.
    kept = [k for k in range(10) if k != 5 and not (begin == 0 and k == 4)]
    assert_same_numbers(recording, [statuses(10)[k] for k in kept])
    assert "damaged bytes skipped" in recording.notes[0]
    assert recording.notes[1] == f"messages lost (gaps in the sequence numbers): {10 - len(kept)}"


# Notes on omitted messages.


def changed(k, **changes):
    """Returns statuses in which fields of the k-th status are changed."""
    result = statuses()
    for name, value in changes.items():
        setattr(result[k], name, value)
    return result


@pytest.mark.parametrize(
    ("messages", "note"),
    [
        (changed(7, arm_name="MTMR"), "messages omitted, of another arm or number of joints: 1"),
        ([*statuses()[:7], b"garbage", *statuses()[8:]], "messages omitted, not an lcmt_dvrk_status of version 1.0: 1"),
        (changed(7, utime=START + 2000), "messages omitted, with the time of another one: 1"),
        (changed(7, utime=START - 95_000), "messages omitted, more than 0.1 s before an earlier one: 1"),
        (changed(7, position=[float("nan")] * N), "messages omitted, with a measurement that is not finite: 1"),
        (changed(7, guard_state=Status.STATE_OFF), "messages omitted, with the motors off: 1"),
        ([*statuses()[:7], *statuses()[8:]], "messages lost (gaps in the sequence numbers): 1"),
    ],
)
def test_unusable_statuses_are_omitted_and_noted(tmp_path, messages, note):
    recording = read_recording(write_log(tmp_path / "a.log", messages), ARM)
    assert_same_numbers(recording, [*statuses()[:7], *statuses()[8:]])
    assert any(n.startswith(note) for n in recording.notes), recording.notes


#: Statuses 5 and 6 arrive after status 7.
LATE = [*range(5), 7, 6, 5, *range(8, 20)]


@pytest.mark.parametrize("suffix", [".csv", ".log", ".mcap"])
def test_recording_with_late_statuses_is_in_order(tmp_path, suffix):
    stream, path, messages = StatusStream("MTML", N), tmp_path / f"a{suffix}", statuses(300)
    file = open_recording_file(path, ARM, stream)
    for k in [*LATE, *range(20, 300)]:
        file.write(messages[k].encode(), messages[k].utime, stream.accept(messages[k].encode()))
    file.close()
    assert stream.notes() == ["messages not in order, sorted by their times: 2"]
    assert_same_numbers(read_recording(path, ARM), messages)


def test_restart_is_noted_and_duplicate_arms_are_refused(tmp_path):
    first, second = statuses(20), statuses(20, session_id=78)
    recording = read_recording(write_log(tmp_path / "restart.log", [*first[:9], *second[12:]]), ARM)
    assert_same_numbers(recording, [*first[:9], *second[12:]])
    assert recording.notes == ("restarts of MTML during the recording: 1",)
    mixed = [(first, second)[k % 2][k - k % 2] for k in range(20)]  # the second arm is slightly later
    with pytest.raises(RecordingError, match=r"a\.log: event 2: two processes send statuses of MTML at the same time"):
        read_recording(write_log(tmp_path / "a.log", mixed), ARM)


def test_arm_is_selected_from_several(tmp_path):
    other = log_bytes(statuses(5, arm_name="MTMR"), "DVRK_STATUS_MTMR")
    path = write_log(tmp_path / "both.log", other, statuses(), other)
    assert_same_numbers(read_recording(path, ARM), statuses())
    assert len(read_recording(path, load_arm("mtmr"))) == 5
    with pytest.raises(RecordingError, match=r"statuses of several arms \(DVRK_STATUS_MTML, DVRK_STATUS_MTMR\)"):
        read_recording(path)


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        (
            [log_bytes([b"x"] * 3, "POSE")],
            r"no status of MTML \(channel DVRK_STATUS_MTML\)\. Channels in the log: POSE \(3\)",
        ),
        ([log_bytes([b"x"])[:20]], "Channels in the log: none"),
        ([[b"x"] * 3], "none of the 3 messages on channel DVRK_STATUS_MTML is usable: .*not an lcmt_dvrk_status.*: 3"),
        ([statuses(guard_state=Status.STATE_OFF)], "none of the 20 messages .* with the motors off: 20"),
        ([b""], "is empty"),
    ],
)
def test_log_without_the_arm_lists_its_arms(tmp_path, parts, message):
    assert_refused(RecordingError, message, read_recording, write_log(tmp_path / "a.log", *parts), ARM)


def test_a_log_is_in_joint_coordinates(tmp_path):
    with pytest.raises(RecordingError, match="an LCM log is in joint coordinates, not in actuator"):
        read_recording(write_log(tmp_path / "a.log", statuses()), ARM, "actuator")


# Files that are written during a recording.


@pytest.mark.parametrize("suffix", [".csv", ".log"])
def test_file_is_complete_after_each_message(tmp_path, suffix):
    stream = StatusStream("MTML", N)
    path = tmp_path / f"a{suffix}"
    file = open_recording_file(path, ARM, stream)
    messages = changed(7, guard_state=Status.STATE_OFF)
    for k, message in enumerate(messages):
        data = message.encode()
        file.write(data, message.utime + 500, stream.accept(data))
        assert_same_numbers(read_recording(path, ARM), [m for m in messages[: k + 1] if m.guard_state])
    file.close()
    with pytest.raises(RecordingError, match=r"nowhere\.csv cannot be written: "):
        check_stream_output("/proc/self/nowhere.csv")  # a folder that is not writable
    with pytest.raises(RecordingError, match="already exists, and a recording is never overwritten"):
        open_recording_file(path, ARM, stream)


def test_unwritable_outputs_are_refused(tmp_path):
    for name, message in {
        "a.txt": r"must end in \.csv or \.mcap or \.log",
        "no/a.csv": "its folder does not exist",
    }.items():
        assert_refused(RecordingError, message, open_recording_file, tmp_path / name, ARM, StatusStream("MTML", N))


def messages_in(path, topic=""):
    """Returns the number of complete messages on topics that end with `topic`, of a bag that may have no end."""
    count, measured = 0, set()
    with path.open("rb") as file, contextlib.suppress(EndOfFile):
        for record in StreamReader(file).records:
            if isinstance(record, Channel) and record.topic.endswith(topic):
                measured.add(record.id)
            count += isinstance(record, Message) and record.channel_id in measured
    return count


def test_bag_grows_by_chunks_and_has_an_index_at_the_end(tmp_path, monkeypatch):
    monkeypatch.setattr(writer_mcap, "CHUNK_TIME", 2_000_000)
    stream, path, messages = StatusStream("MTML", N), tmp_path / "a.mcap", changed(7, guard_state=Status.STATE_OFF)
    used = [m for m in messages if m.guard_state != Status.STATE_OFF]
    file = open_recording_file(path, ARM, stream)
    for message in messages:
        data = message.encode()
        file.write(data, message.utime + 500, stream.accept(data))
        old = [m for m in used if m.utime <= stream.last.utime - 2000]
        assert messages_in(path, "/measured_js") >= len(old)
    killed = tmp_path / "killed.mcap"
    killed.write_bytes(path.read_bytes())
    file.close()
    assert_same_numbers(read_recording(path, ARM), used)
    with path.open("rb") as bag:
        reader = make_reader(bag, validate_crcs=True)
        assert len(reader.get_summary().chunk_indexes) > 5
        logged = [
            (message.publish_time, message.log_time)
            for _, channel, message in reader.iter_messages()
            if channel.topic.endswith("/measured_js")
        ]
    assert logged == [(1000 * m.utime, 1000 * m.utime + 500_000) for m in used]
    with pytest.raises(
        RecordingError, match=r"killed\.mcap: the bag cannot be read .* `mcap recover` can repair it\.$"
    ):
        read_recording(killed, ARM)


def test_time_that_ros_cannot_represent_is_refused(tmp_path):
    stream = StatusStream("MTML", N)
    file = open_recording_file(tmp_path / "a.mcap", ARM, stream)
    (message,) = statuses(1, utime=0)
    with pytest.raises(RecordingError, match="time of a measurement is 0 s; a bag needs times above 0 s"):
        file.write(message.encode(), 1, stream.accept(message.encode()))
    file.close()


@pytest.mark.parametrize("suffix", [".csv", ".log", ".mcap"])
def test_full_disk_ends_the_file_with_a_complete_row(tmp_path, monkeypatch, suffix):
    monkeypatch.setattr(writer_mcap, "CHUNK_TIME", 0)
    stream = StatusStream("MTML", N)
    path = tmp_path / f"a{suffix}"
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    file = open_recording_file(path, ARM, stream)
    # A bag begins with the URDF.
    for message in statuses(40)[:10]:
        file.write(message.encode(), message.utime, stream.accept(message.encode()))
    size = max(5000, path.stat().st_size + 2000)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, limits[1]))
    try:
        with pytest.raises(RecordingError, match="cannot be written: "):
            for message in statuses(40)[10:]:
                file.write(message.encode(), message.utime, stream.accept(message.encode()))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    file.close()
    recording = read_recording(path, ARM)
    assert 5 < len(recording) < 40
    assert recording.notes == ()
    assert_same_numbers(recording, statuses(40)[: len(recording)])
