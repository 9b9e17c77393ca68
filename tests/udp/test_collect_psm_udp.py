"""Collection of PSM poses from both sides, with real processes and UDP multicast."""

import signal

import numpy as np
import pytest
from arm_observer import Observer, is_holding
from arm_processes import LONG_TIMEOUT_DRIVER, dvrk_drake

from dvrk_drake.analysis.excitation.pose_file import load_poses, save_poses
from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.recordings.reading import read_recording

pytestmark = [pytest.mark.network, pytest.mark.realtime, pytest.mark.slow]

POSES = 3


def test_psm_collection_from_both_sides_completes(tmp_path):
    arm, poses, output = load_arm("psm"), tmp_path / "poses.yaml", tmp_path / "poses.csv"
    save_poses(arm.sample_poses(POSES, np.random.default_rng(3), margin=0.1), arm, poses)
    observer = Observer("psm")
    process = dvrk_drake("sim-arm", "--arm", "psm", "--realtime", "--driver", LONG_TIMEOUT_DRIVER)
    try:
        observer.until(lambda status: True, "first status", process=process)
        command = ["collect", "poses", poses, "--arm", "psm", "--output", output]
        command += ["--realtime", "--traverse-time", "2"]
        collecting = dvrk_drake(*command)
        assert collecting.wait() == 0, collecting.output()
        assert f"{POSES} of {POSES} poses" in collecting.output()
        observer.until(is_holding, "hold")
        assert observer.last.fault_code == 0
    finally:
        print(process.end(signal.SIGINT))
    assert process.wait() == 0
    recording = read_recording(output, arm)
    away = np.abs(recording.q - load_poses(poses, arm))
    print("measured at, from the pose:", away.max(axis=0))
    assert np.all(away < arm.per_joint(5e-3, 5e-4))
    error = np.abs(recording.tau - IdentifiedModel.from_arm(arm).holding_torque(recording.q)) / arm.effort_limits
    print(f"measured efforts are off by {error.max():.2g} of the effort limit at most")
    assert np.all(error < 0.005)
