"""From poses to a compensated arm, with real processes and UDP multicast in a separate network.

This file starts itself again inside a network namespace. Processes are forked from one that has imported the package.
"""

import signal

import numpy as np
import pytest
from arm_observer import Observer, accepts_efforts, is_holding
from arm_processes import LONG_TIMEOUT_DRIVER, dvrk_drake
from waiting import wait_until

from dvrk_drake.analysis.excitation.pose_file import load_poses, save_poses
from dvrk_drake.cli import main
from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.recordings.formats import read_recording

pytestmark = [pytest.mark.network, pytest.mark.realtime, pytest.mark.slow]

#: Smallest number of poses for an identification.
POSES = 8
#: Time until the arm releases a silent sender: the expiry and a margin [s]; earlier, another one is refused.
FORGOTTEN = 0.6


@pytest.fixture(scope="module")
def observer():
    """Returns the output of a running arm."""
    observer = Observer("mtml")
    process = dvrk_drake("sim-arm", "--arm", "mtml", "--realtime", "--driver", LONG_TIMEOUT_DRIVER)
    observer.until(lambda status: True, "first status", process=process)
    yield observer
    said = process.end(signal.SIGINT)
    assert process.wait() == 0, said


def moving(status):
    return accepts_efforts(status) and np.abs(status.velocity).max() > 0.05


def test_collect_kill_resume_identify_and_release(observer, tmp_path):
    arm, poses, output = load_arm("mtml"), tmp_path / "poses.yaml", tmp_path / "poses.csv"
    save_poses(arm.sample_poses(POSES, np.random.default_rng(5), margin=0.1), arm, poses)
    command = ["collect", "poses", poses, "--arm", "mtml", "--output", output, "--realtime", "--traverse-time", "1"]
    command.append("--no-both-sides")  # quicker, and a simulated arm has no dry friction

    def rows():
        return output.read_bytes().count(b"\n") - 1 if output.exists() else 0

    # kill -9 on the way to the third pose, or a later one: the arm holds, the file is whole.
    process = dvrk_drake(*command)
    wait_until(lambda: 2 <= rows() < POSES and moving(observer.last), "third leg", process)
    process.end(signal.SIGKILL)
    finished = output.read_bytes()
    assert 2 <= len(read_recording(output, arm)) < POSES
    observer.until(is_holding, "hold")
    observer.during(FORGOTTEN)

    process = dvrk_drake(*command)
    assert process.wait() == 0, process.output()
    assert f"{POSES} of {POSES} poses" in process.output()
    assert output.read_bytes().startswith(finished)
    recording = read_recording(output, arm)
    np.testing.assert_allclose(recording.q, load_poses(poses, arm), atol=5e-3)
    truth = IdentifiedModel.from_arm(arm).holding_torque(recording.q)
    error = np.abs(recording.tau - truth) / arm.effort_limits
    print(f"measured efforts are off by {error.max():.2g} of the effort limit at most")
    assert np.all(error < 0.005)
    observer.until(is_holding, "hold")
    observer.during(FORGOTTEN)

    model = tmp_path / "model.yaml"
    assert main(["identify", str(output), "--arm", "mtml", "--output", str(model)]) == 0
    process = dvrk_drake("control", "--arm", "mtml", "--model", model, "--mode", "gravity", "--realtime")
    begun = observer.until(accepts_efforts, "run", process=process)
    observer.during(3.0)
    released = np.array([status.position for status in observer.received[begun:]])
    said = process.end(signal.SIGINT)
    assert process.wait() == 0, said
    drift = np.abs(released - released[0]).max(axis=0)
    print("drift after release in 3 s [mrad]:", np.round(1e3 * drift, 2))
    # A model of eight poses carries it. The wrists turn freely in simulation, where 1e-5 N m too much moves them by
    # 20 mrad: what is asked of them is the torque.
    assert np.all(drift[:3] < 0.01)
    wrong = IdentifiedModel.load(model).holding_torque(released[0]) - IdentifiedModel.from_arm(arm).holding_torque(
        released[0]
    )
    print("torque at the release is off by, of the limits:", np.abs(wrong / arm.effort_limits).max())
    assert np.all(np.abs(wrong) < 1e-3 * arm.effort_limits)
