"""State machine of the simulated dVRK arm, without ROS and without a simulation."""

import math

import numpy as np
import pytest
from pydrake.math import RigidTransform

from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.systems.ros.crtk_arm_state import CrtkArmState, CrtkCommand

ARMS = {name: load_arm(name) for name in ("mtml", "mtmr", "psm")}
MTM, PSM = ARMS["mtml"], ARMS["psm"]
PERIOD = 0.001


class Bench:
    """Steps a state machine with an ideal arm: the measured pose is the set-point of the last step."""

    def __init__(self, arm, **options):
        self.arm, self.time, self.lines = arm, 0.0, []
        self.machine = CrtkArmState(arm, **options)
        self.q, self.v = np.clip(0.1, arm.position_lower, arm.position_upper), np.zeros(arm.num_joints)
        self.step()

    def step(self, *commands, steps=1):
        for _ in range(steps):
            self.time += PERIOD
            self.machine.step(self.time, self.q, self.v, commands)
            self.q = self.machine.desired_state[: self.arm.num_joints]
            self.lines += self.machine.take_lines()
            commands = ()

    def wait(self, seconds):
        """Lets the time pass in two steps: trajectories end within the first one."""
        self.time += seconds
        self.step(steps=2)

    def say(self, *words):
        for word in words:
            self.step(CrtkCommand("state_command", text=word))

    def home(self):
        self.say("enable", "home")
        self.wait(10.0)
        assert self.machine.is_ready
        self.lines.clear()

    def effort(self, position_control=0.0, gravity=0.0):
        n = self.arm.num_joints
        return self.machine.motor_effort(np.full(n, position_control), np.full(n, gravity))


def test_states_and_homing():
    bench = Bench(MTM)
    machine = bench.machine
    assert (machine.state, machine.is_homed, machine.is_busy, machine.is_biased) == ("DISABLED", False, False, False)
    bench.say("enable", "home")
    assert (machine.state, machine.is_homed, machine.is_busy) == ("ENABLED", False, True)
    bench.wait(10.0)
    assert (machine.state, machine.is_homed, machine.is_busy, machine.is_biased) == ("ENABLED", True, False, True)
    np.testing.assert_allclose(machine.desired_state, 0.0, rtol=0, atol=1e-12)
    bench.say("pause", "pause")
    assert machine.state == "PAUSED" and not machine.is_ready
    bench.say("resume")
    assert machine.is_ready
    bench.say("disable")
    # As on a dVRK, the arm is "homed" until it is enabled again.
    assert (machine.state, machine.is_homed) == ("DISABLED", True)
    bench.say("enable")
    assert (machine.state, machine.is_homed, machine.is_biased) == ("ENABLED", False, True)
    bench.home()
    bench.say("unhome")
    assert not machine.is_homed and not machine.is_biased
    bench.home()


@pytest.mark.parametrize(
    ("state", "refused"),
    [((), {"pause", "resume", "home"}), (("enable",), {"resume"}), (("enable", "pause"), {"enable", "home"})],
)
def test_unsupported_state_commands_are_refused(state, refused):
    for word in ("enable", "disable", "pause", "resume", "home", "unhome"):
        bench = Bench(MTM)
        bench.say(*state)
        before = bench.machine.describe()
        bench.lines.clear()
        bench.say(word)
        if word in refused:
            assert bench.machine.describe() == before
            assert bench.lines == [
                f'state_command refused: "{word}" is not supported in the state {bench.machine.state}'
            ]
        else:
            assert not any("refused" in line for line in bench.lines)


def test_lines_on_changes_and_refusals():
    bench = Bench(PSM)
    bench.home()
    for _ in range(5):
        bench.step(CrtkCommand("servo_jf", [0.0] * 7))
    bench.step(CrtkCommand("servo_jf", [0.0] * 6), CrtkCommand("use_gravity_compensation", is_on=True))
    bench.step(CrtkCommand("jaw/servo_jf", [0.0]))
    bench.step(CrtkCommand("hold"))
    bench.wait(2.0)
    bench.say("dance" * 100)
    names = "yaw, pitch, insertion, roll, wrist_pitch, wrist_yaw"
    assert bench.lines == [
        f"servo_jf refused: 7 efforts, allowed: 6 for {names}",
        "ENABLED, homed, control mode effort, jaw position, gravity compensation on",
        "ENABLED, homed, control mode effort, gravity compensation on",
        "ENABLED, homed, control mode position, gravity compensation on",
        f'state_command refused: "{"dance" * 8}"; allowed: enable, disable, pause, resume, home, unhome '
        "(4 more commands refused before)",
    ]


