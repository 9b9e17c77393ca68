"""`dvrk.connect` over ROS 2: measurement, a motion with the guard in this process, and hold. A script over LCM."""

import os
import signal
import subprocess
import sys

import numpy as np
import pytest
from arm_processes import LONG_TIMEOUT_DRIVER, dvrk_drake
from repository import ROOT
from ros_publisher import DOMAIN_FILE
from waiting import TIMEOUT, wait_until

import dvrk_drake as dvrk
from dvrk_drake.analysis.excitation.periodic_motion import FourierBasis, PeriodicMotion
from dvrk_drake.analysis.excitation.pose_file import load_poses

ros = pytest.importorskip("dvrk_drake.systems.ros.domain", reason="needs cyclonedds")

pytestmark = [pytest.mark.network, pytest.mark.realtime, pytest.mark.slow]

ARM = dvrk.load_arm("mtml")


@pytest.mark.watchdog
def test_motion_and_taught_pose_over_ros(tmp_path, monkeypatch):
    monkeypatch.setenv("CYCLONEDDS_URI", DOMAIN_FILE)
    from dvrk_drake.systems.ros.messages import Empty, OperatingState

    arguments = ("--transport", "ros", "--rate", "500", "--enabled", "--realtime")
    arm, domain = dvrk_drake("sim-arm", "--arm", "mtml", *arguments), ros.RosDomain(0)
    try:
        state, last = domain.subscribe("/MTML/operating_state", OperatingState, depth=100, latched=True), []

        def is_ready():
            last.extend(message for message, _ in state.take())
            return bool(last) and last[-1].is_homed and not last[-1].is_busy

        assert domain.wait_until(is_ready, 60.0), arm.output()
        connection = dvrk.connect(ARM, "ros")
        before = connection.measure(0.1)
        assert before.count > 1 and not ARM.limit_violations(before.q, ARM.per_limit(1e-3, 1e-3))
        basis, span = FourierBasis.of(1.0, 2), ARM.position_upper - ARM.position_lower
        coefficients = np.column_stack([before.q, np.outer(0.01 * span, np.ones(2))])
        path = tmp_path / "m.yaml"
        PeriodicMotion.of_coefficients(ARM, basis, coefficients, 2).save(path)
        connected = ("--arm", "mtml", "--transport", "ros", "--realtime")
        for task in (["--rehearse"], ["--output", tmp_path / "m.csv"]):
            process = dvrk_drake("collect", "motion", path, *connected, *task)
            assert process.wait() == 0, process.output()
        assert len(dvrk.read_recording(tmp_path / "m.csv", ARM)) > 100
        poses = tmp_path / "p.yaml"
        process = dvrk_drake("collect", "teach", poses, *connected, "--at-rest")
        wait_until(poses.exists, "a pose is recorded", process)
        process.end(signal.SIGINT)
        np.testing.assert_allclose(load_poses(poses, ARM)[0], before.q, atol=0.05)
        holds = domain.subscribe("/MTML/hold", Empty, depth=10)
        connection.hold()
        assert domain.wait_until(lambda: bool(holds.take()), 20.0)
    finally:
        arm.end(signal.SIGINT)


@pytest.mark.watchdog
def test_script_controls_an_arm_over_lcm():
    """Runs examples/09_hardware_station.py."""
    arm = dvrk_drake("sim-arm", "--arm", "mtml", "--realtime", "--driver", LONG_TIMEOUT_DRIVER)
    command = [sys.executable, str(ROOT / "examples" / "09_hardware_station.py"), "3"]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    try:
        done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=TIMEOUT, check=False)
    finally:
        arm.end(signal.SIGINT)
    assert done.returncode == 0, done.stderr
    assert "the efforts of this Diagram acted" in done.stdout, done.stdout + arm.output()
