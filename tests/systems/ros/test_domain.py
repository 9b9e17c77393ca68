"""ROS 2 domain over DDS, with a second process in a network namespace."""

import contextlib
import gc
import itertools
import os
import signal
import socket
import struct
import subprocess
import sys
import time
from dataclasses import dataclass

import pytest
import ros_arm
from ros_publisher import DOMAIN_FILE
from waiting import TIMEOUT, wait_until

from dvrk_drake.errors import DvrkDrakeError

module = pytest.importorskip("dvrk_drake.systems.ros.domain", reason="needs cyclonedds")
messages = pytest.importorskip("dvrk_drake.systems.ros.messages", reason="needs cyclonedds")
topic_module = pytest.importorskip("dvrk_drake.systems.ros.domain", reason="needs cyclonedds")
pytestmark = pytest.mark.network

JointState, OperatingState, StringStamped = messages.JointState, messages.OperatingState, messages.StringStamped

#: Numbers of domains. Each test has its own domain, without endpoints of other tests.
DOMAINS = itertools.count(1)
#: Time in which the end of a killed process must be detected [s]. The default of Cyclone DDS is 10 s.
DETECTION = 5.0


@pytest.fixture
def domain(monkeypatch):
    monkeypatch.setenv("CYCLONEDDS_URI", DOMAIN_FILE)
    joined = module.RosDomain(next(DOMAINS))
    yield joined
    joined.close()


@pytest.fixture
def arm(domain):
    """Starts an arm in a process of its own."""
    process = subprocess.Popen(
        [sys.executable, ros_arm.__file__, domain.name.split()[-1]], stdout=subprocess.PIPE, text=True
    )
    try:
        assert process.stdout.readline() == "ready\n"
        yield process
    finally:
        process.kill()
        process.communicate(timeout=TIMEOUT)


def joint_state(number):
    return JointState(messages.Header(messages.Time(number, 0)), ["joint"], [], [], [float(number)])


def received(domain, subscription, number):
    """Waits for `number` messages of a subscription and returns them."""
    found = []
    domain.wait_until(lambda: found.extend(m for m, _ in subscription.take()) or len(found) >= number, TIMEOUT)
    return found


def test_latched_states_reach_a_late_subscription(domain, arm):
    volatile = domain.subscribe(ros_arm.STATE, OperatingState, depth=100)
    assert domain.wait_until(volatile.num_publishers, TIMEOUT)
    # The answer of the arm arrives after anything that the arm would send to the volatile subscription.
    command, measured = domain.advertise(ros_arm.COMMAND, JointState), domain.subscribe(ros_arm.MEASURED, JointState)
    assert domain.wait_until(lambda: command.num_subscribers() and measured.num_publishers(), TIMEOUT)
    answers = []

    def is_answered():
        """Repeats the command, since the arm may not have discovered the subscription of its answer yet."""
        command.publish(joint_state(1))
        answers.extend(message for message, _ in measured.take())
        return answers

    assert domain.wait_until(is_answered, TIMEOUT)
    assert answers[0] == joint_state(1)
    assert volatile.take() == []
    latched = domain.subscribe(ros_arm.STATE, OperatingState, depth=100, latched=True)
    assert [m.state for m in received(domain, latched, len(ros_arm.STATES))] == ros_arm.STATES


def test_endpoints_are_discovered(domain, arm):
    own = domain.advertise("/own", StringStamped)
    state, joints = messages.type_hash(OperatingState), messages.type_hash(JointState)
    expected = {
        module.Endpoint(ros_arm.STATE, "crtk_msgs/msg/OperatingState", True, True, state, False),
        module.Endpoint(ros_arm.MEASURED, "sensor_msgs/msg/JointState", True, False, joints, False),
        module.Endpoint(
            own.topic, "crtk_msgs/msg/StringStamped", True, False, messages.type_hash(StringStamped), is_own=True
        ),
    }
    assert domain.wait_until(lambda: set(domain.publishers()) == expected, TIMEOUT), domain.publishers()
    expected = {
        module.Endpoint(ros_arm.COMMAND, "sensor_msgs/msg/JointState", True, False, joints, False),
        module.Endpoint(ros_arm.HOLD, "std_msgs/msg/Empty", True, False, messages.type_hash(messages.Empty), False),
    }
    assert domain.wait_until(lambda: set(domain.subscribers()) == expected, TIMEOUT), domain.subscribers()
    assert domain.joint_state_topics() == {ros_arm.MEASURED: True}
    assert own.num_subscribers() == 0
    reader = domain.subscribe("/own", StringStamped, reliable=False)
    assert domain.wait_until(lambda: own.num_subscribers() == 1 and reader.num_publishers() == 1, TIMEOUT)
    best_effort = {(e.topic, e.reliable, e.is_own) for e in domain.subscribers()}
    received = {(ros_arm.COMMAND, True, False), (ros_arm.HOLD, True, False)}
    assert best_effort == received | {("/own", False, True)}


