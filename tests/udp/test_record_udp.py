"""`dvrk-drake record` beside LCM's own lcm-logger and lcm-logplayer, all real processes on a network of their own."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import lcm
import numpy as np
import pytest
from own_network import end, inside, outside, run_inside, start
from status_logs import ARM, log_bytes, statuses

from dvrk_drake.lcmtypes import lcmt_dvrk_status as Status
from dvrk_drake.models.lcm_log import LcmLogReader
from dvrk_drake.models.recording import read_recording
from dvrk_drake.models.status_stream import measurements

TOOLS = Path(lcm.__file__).parents[1] / "bin"  # the programs themselves: those on the PATH start them as children
COLUMNS = [f"{prefix}{i + 1}" for prefix in ("q", "qd", "tau") for i in range(7)]


@outside
def test_in_a_network_of_its_own():
    if not (TOOLS / "lcm-logger").exists():
        pytest.skip(f"no {TOOLS}/lcm-logger: the lcm wheel ships it")
    run_inside(__file__)


def start_record(path, *options, arm="mtml"):
    """A recorder that listens already."""
    process = start(sys.executable, "-m", "dvrk_drake.cli", "record", str(path), "--arm", arm, *options)
    line = process.stdout.readline()
    assert line.startswith(f"recording {arm.upper()} on LCM udpm://239.255.76.67:76"), line
    return process


def start_logger(path):
    process = start(str(TOOLS / "lcm-logger"), "--quiet", str(path))
    deadline, publisher = time.monotonic() + 20, lcm.LCM()
    while not (path.exists() and path.stat().st_size):
        publisher.publish("BEGIN", b"")  # it flushes ten times a second, so then it listens
        time.sleep(0.05)
        assert time.monotonic() < deadline
    return process


def by_utime(path):
    """{utime: measurements} of a recorded file, CSV or log."""
    if path.suffix == ".csv":
        table = np.genfromtxt(path, delimiter=",", names=True)
        return {int(row["utime"]): [row[name] for name in COLUMNS] for row in table}
    messages = [Status.decode(event.data) for event in LcmLogReader(path) if event.channel == "DVRK_STATUS_MTML"]
    return {message.utime: list(measurements(message)) for message in messages}


@pytest.fixture(scope="module")
def played(tmp_path_factory):
    """A log of two seconds at 1 kHz, to be played by lcm-logplayer."""
    path = tmp_path_factory.mktemp("played") / "played.log"
    path.write_bytes(log_bytes(statuses(2000)))
    return path


def play(path, *options):
    subprocess.run([TOOLS / "lcm-logplayer", *options, path], check=True, timeout=60, capture_output=True)


@inside
def test_a_live_arm_is_logged_and_recorded_with_the_same_numbers(tmp_path):
    pose = ["0.1", "0.4", "-0.25", "0.6", "0.9", "0.1", "0.5"]
    arm = start(sys.executable, "-m", "dvrk_drake.cli", "arm", "--arm", "mtml", "--pose", *pose)
    paths = [tmp_path / name for name in ("logger.log", "record.csv", "record.log")]
    try:
        assert arm.stdout.readline().startswith("simulated MTML")
        logger = start_logger(paths[0])
        recorders = [start_record(path, "--duration", "2") for path in paths[1:]]
        for recorder in recorders:
            assert recorder.wait(60) == 0, recorder.stdout.read()
            assert "rows" in recorder.stdout.read()
        end(logger, signal.SIGINT)
    finally:
        end(arm, signal.SIGINT)
    logged, *recorded = map(by_utime, paths)
    for rows in recorded:
        assert len(rows) > 500
        common = [utime for utime in rows if utime in logged]
        assert len(common) >= 0.95 * len(rows), "the logger was there all the time"
        assert all(rows[utime] == logged[utime] for utime in common)
    for path in paths:
        recording = read_recording(path, ARM)
        assert np.all(np.diff(recording.t) > 0)
        np.testing.assert_allclose(recording.q[-1], [float(q) for q in pose], atol=0.02)
        assert recording.motion(ARM) == ""


@inside
def test_lcm_logplayer_replays_a_log_into_record(tmp_path, played):
    paths = [tmp_path / name for name in ("again.csv", "again.log", "logger.log")]
    processes = [*map(start_record, paths[:2]), start_logger(paths[2])]
    play(played)
    time.sleep(0.5)
    for process in processes:
        said = end(process, signal.SIGINT)
        assert process.returncode == 0, said
    original = read_recording(played, ARM)
    for path in paths:
        recording = read_recording(path, ARM)
        # Nothing is lost on a loopback unless the machine is overloaded; then the rows that came are still right.
        assert len(recording) >= 0.95 * len(original)
        rows = np.searchsorted(original.t, recording.t + 1e-3 * missing_at_first(path) - 1e-6)
        for name in ("q", "qd", "tau"):
            np.testing.assert_array_equal(getattr(recording, name), getattr(original, name)[rows])
        if len(recording) == len(original):
            np.testing.assert_allclose(recording.t, original.t, atol=1e-9)


def missing_at_first(path):
    return (min(by_utime(path)) - statuses(1)[0].utime) // 1000


@inside
def test_a_killed_record_or_logger_leaves_a_readable_file(tmp_path, played):
    """At whatever moment: the delays fall anywhere in the two seconds."""
    original = by_utime(played)
    for k, delay in enumerate((0.05, 0.3, 0.6123, 1.0377)):
        paths = [tmp_path / f"{k}{name}" for name in (".csv", ".log", "logger.log")]
        processes = [*map(start_record, paths[:2]), start_logger(paths[2])]
        player = start(str(TOOLS / "lcm-logplayer"), str(played))
        while not paths[0].exists() or paths[0].stat().st_size < 2000:
            time.sleep(0.01)
        time.sleep(delay)
        for process in processes:
            end(process, signal.SIGKILL)
        end(player)
        for path in paths:
            if path.name.endswith("logger.log") and delay < 0.3:
                continue  # lcm-logger flushes ten times a second
            recording = read_recording(path, ARM)
            assert len(recording) >= 100 * (delay > 0.2) + 1
            if not path.name.endswith("logger.log"):
                assert recording.notes == ()
            assert all(values == original[utime] for utime, values in by_utime(path).items())


@inside
def test_silence_is_explained(tmp_path, played):
    alone = start_record(tmp_path / "alone.csv", "--lcm-url", "udpm://239.255.76.67:7668?ttl=0")
    waiting = {arm: start_record(tmp_path / f"{arm}.csv", arm=arm) for arm in ("psm", "mtmr", "mtml")}
    time.sleep(0.5)
    said = end(waiting.pop("mtmr"), signal.SIGINT)
    assert "mtmr.csv: not made: ended before the first status of MTMR" in said
    end_of_garbage, publisher = time.monotonic() + 10, lcm.LCM()
    while time.monotonic() < end_of_garbage:
        publisher.publish("DVRK_STATUS_MTML", os.urandom(300))
        time.sleep(0.1)
    messages = {
        "psm": "no message within 10 s on channel DVRK_STATUS_PSM of udpm://239.255.76.67:7667?ttl=0; "
        "there is DVRK_STATUS_MTML",
        "mtml": "no status of MTML within 10 s on channel DVRK_STATUS_MTML of udpm://239.255.76.67:7667?ttl=0: "
        "messages left out, no lcmt_dvrk_status, or one of another version",
    }
    for arm, process in waiting.items():
        assert process.wait(20) == 2
        assert messages[arm] in process.stdout.read()
    assert alone.wait(20) == 2
    assert "does the arm's process or bridge run, on this network?" in alone.stdout.read()
    assert not list(tmp_path.glob("*.csv"))


@inside
def test_two_arms_of_one_name_end_the_recording(tmp_path, played):
    other = tmp_path / "other.log"
    other.write_bytes(log_bytes(statuses(2000, session_id=5)))
    recorder = start_record(tmp_path / "a.csv")
    players = [start(str(TOOLS / "lcm-logplayer"), str(path)) for path in (played, other)]
    assert recorder.wait(30) == 2
    assert "two arms called MTML send at the same time" in recorder.stdout.read()
    for player in players:
        end(player)
    assert len(read_recording(tmp_path / "a.csv", ARM)) > 0
