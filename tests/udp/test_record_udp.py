"""`dvrk-drake record` beside LCM's own lcm-logger and lcm-logplayer, all real processes on a network of their own.

The processes of dvrk-drake are forked from one that has imported the package; one test uses the command line.
"""

import os
import signal
import threading
from pathlib import Path

import lcm
import numpy as np
import pytest
from arm_processes import PATIENCE, POSES, CommandLine, dvrk_drake, impatient_dvrk_drake, start_arm
from own_network import end, start
from recordings import csv_block
from status_logs import ARM, log_bytes, statuses
from waiting import wait_until

from dvrk_drake.lcmtypes import lcmt_dvrk_status as Status
from dvrk_drake.recordings.formats import read_recording
from dvrk_drake.recordings.reader_lcm import measurements, read_events

TOOLS = Path(lcm.__file__).parents[1] / "bin"  # the programs themselves: those on the PATH start them as children
pytestmark = [
    pytest.mark.network,
    pytest.mark.realtime,
    pytest.mark.skipif(not (TOOLS / "lcm-logger").exists(), reason=f"no {TOOLS}/lcm-logger: the lcm wheel ships it"),
]


def start_records(paths, *options, arms=("mtml", "mtml"), start=dvrk_drake):
    """Starts recorders together and waits until they listen, because each waits only some seconds for a status."""
    started = [(start("record", path, "--arm", arm, *options), arm) for path, arm in zip(paths, arms, strict=False)]
    for process, arm in started:
        line = f"recording {arm.upper()} on LCM udpm://239.255.76.67:76"
        wait_until(lambda process=process, line=line: process.output().startswith(line), line, process)
    return [process for process, _ in started]


def start_logger(path):
    process, publisher = start(str(TOOLS / "lcm-logger"), "--quiet", str(path)), lcm.LCM()

    def listens():
        publisher.publish("BEGIN", b"")  # it flushes ten times per second
        return path.exists() and path.stat().st_size

    wait_until(listens, "start of the logger", process)
    return process


def by_utime(path):
    """Returns {utime: measurements} of a recorded file, CSV or log."""
    if path.suffix == ".csv":
        rows = zip(csv_block(path, "utime"), csv_block(path, "q", "qd", "tau").tolist(), strict=True)
        return {int(utime[0]): numbers for utime, numbers in rows}
    messages = [Status.decode(event.data) for event in read_events(path, []) if event.channel == "DVRK_STATUS_MTML"]
    return {message.utime: list(measurements(message)) for message in messages}


@pytest.fixture(scope="module")
def played(tmp_path_factory):
    """Writes a log of one second at 1 kHz for lcm-logplayer."""
    path = tmp_path_factory.mktemp("played") / "played.log"
    path.write_bytes(log_bytes(statuses(1000)))
    return path


def rows_in(path):
    return path.read_bytes().count(b"\n") - 1 if path.exists() else 0


def has_status(path):
    """Returns whether a log contains a complete status, i.e. whether another event begins after it."""
    return path.exists() and path.read_bytes().count(b"DVRK_STATUS_MTML") > 1


def end_logger(logger, path):
    """Stops a process when it has written all earlier messages."""
    publisher = lcm.LCM()

    def is_done():
        publisher.publish("END_OF_LOG", b"")
        return b"END_OF_LOG" in path.read_bytes()

    wait_until(is_done, "end of the log", logger)
    said = end(logger, signal.SIGINT)
    assert logger.returncode == 0, said


