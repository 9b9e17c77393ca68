"""Bridge of docs/connecting_a_real_dvrk.md with a simulated arm and network."""

import re
from collections import deque

import numpy as np
import pytest
from repository import ROOT

from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.lcmtypes import lcmt_dvrk_command as Command
from dvrk_drake.lcmtypes import lcmt_dvrk_status as Status
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.models.lcm_messages import MessageKey
from dvrk_drake.systems.guard.settings import GuardSettings

DOCUMENT = ROOT / "docs" / "connecting_a_real_dvrk.md"
ARM = load_arm("mtml")
N = ARM.num_joints
BAD = GuardSettings().plausibility.bad_samples
#: The simulated arm has no weight.
MODEL = IdentifiedModel.from_arm(ARM).with_scaled_parameters(
    np.zeros(len(IdentifiedModel.from_arm(ARM).base_parameters))
)
HELD = 0.02 * ARM.effort_limits


class Network:
    """Part of lcm.LCM that a bridge uses. Published messages are handled later, in order."""

    def __init__(self):
        self.handlers, self.queue, self.published = {}, deque(), []

    def subscribe(self, channel, handler):
        self.handlers[channel] = handler
        return self

    def set_queue_capacity(self, capacity):
        assert capacity >= 100

    def publish(self, channel, data):
        self.published.append((channel, data))

    def handle_timeout(self, milliseconds):
        if not self.queue:
            return 0
        self.handlers["DVRK_COMMAND_MTML"]("DVRK_COMMAND_MTML", self.queue.popleft())
        return 1


class Crtk:
    """ROS interface of an arm that does not move. It stores the last command."""

    def __init__(self, clock):
        self.q, self.age, self.state, self.sent = np.full(N, 0.1), 0.0, "ENABLED", []
        self.clock, self.came = clock, lambda: clock() - round(1e6 * self.age)

    def measured(self):
        return self.q, np.zeros(N), HELD, self.came()

    def operating_state(self):
        return self.state

    def use_gravity_compensation(self, on):
        return on

    def servo_jf(self, effort):
        self.sent.append(("servo_jf", np.array(effort)))

    def servo_jp(self, position, velocity):
        self.sent.append(("servo_jp", np.array(position)))

    def state_command(self, command):
        self.sent.append((command, None))
        self.state = "DISABLED"

    def hold(self):
        self.sent.append(("hold", None))


class Scene:
    """Runs the document's bridge; `script(scene, k)` is called before each of its periods."""

    def __init__(self, script, periods, settings=None):
        self.crtk, self.network, self.utime, self.statuses = Crtk(lambda: self.utime), Network(), 10**15, []
        self.script, self.periods, self.k, self.settings = script, periods, -1, settings or GuardSettings()
        self.modes, self.key = None, None

    def run(self):
        namespace = {}
        for block in re.findall(r"```python\n(.*?)```", DOCUMENT.read_text(encoding="utf-8"), re.DOTALL):
            exec(block, namespace)
        namespace["run_bridge"](
            self.crtk,
            ARM,
            MODEL,
            self.settings,
            self.network,
            lambda: self.utime,
            self.next_period,
            self.key,
            self.modes,
        )
        self.receive()
        return self

    def receive(self):
        while self.network.published:
            channel, data = self.network.published.pop(0)
            assert channel == "DVRK_STATUS_MTML"
            assert self.key is None or self.key.verify(data)
            self.statuses.append(Status.decode(data))

    def next_period(self):
        self.receive()
        self.k += 1
        self.utime += 1000
        if self.k < self.periods:
            self.script(self, self.k)
        return self.k < self.periods

    def send(self, mode, sender=3, **fields):
        if not self.statuses:
            return
        status, command = self.statuses[-1], Command()
        command.utime, command.sequence, command.sender_id = self.utime, status.sequence, sender
        command.session_id, command.status_utime = status.session_id, status.utime
        command.arm_name, command.num_joints, command.control_mode = "MTML", N, mode
        command.position, command.velocity, command.effort = list(status.position), [0.0] * N, list(HELD)
        for name, value in fields.items():
            setattr(command, name, value)
        self.network.queue.append(command.encode())

    def topics(self, begin, end):
        return {topic for topic, _ in self.crtk.sent[begin:end]}


@pytest.mark.parametrize("message", [Command, Status])
def test_page_documents_every_field(message):
    text = DOCUMENT.read_text(encoding="utf-8")
    assert not [name for name in message.__slots__ if f"`{name}`" not in text]


def test_efforts_act_and_end_in_hold_without_controller():
    scene = Scene(lambda scene, k: k < 400 and scene.send(Command.EFFORT), 500).run()
    assert scene.topics(0, 250) == {"servo_jp"}
    assert scene.topics(260, 445) == {"servo_jf"}
    assert scene.topics(455, 500) == {"servo_jp"}
    np.testing.assert_allclose(scene.crtk.sent[400][1], HELD, atol=1e-12)
    assert scene.crtk.sent[500:] == [("hold", None)]
    assert [s.sequence for s in scene.statuses] == list(range(1, 501))
    assert {s.session_id for s in scene.statuses} == {scene.statuses[0].session_id} != {0}
    assert scene.statuses[-1].num_expired == 1
    np.testing.assert_allclose(scene.statuses[400].effort_commanded, HELD, atol=1e-12)


