"""`collect poses --transport ros` over DDS, with the simulated arm and with the dVRK console."""

import contextlib
import os
import pty
import select
import signal
import subprocess
import sys

import numpy as np
import pytest
from arm_processes import dvrk_drake
from dvrk_console import start_console
from own_network import end, start
from ros_publisher import DOMAIN_FILE
from waiting import TIMEOUT, wait_until

from dvrk_drake.analysis.excitation.pose_file import save_poses
from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.recordings.formats import read_recording

ros = pytest.importorskip("dvrk_drake.systems.ros.domain", reason="needs cyclonedds")
from dvrk_drake.systems.ros.messages import Empty, JointState, OperatingState  # noqa: E402

pytestmark = [pytest.mark.network, pytest.mark.realtime, pytest.mark.slow]

MTML = load_arm("mtml")
#: Domains of ended tests. Cyclone DDS may crash if a subscription is deleted while its listener is called.
KEPT = []
COLLECT = ["collect", "poses", "--arm", "mtml", "--transport", "ros"]
#: `dvrk-drake` in a process of its own, because its publishers exist until the process ends. On a busy computer, the
#: simulated arm may be slow, or silent for a while.
COMMAND = [
    sys.executable,
    "-c",
    "import sys\n"
    "from dvrk_drake.cli import main\n"
    "from dvrk_drake.processes import arm_mover\n"
    "from dvrk_drake.systems.ros import crtk_link\n"
    "crtk_link.SILENCE, arm_mover.STALL, arm_mover.SETTLE = 30.0, 100.0, 100.0\n"
    "sys.exit(main(sys.argv[1:]))",
]
#: Program that could move the arm.
OTHER = (
    "from dvrk_drake.systems.ros.domain import RosDomain\n"
    "from dvrk_drake.systems.ros.messages import JointState\n"
    "publisher = RosDomain(0).advertise('/MTML/servo_jp', JointState)\n"
    "import time\n"
    "time.sleep(1000)"
)
#: Poses near each other, so that the arm needs little time, but with different gravity efforts.
POSES = MTML.sample_poses(6, np.random.default_rng(4), margin=0.3)


@pytest.fixture(autouse=True)
def loopback(monkeypatch):
    """Uses DDS on the loopback interface."""
    monkeypatch.setenv("CYCLONEDDS_URI", DOMAIN_FILE)


@contextlib.contextmanager
def simulated_arm(*options):
    """Context in which a simulated MTML runs, enabled and homed."""
    process = dvrk_drake("sim-arm", "--arm", "mtml", "--transport", "ros", "--rate", "100", "--enabled", *options)
    try:
        domain = ros.RosDomain(0)
        state = domain.subscribe("/MTML/operating_state", OperatingState, depth=100, latched=True)
        KEPT.extend((domain, state))
        last = [OperatingState()]

        def is_ready():
            assert process.poll() is None, process.output()
            last.extend(message for message, _ in state.take())
            return last[-1].is_homed and not last[-1].is_busy

        assert domain.wait_until(is_ready, TIMEOUT)
        yield domain
    finally:
        process.end(signal.SIGINT)


def files(folder, poses=POSES[:2]):
    """Writes a pose file and returns the options with its path and the path of the output."""
    save_poses(poses, MTML, folder / "p.yaml")
    return [str(folder / "p.yaml"), "--output", str(folder / "p.csv")]


def start_collection(folder, *options, poses=POSES):
    return start(*COMMAND, *COLLECT, *files(folder, poses), "--traverse-time", "2", *options)


def collect(folder, *options, poses=POSES, code=0):
    """Runs a collection. Returns its output."""
    process = start_collection(folder, *options, poses=poses)
    output = process.communicate(timeout=TIMEOUT)[0]
    assert process.returncode == code, output
    return output


