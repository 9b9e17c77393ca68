"""Deadman of an arm with a substitute for the ROS domain, without DDS."""

import os
import subprocess
import sys
import time
from types import SimpleNamespace

import pytest
from waiting import TIMEOUT

pytest.importorskip("cyclonedds", reason="needs cyclonedds")

from dvrk_drake.systems.ros import confirmation, deadman
from dvrk_drake.systems.ros.deadman import Deadman

ARM = "/MTML"


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

    num_subscribers = num_publishers

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
def test_silence_after_a_command_leads_to_one_hold(name):
    bench = Bench()
    assert bench.run_for(3 * deadman.TIMEOUT) == 0, "nothing was commanded"
    bench.send(name, 1)
    start = time.monotonic()
    assert bench.run(lambda: bench.hold.published) == 1
    assert time.monotonic() - start >= deadman.TIMEOUT
    assert bench.lines[0].startswith(f"deadman: {ARM}: no command for ") and "published hold at" in bench.lines[0]
    assert bench.run_for(3 * deadman.TIMEOUT) == 1, "the arm holds already"
    bench.send(name, 2)
    assert bench.run(lambda: bench.hold.published > 1) == 2
    assert len(bench.lines) == 2


def state(text):
    return SimpleNamespace(state=text)


@pytest.mark.parametrize(
    ("name", "stamp", "message", "held"),
    [
        ("hold", 6, None, True),
        ("hold", 4, None, False),
        ("operating_state", 6, state("DISABLED"), True),
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
        assert bench.run(lambda: bench.hold.published) == 1


@pytest.mark.parametrize("held", [False, True])
def test_end_of_the_bridge_leads_to_hold(held):
    bench = Bench()
    bench.send("servo_jf", 5)
    if held:
        bench.send("hold", 6)
    bridge, end = os.pipe()
    os.close(end)
    assert bench.run(lambda: False, bridge) == (0 if held else 1)
    os.close(bridge)
    assert bench.lines == [] if held else "the bridge has ended; published hold at" in bench.lines[0]


@pytest.fixture
def fast(monkeypatch):
    """Makes the time between two attempts, and until the first warning, short."""
    monkeypatch.setattr(confirmation, "_INTERVAL", 0.001)
    monkeypatch.setattr(deadman, "_CONFIRMATION", 0.01)


def num_warnings(bench):
    return sum("the arm has not confirmed hold for" in line for line in bench.lines)


@pytest.mark.usefixtures("fast")
def test_hold_is_repeated_until_the_network_works_again():
    bench = Bench()
    arm = bench.subscribed["operating_state"]
    # Without a connection to the arm, DDS regards each message as confirmed.
    arm.num_publishers = lambda: num_warnings(bench) >= 5
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
def test_hold_that_the_bridge_could_not_confirm_is_repeated():
    bench = Bench()
    bench.subscribed["operating_state"].num_publishers = lambda: num_warnings(bench) >= 3
    bench.send("servo_jf", 5)
    bench.send("hold", 6)
    bridge, end = os.pipe()
    os.write(end, b"\0")
    os.close(end)
    bench.run(lambda: False, bridge)
    os.close(bridge)
    assert "the bridge has ended; published hold at" in bench.lines[0]
    assert bench.lines[-1] == f"deadman: {ARM}: the arm has confirmed hold now"


def test_changes_of_the_connection_are_reported():
    bench = Bench()
    bench.hold.connections = 0
    changes = [(bench.hold, 1), (bench.subscribed["servo_jf"], 0), (bench.subscribed["servo_jf"], 1)]

    def change_after_each_report():
        if len(bench.connected) == 3 - len(changes) and changes:
            topic, connections = changes.pop(0)
            topic.connections = connections
        return len(bench.connected) == 3

    bench.run(change_after_each_report)
    assert bench.connected == [True, False, True]


def test_report_is_one_write_without_buffers():
    """A bridge must not read the end of the line separately. In a packet pipe, each write is one packet."""
    read_end, write_end = os.pipe2(os.O_DIRECT)
    code = "from dvrk_drake.systems.ros import deadman; deadman._report_connected(True)"
    environment = {**os.environ, "PYTHONUNBUFFERED": "1"}
    subprocess.run([sys.executable, "-c", code], stdout=write_end, env=environment, check=True)
    assert os.read(read_end, 100) == b"ready\n"
    os.close(read_end)
    os.close(write_end)