def test_missing_measurements_end_efforts():
    def script(scene, k):
        scene.send(Command.EFFORT)
        scene.crtk.age = max(0, k - 300) * 1e-3

    scene = Scene(script, 400).run()
    assert scene.topics(260, 320) == {"servo_jf"}
    # A few bad measurements are tolerated in HOLD.
    assert scene.topics(321, 321 + BAD) == {"servo_jp"}
    assert scene.topics(321 + BAD, 400) == {"hold"}
    assert scene.statuses[-1].fault_text == "the measurement is 0.041 s old; allowed: 0 to 0.02 s"
    # Statuses carry the constant time of the measurement, so nothing is recorded twice.
    assert len({status.utime for status in scene.statuses[300:]}) == 1


def test_repeated_measurement_keeps_its_time():
    """A state at 500 Hz in a slow loop at 1 kHz is one measurement and is recorded once."""

    def script(scene, k):
        crtk = scene.crtk
        if k % 2 == 0:
            came = scene.utime
            crtk.came = lambda: came
        crtk.operating_state = lambda: (setattr(scene, "utime", scene.utime + 17 * (k % 5)), "ENABLED")[1]

    utimes = [status.utime for status in Scene(script, 100).run().statuses]
    assert utimes[::2] == utimes[1::2]
    assert len(set(utimes)) == 50


def test_arm_after_off_is_held_at_measured_pose():
    def script(scene, k):
        crtk = scene.crtk
        if k == 300:
            crtk.state = "DISABLED"
        if 300 < k <= 400:
            crtk.q = crtk.q - 1e-3
        if k == 450:
            crtk.state = "ENABLED"
        if k < 455:
            scene.send(Command.EFFORT if k < 300 else Command.HOLD)
        elif k < 460:
            scene.send(Command.HOLD, reset_fault=True)

    scene = Scene(script, 500).run()
    assert scene.topics(290, 300) == {"servo_jf"}
    assert scene.topics(300, 455) == {"hold"}
    assert scene.topics(457, 500) == {"servo_jp"}
    np.testing.assert_array_equal(scene.crtk.sent[470][1], scene.crtk.q)
    assert scene.statuses[299].guard_state == Status.STATE_EFFORT
    assert {s.fault_text for s in scene.statuses[300:455]} == {"operating_state is DISABLED"}
    assert scene.statuses[-1].guard_state == Status.STATE_HOLD


def test_off_is_not_accepted():
    scene = Scene(lambda scene, k: scene.send(Command.OFF if k >= 300 else Command.HOLD), 320).run()
    assert scene.topics(0, 320) == {"servo_jp"}
    assert scene.statuses[-1].refusal_code == Status.REFUSAL_BAD_MODE


def test_off_disables_arm_if_bridge_accepts_it():
    scene = Scene(lambda scene, k: scene.send(Command.OFF if k >= 300 else Command.HOLD), 320)
    scene.modes = (Command.POSITION, Command.EFFORT, Command.OFF)
    scene.run()
    assert scene.topics(0, 300) == {"servo_jp"}
    topics = [topic for topic, _ in scene.crtk.sent[300:]]
    assert topics[0] == "disable" and set(topics[1:]) == {"hold"}
    assert scene.statuses[-1].fault_text == "operating_state is DISABLED"


def test_a_second_controller_is_ignored_and_counted():
    def script(scene, k):
        scene.send(Command.EFFORT)
        if k >= 300:
            scene.send(Command.EFFORT, sender=4)

    scene = Scene(script, 400).run()
    assert scene.topics(301, 400) == {"servo_jf"}
    last = scene.statuses[-1]
    assert (last.num_ignored, last.ignored_code) == (100, Status.REFUSAL_OTHER_SENDER)
    assert (last.num_refused, last.fault_code, last.command_sender_id) == (0, Status.FAULT_NONE, 3)


def test_bridge_with_key_verifies_and_signs():
    key = MessageKey(bytes(range(32)))

    def script(scene, k):
        if not scene.statuses:
            return
        if k >= 300:
            scene.send(Command.EFFORT, effort=list(ARM.effort_limits), sequence=scene.statuses[-1].sequence + 1)
        scene.send(Command.EFFORT)
        scene.network.queue[-1] = key.sign(scene.network.queue[-1])

    scene = Scene(script, 400)
    scene.key = key
    scene.run()
    assert scene.topics(301, 400) == {"servo_jf"}
    np.testing.assert_allclose(scene.crtk.sent[399][1], HELD, atol=1e-12)
    last = scene.statuses[-1]
    assert (last.num_ignored, last.ignored_code) == (100, Status.REFUSAL_NOT_AUTHENTIC)
    assert {status.mac_size for status in scene.statuses} == {16}


def test_tenth_of_the_limits_of_the_checklist():
    (text,) = set(re.findall(r"`(GuardSettings\(.*?\))`", DOCUMENT.read_text(encoding="utf-8")))
    settings = eval(text)
    scene = Scene(lambda scene, k: scene.send(Command.EFFORT, effort=list(HELD if k < 300 else ARM.effort_limits)), 600)
    scene.settings = settings
    scene.run()
    efforts = np.array([effort for topic, effort in scene.crtk.sent if topic == "servo_jf"])
    assert efforts.max(axis=0) == pytest.approx(0.1 * ARM.effort_limits)
    assert np.all(np.abs(np.diff(efforts, axis=0)) <= 0.005 * ARM.effort_limits * (1 + 1e-9))
