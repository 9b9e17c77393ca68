"""`dvrk-drake sim-arm --transport ros` beside a publisher of random and malformed messages over DDS.

While the arm is not ready, no message changes its state, its set-point or its efforts. While it is ready, this holds
for messages that are not valid.
"""

import itertools
import re

import numpy as np
import pytest
from crtk_conformance import start_simulated_arm
from ros_publisher import DOMAIN_FILE
from waiting import TIMEOUT

from dvrk_drake.models.arm_files import load_arm

m = pytest.importorskip("dvrk_drake.systems.ros.messages", reason="needs cyclonedds")

pytestmark = pytest.mark.network

ARM = load_arm("psm")
#: Number of joints in the topics without the jaw.
MAIN = ARM.num_joints - 1
JOINT_COMMANDS = ("servo_jp", "servo_jf", "move_jp")
TOPICS = {
    **dict.fromkeys(JOINT_COMMANDS, m.JointState),
    **{f"jaw/{name}": m.JointState for name in JOINT_COMMANDS},
    "servo_cp": m.PoseStamped,
    "move_cp": m.PoseStamped,
    "hold": m.Empty,
    "free": m.Empty,
    "use_gravity_compensation": m.Bool,
    "state_command": m.StringStamped,
}
NOT_FINITE = [np.nan, np.inf, -np.inf]
NUMBERS = [0.0, -0.3, 1.0, 1e-320, 1e6, -1e308, *NOT_FINITE]
WORDS = ["", "Enable", "enable ", "ENABLED", "home\n", "fault", "x" * 2000, "%s", "\x1b[2J", "é", "jaw"]
DISABLED, ENABLED, HOMED = ("DISABLED", True, False), ("ENABLED", False, False), ("ENABLED", True, False)


class RandomMessages:
    """Random messages with the types of the command topics."""

    def __init__(self):
        self.generator = np.random.default_rng(7)

    def any(self, name):
        """Returns a message of a topic. It may be a valid command, except that no state command is valid."""
        kind = TOPICS[name]
        if kind is m.JointState:
            names = [self.word() for _ in range(self.generator.integers(0, 9))]
            return kind(self.header(), names, self.numbers(), self.numbers(), self.numbers())
        if kind is m.PoseStamped:
            p, r = m.Point(*self.numbers(3)), m.Quaternion(*self.numbers(4))
            if self.generator.random() < 0.5:
                p, r = m.Point(0.0, 0.0, -0.1), m.Quaternion(0.0, 0.0, 0.0, 1.0)
            return kind(self.header(), m.Pose(p, r))
        if kind is m.StringStamped:
            return kind(self.header(), self.word())
        return m.Bool(bool(self.generator.integers(0, 2))) if kind is m.Bool else kind()

    def invalid(self, name):
        """Returns a message that the ready arm must refuse."""
        message = self.any(name)
        if TOPICS[name] is m.JointState:
            number = 1 if name.startswith("jaw/") else MAIN
            field = "effort" if name.endswith("servo_jf") else "position"
            if len(getattr(message, field)) == number:
                getattr(message, field)[-1] = float(self.generator.choice(NOT_FINITE))
        elif TOPICS[name] is m.PoseStamped:
            message.pose.position.x = float(self.generator.choice(NOT_FINITE))
        return message

    def numbers(self, length=None):
        if length is None:
            length = self.generator.choice([0, 1, MAIN - 1, MAIN, MAIN, MAIN + 1, 100])
        return [float(number) for number in self.generator.choice(NUMBERS, length)]

    def word(self):
        return str(self.generator.choice(WORDS))

    def header(self):
        seconds, nanoseconds = self.generator.integers(-(2**31), 2**31), self.generator.integers(0, 2**32)
        return m.Header(m.Time(int(seconds), int(nanoseconds)), self.word())


