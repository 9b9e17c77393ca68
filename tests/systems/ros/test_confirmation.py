"""Messages that are repeated until the arm has received them, with a substitute publisher and over DDS."""

import subprocess
import sys

import pytest
import ros_arm
from own_network import inside, outside, run_inside
from ros_publisher import DOMAIN_FILE
from waiting import TIMEOUT

from dvrk_drake.systems.ros import confirmation
from dvrk_drake.systems.ros.confirmation import repeat_until_received

ros = pytest.importorskip("dvrk_drake.systems.ros.domain", reason="needs cyclonedds")
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
    assert repeat_until_received(publisher, "hold", lambda: publisher.present, TIMEOUT)
    assert (publisher.published, publisher.confirmations) == (published, [])


@outside
@pytest.mark.parametrize("confirmations", [[], ["no"] * 5, ["absent"] * 1000])
def test_message_that_is_never_confirmed(monkeypatch, confirmations):
    monkeypatch.setattr(confirmation, "_INTERVAL", 0.001)
    publisher = SubstitutePublisher(*confirmations)
    assert not repeat_until_received(publisher, "hold", lambda: publisher.present, 0.05)
    assert publisher.published > 0


@outside
def test_runs_in_a_separate_network(request):
    run_inside(request)


def network(state):
    subprocess.run(["ip", "link", "set", "lo", state], check=True)


@inside
def test_message_is_received_after_a_loss_of_the_network(monkeypatch):
    # With this period, DDS discovers the arm again about one second after the loss.
    config = DOMAIN_FILE.replace("<Discovery>", "<Discovery><SPDPInterval>500ms</SPDPInterval>")
    monkeypatch.setenv("CYCLONEDDS_URI", config)
    domain = ros.RosDomain(1)
    process = subprocess.Popen([sys.executable, ros_arm.__file__, "1"], stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout.readline() == "ready\n"
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
        assert not repeat_until_received(command, message, state.num_publishers, 0.1)
        network("up")
        assert repeat_until_received(command, message, state.num_publishers, TIMEOUT)
        assert domain.wait_until(lambda: message in [answer for answer, _ in measured.take()], TIMEOUT)
    finally:
        process.kill()
        process.communicate(timeout=TIMEOUT)
