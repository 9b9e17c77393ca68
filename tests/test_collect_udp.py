"""From poses to a compensated arm, with real processes over real UDP multicast in a network of their own.

As in test_lcm_udp.py, this file starts itself again inside a network namespace.
"""

import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from test_lcm_udp import INSIDE, NETWORK, Observer, end, inside, start, unshare

from dvrk_drake.cli import main
from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.lcmtypes import lcmt_dvrk_status as Status
from dvrk_drake.models.arm import load_arm
from dvrk_drake.models.pose_file import load_poses
from dvrk_drake.models.recording import read_recording

# Commands may be late on a machine that runs other tests: here the arm waits longer than by default before it takes over.
DRIVER = "guard: {expiry: 0.5}\n"
POSES = 9


@pytest.mark.skipif(INSIDE in os.environ, reason="is inside already")
def test_in_a_network_of_its_own():
    pytest_run = [sys.executable, "-m", "pytest", "-x", "-p", "no:cacheprovider", "-p", "no:xdist", "-rs", "-s"]
    environment = {**os.environ, INSIDE: "1", "OMP_NUM_THREADS": "1"}
    environment.pop("LCM_DEFAULT_URL", None)
    command = [*unshare(), "sh", "-c", f'{NETWORK} && exec "$@"', "sh", *pytest_run, __file__]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=400, check=False)
    print(done.stdout[-6000:], done.stderr[-3000:])
    assert done.returncode == 0


def dvrk_drake(*arguments):
    return start(sys.executable, "-m", "dvrk_drake.cli", *map(str, arguments))


@pytest.fixture(scope="module")
def observer(tmp_path_factory):
    """What a running arm says."""
    driver = tmp_path_factory.mktemp("arm") / "driver.yaml"
    driver.write_text(DRIVER)
    observer = Observer("mtml")
    process = dvrk_drake("arm", "--arm", "mtml", "--realtime", "--driver", driver)
    observer.until(lambda status: True, 90, "first status")
    yield observer
    said = end(process, signal.SIGINT)
    assert process.returncode == 0, said


def until(condition, seconds, process):
    deadline = time.monotonic() + seconds
    while not condition():
        assert process.poll() is None, process.stdout.read()
        assert time.monotonic() < deadline
        time.sleep(0.01)


def holds(status):
    return status.guard_state == Status.STATE_HOLD


def moving(status):
    return status.guard_state == Status.STATE_EFFORT and np.abs(status.velocity).max() > 0.05


@inside
def test_collect_stop_kill_go_on_identify_and_release(observer, tmp_path):
    arm, poses, output = load_arm("mtml"), tmp_path / "poses.yaml", tmp_path / "poses.csv"
    assert main(["collect", "--arm", "mtml", "--poses", str(poses), "--random", str(POSES), "--seed", "5"]) == 0
    command = ["collect", "--arm", "mtml", "--poses", poses, "--output", output, "--realtime", "--traverse-time", "1"]

    def rows():
        return output.read_bytes().count(b"\n") - 1 if output.exists() else 0

    # Ctrl-C on the way to the second pose.
    process = dvrk_drake(*command)
    until(lambda: rows() == 1, 60, process)
    observer.until(moving, 10, "way to the second pose")
    said = end(process, signal.SIGINT)
    assert process.returncode == 130, said
    assert f"1 of {POSES} poses" in said
    assert holds(observer.last) and observer.last.num_expired == 0
    finished = output.read_bytes()

    # kill -9 on a later way: the arm holds, the file is whole.
    process = dvrk_drake(*command)
    until(lambda: rows() == 3, 60, process)
    observer.until(moving, 10, "way to the fourth pose")
    end(process, signal.SIGKILL)
    assert output.read_bytes().startswith(finished)
    finished = output.read_bytes()
    assert len(read_recording(output, arm)) == 3
    observer.until(holds, 2, "hold")

    process = dvrk_drake(*command)
    said, _ = process.communicate(timeout=120)
    assert process.returncode == 0, said
    assert f"{POSES - 3} poses of MTML to visit" in said
    assert output.read_bytes().startswith(finished)
    recording = read_recording(output, arm)
    np.testing.assert_allclose(recording.q, load_poses(poses, arm), atol=5e-3)
    truth = IdentifiedModel.from_arm(arm).holding_torque(recording.q)
    print(
        "worst error of a measured effort, of the effort limit:",
        np.max(np.abs(recording.tau - truth) / arm.effort_limits),
    )
    assert np.all(np.abs(recording.tau - truth) < 0.005 * arm.effort_limits)
    assert holds(observer.last)

    model = tmp_path / "model.yaml"
    assert main(["identify", str(output), "--arm", "mtml", "--output", str(model)]) == 0
    process = dvrk_drake("run", "--arm", "mtml", "--model", model, "--mode", "gravity", "--realtime")
    begun = observer.until(lambda status: status.guard_state == Status.STATE_EFFORT, 60, "run")
    time.sleep(3.0)
    released = np.array([status.position for _, status in observer.heard[begun:]])
    said = end(process, signal.SIGINT)
    assert process.returncode == 0, said
    drift = np.abs(released - released[0]).max(axis=0)
    print("drift after release in 3 s [mrad]:", np.round(1e3 * drift, 2))
    assert np.all(drift < 0.02)


@inside
def test_teach_takes_where_the_arm_rests_and_what_enter_says(observer, tmp_path):
    poses = tmp_path / "poses.yaml"
    command = ["collect", "--arm", "mtml", "--poses", poses, "--teach", "--at-rest", "--realtime"]
    process = subprocess.Popen(
        [sys.executable, "-m", "dvrk_drake.cli", *map(str, command)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    until(poses.exists, 60, process)
    process.stdin.write("\n")
    process.stdin.flush()
    lines = []
    while "again" not in "".join(lines):
        lines.append(process.stdout.readline())
        assert lines[-1]
    said = end(process, signal.SIGINT)
    assert process.returncode == 0, said
    assert "1 poses; MTML holds by itself" in said
    assert "not taken: it is pose 1 again\n" in lines
    np.testing.assert_allclose(load_poses(poses, load_arm("mtml")), [observer.last.position], atol=0.01)
    assert holds(observer.last)
