"""Search for the topic of an arm, in a substitute domain, and the checks of names, namespaces and domain numbers."""

import dataclasses
from types import SimpleNamespace

import pytest
from command_output import refusal

from dvrk_drake.cli import main
from dvrk_drake.errors import DvrkDrakeError, RecordingError
from dvrk_drake.models.arm_files import known_arms, load_arm
from dvrk_drake.systems.ros.crtk_client import connect_client
from dvrk_drake.systems.ros.crtk_link import connect_move_link
from dvrk_drake.systems.ros.discovery import find_topic, topic_fault
from dvrk_drake.systems.ros.open_domain import domain_number, open_ros_domain

MTML, MTMR, PSM = (load_arm(name) for name in ("mtml", "mtmr", "psm"))
DOMAIN = "ROS domain 5"


class SubstituteDomain:
    """Domain with JointState topics that appear after a time. Waiting takes no time.

    Attributes:
        time: Present time [s].
    """

    name = DOMAIN

    def __init__(self, topics=(), after=0.0):
        self.time, self._topics, self._after = 0.0, topics, after

    def joint_state_topics(self):
        return dict.fromkeys(self._topics if self.time >= self._after else (), True)

    def wait_until(self, condition, seconds):
        end = self.time + seconds
        while not (met := condition()) and self.time < end:
            self.time += 0.1
        return met


def search(domain, *arguments, **options):
    """Returns the result of a search and the reported lines."""
    lines = []
    return find_topic(domain, *arguments, report=lines.append, **options), lines


def refused(domain, *arguments, **options):
    with pytest.raises(RecordingError) as error:
        search(domain, *arguments, **options)
    return str(error.value)


@pytest.mark.parametrize(("after", "lines"), [(0.5, []), (3.0, [f"searching for /MTML/measured_js in {DOMAIN}"])])
def test_a_long_search_is_reported(after, lines):
    domain = SubstituteDomain(["/lab/MTML/measured_js"], after)
    assert search(domain, MTML) == ("/lab/MTML/measured_js", lines)
    # The search ends one second after the first topic, in which other topics may be discovered.
    assert domain.time == pytest.approx(after + 1.0, abs=0.15)


def test_topics_of_the_domain_are_listed_only_if_there_are_any():
    advice = "Start the dVRK's console, or check --domain and the network"
    domain = SubstituteDomain()
    assert refused(domain, MTML) == f"{DOMAIN}: no topic /MTML/measured_js within 10 s. {advice}"
    assert domain.time == pytest.approx(10.0, abs=0.25)
    assert refused(SubstituteDomain(), MTML, "left/") == f"{DOMAIN}: no topic /left within 10 s. {advice}"
    assert "Topics with JointState messages: /PSM1/measured_js. Check --arm, or choose one" in refused(
        SubstituteDomain(["/PSM1/measured_js"]), MTML
    )


def test_search_can_be_stopped():
    domain = SubstituteDomain()
    assert refused(domain, MTML, stopped=lambda: domain.time > 2.0).endswith("/MTML/measured_js was stopped")
    assert domain.time < 2.5


@pytest.mark.parametrize(
    ("arm", "topic", "other"),
    [
        (MTMR, "/MTML", "MTML"),
        (MTMR, "/lab/MTML/measured_js", "MTML"),
        (MTMR, "/MTML/setpoint_js", "MTML"),
        (MTMR, "mtml2/", "MTML"),
        (MTML, "/PSM2", "PSM"),
        (PSM, "/MTMR", "MTMR"),
    ],
)
def test_namespace_of_another_arm_is_refused(arm, topic, other):
    text = refused(SubstituteDomain([f"/{topic.strip('/')}"]), arm, topic)
    assert f"is the namespace of the arm {other}, not of {arm.name}. Choose --arm {other.lower()}, or" in text