def test_log_and_recording_of_live_arm_agree(tmp_path):
    driver = tmp_path / "driver.yaml"
    # The network buffer then holds half a second, so a busy computer loses nothing.
    driver.write_text("status_period: 0.005\n")
    arm = start_arm("mtml", "--driver", driver)
    paths = [tmp_path / name for name in ("logger.log", "record.csv", "record.log")]
    try:
        wait_until(lambda: "\nsimulated MTML" in arm.output(), "start of the arm", arm)
        for line in arm.output().partition("simulated MTML on")[0].splitlines():
            assert line == "starting the simulated MTML" or "warning: " in line  # scheduling may not be permitted
        logger = start_logger(paths[0])
        for recorder in start_records(paths[1:], "--duration", "1", start=CommandLine):
            assert recorder.wait() == 0, recorder.output()
            assert "rows" in recorder.output()
        end_logger(logger, paths[0])
    finally:
        arm.end(signal.SIGINT)
    logged, *recorded = map(by_utime, paths)
    for rows in recorded:
        assert len(rows) > 100
        common = [utime for utime in rows if utime in logged]
        assert len(common) >= 0.95 * len(rows), "the logger was there all the time"
        assert all(rows[utime] == logged[utime] for utime in common)
    for path in paths:
        recording = read_recording(path, ARM)
        assert np.all(np.diff(recording.t) > 0)
        np.testing.assert_allclose(recording.q[-1], POSES["mtml"], atol=0.02)
        assert recording.motion(ARM) == ""


def test_killed_record_or_logger_leaves_readable_file(tmp_path, played):
    """Kills the process when the first file has a given number of 1000 rows."""
    original = by_utime(played)
    for count in (1, 100, 300):
        paths = [tmp_path / f"{count}{name}" for name in (".csv", ".log", "logger.log")]
        logger, recorders = start_logger(paths[2]), start_records(paths[:2])
        player = start(str(TOOLS / "lcm-logplayer"), str(played))
        wait_until(lambda count=count, path=paths[0]: rows_in(path) >= count, f"{count} rows", recorders[0])
        # lcm-logger flushes ten times per second.
        read = paths if count > 1 else paths[:2]
        wait_until(lambda read=read: all(map(has_status, read[1:])), "a whole status")
        before = [path.read_bytes() for path in read]
        end(logger)
        for recorder in recorders:
            recorder.end()
        end(player)
        for path, was in zip(read, before, strict=True):
            assert path.read_bytes().startswith(was)
            recording = read_recording(path, ARM)
            assert len(recording) >= (count if path.suffix == ".csv" else 1)
            if not path.name.endswith("logger.log"):
                assert not [note for note in recording.notes if "missing in the sequence" not in note]
            assert all(values == original[utime] for utime, values in by_utime(path).items())


def test_missing_status_is_explained(tmp_path, played):
    publisher, ended = lcm.LCM(), threading.Event()

    def send_garbage():
        while not ended.wait(0.1):
            publisher.publish("DVRK_STATUS_MTML", os.urandom(300))

    threading.Thread(target=send_garbage, daemon=True).start()
    other = ["--lcm-url", "udpm://239.255.76.67:7668?ttl=0"]
    (alone,) = start_records([tmp_path / "alone.csv"], *other, start=impatient_dvrk_drake)
    arms = ("psm", "mtml")
    paths = [tmp_path / f"{arm}.csv" for arm in arms]
    waiting = dict(zip(arms, start_records(paths, arms=arms, start=impatient_dvrk_drake), strict=True))
    (interrupted,) = start_records([tmp_path / "mtmr.csv"], arms=["mtmr"])
    said = interrupted.end(signal.SIGINT)
    assert "mtmr.csv was not written: the recording ended before the first status of MTMR" in said
    messages = {
        "psm": f"no message within {PATIENCE} s on channel DVRK_STATUS_PSM of udpm://239.255.76.67:7667?ttl=0. "
        "Channels with messages: DVRK_STATUS_MTML",
        "mtml": f"no status of MTML within {PATIENCE} s on channel DVRK_STATUS_MTML of udpm://239.255.76.67:7667?"
        "ttl=0: messages omitted, not an lcmt_dvrk_status of version 1.0",
    }
    for arm, process in waiting.items():
        assert process.wait() == 2
        assert messages[arm] in process.output()
    ended.set()
    assert alone.wait() == 2
    assert "Check that the arm's process or bridge runs on this network." in alone.output()
    assert not list(tmp_path.glob("*.csv"))
