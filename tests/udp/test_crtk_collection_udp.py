"""`dvrk-drake collect --ros` over DDS, with the simulated arm and with the dVRK console, in a network namespace."""

import contextlib
import os
import signal
import sys

import numpy as np
import pytest
from command_output import refusal
from dvrk_console import start_console
from own_network import end, inside, outside, run_inside, start
from ros_publisher import DOMAIN_FILE
from waiting import TIMEOUT

from dvrk_drake.analysis.identification import identify
from dvrk_drake.cli import main
from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.recordings.pose_file import save_poses
from dvrk_drake.recordings.reading import read_recording

ros = pytest.importorskip("dvrk_drake.systems.ros.domain", reason="needs cyclonedds")
from dvrk_drake.systems.ros.messages import Empty, Header, JointState, OperatingState, StringStamped  # noqa: E402

MTML = load_arm("mtml")
#: Domains of ended tests. Cyclone DDS may crash if a subscription is deleted while its listener is called.
KEPT = []
#: Poses near each other, so that the arm needs little time, but with different gravity efforts.
POSES = MTML.sample_poses(6, np.random.default_rng(4), margin=0.3)


@outside
def test_runs_in_a_separate_network(request):
    run_inside(request)


@pytest.fixture(autouse=True)
def loopback(monkeypatch):
    """Uses DDS on the loopback interface. The computer may be busy for longer than a silence of an arm."""
    monkeypatch.setenv("CYCLONEDDS_URI", DOMAIN_FILE)
    monkeypatch.setattr("dvrk_drake.processes.crtk_monitor.SILENCE", 30.0)


@contextlib.contextmanager
def simulated_arm(*options):
    """Context in which a simulated MTML runs, enabled and homed."""
    process = start(sys.executable, "-m", "dvrk_drake.cli", "arm", "--arm", "mtml", "--ros", "--rate", "100", *options)
    try:
        domain = ros.RosDomain()
        KEPT.append(domain)
        command = domain.advertise("/MTML/state_command", StringStamped)
        state = domain.subscribe("/MTML/operating_state", OperatingState, depth=100, latched=True)
        last = [OperatingState()]
        KEPT.append(state)

        def wait(condition):
            def met():
                assert process.poll() is None, process.stdout.read()
                last.extend(message for message, _ in state.take())
                return condition(last[-1])

            assert domain.wait_until(met, TIMEOUT)

        wait(lambda now: command.num_subscribers() and now.state == "DISABLED")
        command.publish(StringStamped(Header.now(), "enable"))
        wait(lambda now: now.state == "ENABLED")
        command.publish(StringStamped(Header.now(), "home"))
        wait(lambda now: now.is_homed and not now.is_busy)
        yield domain
    finally:
        end(process, signal.SIGINT)


def files(folder, poses=POSES[:2]):
    """Writes a pose file and returns the options with its path and the path of the output."""
    save_poses(poses, MTML, folder / "p.yaml")
    return ["--poses", str(folder / "p.yaml"), "--output", str(folder / "p.csv")]


def refused(capfd, *options):
    """Returns the error line of a command that ends with the exit code 2."""
    capfd.readouterr()
    assert main(["collect", "--arm", "mtml", *options]) == 2
    return refusal(capfd.readouterr().err)


def collect(folder, *options, poses=POSES):
    return main(["collect", "--ros", "--arm", "mtml", *files(folder, poses), "--traverse-time", "1", *options])


