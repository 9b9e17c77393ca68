"""Messages that are repeated until the arm has received them, with a substitute publisher and over DDS."""

import os
import signal
import subprocess
import sys
import time

import pytest
import ros_arm
from own_network import inside, outside, run_inside
from ros_publisher import DOMAIN_FILE
from waiting import TIMEOUT

from dvrk_drake.systems.ros import confirmation
from dvrk_drake.systems.ros.confirmation import repeat_until_received

ros = pytest.importorskip("dvrk_drake.systems.ros.domain", reason="needs cyclonedds")
from dvrk_drake.systems.ros.deadman import DeadmanProcess  # noqa: E402
from dvrk_drake.systems.ros.messages import JointState, OperatingState  # noqa: E402


class SubstitutePublisher:
    """Publisher whose messages are confirmed as given, each confirmation "yes", "no" or "absent" for no arm."""

    def __init__(self, *confirmations):
        self.confirmations, self.present, self.published = list(confirmations), True, 0

    def publish(self, message):
        assert message == "hold"
        self.published += 1

    def wait_until_received(self, seconds):
        confirmation = self.confirmations.pop(0) if self.confirmations else "no"
        self.present = confirmation != "absent"
        return confirmation != "no"


def time_limit(seconds):
    """Returns a function that returns whether the time has passed."""
    end = time.monotonic() + seconds
    return lambda: time.monotonic() > end


@outside
@pytest.mark.parametrize(
    ("confirmations", "published"),
    [
        (["yes"], 0),
        (["no", "yes", "yes"], 2),
        (["absent", "yes", "yes"], 2),
        (["no", "yes", "absent", "no", "yes", "yes"], 5),
    ],
)
def test_message_is_repeated_until_it_is_confirmed_after_a_loss(monkeypatch, confirmations, published):
    monkeypatch.setattr(confirmation, "_INTERVAL", 0.0)
    publisher = SubstitutePublisher(*confirmations)
    assert repeat_until_received(publisher, "hold", lambda: publisher.present, time_limit(TIMEOUT))
    assert (publisher.published, publisher.confirmations) == (published, [])


@outside
@pytest.mark.parametrize("confirmations", [[], ["no"] * 5, ["absent"] * 1000])
def test_message_that_is_never_confirmed(monkeypatch, confirmations):
    monkeypatch.setattr(confirmation, "_INTERVAL", 0.001)
    publisher = SubstitutePublisher(*confirmations)
    assert not repeat_until_received(publisher, "hold", lambda: publisher.present, time_limit(0.05))
    assert publisher.published > 0


@outside
def test_runs_in_a_separate_network(request):
    run_inside(request)


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


@inside
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
    assert not repeat_until_received(command, message, state.num_publishers, time_limit(0.1))
    network("up")
    assert repeat_until_received(command, message, state.num_publishers, time_limit(TIMEOUT))
    assert domain.wait_until(lambda: message in [answer for answer, _ in measured.take()], TIMEOUT)


@pytest.fixture
def deadman():
    """Deadman process of this process, which publishes the commands of a bridge. The network is lost."""
    domain = ros.RosDomain(1)
    commands = [domain.advertise(topic, JointState) for topic in (ros_arm.COMMAND, "/MTML/servo_jp")]
    process = DeadmanProcess("/MTML", 1)
    try:
        assert not process.problem()
        commands[0].publish(JointState(effort=[1.0]))
        network("down")
        assert domain.wait_until(lambda: "not connected" in process.problem(), TIMEOUT)
        yield process
    finally:
        process._process.kill()
        process._process.wait()


@inside
def test_deadman_repeats_hold_after_the_end_of_the_bridge(arm, deadman):
    deadman.close(is_confirmed=False)
    time.sleep(0.5)
    assert "has ended" not in deadman.problem(), "the arm has not confirmed hold yet"
    network("up")
    assert arm.stdout.readline() == "hold\n"
    deadman._process.wait(TIMEOUT)


@inside
@pytest.mark.usefixtures("arm")
def test_signal_ends_the_deadman_after_the_bridge(deadman):
    os.kill(deadman.pid, signal.SIGTERM)
    time.sleep(0.5)
    assert "has ended" not in deadman.problem(), "the bridge has not ended yet"
    deadman.close(is_confirmed=False)
    time.sleep(0.1)
    os.kill(deadman.pid, signal.SIGTERM)
    assert deadman._process.wait(TIMEOUT) == 0