def test_endpoints_of_a_killed_process_vanish(domain, arm):
    command = domain.advertise(ros_arm.COMMAND, JointState)
    assert domain.wait_until(lambda: len(domain.publishers()) == 3 and command.num_subscribers() == 1, TIMEOUT)
    arm.kill()
    assert domain.wait_until(lambda: len(domain.publishers()) == 1, DETECTION)
    assert domain.publishers()[0].is_own
    assert domain.wait_until(lambda: not domain.subscribers() and not command.num_subscribers(), DETECTION)


def test_messages_continue_after_a_suspension(domain, arm):
    command, measured = domain.advertise(ros_arm.COMMAND, JointState), domain.subscribe(ros_arm.MEASURED, JointState)

    def answers():
        command.publish(joint_state(1))
        return bool(measured.take())

    assert domain.wait_until(answers, TIMEOUT)
    # In some of the suspensions, only one of the processes considers the other one as ended.
    for _ in range(4):
        arm.send_signal(signal.SIGSTOP)
        os.waitpid(arm.pid, os.WUNTRACED)
        assert domain.wait_until(lambda: not measured.num_publishers(), DETECTION)
        measured.take()
        arm.send_signal(signal.SIGCONT)
        assert domain.wait_until(answers, DETECTION)


def test_a_stopped_subscriber_does_not_stop_the_publisher(domain, arm):
    command = domain.advertise(ros_arm.COMMAND, JointState)
    assert domain.wait_until(command.num_subscribers, TIMEOUT)
    arm.send_signal(signal.SIGSTOP)
    os.waitpid(arm.pid, os.WUNTRACED)
    command.publish(joint_state(0))
    assert not command.wait_until_received(0.0)
    begin = time.monotonic()
    for number in range(5000):  # 5 s at 1 kHz, 1 MB
        command.publish(joint_state(number))
    # DDS may wait 100 ms for each message that does not fit into the history of the publisher.
    assert time.monotonic() - begin < 50.0


def test_depth_keeps_the_last_messages(domain):
    subscriptions = [domain.subscribe("/depth", JointState, depth=depth) for depth in (1, 3)]
    publisher = domain.advertise("/depth", JointState)
    assert domain.wait_until(lambda: publisher.num_subscribers() == 2, TIMEOUT)
    before = time.time_ns()
    for number in range(10):
        publisher.publish(joint_state(number))
    after = time.time_ns()
    assert publisher.wait_until_received(TIMEOUT)
    for subscription, first in zip(subscriptions, (9, 7), strict=True):
        samples = subscription.take()
        assert [message for message, _ in samples] == [joint_state(number) for number in range(first, 10)]
        assert all(before <= published <= after for _, published in samples)
        assert subscription.take() == []


def test_unused_subscription_ends(domain):
    subscription, publisher = domain.subscribe("/end", JointState), domain.advertise("/end", JointState)
    assert domain.wait_until(publisher.num_subscribers, TIMEOUT)
    gc.disable()  # a reader in a reference cycle would remain in DDS
    try:
        del subscription
        assert domain.wait_until(lambda: not publisher.num_subscribers(), DETECTION)
    finally:
        gc.enable()


