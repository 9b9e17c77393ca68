"""Messages that are repeated until the arm has received them, with a substitute publisher and over DDS."""

import itertools
import os
import signal
import subprocess
import sys
import time

import pytest
import ros_arm
from ros_publisher import DOMAIN_FILE
from waiting import TIMEOUT

from dvrk_drake.systems.ros.deadman import repeat_until_confirmed

ros = pytest.importorskip("dvrk_drake.systems.ros.domain", reason="needs cyclonedds")
from dvrk_drake.systems.ros.deadman import DeadmanProcess  # noqa: E402
from dvrk_drake.systems.ros.messages import JointState, OperatingState  # noqa: E402

pytestmark = pytest.mark.network


def time_limit(seconds):
    """Returns a function that returns whether the time has passed."""
    end = time.monotonic() + seconds
    return lambda: time.monotonic() > end


@pytest.mark.parametrize("attempts", ["yy", "nyy", "ynyy", "nynnyy"])
def test_two_attempts_in_succession_must_be_confirmed(monkeypatch, attempts):
    monkeypatch.setattr("dvrk_drake.systems.ros.deadman._INTERVAL", 0.0)
    left = list(attempts)
    assert repeat_until_confirmed(lambda longest: left.pop(0) == "y", time_limit(TIMEOUT))
    assert not left


@pytest.mark.parametrize("attempts", ["n", "yn"])
def test_message_that_is_never_confirmed(monkeypatch, attempts):
    monkeypatch.setattr("dvrk_drake.systems.ros.deadman._INTERVAL", 0.001)
    results = itertools.cycle(attempts)
    assert not repeat_until_confirmed(lambda longest: next(results) == "y", time_limit(0.05))


def network(state):
    subprocess.run(["ip", "link", "set", "lo", state], check=True)


@pytest.fixture
def arm(monkeypatch):
    """Process of an arm that uses DDS, see `ros_arm`."""
    # With this period, DDS discovers the arm again about one second after the loss.
    config = DOMAIN_FILE.replace("<Discovery>", "<Discovery><SPDPInterval>500ms</SPDPInterval>")
    monkeypatch.setenv("CYCLONEDDS_URI", config)
    process = subprocess.Popen([sys.executable, ros_arm.__file__, "1"], stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout.readline() == "ready\n"
        yield process
    finally:
        network("up")
        process.kill()
        process.communicate(timeout=TIMEOUT)


@pytest.mark.usefixtures("arm")
def test_message_is_received_after_a_loss_of_the_network():
    domain = ros.RosDomain(1)
    command = domain.advertise(ros_arm.COMMAND, JointState)
    state = domain.subscribe(ros_arm.STATE, OperatingState)
    measured = domain.subscribe(ros_arm.MEASURED, JointState, depth=100)
    connected = (command.num_subscribers, state.num_publishers, measured.num_publishers)
    assert domain.wait_until(lambda: all(number() for number in connected), TIMEOUT)
    network("down")
    assert domain.wait_until(lambda: not any(number() for number in connected), TIMEOUT)
    message = JointState(effort=[1.0])
    command.publish(message)
    assert command.wait_until_received(0.1), "without subscriptions, DDS regards each message as confirmed"

    def attempt(longest):
        command.publish(message)
        arm = command.subscriber_participants() & state.publisher_participants()
        return command.wait_until_received(longest) and bool(arm)

    assert not repeat_until_confirmed(attempt, time_limit(0.1))
    network("up")
    assert repeat_until_confirmed(attempt, time_limit(TIMEOUT))
    assert domain.wait_until(lambda: message in [answer for answer, _ in measured.take()], TIMEOUT)


@pytest.fixture
def deadman(arm):
    """Deadman process of this process, which publishes a command like a bridge. Then the network is lost."""
    domain = ros.RosDomain(1)
    commands = [domain.advertise(topic, JointState) for topic in (ros_arm.COMMAND, "/MTML/servo_jp")]
    process = DeadmanProcess("/MTML", 1)
    try:
        assert not process.problem()
        # On a busy computer, the arm could confirm the hold of the deadman process before the network is lost.
        arm.send_signal(signal.SIGSTOP)
        commands[0].publish(JointState(effort=[1.0]))
        network("down")
        arm.send_signal(signal.SIGCONT)
        assert domain.wait_until(lambda: "not connected" in process.problem(), TIMEOUT)
        yield process
    finally:
        process._process.kill()
        process._process.wait()


def test_deadman_repeats_hold_after_the_end_of_the_bridge(arm, deadman):
    deadman.close(is_confirmed=False)
    time.sleep(0.5)
    assert deadman._process.poll() is None, "the arm has not confirmed hold yet"
    network("up")
    assert arm.stdout.readline() == "hold\n"
    deadman._process.wait(TIMEOUT)


@pytest.mark.usefixtures("arm")
def test_signal_ends_the_deadman_after_the_bridge(deadman):
    os.kill(deadman.pid, signal.SIGTERM)
    time.sleep(0.5)
    assert "has ended" not in deadman.problem(), "the bridge has not ended yet"
    deadman.close(is_confirmed=False)
    time.sleep(0.1)
    os.kill(deadman.pid, signal.SIGTERM)
    assert deadman._process.wait(TIMEOUT) == 0
