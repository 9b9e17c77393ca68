"""Hardware station over ROS 2: one Diagram controls the simulated arm of another process."""

import os
import signal
import subprocess
import sys

import numpy as np
import pytest
import yaml
from arm_processes import LONG_TIMEOUT_DRIVER, dvrk_drake
from crtk_conformance import compare, start_simulated_arm
from effort_controller import LENIENT_DRIVER
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from repository import ROOT
from ros_publisher import DOMAIN_FILE
from waiting import TIMEOUT, wait_until

import dvrk_drake as dvrk
from dvrk_drake.analysis.excitation.periodic_motion import FourierBasis, PeriodicMotion
from dvrk_drake.analysis.excitation.pose_file import load_poses
from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.errors import StationError
from dvrk_drake.systems.closed_loop import add_closed_loop
from dvrk_drake.systems.gravity_pid_controller import GravityPidController
from dvrk_drake.systems.station import Station, load_station_config

pytestmark = [pytest.mark.network, pytest.mark.realtime]

ros = pytest.importorskip("dvrk_drake.systems.ros.domain", reason="needs cyclonedds")


@pytest.mark.watchdog
def test_diagram_controls_an_arm_with_efforts(tmp_path, monkeypatch):
    monkeypatch.setenv("CYCLONEDDS_URI", DOMAIN_FILE)
    from dvrk_drake.systems.ros.messages import Empty, JointState

    guard = yaml.safe_load(LENIENT_DRIVER)["guard"]
    path = tmp_path / "station.yaml"
    path.write_text(yaml.safe_dump({"arms": {"mtml": {"arm": "mtml", "ros_driver": {"guard": guard}}}}))
    config = load_station_config(path)
    with start_simulated_arm("mtml", "MTML", 500.0) as arm:
        arm.enable_and_home()
        before = np.array(arm.latest().position)
        efforts = arm.domain.subscribe("/MTML/servo_jf", JointState)
        holds = arm.domain.subscribe("/MTML/hold", Empty)
        station = Station(config, hardware=True)
        builder = DiagramBuilder()
        model = IdentifiedModel.from_arm(station.arms["mtml"])
        add_closed_loop(builder, station, GravityPidController(model), name="mtml")
        simulator = Simulator(builder.Build())
        simulator.set_target_realtime_rate(1.0)
        while not (applied := efforts.take()):
            simulator.AdvanceTo(simulator.get_context().get_time() + 0.1)
            assert simulator.get_context().get_time() < 60.0, "no effort was published"
        simulator.AdvanceTo(simulator.get_context().get_time() + 0.5)
        context = station.GetMyContextFromRoot(simulator.get_context())
        measured = station.GetOutputPort("mtml.position_measured").Eval(context)
        np.testing.assert_allclose(measured, before, rtol=0, atol=0.03)
        gravity = model.holding_torque(before[None])[0]
        np.testing.assert_allclose(applied[-1][0].effort, gravity, rtol=0, atol=0.05)
        # The Diagram no longer advances, so the deadman process holds the arm.
        assert arm.domain.wait_until(lambda: bool(holds.take()), 20.0)


def test_later_station_of_a_process_replaces_an_earlier_one(tmp_path, monkeypatch):
    """In a notebook, the Diagram of the first station still exists when its cell is executed again."""
    monkeypatch.setenv("CYCLONEDDS_URI", DOMAIN_FILE)
    path = tmp_path / "station.yaml"
    path.write_text(yaml.safe_dump({"arms": {"mtml": {"arm": "mtml", "ros_driver": {}}}}))
    config, simulators = load_station_config(path), []
    with start_simulated_arm("mtml", "MTML", 500.0) as arm:
        arm.enable_and_home()
        for _ in range(3):
            station = Station(config, hardware=True)
            simulators.append(Simulator(station))
            measured = station.GetOutputPort("mtml.position_measured")
            while not np.all(np.isfinite(measured.Eval(simulators[-1].get_context()))):
                time = simulators[-1].get_context().get_time()
                simulators[-1].AdvanceTo(time + 0.01)
                assert time < 60.0, "no measurement"
        for simulator in simulators[:-1]:
            with pytest.raises(StationError, match=r"^/MTML: this station has ended, because a later station of this"):
                simulator.AdvanceTo(simulator.get_context().get_time() + 0.01)
        simulators[-1].AdvanceTo(simulators[-1].get_context().get_time() + 0.01)


# `dvrk.connect` over ROS 2: measurement, a motion with the guard in this process, and hold. A script over LCM.


ARM = dvrk.load_arm("mtml")


@pytest.mark.slow
@pytest.mark.watchdog
def test_motion_and_taught_pose_over_ros(tmp_path, monkeypatch):
    monkeypatch.setenv("CYCLONEDDS_URI", DOMAIN_FILE)
    from dvrk_drake.systems.ros.messages import Empty, OperatingState

    # The controller receives each message, and needs 500 Hz also while this computer is busy.
    arguments = ("--transport", "ros", "--rate", "700", "--enabled", "--realtime")
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
        # An arm without friction drifts while it is guided, and holds where it is when the command ends.
        np.testing.assert_allclose(load_poses(poses, ARM)[-1], connection.measure(0.1).q, atol=0.05)
        holds = domain.subscribe("/MTML/hold", Empty, depth=10)
        connection.hold()
        assert domain.wait_until(lambda: bool(holds.take()), 20.0)
    finally:
        arm.end(signal.SIGINT)


@pytest.mark.slow
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


# Conformance of the simulated arm and the dVRK console: the same checks of topics, states and commands.


pytest.importorskip("cyclonedds", reason="needs cyclonedds")


#: Checks in which the arms differ on purpose (docs/ros.md): beginnings of the texts of the console and the simulation.
DIFFERENCES = {
    "servo_jp with a number too many": ("set-point [", "set-point unchanged"),
    "servo_jp with a jump of 70 mm": ("FAULT, homed", "ENABLED, homed"),
    "pause, pause, resume": ("PAUSED, homed", "ENABLED, homed"),
    "unhome, then home": ("ENABLED, not homed", "ENABLED, homed"),
}


@pytest.mark.slow
@pytest.mark.parametrize("arm", ["MTML", "PSM1"])
def test_simulated_arm_conforms_to_the_console(arm, tmp_path, monkeypatch):
    monkeypatch.setenv("CYCLONEDDS_URI", DOMAIN_FILE)
    found = compare(arm, tmp_path)
    different = {check: texts for check, texts in found.items() if texts[0] != texts[1]}
    assert different.keys() == DIFFERENCES.keys() & found.keys(), different
    for check, texts in different.items():
        for text, beginning in zip(texts, DIFFERENCES[check], strict=True):
            assert text.startswith(beginning), check
