"""Deadman of an arm with a substitute for the ROS domain, without DDS."""

import os
import subprocess
import sys
import time
from types import SimpleNamespace

import pytest
from waiting import TIMEOUT

pytest.importorskip("cyclonedds", reason="needs cyclonedds")

from dvrk_drake.errors import DvrkDrakeError
from dvrk_drake.systems.ros import deadman
from dvrk_drake.systems.ros.deadman import Deadman, DeadmanProcess

ARM = "/MTML"
#: Number of messages until hold is confirmed.
TWICE = 2


class SubstituteTopic:
    """Publisher or subscription. The test adds messages, each (message, time of publication)."""

    def __init__(self, topic):
        self.topic, self.messages, self.connections, self.confirms = topic, [], 1, True
        self.published = 0

    def take(self):
        messages, self.messages = self.messages, []
        return messages

    def publish(self, message):
        self.published += 1

    def num_publishers(self):
        return self.connections

    def participants(self):
        return {"arm"} if self.connections else {"bridge"}

    subscriber_participants = publisher_participants = participants

    def wait_until_received(self, seconds):
        return self.confirms


class Bench:
    """Deadman, and the topics of its domain."""

    def __init__(self):
        self.subscribed, self.lines, self.connected = {}, [], []
        self.deadman = Deadman(self, ARM, self.lines.append)

    def subscribe(self, topic, kind, **options):
        return self.subscribed.setdefault(topic.removeprefix(f"{ARM}/"), SubstituteTopic(topic))

    def advertise(self, topic, kind):
        assert topic == f"{ARM}/hold"
        self.hold = SubstituteTopic(topic)
        return self.hold

    def send(self, name, stamp, message=None):
        self.subscribed[name].messages.append((message, stamp))

    def run(self, until, bridge=None):
        """Runs the deadman until a condition is true, at most `TIMEOUT`."""
        end = time.monotonic() + TIMEOUT
        self.deadman.run(lambda: until() or time.monotonic() > end, bridge, self.connected.append)
        return self.hold.published

    def run_for(self, seconds):
        end = time.monotonic() + seconds
        return self.run(lambda: time.monotonic() > end)


@pytest.mark.parametrize("name", ["servo_jf", "servo_jp"])
def test_silence_after_a_command_leads_to_hold(name):
    bench = Bench()
    assert bench.run_for(3 * deadman.TIMEOUT) == 0, "nothing was commanded"
    bench.send(name, 1)
    start = time.monotonic()
    assert bench.run(lambda: bench.hold.published) == TWICE
    assert time.monotonic() - start >= deadman.TIMEOUT
    assert bench.lines[0].startswith(f"deadman: {ARM}: no command for ") and "published hold at" in bench.lines[0]
    assert bench.run_for(3 * deadman.TIMEOUT) == TWICE, "the arm holds already"
    bench.send(name, 2)
    assert bench.run(lambda: bench.hold.published > TWICE) == 2 * TWICE
    assert len(bench.lines) == 2


def state(text):
    return SimpleNamespace(state=text)


@pytest.mark.parametrize(
    ("name", "stamp", "message", "held"),
    [
        ("hold", 6, None, True),
        ("hold", 4, None, False),
        ("operating_state", 6, state("DISABLED"), False),  # it may be a message of another process
        ("operating_state", 6, state("ENABLED"), False),
    ],
)
def test_end_of_commands(name, stamp, message, held):
    bench = Bench()
    bench.send("servo_jf", 5)
    bench.send(name, stamp, message)
    if held:
        assert bench.run_for(3 * deadman.TIMEOUT) == 0
    else:
        assert bench.run(lambda: bench.hold.published) == TWICE


def run_until_bridge_ends(bench, last=b""):
    """Returns how often `hold` was published. The bridge writes `last` before its end."""
    bridge, end = os.pipe()
    os.write(end, last)
    os.close(end)
    # Signals must not end the deadman before it has published hold.
    bench.deadman.run(lambda: True, bridge, bench.connected.append)
    os.close(bridge)
    return bench.hold.published


