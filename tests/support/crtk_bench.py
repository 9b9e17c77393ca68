"""Test bench for a bridge to a dVRK: a substitute client without DDS, and clocks that the test sets."""

from types import SimpleNamespace

import numpy as np

from dvrk_drake.lcmtypes import lcmt_dvrk_command as Command
from dvrk_drake.lcmtypes import lcmt_dvrk_status as Status
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.models.lcm_messages import decode
from dvrk_drake.systems.driver import DvrkDriver
from dvrk_drake.systems.guard.settings import GuardSettings, PlausibilitySettings
from dvrk_drake.systems.ros import crtk_client
from dvrk_drake.systems.ros.crtk_bridge import CrtkBridge
from dvrk_drake.systems.ros.crtk_client import JointMeasurement

MS = 1_000_000
START = 1_795_257_600 * 10**9
ARMS = {name: load_arm(name) for name in ("mtml", "psm")}
POSES = {"mtml": [0.1, 0.4, -0.25, 0.6, 0.9, 0.1, 0.5], "psm": [0.2, -0.3, 0.1, 0.5, 0.2, -0.3, 0.3]}


class SubstituteClient:
    """Client of an arm that stores commands in `sent`, each a tuple of the name of the topic and its values."""

    def __init__(self, name):
        self.arm, self.namespace = ARMS[name], f"/{ARMS[name].name}"
        self.measurement, self.gravity_compensation, self.not_ready_reason = None, 0.0, ""
        self.others, self.domain = [], SimpleNamespace(num_changes=0, clear=lambda: None)
        self.sent, self.is_new, self.other_hold, self.confirms = [], False, False, True
        self.num_read_again = 0
        #: Effort of the dVRK's own gravity compensation after it was switched off; None: no message arrives.
        self.gravity_after_switch = 0.0

    def receive_measurement(self):
        is_new, self.is_new = self.is_new, False
        return is_new

    def receive_state(self):
        if self.gravity_compensation is None:
            self.gravity_compensation = self.gravity_after_switch

    def other_publishers(self):
        return self.others

    def read_state_again(self):
        self.num_read_again += 1

    def take_other_hold(self):
        taken, self.other_hold = self.other_hold, False
        return taken

    def hold_until_confirmed(self, seconds):
        self.hold()
        return self.confirms

    def use_gravity_compensation(self, on):
        self.sent.append(("use_gravity_compensation", on))

    def hold(self):
        self.sent.append(("hold",))

    def state_command(self, command):
        self.sent.append(("state_command", command))

    def servo_jf(self, effort):
        self.sent.append(("servo_jf", np.array(effort)))

    def servo_jp(self, q, v=None):
        self.sent.append(("servo_jp", np.array(q)))

    def servo_separate(self, name, value):
        self.sent.append((f"separate/{name}", value))


class CrtkBench:
    """Bridge with a substitute client. The arm is at rest and measures no effort, as in a kinematic simulation.

    Attributes:
        now: Time of the monotonic clock [ns].
        statuses: Statuses so far.
        lines: Reported lines so far.
        blocked: Problem of the deadman process, or "".
    """

    def __init__(self, monkeypatch, name="mtml", *, period=1.0, modes=("position", "effort"), key_file=""):
        monkeypatch.setattr(crtk_client, "time", self)
        self.now, self.statuses, self.lines, self.blocked = 10_000 * MS, [], [], ""
        self.client, self.period = SubstituteClient(name), period
        n = self.client.arm.num_joints
        self.q, self.v, self.effort, self.stamp_offset = np.array(POSES[name]), np.zeros(n), np.zeros(n), 0
        self.problem, self.raw, self.sequence = "", [], 0
        guard = GuardSettings(plausibility=PlausibilitySettings(start_gravity=2.0, tracking_error=1.0, zero_time=1.0))
        driver = DvrkDriver(guard=guard, control_modes=list(modes), key_file=str(key_file))
        self.bridge = CrtkBridge(
            self.client,
            driver,
            self._store,
            report=self.lines.append,
            deadman=SimpleNamespace(problem=lambda: self.blocked, close=self._close_deadman),
        )

    def _close_deadman(self, *, is_confirmed):
        self.lines.append("deadman ended" if is_confirmed else "deadman repeats hold")

    def time_ns(self):
        return START + self.now

    def monotonic_ns(self):
        return self.now

    def _store(self, data):
        self.raw.append(data)
        self.statuses.append(decode(Status, data))

    @property
    def status(self):
        return self.statuses[-1]

    @property
    def sent(self):
        return self.client.sent

    def names(self):
        """Returns the topics of the commands since the last call of `clear`."""
        return [name for name, *_ in self.sent]

    def clear(self):
        self.sent.clear()

    def measure(self):
        """Lets a measurement arrive now."""
        q, v, effort = (np.full(len(self.q), np.nan) if self.problem else x for x in (self.q, self.v, self.effort))
        stamp = START + self.now + self.stamp_offset
        self.client.measurement = JointMeasurement(q.copy(), v.copy(), effort.copy(), stamp, self.now, self.problem)
        self.client.is_new = True

    def tick(self, count=1):
        """Advances by `count` periods with one measurement each, and updates the bridge."""
        for _ in range(count):
            self.now += round(self.period * MS)
            self.measure()
            self.bridge.update()
        return self

    def command(self, mode=Command.EFFORT, **fields):
        """Returns an encoded command that answers the last status."""
        self.sequence += 1
        command, n = Command(), len(self.q)
        command.utime, command.sequence, command.sender_id = self.now // 1000, self.sequence, 5
        command.session_id, command.status_utime = self.status.session_id, self.status.utime
        command.arm_name, command.num_joints, command.control_mode = self.client.arm.name, n, mode
        command.position, command.velocity, command.effort = self.q.tolist(), [0.0] * n, [0.0] * n
        for name, value in fields.items():
            setattr(command, name, value)
        return command.encode()

    def run(self, count, mode=Command.EFFORT, **fields):
        """Answers `count` measurements with commands."""
        for _ in range(count):
            self.tick()
            self.now += MS // 10
            self.bridge.put(self.command(mode, **fields))
            self.bridge.update()
        return self

    def ready(self):
        """Runs until the rate is determined and the guard accepts commands."""
        return self.tick(150)

    def started(self, mode=Command.EFFORT):
        """Runs until commands act."""
        self.ready().run(300, mode)
        assert self.status.guard_state in (Status.STATE_EFFORT, Status.STATE_POSITION), self.lines
        return self

    def reset(self):
        """Resets a fault, or resumes."""
        self.run(1, Command.HOLD)
        return self.run(1, Command.HOLD, reset_fault=True).tick()