def test_efforts_act_without_time_limit():
    bench = Bench(MTM)
    assert np.all(bench.effort(9.0, 9.0) == 0)
    bench.home()
    limits = MTM.effort_limits
    np.testing.assert_allclose(bench.effort(0.01, 9.0), 0.01, rtol=0, atol=1e-12)
    command = 0.5 * limits * [1, -1, 1, -1, 1, -1, 1]
    bench.step(CrtkCommand("servo_jf", command))
    for gravity_compensation in (False, True):
        bench.step(CrtkCommand("use_gravity_compensation", is_on=gravity_compensation))
        bench.wait(3600.0)
        np.testing.assert_allclose(
            bench.effort(9.0, 0.01), np.clip(command + 0.01 * gravity_compensation, -limits, limits), rtol=0, atol=1e-12
        )
    bench.step(CrtkCommand("servo_jf", 1e3 * limits))
    np.testing.assert_allclose(bench.effort(0.0, 0.0), limits, rtol=0, atol=1e-12)
    bench.step(CrtkCommand("free"))
    np.testing.assert_allclose(bench.effort(9.0, 0.01), 0.01, rtol=0, atol=1e-12)
    bench.say("disable")
    assert np.all(bench.effort(9.0, 9.0) == 0)


def test_hold_after_effort_regulates_the_measured_pose():
    bench = Bench(PSM)
    bench.home()
    bench.step(CrtkCommand("servo_jf", np.zeros(6)), CrtkCommand("jaw/servo_jf", [0.0]))
    bench.q = np.array([0.3, -0.2, 0.1, 0.4, 0.5, -0.6, 0.7])
    bench.step(CrtkCommand("hold"))
    bench.q = bench.q + 0.1
    bench.step(steps=10)
    np.testing.assert_array_equal(bench.machine.desired_state, [0.3, -0.2, 0.1, 0.4, 0.5, -0.6, 0.7, *[0.0] * 7])
    np.testing.assert_allclose(bench.effort(0.01, 9.0), 0.01, rtol=0, atol=1e-12)


@pytest.mark.parametrize("name", ARMS)
def test_move_jp_follows_the_goal_within_the_limits(name):
    arm, generator = ARMS[name], np.random.default_rng(1)
    bench = Bench(arm)
    bench.home()
    jaw = arm.num_joints - (1 if arm.separate_joint else 0)
    speed = (arm.position_upper - arm.position_lower) / 3.0
    for goal in arm.sample_poses(6, generator):
        bench.step(CrtkCommand("move_jp", goal[:jaw]), *[CrtkCommand("jaw/move_jp", goal[jaw:])] * (jaw < 7))
        assert bench.machine.is_busy
        last = bench.machine.desired_state
        for _ in range(6000):
            bench.step()
            state = bench.machine.desired_state
            assert np.all(np.abs(state[:7] - last[:7]) <= 1.001 * speed * PERIOD + 1e-12)
            last = state
            if not bench.machine.is_busy:
                break
        np.testing.assert_allclose(last, [*goal, *[0.0] * 7], rtol=0, atol=1e-12)
    # Another command ends the motion.
    bench.step(CrtkCommand("move_jp", np.zeros(jaw)), steps=200)
    bench.step(CrtkCommand("servo_jp", last[:jaw]))
    assert bench.machine.groups[0].is_moving is False
    # A goal outside the limits is clipped. A new goal during a motion leads to no jump.
    bench.step(CrtkCommand("move_jp", np.full(jaw, 1e3)), steps=300)
    before = bench.machine.desired_state
    bench.step(CrtkCommand("move_jp", np.full(jaw, -1e3)))
    np.testing.assert_allclose(bench.machine.desired_state, before, rtol=0, atol=4 * PERIOD * np.max(speed))
    bench.wait(10.0)
    np.testing.assert_allclose(bench.machine.desired_state[:jaw], arm.position_lower[:jaw], rtol=0, atol=1e-12)


@pytest.mark.parametrize("name", ["servo_jp", "servo_jf", "move_jp"])
@pytest.mark.parametrize(
    "values", [[], [0.1] * 6, [0.1] * 8, [0.1] * 6 + [math.nan], [-math.inf] + [0.1] * 6, [1e9] * 7]
)
def test_invalid_numbers_change_nothing(name, values):
    bench = Bench(MTM)
    bench.home()
    for mode in ("free", "hold"):
        bench.step(CrtkCommand(mode))
        bench.lines.clear()
        described, before = bench.machine.describe(), bench.machine.desired_state
        bench.step(CrtkCommand(name, values), steps=50)
        assert bench.machine.describe() == described and not bench.machine.is_busy
        np.testing.assert_array_equal(bench.machine.desired_state, before)
        np.testing.assert_allclose(bench.effort(0.01, 9.0), 0.01 if mode == "hold" else 0.0, rtol=0, atol=1e-12)


