"""Connection to an arm in a substitute domain: Ctrl-C ends every wait, and no command is sent."""

from types import SimpleNamespace

import pytest

pytest.importorskip("cyclonedds", reason="needs cyclonedds")

from dvrk_drake.errors import DvrkDrakeError
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.systems.ros.crtk_client import connect_client
from dvrk_drake.systems.ros.crtk_move_link import connect_move_link

ARM = load_arm("mtml")
#: Longest time between Ctrl-C and the end of a wait [s].
LONGEST = 0.1


class SubstituteDomain:
    """Domain of an MTML that sends no messages. Waiting takes no time.

    Attributes:
        time: Present time [s].
        published: Messages that were published on any topic.
    """

    name = "ROS domain 5"

    def __init__(self, others=()):
        self.time, self.published = 0.0, []
        self._others = [SimpleNamespace(topic=topic, is_own=False) for topic in others]

    def joint_state_topics(self):
        return {"/MTML/measured_js": True}

    def publishers(self):
        return self._others

    def subscribe(self, topic, message_type, **options):
        return SimpleNamespace(take=list, publisher_participants=lambda: {"arm"})

    def advertise(self, topic, message_type):
        return SimpleNamespace(topic=topic, publish=self.published.append, subscriber_participants=lambda: {"arm"})

    def wait_until(self, condition, seconds):
        end = self.time + seconds
        while not (met := condition()) and self.time < end:
            self.time += 0.02
        return met


@pytest.mark.parametrize("stop", [0.0, 0.5, 1.5, 3.0])
@pytest.mark.parametrize("others", [(), ("/MTML/servo_jf",)])
def test_ctrl_c_ends_the_connection(stop, others):
    """The search ends at 1 s. Then other publishers are awaited for 3 s, and messages for 5 s."""
    domain = SubstituteDomain(others=others)
    with pytest.raises(DvrkDrakeError, match="was stopped"):
        connect_client(domain, ARM, None, ("servo_jp", "hold"), stopped=lambda: domain.time >= stop)
    assert domain.time <= stop + LONGEST
    assert not domain.published


@pytest.mark.parametrize("stop", [0.0, 1.5])
def test_ctrl_c_ends_the_wait_for_an_arm_that_is_not_ready(stop, monkeypatch):
    """`collect poses --transport ros` waits 2 s for an arm that is enabled and homed."""
    domain = SubstituteDomain()
    client = SimpleNamespace(namespace="/MTML", not_ready_reason="operating_state is DISABLED", receive=lambda: None)
    monkeypatch.setattr("dvrk_drake.systems.ros.crtk_move_link.connect_client", lambda *arguments, **options: client)
    with pytest.raises(DvrkDrakeError, match="the connection to /MTML was stopped; no command was sent to the arm"):
        connect_move_link(domain, ARM, None, None, 0.6, stopped=lambda: domain.time >= stop)
    assert domain.time <= stop + LONGEST