@pytest.mark.parametrize("messages", [[], ["servo_jf"], ["servo_jf", "hold"]])
def test_end_of_the_bridge_leads_to_hold(messages):
    """The deadman does not know whether the arm has received the `hold` of the bridge."""
    bench = Bench()
    for stamp, name in enumerate(messages):
        bench.send(name, stamp)
    assert run_until_bridge_ends(bench) == TWICE
    assert "the bridge has ended; published hold at" in bench.lines[0]


def test_bridge_whose_hold_is_confirmed_leads_to_nothing():
    bench = Bench()
    bench.send("servo_jf", 5)
    bench.send("hold", 6)
    assert run_until_bridge_ends(bench, b"\0") == 0
    assert not bench.lines


def test_end_of_the_bridge_of_a_disabled_arm_leads_to_nothing():
    bench = Bench()
    bench.send("operating_state", 1, state("DISABLED"))
    assert run_until_bridge_ends(bench) == 0
    bench.send("servo_jf", 2)  # so the state was that of another process
    assert run_until_bridge_ends(bench) == TWICE


def test_hold_is_not_repeated_after_the_end_of_the_bridge():
    bench = Bench()
    bench.send("servo_jf", 1)
    assert bench.run(lambda: bench.hold.published) == TWICE
    assert run_until_bridge_ends(bench) == TWICE


@pytest.fixture
def fast(monkeypatch):
    """Makes the time between two attempts, and until the first warning, short."""
    monkeypatch.setattr(deadman, "_INTERVAL", 0.001)
    monkeypatch.setattr(deadman, "_CONFIRMATION", 0.01)


def num_warnings(bench):
    return sum("the arm has not confirmed hold for" in line for line in bench.lines)


@pytest.mark.usefixtures("fast")
def test_hold_is_repeated_until_the_network_works_again():
    bench = Bench()
    # Without a connection to the arm, DDS regards each message as confirmed. The bridge also subscribes to hold.
    bench.hold.subscriber_participants = lambda: {"arm", "bridge"} if num_warnings(bench) >= 5 else {"bridge"}
    bench.send("servo_jf", 1)
    bench.run(lambda: bench.lines and "confirmed hold now" in bench.lines[-1])
    assert bench.hold.published > 5
    assert num_warnings(bench) == 5
    assert bench.lines[1].endswith(f"PRESS THE STOP BUTTON. Process {os.getpid()} continues to send hold")
    assert bench.lines[-1] == f"deadman: {ARM}: the arm has confirmed hold now"


@pytest.mark.usefixtures("fast")
def test_stop_ends_the_repetition_of_hold():
    bench = Bench()
    bench.hold.confirms = False
    bench.send("servo_jf", 1)
    bench.run(lambda: num_warnings(bench) == 3)
    assert num_warnings(bench) == 3
    assert "now" not in bench.lines[-1]


@pytest.mark.usefixtures("fast")
def test_disabled_arm_ends_the_repetition_of_hold():
    bench = Bench()
    bench.hold.confirms = False
    bench.send("servo_jf", 1)

    def disable_later():
        if num_warnings(bench) == 2:
            bench.send("operating_state", 9, state("DISABLED"))
        return "stopped to send hold" in bench.lines[-1:][0] if bench.lines else False

    bench.run(disable_later)
    assert bench.lines[-1] == f"deadman: {ARM}: stopped to send hold"


@pytest.mark.usefixtures("fast")
def test_hold_that_cannot_be_published_is_repeated(monkeypatch):
    bench = Bench()

    def fail_at_first(message):
        bench.hold.published += 1
        if bench.hold.published < 4:
            raise DvrkDrakeError("the message could not be sent")

    monkeypatch.setattr(bench.hold, "publish", fail_at_first)
    bench.send("servo_jf", 1)
    assert bench.run(lambda: bench.hold.published > 4) == 3 + TWICE
    assert "published hold at" in bench.lines[0]