def test_holding_torques_with_friction(tmp_path):
    with simulated_arm("--effects", "friction") as domain:
        hold = domain.subscribe("/MTML/hold", Empty, depth=10)
        KEPT.append(hold)
        assert domain.wait_until(hold.num_publishers, 0.0) == 0
        assert "pose 6 measured, 6 of 6" in collect(tmp_path)
        assert domain.wait_until(lambda: len(hold.take()) > 0, TIMEOUT)
        assert "contains all 6 poses already" in collect(tmp_path)
    truth = IdentifiedModel.from_arm(MTML)
    recording = read_recording(tmp_path / "p.csv")
    # At rest, the proportional effort of the position controller is at most the dry friction.
    assert np.all(np.abs(recording.q - POSES) < MTML.dry_friction() / np.asarray(MTML.gains.kp) + 2e-3)
    expected = np.array([truth.holding_torque(q) for q in recording.q])
    # The friction at rest never exceeds the dry friction. How far it cancels depends on the speed of the simulated arm,
    # and thus on the load of the computer.
    assert np.all(np.abs(recording.tau - expected) < MTML.dry_friction() + 1e-3)
    bag = read_recording(tmp_path / "p_1.mcap", MTML)
    assert np.all(np.min(np.linalg.norm(bag.q[:, None] - recording.q, axis=2), axis=0) < 0.01)
    assert not (tmp_path / "p_2.mcap").exists()


def test_interrupted_collection_continues_in_a_second_bag(tmp_path):
    with simulated_arm() as domain:
        goals = domain.subscribe("/MTML/move_jp", JointState, depth=10)
        KEPT.append(goals)
        process = start_collection(tmp_path, "--no-both-sides", poses=POSES[:1])
        wait_until(lambda: len(goals.take()) > 0, "the first goal", process)
        output = end(process, signal.SIGINT)
        assert process.returncode == 130 and "hold was published" in output and output.count("error") == 0
        collect(tmp_path, "--no-both-sides", poses=POSES[:1])
        assert sorted(os.listdir(tmp_path)) == ["p.csv", "p.yaml", "p_1.mcap", "p_2.mcap"]
        assert len(read_recording(tmp_path / "p.csv").q) == 1
        other = start(sys.executable, "-c", OTHER)
        wait_until(lambda: "/MTML/servo_jp" in {e.topic for e in domain.publishers()}, "the other publisher", other)
        output = collect(tmp_path, "--no-both-sides", poses=POSES[:2], code=2)
        end(other)
        assert "another process publishes /MTML/servo_jp" in output


@pytest.mark.parametrize("action", ["SIG_DFL", "SIG_IGN"])
def test_closed_terminal_holds_the_arm(tmp_path, action):
    """The kernel sends SIGHUP. If the shell has ignored this signal, the next output fails."""
    with simulated_arm() as domain:
        goals, hold = domain.subscribe("/MTML/move_jp", JointState), domain.subscribe("/MTML/hold", Empty, depth=10)
        KEPT.extend((goals, hold))
        terminal, child = pty.openpty()
        command = [*COMMAND, *COLLECT, *files(tmp_path), "--yes", "--traverse-time", "5"]
        shell = (
            "import os, signal, sys\n"
            f"os.login_tty({child})\n"
            f"signal.signal(signal.SIGHUP, signal.{action})\n"
            "os.execv(sys.executable, sys.argv[1:])"
        )
        process = subprocess.Popen([sys.executable, "-c", shell, *command], pass_fds=[child])
        os.close(child)
        output = b""

        def moves():
            nonlocal output
            if select.select([terminal], [], [], 0.0)[0]:
                output += os.read(terminal, 4096)
            return len(goals.take()) > 0

        try:
            wait_until(moves, "the first goal", process)
            assert not hold.take(), output
            os.close(terminal)
            wait_until(lambda: len(hold.take()) > 0, "hold")
            process.wait(TIMEOUT)
        finally:
            process.kill()
            process.wait(TIMEOUT)
    assert len(read_recording(tmp_path / "p_1.mcap", MTML)) > 0


def test_dvrk_console_moves_to_the_poses(tmp_path):
    with start_console("MTML", tmp_path, rate=100.0, motion=True) as console:
        output = collect(tmp_path, poses=POSES[:2], code=2)
        assert "operating_state is DISABLED. Enable and home the arm" in output
        console.enable_and_home()
        collect(tmp_path, poses=POSES[:2])
        assert console.modes()[-2:] == ["JOINT_SPACE/TRAJECTORY_MODE", "JOINT_SPACE/POSITION_MODE"]
    np.testing.assert_allclose(read_recording(tmp_path / "p.csv").q, POSES[:2], atol=1e-4)
    bag = read_recording(tmp_path / "p_1.mcap", MTML)
    assert bag.t[-1] - bag.t[0] > 3.0 and np.all(np.isfinite(bag.q))
