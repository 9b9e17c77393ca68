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
from waiting import TIMEOUT, wait_until

from dvrk_drake.analysis.identification import identify
from dvrk_drake.cli import main
from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.processes.crtk_collector import CrtkCollectionSettings, approaches
from dvrk_drake.recordings.pose_file import save_poses
from dvrk_drake.recordings.reading import read_recording

ros = pytest.importorskip("dvrk_drake.systems.ros.domain", reason="needs cyclonedds")
from dvrk_drake.systems.ros.messages import Empty, JointState, OperatingState  # noqa: E402

MTML = load_arm("mtml")
#: Domains of ended tests. Cyclone DDS may crash if a subscription is deleted while its listener is called.
KEPT = []
#: `dvrk-drake` in a process of its own, because its publishers exist until the process ends. On a busy computer, the
#: simulated arm may be slow, or silent for a while.
COMMAND = [
    sys.executable,
    "-c",
    "import sys\n"
    "from dvrk_drake.cli import main\n"
    "from dvrk_drake.processes import crtk_collector, crtk_monitor\n"
    "crtk_monitor.SILENCE, crtk_collector.STALL, crtk_collector.SETTLE = 30.0, 100.0, 100.0\n"
    "sys.exit(main(sys.argv[1:]))",
]
#: Poses near each other, so that the arm needs little time, but with different gravity efforts. `identify` requires 8.
POSES = MTML.sample_poses(8, np.random.default_rng(4), margin=0.3)


@outside
def test_runs_in_a_separate_network(request):
    run_inside(request)


@pytest.fixture(autouse=True)
def loopback(monkeypatch):
    """Uses DDS on the loopback interface."""
    monkeypatch.setenv("CYCLONEDDS_URI", DOMAIN_FILE)


@contextlib.contextmanager
def simulated_arm(*options):
    """Context in which a simulated MTML runs, enabled and homed."""
    command = [sys.executable, "-m", "dvrk_drake.cli", "arm", "--arm", "mtml", "--ros", "--rate", "100", "--enabled"]
    process = start(*command, *options)
    try:
        domain = ros.RosDomain()
        state = domain.subscribe("/MTML/operating_state", OperatingState, depth=100, latched=True)
        KEPT.extend((domain, state))
        last = [OperatingState()]

        def is_ready():
            assert process.poll() is None, process.stdout.read()
            last.extend(message for message, _ in state.take())
            return last[-1].is_homed and not last[-1].is_busy

        assert domain.wait_until(is_ready, TIMEOUT)
        yield domain
    finally:
        end(process, signal.SIGINT)


def remaining_friction(q):
    """Returns a bound (7,) for the friction [N m] that the mean of both approach directions to a pose contains.

    A presliding element is a spring with the stiffness F / s that slides at the force F. If an approach is shorter than
    the travel 2 s from one sliding force to the other, the force does not reach its limit. The mean of both directions
    then contains up to F (1 - d / 2 s), where d is the length of the approach. An element that slides in one direction
    only adds the mean F / 2.
    """
    ends = approaches(MTML, q, CrtkCollectionSettings())
    bound = np.zeros(7)
    for effect in MTML.effects.friction:
        if effect.kind != "viscous":
            row = MTML.effect_coordinates[effect.coordinate] @ MTML.transmission.matrix
            length = np.min(np.abs(row @ (ends - q).T))
            share = max(0.0, 1 - length / (2 * effect.scale)) if effect.kind == "presliding" else 0.5
            bound += np.abs(row) * effect.coefficient * share
    return bound


def files(folder, poses=POSES[:2]):
    """Writes a pose file and returns the options with its path and the path of the output."""
    save_poses(poses, MTML, folder / "p.yaml")
    return ["--poses", str(folder / "p.yaml"), "--output", str(folder / "p.csv")]


def refused(capfd, *options):
    """Returns the error line of a command that ends with the exit code 2."""
    capfd.readouterr()
    assert main(["collect", "--arm", "mtml", *options]) == 2
    return refusal(capfd.readouterr().err)


def start_collection(folder, *options, poses=POSES):
    return start(*COMMAND, "collect", "--ros", "--arm", "mtml", *files(folder, poses), "--traverse-time", "2", *options)


def collect(folder, *options, poses=POSES, code=0):
    """Runs a collection. Returns its output."""
    process = start_collection(folder, *options, poses=poses)
    output = process.communicate(timeout=TIMEOUT)[0]
    assert process.returncode == code, output
    return output


@inside
def test_holding_torques_and_model_with_friction(tmp_path):
    with simulated_arm("--effects", "friction") as domain:
        hold = domain.subscribe("/MTML/hold", Empty, depth=10)
        KEPT.append(hold)
        assert domain.wait_until(hold.num_publishers, 0.0) == 0
        assert "pose 8 measured, 8 of 8" in collect(tmp_path)
        assert domain.wait_until(lambda: len(hold.take()) > 0, TIMEOUT)
        assert "contains all 8 poses already" in collect(tmp_path)
    truth = IdentifiedModel.from_arm(MTML)
    recording = read_recording(tmp_path / "p.csv")
    np.testing.assert_allclose(recording.q, POSES, atol=0.02)
    expected = np.array([truth.holding_torque(q) for q in recording.q])
    friction = np.array([remaining_friction(q) for q in recording.q])
    # If the arm overshoots a pose before it rests there, the friction elements are partly unloaded.
    overshoot = 0.15 * MTML.dry_friction()
    assert np.all(np.abs(recording.tau - expected) < friction + overshoot)
    model = identify(recording, MTML).model
    others = MTML.sample_poses(50, np.random.default_rng(1))
    error = [model.holding_torque(q) - truth.holding_torque(q) for q in others]
    assert np.all(np.sqrt(np.mean(np.square(error), axis=0)) < friction.max(axis=0) + overshoot)
    bag = read_recording(tmp_path / "p_1.mcap", MTML)
    assert np.all(np.min(np.linalg.norm(bag.q[:, None] - recording.q, axis=2), axis=0) < 0.01)
    assert not (tmp_path / "p_2.mcap").exists()


@inside
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
        KEPT.append(domain.advertise("/MTML/servo_jp", JointState))
        output = collect(tmp_path, "--no-both-sides", poses=POSES[:2], code=2)
        assert "another process publishes /MTML/servo_jp" in output


@inside
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


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--yes"], "--topic, --domain, --max-effort and --yes require --ros"),
        (["--ros", "--reset"], "cannot be used with --ros"),
        (["--ros", "--max-effort", "3"], "max_effort is 3; allowed: 0.05..2"),
    ],
)
def test_options_are_checked(tmp_path, capfd, options, message):
    assert message in refused(capfd, *files(tmp_path), *options)


def test_ros_needs_an_output(tmp_path, capfd):
    assert "--ros requires --output" in refused(capfd, *files(tmp_path)[:2], "--ros", "--teach")