@pytest.mark.parametrize(
    ("arm", "namespace"),
    [
        (MTML, "/left_master"),
        (MTML, "/MTMR/MTML"),
        (PSM, "/PSM2"),
        (PSM, "/ECM_view"),
        (dataclasses.replace(MTML, name="MTML2"), "/MTML"),
        (dataclasses.replace(MTML, name="LEFT"), "/MTML"),
    ],
)
def test_other_namespaces_are_accepted(arm, namespace):
    topic = f"{namespace}/measured_js"
    assert search(SubstituteDomain([topic]), arm, namespace) == (topic, [])


def test_files_of_arms_have_the_names_of_the_arms():
    assert all(name.upper().startswith(load_arm(name).name) for name in known_arms())


def test_names_are_checked_before_the_search():
    for name in ("", "/", "/a b", "foo//bar", "/PSM1/2", "/2", "/M-L", "/Ärm", "~/x", "//MTML"):
        domain = SubstituteDomain()
        assert f'topic is "{name}"; allowed: names of letters' in refused(domain, MTML, name)
        assert domain.time == 0
    for name in ("MTML", "/MTML", "/lab_1/PSM1/", "_a/B2"):
        assert topic_fault(name) == ""


@pytest.mark.parametrize(
    "command",
    [["bridge"], ["bridge", "deadman"], ["sim-arm", "--transport", "ros"], ["record", "a.mcap", "--transport", "ros"]],
)
def test_domain_number_is_checked_first(command, capsys, tmp_path, monkeypatch):
    pytest.importorskip("cyclonedds", reason="needs cyclonedds")
    monkeypatch.chdir(tmp_path)
    assert main([*command, "--arm", "mtml", "--domain", "999"]) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    expected = "dvrk-drake: error: ROS domain 999: allowed: 0 to 232 (--domain, or ROS_DOMAIN_ID)"
    assert refusal(captured.err) == expected


def test_domain_number(monkeypatch):
    for text, number in (("", 0), ("7", 7)):
        monkeypatch.setenv("ROS_DOMAIN_ID", text)
        assert (domain_number(), domain_number(232)) == (number, 232)
    monkeypatch.setenv("ROS_DOMAIN_ID", "one")
    with pytest.raises(DvrkDrakeError, match="ROS domain one: allowed: 0 to 232"):
        domain_number()


def test_invalid_configuration_of_dds_gives_advice(monkeypatch):
    pytest.importorskip("cyclonedds", reason="needs cyclonedds")
    monkeypatch.setenv("CYCLONEDDS_URI", "garbage")
    expected = (
        'ROS domain 7 cannot be used. CYCLONEDDS_URI is "garbage"; allowed: an existing XML file, or XML, with '
        "existing network interfaces that are connected. Correct it or unset it"
    )
    with pytest.raises(DvrkDrakeError) as error:
        open_ros_domain(7)
    assert str(error.value) == expected


# Connection to an arm in a substitute domain: Ctrl-C ends every wait, and no command is sent.


pytest.importorskip("cyclonedds", reason="needs cyclonedds")


ARM = load_arm("mtml")
#: Longest time between Ctrl-C and the end of a wait [s].
LONGEST = 0.1


class SilentDomain:
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
    domain = SilentDomain(others=others)
    with pytest.raises(DvrkDrakeError, match="was stopped"):
        connect_client(domain, ARM, None, ("servo_jp", "hold"), stopped=lambda: domain.time >= stop)
    assert domain.time <= stop + LONGEST
    assert not domain.published


@pytest.mark.parametrize("stop", [0.0, 1.5])
def test_ctrl_c_ends_the_wait_for_an_arm_that_is_not_ready(stop, monkeypatch):
    """`collect poses --transport ros` waits 2 s for an arm that is enabled and homed."""
    domain = SilentDomain()
    client = SimpleNamespace(namespace="/MTML", not_ready_reason="operating_state is DISABLED", receive=lambda: None)
    monkeypatch.setattr("dvrk_drake.systems.ros.crtk_link.connect_client", lambda *arguments, **options: client)
    with pytest.raises(DvrkDrakeError, match="the connection to /MTML was stopped; no command was sent to the arm"):
        connect_move_link(domain, ARM, None, None, 0.6, stopped=lambda: domain.time >= stop)
    assert domain.time <= stop + LONGEST