class Sender:
    """Sends messages to an arm, and stores its states and set-points meanwhile.

    Attributes:
        setpoints: Messages on setpoint_js since the last call of `forget`.
    """

    def __init__(self, subject):
        self.subject, self.random, self.setpoints = subject, RandomMessages(), []
        for name, kind in TOPICS.items():
            subject.advertise(name, kind)
        self._topic = subject.domain.subscribe(f"/{subject.arm}/setpoint_js", m.JointState, depth=10_000)
        assert subject.domain.wait_until(self._topic.num_publishers, TIMEOUT)
        self.next_setpoint()

    def next_setpoint(self):
        """Waits for a message on setpoint_js."""
        count = len(self.setpoints)

        def arrived():
            self.setpoints += [message for message, _ in self._topic.take()]
            return len(self.setpoints) > count

        assert self.subject.process.poll() is None
        assert self.subject.domain.wait_until(arrived, TIMEOUT)
        return self.setpoints[-1]

    def until(self, condition, what):
        def met():
            self.next_setpoint()
            return condition()

        assert self.subject.domain.wait_until(met, TIMEOUT), what

    def change_state(self, command, goal):
        self.subject.state_command(command)
        self.until(lambda: self.subject.state() == goal, command)

    def send(self, number, message, names=tuple(TOPICS)):
        """Sends messages on the topics in turn: one per topic and set-point, so that the arm reads each one.

        Args:
            number: Number of messages.
            message: Function from the name of a topic to a message.
            names: Names of the topics.
        """
        for k in range(number):
            if k % len(names) == 0:
                self.next_setpoint()
            self.subject.command(names[k % len(names)], message(names[k % len(names)]))
        for _ in range(10):
            self.next_setpoint()

    def send_malformed(self):
        """Sends texts that are not UTF-8. The writer of Cyclone DDS refuses other malformed data."""
        from cyclonedds._clayer import ddspy_write

        for name in ("state_command", *JOINT_COMMANDS, "servo_cp"):
            message = self.random.any(name)
            message.header.frame_id = "abc"
            data = message.serialize(use_version_2=False).replace(b"abc", b"\xff\xfe\xfd")
            writer = self.subject._publishers[name]._writer
            assert ddspy_write(writer._ref, data + bytes(-len(data) % 4)) == 0
            self.next_setpoint()


def test_random_messages_do_not_move_the_arm(monkeypatch):
    monkeypatch.setenv("CYCLONEDDS_URI", DOMAIN_FILE)
    with start_simulated_arm("psm", "PSM1", 500.0) as subject:
        check_arm(Sender(subject))
        states = [(state, homed) for state, homed, _ in subject.states]
    lines = subject.process.output().splitlines()
    start = [("DISABLED", False), ("ENABLED", False), ("ENABLED", True), ("DISABLED", True)]
    assert [state for state, _ in itertools.groupby(states)] == [*start, *start[1:3]]
    refused = [re.search(r"refused: .*?(?:\((\d+) more commands refused before\))?$", line) for line in lines]
    num_refused = sum(1 + int(match[1] or 0) for match in refused if match)
    # Those of the last 2 s are not counted, nor those on use_gravity_compensation.
    assert num_refused > 5000
    # Each line is complete, also for a text with a line break.
    assert all(re.match(r"starting|simulated|ended| *\d+\.\d{3} s  ", line) for line in lines), lines


def check_arm(sender):
    subject, random = sender.subject, sender.random

    # DISABLED, not homed: the measurements are not valid.
    sender.send(3000, random.any)
    sender.send_malformed()
    assert {message.header.nanoseconds for message in sender.setpoints} == {0}
    assert subject.state() == ("DISABLED", False, False)

    sender.change_state("enable", ENABLED)
    sender.change_state("home", HOMED)

    # DISABLED, homed: no motor has power.
    sender.change_state("disable", DISABLED)
    sender.until(lambda: sender.setpoints[-1].effort == [0.0] * MAIN, "no power")
    sender.setpoints.clear()
    sender.send(4000, random.any)
    sender.send_malformed()
    assert {tuple(message.effort) for message in sender.setpoints} == {(0.0,) * MAIN}
    assert subject.state() == DISABLED

    # ENABLED, not homed: the arm regulates one pose.
    sender.change_state("enable", ENABLED)
    sender.until(lambda: any(sender.setpoints[-1].effort), "power")
    sender.setpoints.clear()
    sender.send(3000, random.any)
    sender.send_malformed()
    assert len({tuple(message.position) for message in sender.setpoints}) == 1
    error = np.subtract(subject.latest().position, sender.setpoints[-1].position)
    assert np.max(np.abs(error)) < 0.05
    assert subject.state() == ENABLED

    # Ready, in position control.
    sender.change_state("home", HOMED)
    sender.next_setpoint()
    jaw = subject.latest("jaw/setpoint_js").position
    sender.setpoints.clear()
    sender.send(1000, random.invalid, [name for name in TOPICS if name != "free"])
    sender.send_malformed()
    assert len({tuple(message.position) for message in sender.setpoints}) == 1
    assert subject.latest("jaw/setpoint_js").position == jaw

    # Ready, in effort control. The commanded effort continues to act.
    effort = (0.01 * ARM.effort_limits[:MAIN]).tolist()
    subject.command("use_gravity_compensation", m.Bool(False))
    subject.command("servo_jf", m.JointState(m.Header.now(), effort=effort))
    sender.until(lambda: sender.setpoints[-1].effort == effort, "effort")
    sender.setpoints.clear()
    names = [*JOINT_COMMANDS, *(f"jaw/{name}" for name in JOINT_COMMANDS), "servo_cp", "move_cp", "state_command"]
    sender.send(1000, random.invalid, names)
    sender.send_malformed()
    assert {tuple(message.effort) for message in sender.setpoints} == {tuple(effort)}
    assert subject.state() == HOMED