PUBLISH = """
import time
from dvrk_drake.systems.ros.open_domain import open_ros_domain
from dvrk_drake.systems.ros.messages import Empty
publisher = open_ros_domain().advertise("/often", Empty)
while True:
    publisher.publish(Empty())
    time.sleep(5e-4)
"""
SUBSCRIBE = """
from dvrk_drake.systems.ros.open_domain import open_ros_domain
from dvrk_drake.systems.ros.messages import Empty
domain = open_ros_domain()
for _ in range(1500):
    subscription = domain.subscribe("/often", Empty)
    assert domain.wait_until(subscription.take, 60.0)
    del subscription
"""


def test_subscriptions_end_while_messages_arrive(monkeypatch):
    monkeypatch.setenv("CYCLONEDDS_URI", DOMAIN_FILE)
    publisher = subprocess.Popen([sys.executable, "-c", PUBLISH])
    try:
        # Without a separate process, an error could block the test for ever.
        subprocess.run([sys.executable, "-c", SUBSCRIBE], timeout=60, check=True)
    finally:
        publisher.kill()
        publisher.wait()


@pytest.mark.parametrize("depth", [1, 7])
def test_flood_and_repeated_errors_end_take(domain, monkeypatch, depth):
    """A publisher that is faster than the subscriber, and an error that consumes no message."""
    subscription, publisher = (
        domain.subscribe("/flood", JointState, depth=depth),
        domain.advertise("/flood", JointState),
    )
    assert domain.wait_until(publisher.num_subscribers, TIMEOUT)
    take = subscription._reader.take

    def publish_and_take(count):
        publisher.publish(joint_state(1))
        assert publisher.wait_until_received(TIMEOUT)
        return take(count)

    monkeypatch.setattr(subscription._reader, "take", publish_and_take)
    assert len(subscription.take()) == depth + 1

    def fail(count):
        raise ValueError("cannot be decoded")

    monkeypatch.setattr(subscription._reader, "take", fail)
    assert subscription.take() == []
    assert subscription.num_malformed == depth + 1


def num_descriptors():
    return len(os.listdir("/proc/self/fd"))


def test_closed_domain_leaves_no_descriptor_and_no_publisher(monkeypatch):
    monkeypatch.setenv("CYCLONEDDS_URI", DOMAIN_FILE)
    number, before, kept = next(DOMAINS), num_descriptors(), []
    for _ in range(3):
        ros = module.RosDomain(number)
        assert ros.publishers() == [], "a publisher of a closed domain remains"
        # These objects exist until the end of the test, as in a notebook.
        kept.append((ros, ros.subscribe("/a", JointState), ros.advertise("/a", JointState)))
        assert ros.wait_until(kept[-1][2].num_subscribers, TIMEOUT)
        ros.close()
        ros.close()
        kept[-1][0]._pipe.notify(None)  # DDS may call a listener after the end
        # Another thread deletes the readers, and with them the sockets of the domain.
        wait_until(lambda: num_descriptors() <= before, "end of the descriptors")


def test_arriving_message_wakes_up(domain):
    subscription, publisher = domain.subscribe("/wake", JointState), domain.advertise("/wake", JointState)
    assert domain.wait_until(publisher.num_subscribers, TIMEOUT)
    domain.clear()
    assert not domain.wait(0.0)
    publisher.publish(joint_state(1))
    assert domain.wait(TIMEOUT)
    assert not domain.wait(0.0)
    assert len(subscription.take()) == 1
    assert not domain.wait_until(lambda: False, 0.01)


def test_malformed_text_is_counted(domain):
    from cyclonedds._clayer import ddspy_write
    from cyclonedds.pub import DataWriter
    from cyclonedds.topic import Topic

    subscription = domain.subscribe("/text", StringStamped, depth=10)
    topic = Topic(domain.participant, topic_module.dds_topic("/text"), StringStamped)
    writer = DataWriter(domain.participant, topic, qos=topic_module.ros_qos(10))
    assert domain.wait_until(subscription.num_publishers, TIMEOUT)
    message = StringStamped(messages.Header(), "abc")
    encoded = message.serialize(use_version_2=False)
    for data in (encoded, encoded.replace(b"abc", b"\xff\xfe\xfd"), encoded, b"\xff" * 40, encoded):
        # DDS itself refuses the last but one, which contains no text.
        ddspy_write(writer._ref, data + bytes(-len(data) % 4))
    assert received(domain, subscription, 3) == [message] * 3
    assert subscription.num_malformed == 1


