"""Bridge beside bad messages over DDS, of the arm and of another process that commands the arm.

The bridge continues. It commands only within limits, and no efforts while another process could command the arm.
"""

import os
import threading

import numpy as np
import pytest
from ros_bridge import CommandMonitor, Operator, start_bridge
from ros_publisher import DOMAIN_FILE
from waiting import TIMEOUT, wait_until

from dvrk_drake.lcmtypes import lcmt_dvrk_status as Status
from dvrk_drake.models.arm_files import load_arm

pytestmark = [pytest.mark.network, pytest.mark.realtime]

ARM = load_arm("mtml")
NAMES, POSE = list(ARM.joint_names), [0.1, 0.4, -0.25, 0.6, 0.9, 0.1, 0.5]
os.environ.setdefault("CYCLONEDDS_URI", DOMAIN_FILE)


class BadArm:
    """Publishes valid measurements of an enabled arm at 1 kHz in a thread."""

    def __init__(self):
        from dvrk_drake.systems.ros import messages as m
        from dvrk_drake.systems.ros.domain import RosDomain

        self.m, self.domain = m, RosDomain(0)
        topics = {
            "measured_js": m.JointState,
            "gravity_compensation/setpoint_js": m.JointState,
            "operating_state": m.OperatingState,
        }
        self.publishers = {
            name: self.domain.advertise(f"/MTML/{name}", kind, latched=name == "operating_state")
            for name, kind in topics.items()
        }
        self.monitor = CommandMonitor(self.domain, "/MTML")
        self.ended = threading.Event()
        self.set_state("ENABLED")
        self.thread = threading.Thread(target=self._run, daemon=True)
        self.thread.start()

    def set_state(self, state, is_homed=True):
        message = self.m.OperatingState(self.m.Header.now(), state, is_homed, False)
        self.publishers["operating_state"].publish(message)

    def _run(self):
        zeros = [0.0] * len(POSE)
        while not self.ended.wait(0.001):
            message = self.m.JointState(self.m.Header.now(), list(NAMES), list(POSE), zeros, zeros)
            self.publishers["measured_js"].publish(message)
            off = self.m.JointState(self.m.Header.now(), list(NAMES), [], [], zeros)
            self.publishers["gravity_compensation/setpoint_js"].publish(off)

    def end(self):
        self.ended.set()
        self.thread.join(TIMEOUT)


@pytest.fixture
def arm():
    arm = BadArm()
    yield arm
    arm.end()


def test_bad_and_random_messages_do_not_end_the_bridge(arm, tmp_path):
    operator, bridge = Operator("mtml"), start_bridge("mtml", tmp_path)
    try:
        wait_until(lambda: arm.monitor.first(["servo_jp"], 0), "first command", bridge)
        send_random_messages(arm)
        arm.set_state("ENABLED")
        count = len(operator.received)
        wait_until(lambda: len(operator.received) > count + 50, "statuses", bridge)
        assert bridge.poll() is None
        assert operator.last.guard_state in (Status.STATE_HOLD, Status.STATE_FAULT)
        commands = arm.monitor.receive()
        assert commands
        assert not [name for name, *_ in commands if name == "servo_jf"]
        for name, _, message in commands:
            if name == "servo_jp":
                assert not ARM.limit_violations(np.array(message.position))
    finally:
        bridge.end()
        operator.end()


def send_random_messages(arm):
    """Sends 10,000 random messages on the topics that the bridge reads, between the valid ones."""
    m, generator = arm.m, np.random.default_rng(5)
    values = [0.0, -1.0, np.nan, np.inf, -np.inf, 1e308, -1e-320]
    words = ["ENABLED", "DISABLED", "PAUSED", "FAULT", "", "x" * 2000, "a\nb", "%s", *NAMES]

    def numbers():
        return [float(generator.choice(values)) for _ in range(generator.integers(0, 12))]

    def header():
        return m.Header(m.Time(int(generator.integers(-(2**31), 2**31)), int(generator.integers(0, 2**32))), "")

    def names():
        return NAMES if generator.random() < 0.5 else [str(word) for word in generator.choice(words, 7)]

    for k in range(10_000):
        topic = ("measured_js", "gravity_compensation/setpoint_js", "operating_state")[k % 3]
        if topic == "operating_state":
            flags = [bool(flag) for flag in generator.integers(0, 2, 2)]
            message = m.OperatingState(header(), str(generator.choice(words)), *flags)
        else:
            message = m.JointState(header(), names(), numbers(), numbers(), numbers())
        arm.publishers[topic].publish(message)
