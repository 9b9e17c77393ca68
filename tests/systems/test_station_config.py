"""Station files: Drake's loader and schemas, same ports in simulation and on hardware."""

import re

import numpy as np
import pytest
from pydrake.common.yaml import yaml_dump_typed, yaml_load_typed
from pydrake.lcm import DrakeLcm
from pydrake.systems.analysis import ApplySimulatorConfig, Simulator
from repository import ROOT

from dvrk_drake.errors import ArmError, StationError
from dvrk_drake.experiments.scenario import Scenario
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.systems.arm_station import ArmStation, arm_plant_config, station_ports
from dvrk_drake.systems.hardware_arm_station import HardwareArmStation
from dvrk_drake.systems.ros.crtk_driver import CrtkDriver
from dvrk_drake.systems.station_config import ArmConfig, StationConfig, load_station_config, make_arm_station

pytestmark = pytest.mark.drake_api

FILE = """
arm: psm
closure: ball
gravity: [0, 9.81, 0]
simulated_effects: [friction]
seed: 3
plant: {time_step: 0.002, contact_model: point}
simulator: {target_realtime_rate: 0.0, start_time: 1.0}
driver: {status_period: 0.002, model: model.yaml}
"""


@pytest.fixture
def path(tmp_path):
    path = tmp_path / "station.yaml"
    path.write_text(FILE)
    return path


def test_file_is_loaded_with_defaults(path):
    config = load_station_config(path)
    assert (config.arm, config.closure, config.seed, config.simulated_effects) == ("psm", "ball", 3, ["friction"])
    assert (config.plant.time_step, config.plant.contact_model) == (0.002, "point")
    assert config.plant.discrete_contact_approximation == "sap" and not config.plant.use_sampled_output_ports
    assert config.driver.status_period == 0.002
    assert config.driver.model == str(path.parent / "model.yaml")


def test_configuration_round_trip():
    config = StationConfig(arm="mtmr", plant=arm_plant_config(2e-3))
    again = yaml_load_typed(schema=StationConfig, data=yaml_dump_typed(config, schema=StationConfig))
    assert repr(again) == repr(config), "Drake's own schemas do not define equality"


def test_station_matches_its_file(path):
    config = load_station_config(path)
    station = make_arm_station(config)
    assert isinstance(station, ArmStation) and station.plant.time_step() == 0.002
    np.testing.assert_allclose(station.plant.gravity_field().gravity_vector(), [0.0, 9.81, 0.0], atol=0)
    assert station.plant.get_contact_model().name == "kPoint"
    assert station.plant.num_constraints() > 0, "pinned loops"
    simulator = Simulator(station)
    ApplySimulatorConfig(config.simulator, simulator)
    simulator.Initialize()
    simulator.AdvanceTo(1.004)


@pytest.mark.parametrize("name", ["mtml", "psm"])
def test_hardware_and_simulation_have_the_same_ports(name):
    config = StationConfig(arm=name)
    hardware, simulation = make_arm_station(config, hardware=True, lcm=DrakeLcm("memq://")), make_arm_station(config)
    assert isinstance(hardware, HardwareArmStation)
    for ports in (hardware, simulation):
        for port, size in station_ports(load_arm(name)).inputs.items():
            assert ports.GetInputPort(port).size() == size
        for port, size in station_ports(load_arm(name)).outputs.items():
            assert ports.GetOutputPort(port).size() == size


def test_scenario_has_the_same_arm_fields():
    assert issubclass(Scenario, ArmConfig) and issubclass(StationConfig, ArmConfig)
    # "closure" has another default in a scenario, but the same meaning.
    own = [set(schema.__annotations__) & set(ArmConfig.__annotations__) for schema in (Scenario, StationConfig)]
    assert own == [{"closure"}, set()]


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("arm: psm", "", "arm is missing; give an arm's name"),
        ("closure: ball", "closure: weld", 'closure is "weld"; allowed: mimic, ball'),
        (
            "[0, 9.81, 0]",
            "[0, 981, 0]",
            r"station\.yaml: gravity \(0, 981, 0\) must be a vector of three numbers with a norm up to 30 m/s",
        ),
        ("seed: 3", "seed: -1", r"seed is -1; allowed: 0\.\."),
        ("[friction]", "[fraction]", "simulated arm: .*fraction"),
        ("time_step: 0.002,", "time_step: 0.02,", r"plant\.time_step must be above 0 and at most 0\.01 s"),
        ("status_period: 0.002", "status_period: 0.2", r"status_period is 0\.2; allowed"),
        ("seed: 3", "sead: 3", r"station\.yaml: .*sead"),
        ("point", "[", r"station\.yaml: "),
    ],
)
def test_invalid_values_are_reported(path, old, new, message):
    assert FILE.count(old) == 1
    path.write_text(FILE.replace(old, new))
    with pytest.raises((StationError, ArmError), match=message) as error:
        load_station_config(path)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("section", "message"),
    [
        ({"rate": 5}, r"ros_driver: rate is 5; allowed: 10\.\.1000 Hz"),
        ({"domain": "x"}, r'ros_driver: domain is "x"; allowed: an integer'),
        ({"ratte": 500}, r'ros_driver: key "ratte" is unknown; did you mean "rate"\? allowed in ros_driver: domain, '),
        ({"guard": {"expiry": 9.0}}, r"ros_driver: guard\.expiry is 9; allowed: "),
        ({"control_modes": ["jump"]}, r"control_modes contains an unknown mode: \['jump'\]; allowed: position, "),
        ({"namespace": "MTM L"}, 'namespace is "MTM L"; allowed: '),
        ([1], r"ros_driver: must have keys and values, not \[1\]; allowed in ros_driver: domain, "),
    ],
)
def test_mistakes_in_the_driver_over_ros_are_reported(path, section, message):
    path.write_text(f"{FILE}ros_driver: {section}\n")
    with pytest.raises(StationError, match=rf"station\.yaml: {message}") as error:
        load_station_config(path)
    assert "\n" not in str(error.value)


def test_driver_over_ros_is_chosen_and_has_no_lcm_interface(path):
    path.write_text(f"{FILE}ros_driver: {{domain: 3, model: ros.yaml}}\n")
    config = load_station_config(path)
    assert config.ros_driver == CrtkDriver(domain=3, model=str(path.parent / "ros.yaml"))
    with pytest.raises(StationError, match="lcm cannot be used with a driver over ROS 2"):
        make_arm_station(config, hardware=True, lcm=DrakeLcm("memq://"))


def test_documentation_example_runs(monkeypatch):
    monkeypatch.chdir(ROOT)
    blocks = re.findall(r"```python\n(.*?)```", (ROOT / "docs/lcm.md").read_text(), re.DOTALL)
    (code,) = (block for block in blocks if "load_station_config" in block)
    names: dict = {}
    exec(code, names)
    assert names["simulator"].get_context().get_time() == 0.5


def test_missing_file_is_reported(tmp_path):
    with pytest.raises(StationError, match=r"nowhere\.yaml: "):
        load_station_config(tmp_path / "nowhere.yaml")
