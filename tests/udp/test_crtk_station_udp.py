"""Hardware station over ROS 2: one Diagram controls the simulated arm of another process."""

import numpy as np
import pytest
import yaml
from crtk_conformance import start_simulated_arm
from effort_controller import LENIENT_DRIVER
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from ros_publisher import DOMAIN_FILE

from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.errors import StationError
from dvrk_drake.systems.closed_loop import add_closed_loop
from dvrk_drake.systems.gravity_pid_controller import GravityPidController
from dvrk_drake.systems.station import Station
from dvrk_drake.systems.station_config import load_station_config

ros = pytest.importorskip("dvrk_drake.systems.ros.domain", reason="needs cyclonedds")

pytestmark = [pytest.mark.network, pytest.mark.realtime]


@pytest.mark.watchdog
def test_diagram_controls_an_arm_with_efforts(tmp_path, monkeypatch):
    monkeypatch.setenv("CYCLONEDDS_URI", DOMAIN_FILE)
    from dvrk_drake.systems.ros.messages import Empty, JointState

    guard = yaml.safe_load(LENIENT_DRIVER)["guard"]
    path = tmp_path / "station.yaml"
    path.write_text(yaml.safe_dump({"arms": {"mtml": {"arm": "mtml", "ros_driver": {"guard": guard}}}}))
    config = load_station_config(path)
    with start_simulated_arm("mtml", "MTML", 500.0) as arm:
        for word, homed in (("enable", False), ("home", True)):
            arm.state_command(word)
            assert arm.domain.wait_until(lambda goal=("ENABLED", homed, False): arm.state() == goal, 20.0)
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
        for word, homed in (("enable", False), ("home", True)):
            arm.state_command(word)
            assert arm.domain.wait_until(lambda goal=("ENABLED", homed, False): arm.state() == goal, 20.0)
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
