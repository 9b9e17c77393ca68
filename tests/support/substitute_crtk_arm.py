"""Substitute for CrtkClient: an arm that follows `move_jp` on its own clock, without DDS."""

from types import SimpleNamespace

import numpy as np
from sticky_arm import Disk

from dvrk_drake.analysis.excitation.pose_file import CollectionFile
from dvrk_drake.dynamics.identified_model import ControlModel, IdentifiedModel
from dvrk_drake.errors import CollectionError
from dvrk_drake.processes.arm_controller import GoalController
from dvrk_drake.processes.collector import CollectionSettings, Collector
from dvrk_drake.systems.ros.crtk_move_link import CrtkMoveLink

#: Interval of the measurements [s].
PERIOD = 0.01
#: Time stamp of the first measurement [ns].
_STAMP = 1_800_000_000_000_000_000


class SubstituteArm:
    """Arm with dry friction that follows its goals with limited speed. Only the attributes of CrtkClient that are used.

    Attributes:
        q: Measured positions (n,) [rad, m].
        friction: Dry friction (n,) [N m, N]. Its sign is that of the last motion.
        goals: Goals of `move_jp` so far.
        commands: Names of the commands so far, without repetitions.
        ticks: Number of periods so far.
    """

    namespace = "/MTML"

    def __init__(self, arm, friction=None):
        n = arm.num_joints
        self.arm, self.model = arm, ControlModel(IdentifiedModel.from_arm(arm))
        self.q, self.friction = np.zeros(n), np.zeros(n) if friction is None else friction
        self.goals, self.commands, self.ticks = [], [], 0
        self.state, self.is_homed, self.is_blocked, self.is_silent = "ENABLED", True, False, False
        self.extra = np.zeros(n)
        self.problem, self.others, self.unheard, self.num_received = "", [], [], 0
        self.domain = SimpleNamespace(num_changes=0)
        self.stamp_offset = 0
        self._target, self._direction = self.q, np.ones(n)
        self._speed = arm.position_upper - arm.position_lower
        self.measurement = None

    @property
    def time(self):
        """Present time of the arm [s]."""
        return 100.0 + PERIOD * self.ticks

    @property
    def operating_state(self):
        return SimpleNamespace(is_busy=bool(np.any(self.q != self._target)))

    @property
    def not_ready_reason(self):
        return "" if (self.state, self.is_homed) == ("ENABLED", True) else f"operating_state is {self.state}"

    def step(self):
        """Advances the arm by one period."""
        self.ticks += 1
        if not self.is_blocked:
            step = np.clip(self._target - self.q, -PERIOD * self._speed, PERIOD * self._speed)
            self._direction = np.where(step, np.sign(step), self._direction)
            self.q = self.q + step

    def receive(self):
        if self.is_silent:
            return False
        effort = self.model.gravity_effort(self.q) + self._direction * self.friction + self.extra
        stamp = _STAMP + round(1e9 * PERIOD * self.ticks) + self.stamp_offset
        self.measurement = SimpleNamespace(
            q=self.q, v=0.0 * self.q, effort=effort, stamp=stamp, arrival=round(1e9 * self.time), problem=self.problem
        )
        self.num_received += 1
        return True

    def move_jp(self, q):
        assert not self.arm.limit_violations(q, 1e-9)
        self.goals.append(np.array(q))
        self._target = self.goals[-1]
        self._command("move_jp")

    def hold(self):
        self._target = self.q
        self._command("hold")

    def other_publishers(self):
        return self.others

    def unheard_commands(self, names):
        return [f"/MTML/{name}" for name in names if name in self.unheard]

    def _command(self, name):
        if self.commands[-1:] != [name]:
            self.commands.append(name)


class Collection:
    """Collector of a substitute arm.

    Attributes:
        arm: Substitute arm.
        collector: Collector.
        lines: Reported lines.
        keys: Number of times that Enter will be reported as pressed.
    """

    def __init__(self, arm, poses, path, stopped=lambda: False, **settings):
        self.arm, self.lines, self.keys = arm, [], 0
        checked = CollectionSettings(**({"traverse_time": 1.0} | settings))
        self.output = CollectionFile(path, arm.arm, checked.both_sides)
        self.link = CrtkMoveLink(arm, arm.model, checked.max_effort)
        self.controller = GoalController(arm.arm, lambda: self.link.is_busy)
        self.collector = Collector(
            poses,
            self.controller,
            self.output,
            checked,
            stopped=stopped,
            enter=self._enter,
            report=self.lines.append,
            writer=Disk(),
        )

    def run(self, until=lambda: False, seconds=600.0):
        """Runs the collection until it has finished, or until a condition is true."""
        end, collector = self.arm.time + seconds, self.collector
        while not collector.finished and not until():
            assert self.arm.time < end, "the collection did not end"
            self.arm.step()
            try:
                status = self.link.update(self.arm.time)
            except CollectionError as error:
                collector.problem, collector.finished = error, True
                break
            if status is not None:
                desired = collector.update(status, self.arm.time)
                self.link.send(self.controller.answer(status, self.arm.time, desired))
        return collector

    def _enter(self):
        self.keys, pressed = max(self.keys - 1, 0), self.keys > 0
        return pressed
