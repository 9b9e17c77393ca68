"""Collector over ROS 2 with a substitute for the arm, without DDS."""

from types import SimpleNamespace

import numpy as np
import pytest
from sticky_arm import Disk

from dvrk_drake.analysis.excitation.pose_file import CollectionFile
from dvrk_drake.dynamics.identified_model import ControlModel, IdentifiedModel
from dvrk_drake.errors import CollectionError
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.processes.arm_controller import GoalController, MotionStyle
from dvrk_drake.processes.collector import DELAY, CollectionSettings, Collector, approaches, estimated_duration, summary
from dvrk_drake.processes.recorder import bag_path
from dvrk_drake.systems.ros.crtk_link import GOAL_PERIOD, CrtkMoveLink

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
        self.link.now = lambda: arm.time
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
                status = self.link.poll()
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


pytest.importorskip("cyclonedds", reason="needs cyclonedds")


MTML = load_arm("mtml")
POSES = MTML.sample_poses(2, np.random.default_rng(0), margin=0.1)


@pytest.fixture
def collection(tmp_path):
    """Returns a collection of `POSES` with an arm at zero and dry friction."""
    return Collection(SubstituteArm(MTML, 0.1 * MTML.effort_limits), POSES, tmp_path / "p.csv")


def in_motion(collection):
    """Returns a condition that is true during the motion to the first pose."""
    return lambda: len(collection.arm.goals) > 3


def test_goals_advance_slowly_on_a_line(collection):
    collection.run()
    goals = np.array(collection.arm.goals)
    speed = (MTML.position_upper - MTML.position_lower) / 1.0
    steps = np.abs(np.diff(goals, axis=0))
    assert np.all(steps <= speed * (GOAL_PERIOD + 2 * PERIOD))
    first = goals[: 1 + int(np.argmax(np.all(goals == goals[np.argmax(np.abs(goals[:, 6]))], axis=1)))]
    progress = first @ first[-1] / (first[-1] @ first[-1])
    np.testing.assert_allclose(first, np.outer(progress, first[-1]), rtol=0, atol=1e-9)


def test_pause_holds_and_repeats_the_pose(collection):
    arm = collection.arm
    collection.run(in_motion(collection))
    collection.keys = 1
    collection.run(lambda: collection.collector.paused)
    assert arm.commands == ["move_jp", "hold"] and "paused" in collection.collector.describe()
    goals, end = len(arm.goals), arm.time + 5.0
    arm.extra = 2 * MTML.effort_limits  # an operator may push the arm
    collection.run(lambda: arm.time > end)
    arm.extra = np.zeros(7)
    assert len(arm.goals) == goals and collection.collector.paused
    collection.keys = 1
    assert collection.run().done.all() and not collection.collector.paused
    assert arm.commands == ["move_jp", "hold", "move_jp", "hold"]
    assert collection.lines[:2] == ["paused: the arm holds its pose; Enter continues", "continued"]


def disturb(arm, **changes):
    for name, value in changes.items():
        setattr(arm, name, value)


def jump(arm):
    arm.q = arm.q + np.eye(7)[2] * 0.1 * (MTML.position_upper - MTML.position_lower)