@inside
def test_holding_torques_and_model_with_friction(tmp_path, capfd):
    with simulated_arm("--effects", "friction") as domain:
        hold = domain.subscribe("/MTML/hold", Empty, depth=10)
        KEPT.append(hold)
        assert domain.wait_until(hold.num_publishers, 0.0) == 0
        assert collect(tmp_path) == 0
        assert domain.wait_until(lambda: len(hold.take()) > 0, TIMEOUT)
        assert collect(tmp_path) == 0
    output = capfd.readouterr().out
    assert "pose 6 measured, 6 of 6" in output and "contains all 6 poses already" in output
    truth = IdentifiedModel.from_arm(MTML)
    recording = read_recording(tmp_path / "p.csv")
    np.testing.assert_allclose(recording.q, POSES, atol=0.02)
    expected = np.array([truth.holding_torque(q) for q in recording.q])
    # Dry friction cancels in the mean of both approach directions, but the wide hysteresis of the arm does not.
    assert np.all(np.abs(recording.tau - expected) < 0.6 * MTML.dry_friction() + 1e-3)
    model = identify(recording, MTML).model
    others = MTML.sample_poses(50, np.random.default_rng(1))
    error = [model.holding_torque(q) - truth.holding_torque(q) for q in others]
    assert np.all(np.sqrt(np.mean(np.square(error), axis=0)) < 0.6 * MTML.dry_friction() + 1e-3)
    bag = read_recording(tmp_path / "p_1.mcap", MTML)
    assert np.all(np.min(np.linalg.norm(bag.q[:, None] - recording.q, axis=2), axis=0) < 0.01)
    assert not (tmp_path / "p_2.mcap").exists()


@inside
def test_interrupted_collection_continues_in_a_second_bag(tmp_path):
    with simulated_arm() as domain:
        goals = domain.subscribe("/MTML/move_jp", JointState, depth=10)
        KEPT.append(goals)
        command = [sys.executable, "-m", "dvrk_drake.cli", "collect", "--ros", "--arm", "mtml", "--no-both-sides"]
        process = start(*command, *files(tmp_path, POSES[:1]))
        assert domain.wait_until(lambda: len(goals.take()) > 0, TIMEOUT)
        output = end(process, signal.SIGINT)
        assert process.returncode == 130 and "hold was published" in output and output.count("error") == 0
        other = domain.advertise("/MTML/servo_jp", JointState)
        process = start(*command, *files(tmp_path, POSES[:1]))
        assert process.wait(TIMEOUT) == 2
        assert "another process publishes /MTML/servo_jp" in process.stdout.read()
        del other
        assert collect(tmp_path, "--no-both-sides", poses=POSES[:1]) == 0
    assert sorted(os.listdir(tmp_path)) == ["p.csv", "p.yaml", "p_1.mcap", "p_2.mcap"]
    assert len(read_recording(tmp_path / "p.csv").q) == 1


@inside
def test_dvrk_console_moves_to_the_poses(tmp_path):
    with start_console("MTML", tmp_path, rate=100.0, motion=True) as console:
        # In a process of its own, because its publishers exist until the process ends.
        process = start(sys.executable, "-m", "dvrk_drake.cli", "collect", "--ros", "--arm", "mtml", *files(tmp_path))
        assert process.wait(TIMEOUT) == 2
        assert "operating_state is DISABLED. Enable and home the arm" in process.stdout.read()
        console.enable_and_home()
        assert collect(tmp_path, poses=POSES[:2]) == 0
        assert console.modes()[-2:] == ["JOINT_SPACE/TRAJECTORY_MODE", "JOINT_SPACE/POSITION_MODE"]
    np.testing.assert_allclose(read_recording(tmp_path / "p.csv").q, POSES[:2], atol=1e-4)
    bag = read_recording(tmp_path / "p_1.mcap", MTML)
    assert bag.t[-1] - bag.t[0] > 3.0 and np.all(np.isfinite(bag.q))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--yes"], "--topic, --domain, --max-effort and --yes require --ros"),
        (["--ros", "--reset"], "cannot be used with --ros"),
        (["--ros", "--max-effort", "3"], "max_effort = 3"),
    ],
)
def test_options_are_checked(tmp_path, capfd, options, message):
    assert message in refused(capfd, *files(tmp_path), *options)


def test_ros_needs_an_output(tmp_path, capfd):
    assert "--ros requires --output" in refused(capfd, *files(tmp_path)[:2], "--ros", "--teach")