def test_publisher_of_another_layout_is_not_received(domain):
    from cyclonedds.idl import IdlStruct
    from cyclonedds.idl.types import uint32
    from cyclonedds.pub import DataWriter
    from cyclonedds.topic import Topic

    @dataclass
    class Other(IdlStruct, typename=messages.dds_type_name(StringStamped)):
        number: uint32 = 0

    subscription = domain.subscribe("/other", StringStamped, depth=10)
    topic = Topic(domain.participant, topic_module.dds_topic("/other"), Other)
    writer = DataWriter(domain.participant, topic, qos=topic_module.ros_qos(10))
    publisher = domain.advertise("/other", StringStamped)
    assert domain.wait_until(lambda: len(domain.publishers()) == 2, TIMEOUT)
    assert domain.wait_until(publisher.num_subscribers, TIMEOUT)
    writer.write(Other(1))
    publisher.publish(StringStamped(string="a"))
    assert received(domain, subscription, 1) == [StringStamped(string="a")]
    assert subscription.num_publishers() == 1


def payloads(frame):
    """Yields the serialized messages of user topics in an Ethernet frame, see the DDSI-RTPS standard, 9.4."""
    data_submessage, inline_qos, ipv4, udp = 0x15, 0x02, 0x0800, 17
    if len(frame) < 42 or frame[12:14] != ipv4.to_bytes(2, "big") or frame[23] != udp:
        return
    rtps, position = frame[42:], 20
    while rtps.startswith(b"RTPS") and position < len(rtps):
        kind, flags, length = struct.unpack_from("<BBH", rtps, position)
        begin = position + 4
        position = begin + length if length else len(rtps)
        body = rtps[begin:position]
        if kind == data_submessage and not flags & inline_qos and body[11] & 0xC0 == 0:
            yield body[4 + struct.unpack_from("<H", body, 2)[0] :]


def test_bytes_on_the_network_end_with_zeros(domain, arm):
    publisher = domain.advertise(ros_arm.COMMAND, JointState)
    assert domain.wait_until(publisher.num_subscribers, TIMEOUT)
    sent = [JointState(messages.Header(messages.Time(1, 2)), ["a" * k], [1.0], [], [2.0] * k) for k in range(9)]
    sent += [JointState(name=["a" * k]) for k in range(9)]
    captured = []
    with socket.socket(socket.AF_PACKET, socket.SOCK_RAW, socket.htons(3)) as network:
        network.bind(("lo", 0))
        network.setblocking(False)
        for message in sent:
            publisher.publish(message)
            assert publisher.wait_until_received(TIMEOUT)
            with contextlib.suppress(BlockingIOError):
                while True:
                    captured += payloads(network.recv(1 << 16))
    for message in sent:
        encoded = message.serialize(use_version_2=False)
        assert encoded + bytes(-len(encoded) % 4) in captured
        if len(encoded) % 4:
            assert encoded not in captured


def test_lost_network_prints_nothing(monkeypatch, capfd):
    peer = '<Peer address="192.0.2.1"/></Peers>'
    monkeypatch.setenv("CYCLONEDDS_URI", DOMAIN_FILE.replace("</Peers>", peer))
    ros = module.RosDomain(next(DOMAINS))
    ros.wait_until(lambda: False, 1.5)  # three announcements to an address without a route
    assert capfd.readouterr() == ("", "")


def test_reason_of_an_invalid_configuration_is_printed(monkeypatch, capfd):
    monkeypatch.setenv("CYCLONEDDS_URI", "<CycloneDDS><Domain><Invalid/></Domain></CycloneDDS>")
    with pytest.raises(DvrkDrakeError, match=r"ROS domain \d+ cannot be used. CYCLONEDDS_URI is .<Cyc"):
        module.RosDomain(next(DOMAINS))
    printed = capfd.readouterr().err.splitlines()
    assert len(printed) == 1
    assert "Invalid: unknown element" in printed[0]