@pytest.mark.parametrize(
    ("fault", "message"),
    [
        (lambda arm: disturb(arm, extra=np.eye(7)[1] * 0.75 * MTML.effort_limits), "of shoulder_pitch differs from"),
        (lambda arm: disturb(arm, is_blocked=True), "does not follow: "),
        (lambda arm: disturb(arm, is_silent=True), "no message on /MTML/measured_js for 1 s"),
        (lambda arm: disturb(arm, problem="/MTML/measured_js: a position is not finite"), "is not finite"),
        (jump, "elbow_pitch jumped by 0.1"),
        (lambda arm: disturb(arm, stamp_offset=-10 * 10**9), "the time stamp changed by -9.9"),
        (lambda arm: disturb(arm, stamp_offset=10 * 10**9), "the time stamp changed by 10.0"),
        (lambda arm: disturb(arm, state="DISABLED"), "operating_state is DISABLED"),
        (lambda arm: disturb(arm, is_homed=False), "operating_state is ENABLED"),
        (
            lambda arm: disturb(arm, others=["/MTML/servo_jp"], domain=SimpleNamespace(num_changes=1)),
            "another process publishes /MTML/servo_jp",
        ),
        (lambda arm: disturb(arm, unheard=["move_jp"]), "no process subscribes to /MTML/move_jp"),
    ],
)
def test_soft_stops(collection, fault, message):
    collection.run(in_motion(collection))
    fault(collection.arm)
    goals, start = len(collection.arm.goals), collection.arm.time
    problem = collection.run().problem
    assert isinstance(problem, CollectionError) and str(problem).startswith(
        ("MTML stopped: ", "MTML does not follow: ")
    )
    assert message in str(problem) and "\n" not in str(problem)
    is_slow = "follow" in message or "1 s" in message
    assert collection.arm.time - start < (3.0 if is_slow else 0.1)
    # While an arm does not follow, its goal does not move away from it.
    ahead = np.abs(np.array(collection.arm.goals[goals - 1 :]) - collection.arm.q)
    span = MTML.position_upper - MTML.position_lower
    assert np.all(ahead <= 0.1 * span + span * (GOAL_PERIOD + 2 * PERIOD)) or "jumped" in message


@pytest.mark.parametrize(("speed", "is_accepted"), [(0.02, True), (0.001, False)])
def test_slow_arm_is_waited_for(collection, speed, is_accepted):
    """The speed is given in ranges of the joints per second. The goals move by up to one range per second."""
    collection.arm._speed = speed * (MTML.position_upper - MTML.position_lower)
    problem = collection.run().problem
    assert problem is None if is_accepted else "does not follow: " in str(problem)


def test_goals_of_the_summary_contain_the_approaches():
    settings = CollectionSettings(1.0)
    pose = np.zeros(7)
    ends = np.array(approaches(MTML, pose, settings, MotionStyle.of_goals(MTML)))
    line = summary(MTML, pose, pose[None], settings)[1]
    assert ends[0, 0] < 0 < ends[1, 0] and line.endswith(f"{ends[0, 0]:.3f} to {ends[1, 0]:.3f}")
    assert np.all(MTML.position_lower <= ends) and np.all(ends <= MTML.position_upper)


def test_short_effort_peak_is_accepted(collection):
    collection.run(in_motion(collection))
    collection.arm.extra, end = 2 * MTML.effort_limits, collection.arm.time + 3.5 * PERIOD
    collection.run(lambda: collection.arm.time > end)
    collection.arm.extra = np.zeros(7)
    assert collection.run().problem is None


def test_start_outside_the_limits_is_refused(collection):
    collection.arm.q = MTML.position_upper + 0.1
    assert "cannot start: outer_yaw = " in str(collection.run().problem)
    assert not collection.arm.goals


def test_estimated_duration(collection):
    settings = CollectionSettings(1.0)
    estimate = estimated_duration(MTML, np.zeros(7), POSES, settings)
    start = collection.arm.time
    collection.run()
    # The substitute follows without delay. Each of the 8 motions takes at most the period of the goals longer.
    stops = 4 * len(POSES)
    assert 0 <= collection.arm.time - start - (estimate - stops * DELAY) < stops * GOAL_PERIOD
    lines = summary(MTML, np.zeros(7), POSES, settings)
    assert len(lines) == 9 and lines[-1].startswith("2 poses, each approached from both sides; estimated duration 0.")
    assert lines[1].startswith("outer_yaw            0.000")


@pytest.mark.parametrize("value", [0.0, 2.5, float("nan")])
def test_settings_are_checked(value):
    with pytest.raises(CollectionError, match="max_effort"):
        CollectionSettings(max_effort=value)


def test_bag_path(tmp_path):
    assert bag_path(tmp_path / "poses.csv") == tmp_path / "poses_1.mcap"
    (tmp_path / "poses_1.mcap").touch()
    (tmp_path / "poses_2.mcap").symlink_to("nowhere")
    assert bag_path(tmp_path / "poses.csv") == tmp_path / "poses_3.mcap"
