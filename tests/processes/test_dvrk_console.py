"""Support for tests against the dVRK console: the peer executes commands over DDS, and ends with the context."""

import os
import signal
from pathlib import Path

import numpy as np
import pytest
from dvrk_console import start_console
from ros_publisher import DOMAIN_FILE
from waiting import wait_until

pytestmark = [pytest.mark.network, pytest.mark.slow]


@pytest.fixture(autouse=True)
def loopback(monkeypatch):
    """Uses DDS on the loopback interface."""
    monkeypatch.setenv("CYCLONEDDS_URI", DOMAIN_FILE)


@pytest.mark.parametrize("motion", [False, True])
def test_console_homes_moves_and_holds(tmp_path, motion):
    with start_console("MTML", tmp_path, motion=motion) as console:
        from dvrk_drake.systems.ros.messages import Empty, JointState

        assert console.state() == ("DISABLED", False, False)
        assert console.latest().header.nanoseconds == 0
        console.enable_and_home()
        goal = [0.1, 0.2, 0.05, -0.3, 0.4, 0.1, 0.2]
        console.command("servo_jp", JointState(position=goal))
        console.wait_for_position(goal)
        assert console.latest().header.nanoseconds > 0
        console.command("servo_jf", JointState(effort=[0.1] * 7))
        wait_until(lambda: console.modes()[-1] == "JOINT_SPACE/EFFORT_MODE", "effort mode", console.process)
        console.command("hold", Empty())
        wait_until(lambda: console.modes()[-1] == "JOINT_SPACE/POSITION_MODE", "position mode", console.process)
    # A killed process may remain as a zombie without a command line.
    command = Path(f"/proc/{console.pid}/cmdline")
    wait_until(lambda: not command.exists() or not command.read_bytes(), "end of the console")


def test_move_jp_arrives_and_is_busy_on_the_way(tmp_path):
    with start_console("MTML", tmp_path, motion=True) as console:
        from dvrk_drake.systems.ros.messages import JointState, PoseStamped

        console.enable_and_home()
        # At q = 0, the wrist centre is at (0, -0.3645, -0.1288) m, and each wrist axis goes through it.
        p = console.latest("measured_cp", PoseStamped).pose.position
        np.testing.assert_allclose([p.x, p.y, p.z], [0, -0.3645, -0.1288], atol=1e-4)
        goal = [0.2, 0.1, -0.1, 0.3, 0.2, -0.1, 0.4]
        num_states = len(console.states)
        console.command("move_jp", JointState(position=goal))
        wait_until(lambda: console.state() and ("ENABLED", True, True) in console.states[num_states:], "busy")
        console.wait_for_position(goal)
        wait_until(lambda: console.state() == ("ENABLED", True, False), "not busy", console.process)
        assert console.modes()[-1] == "JOINT_SPACE/TRAJECTORY_MODE"
        # A trajectory with limits on velocity and acceleration takes time, unlike servo_jp.
        np.testing.assert_allclose(console.latest("setpoint_js").position, goal, atol=1e-9)


def test_servo_cp_reaches_a_measured_pose(tmp_path):
    with start_console("MTML", tmp_path, motion=True) as console:
        from dvrk_drake.systems.ros.messages import JointState, PoseStamped

        console.enable_and_home()
        there, away = [0.2, 0.1, -0.1, 0.3, 0.2, -0.1, 0.4], [0.25, 0.15, -0.05, 0.3, 0.25, -0.1, 0.4]
        console.command("servo_jp", JointState(position=there))
        console.wait_for_position(there)
        pose = console.latest("measured_cp", PoseStamped)
        console.command("servo_jp", JointState(position=away))
        console.wait_for_position(away)
        console.command("servo_cp", pose)
        wait_until(lambda: console.modes()[-1] == "CARTESIAN_SPACE/POSITION_MODE", "Cartesian mode", console.process)

        def at_pose():
            p = console.latest("measured_cp", PoseStamped).pose.position
            q = pose.pose.position
            return np.allclose([p.x, p.y, p.z], [q.x, q.y, q.z], atol=1e-4)

        wait_until(at_pose, "pose", console.process)


def test_jaw_efforts_change_the_control_space(tmp_path):
    with start_console("PSM1", tmp_path, motion=True) as console:
        from dvrk_drake.systems.ros.messages import JointState

        console.enable_and_home()
        assert console.latest().name == ["yaw", "pitch", "insertion", "roll", "wrist_pitch", "wrist_yaw"]
        for _ in range(2):
            for name, number, space in (("jaw/servo_jf", 1, "CARTESIAN"), ("servo_jf", 6, "JOINT")):
                before = len(console.modes())
                console.command(name, JointState(effort=[0.01] * number))
                wait_until(lambda n=before: len(console.modes()) > n, "a change of the mode", console.process)
                assert console.modes()[-1] == f"{space}_SPACE/EFFORT_MODE"


def test_context_ends_the_console_whose_parent_was_killed(tmp_path):
    with start_console("PSM1", tmp_path) as console:
        os.kill(console.process.pid, signal.SIGKILL)
        console.process.wait()
        assert Path(f"/proc/{console.pid}/cmdline").read_bytes()
    # The console is not a child of this process, so it may exist as a zombie, without a command line.
    command_line = Path(f"/proc/{console.pid}/cmdline")
    wait_until(lambda: not command_line.exists() or not command_line.read_bytes(), "the end of the console")