@pytest.mark.parametrize("error", [None, KeyboardInterrupt])
def test_stopped_start_leaves_no_process(monkeypatch, error):
    started, calls = [], []

    def start(command, **options):
        started.append(subprocess.Popen([sys.executable, "-c", "import time; time.sleep(300)"], **options))
        return started[0]

    def stopped():
        calls.append(None)
        if error is not None:
            raise error
        return len(calls) > 1

    monkeypatch.setattr(deadman, "subprocess", SimpleNamespace(Popen=start, PIPE=subprocess.PIPE))
    with pytest.raises(error or DvrkDrakeError) as raised:
        DeadmanProcess(ARM, None, stopped)
    assert error or "the start of the deadman process was stopped; no command was sent" in str(raised.value)
    assert started[0].poll() is not None
    assert started[0].stdin.closed and started[0].stdout.closed


#: Prints the requested priority, and that of a thread that started afterwards, as the threads of DDS do.
PRIORITY = """
import os, threading
from dvrk_drake.systems.ros import deadman
if {refused}:
    def refuse(*_):
        raise PermissionError(1, "not permitted")
    os.sched_setscheduler = refuse
print(deadman.request_priority())
thread = threading.Thread(target=lambda: print(os.sched_getscheduler(0) == os.SCHED_FIFO))
thread.start()
thread.join()
"""
REFUSED = (
    "no real-time priority, so a busy computer can delay it. Give the user an rtprio limit of 60, or CAP_SYS_NICE\n"
)


@pytest.mark.parametrize("refused", [False, True])
def test_real_time_priority_is_stated(refused):
    code = PRIORITY.format(refused=refused)
    printed = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    granted = "" if refused else "real-time priority 60\nTrue\n"
    assert printed in (granted, f"{REFUSED}False\n")  # the system may refuse the request


def test_stand_alone_command_requests_priority_before_dds(monkeypatch, capsys):
    from dvrk_drake.cli import main
    from dvrk_drake.systems.ros import discovery, open_domain

    calls, requested = [], "real-time priority 60"
    monkeypatch.setattr(deadman, "request_priority", lambda: calls.append("priority") or requested)
    monkeypatch.setattr(open_domain, "open_ros_domain", lambda domain: calls.append("domain"))
    monkeypatch.setattr(discovery, "find_topic", lambda *_, **__: f"{ARM}/measured_js")
    monkeypatch.setattr(deadman, "Deadman", lambda *_: SimpleNamespace(run=lambda stopped: calls.append("run")))
    assert main(["bridge", "deadman", "--arm", "mtml"]) == 0
    assert calls == ["priority", "domain", "run"]
    assert capsys.readouterr().out == f"deadman of {ARM}; Ctrl-C ends it; it has {requested}\n"


def test_connection_is_reported_in_each_period():
    bench = Bench()
    bench.hold.connections = 0
    changes = [(bench.hold, 1), (bench.subscribed["servo_jf"], 0), (bench.subscribed["servo_jf"], 1)]

    def change_after_each_report():
        if len(bench.connected) == 4 - len(changes) and changes:
            topic, connections = changes.pop(0)
            topic.connections = connections
        return len(bench.connected) == 5

    bench.run(change_after_each_report)
    assert bench.connected == [False, True, False, True, True]


def test_silence_of_the_process_is_a_problem():
    """A process that is suspended holds no arm."""
    process, (read_end, write_end) = DeadmanProcess.__new__(DeadmanProcess), os.pipe()
    with open(read_end, "rb", buffering=0) as stdout, open(write_end, "wb", buffering=0) as reports:
        process._process, process.pid, process._is_blind = SimpleNamespace(poll=lambda: None, stdout=stdout), 7, False
        process._last_report = time.monotonic() - 2 * deadman._SILENCE
        assert process.problem() == "the deadman process 7 does not respond. Restart the bridge"
        reports.write(b"ready\n")
        assert process.problem() == ""
        reports.write(b"ready\nblind\n")
        assert "is not connected to the topics" in process.problem()


def test_report_is_one_write_without_buffers():
    """A bridge must not read the end of the line separately. In a packet pipe, each write is one packet."""
    read_end, write_end = os.pipe2(os.O_DIRECT)
    code = "from dvrk_drake.systems.ros import deadman; deadman._report_connected(True)"
    environment = {**os.environ, "PYTHONUNBUFFERED": "1"}
    subprocess.run([sys.executable, "-c", code], stdout=write_end, env=environment, check=True)
    assert os.read(read_end, 100) == b"ready\n"
    os.close(read_end)
    os.close(write_end)