def test_commanded_poses_use_the_inverse_kinematics():
    poses = []
    result = np.full(7, 0.2)

    def inverse(pose, q_near):
        poses.append((pose, q_near))
        return result

    bench = Bench(PSM, inverse=inverse)
    bench.home()
    bench.step(CrtkCommand("servo_cp", (0.1, 0.2, 0.3, 0.0, 0.0, 0.0, 1.0)))
    assert poses[0][0].IsExactlyEqualTo(RigidTransform([0.1, 0.2, 0.3]))
    np.testing.assert_allclose(bench.machine.desired_state[:7], [0.2] * 6 + [0.0], rtol=0, atol=1e-12)
    for wrong in ([0.0] * 7, [math.nan, 0, 0, 0, 0, 0, 1], [0, 0, 0, 0, 0, 0, 1e9], [0] * 6):
        bench.step(CrtkCommand("servo_cp", wrong))
    assert len(poses) == 1
    result = None
    bench.wait(2.0)
    bench.step(CrtkCommand("servo_cp", (9.0, 0.2, 0.3, 0.0, 0.0, 0.0, 1.0)))
    np.testing.assert_allclose(bench.machine.desired_state[:7], [0.2] * 6 + [0.0], rtol=0, atol=1e-12)
    refusal = "the pose must have finite numbers below 1e+06 and a unit quaternion"
    assert bench.lines == [
        f"servo_cp refused: {refusal}",
        "servo_cp refused: the arm cannot reach the pose from the present set-point (3 more commands refused before)",
    ]
    result = np.full(7, 0.1)
    bench.step(CrtkCommand("move_cp", (0.1, 0.2, 0.3, 0.0, 0.0, 0.0, 1.0)))
    assert bench.machine.is_busy
    bench.wait(2.0)
    assert not bench.machine.is_busy
    np.testing.assert_allclose(bench.machine.desired_state[:7], [0.1] * 6 + [0.0], rtol=0, atol=1e-12)


def test_invalid_measurement_removes_the_power():
    bench = Bench(MTM)
    bench.home()
    bench.v = np.full(7, np.nan)
    bench.step(steps=2)
    assert bench.machine.state == "FAULT" and np.all(bench.effort(1.0, 1.0) == 0)
    bench.v = np.zeros(7)
    bench.say("home")
    assert bench.machine.state == "FAULT"
    bench.home()


NAMES = [
    *("servo_jp", "servo_jf", "move_jp", "jaw/servo_jp", "jaw/servo_jf", "jaw/move_jp", "servo_cp", "hold", "free"),
    *("use_gravity_compensation", "state_command", "", "jaw/hold", "x/servo_jp", "servo_cf", "\x00"),
]
WORDS = ["enable", "home", "pause", "resume", "unhome", "", "ENABLE", "\n", "x" * 10_000]


def random_command(generator):
    size = int(generator.choice([0, 1, 5, 6, 7, 7, 7, 8, 100]))
    values = generator.normal(size=size) * 10.0 ** generator.integers(-3, 4)
    if generator.random() < 0.3 and size:
        values[generator.integers(size)] = generator.choice([np.nan, np.inf, -np.inf, 1e308, -1e20, 1e5])
    return CrtkCommand(
        str(generator.choice(NAMES)),
        values.tolist(),
        generator.normal(size=int(generator.choice([0, 0, 7, 3]))).tolist(),
        text=WORDS[generator.integers(len(WORDS))],
        is_on=bool(generator.random() < 0.5),
    )


@pytest.mark.parametrize("name", ["mtml", "psm"])
def test_random_commands_keep_the_limits(name):
    arm, generator = ARMS[name], np.random.default_rng(3)
    bench, seen = Bench(arm), set()
    for _ in range(10_000):
        command = random_command(generator)
        if command.name == "state_command" and command.text in {"pause", "unhome"} and generator.random() < 0.8:
            continue
        bench.step(command)
        if command.name == "state_command" and command.text == "home":
            bench.wait(10.0)
        seen.add(bench.machine.describe())
        desired, effort = bench.machine.desired_state, bench.effort(1e9, 1e9)
        assert np.all(np.isfinite(desired)) and np.all(np.abs(effort) <= arm.effort_limits)
        inside = (desired[:7] >= arm.position_lower) & (desired[:7] <= arm.position_upper)
        assert np.all(inside)
    assert len(seen) > 6 and any("control mode effort" in text for text in seen)


def test_random_commands_move_nothing_while_disabled():
    generator = np.random.default_rng(4)
    for name in ("mtml", "psm"):
        bench = Bench(ARMS[name])
        bench.q = start = bench.q + 0.01
        for _ in range(10_000):
            command = random_command(generator)
            if not (command.name == "state_command" and command.text == "enable"):
                bench.step(command)
            assert bench.machine.state == "DISABLED" and not bench.machine.is_busy
            assert np.all(bench.effort(1.0, 1.0) == 0)
        np.testing.assert_array_equal(bench.q, start)
        assert sum("refused" in line for line in bench.lines) <= 10_000 * PERIOD / 2 + 1
