"""Station files: Drake's loader and schemas, same ports in simulation and on hardware."""

import re

import numpy as np
import pytest
from command_output import assert_refused
from pydrake.lcm import DrakeLcm
from pydrake.systems.analysis import ApplySimulatorConfig, Simulator
from pydrake.systems.framework import DiagramBuilder
from repository import ROOT

from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.errors import ArmError, StationError
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.systems.arm_station import ArmStation, station_ports
from dvrk_drake.systems.closed_loop import add_closed_loop
from dvrk_drake.systems.driver import CrtkDriver
from dvrk_drake.systems.gravity_pid_controller import GravityPidController
from dvrk_drake.systems.hardware_arm_station import HardwareArmStation
from dvrk_drake.systems.station import Station, StationArm, StationConfig, load_station_config

pytestmark = pytest.mark.drake_api

FILE = """
arms:
  side:
    arm: psm
    closure: ball
    X_PB: {translation: [0, 0, 0.5], rpy: [1.5707963267948966, 0, 0]}
    simulated_effects: [friction]
    seed: 3
    driver: {status_period: 0.002, model: model.yaml}
plant: {time_step: 0.002, contact_model: point}
simulator: {target_realtime_rate: 0.0, start_time: 1.0}
"""


@pytest.fixture
def path(tmp_path):
    path = tmp_path / "station.yaml"
    path.write_text(FILE)
    return path


def test_file_is_loaded_with_defaults(path):
    config = load_station_config(path)
    (arm,) = config.arms.values()
    assert (arm.arm, arm.closure, arm.seed, arm.simulated_effects) == ("psm", "ball", 3, ["friction"])
    assert (config.plant.time_step, config.plant.contact_model) == (0.002, "point")
    assert config.plant.discrete_contact_approximation == "sap" and not config.plant.use_sampled_output_ports
    assert arm.driver.status_period == 0.002
    assert arm.driver.model == str(path.parent / "model.yaml")


def test_station_matches_its_file(path):
    config = load_station_config(path)
    station = Station(config)
    plant = station.plant
    assert plant.time_step() == 0.002
    assert plant.get_contact_model().name == "kPoint"
    assert plant.num_constraints() > 0, "pinned loops"
    X_WB = plant.GetFrameByName("base_link").CalcPoseInWorld(plant.CreateDefaultContext())
    np.testing.assert_allclose(X_WB.GetAsMatrix4()[:3], [[1, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0.5]], atol=1e-12)
    np.testing.assert_allclose(station.arms["side"].gravity, [0.0, -9.81, 0.0], atol=1e-12)
    simulator = Simulator(station)
    ApplySimulatorConfig(config.simulator, simulator)
    simulator.Initialize()
    simulator.AdvanceTo(1.004)


def test_arm_at_a_frame_of_the_directives_moves_as_alone(path):
    """The frame is rotated against the pose of the base, so that gravity is that of an upright arm."""
    turned = "{name: stand, X_PF: {base_frame: world, translation: [1, 0, 0], rotation: !Rpy {deg: [-90, 0, 0]}}}"
    (path.parent / "cell.dmd.yaml").write_text(f"directives: [{{add_frame: {turned}}}]")
    path.write_text(FILE.replace("X_PB: {", "X_PB: {parent_frame: stand, ") + "directives: cell.dmd.yaml\n")
    config = load_station_config(path)
    arm = load_arm("psm")
    alone = ArmStation(arm, plant_config=config.plant, closure="ball", effects=arm.effects.only(["friction"]), seed=3)
    station, states = Station(config), []
    np.testing.assert_allclose(station.arms["side"].gravity, [0.0, 0.0, -9.81], atol=1e-12)
    X_WB = station.plant.GetFrameByName("base_link").CalcPoseInWorld(station.plant.CreateDefaultContext())
    np.testing.assert_allclose(X_WB.translation(), [1.0, 0.5, 0.0], atol=1e-12)
    for system, name in ((station, ["side"]), (alone, [])):
        simulator = Simulator(system)
        system.SetPositions(simulator.get_mutable_context(), *name, [0.2, 0.1, 0.1, 0, 0, 0, 0.5])
        simulator.AdvanceTo(0.05)
        port = system.GetOutputPort(f"{(name or ['psm'])[0]}.state_true")
        states.append(port.Eval(simulator.get_context()))
    assert np.abs(states[0][7:]).max() > 0.01
    np.testing.assert_allclose(states[0], states[1], atol=1e-9)


def test_arm_of_a_closed_loop_is_named(path):
    station, builder = Station(load_station_config(path)), DiagramBuilder()
    with pytest.raises(StationError, match='the station has no arm ""; allowed: side'):
        add_closed_loop(builder, station, GravityPidController(IdentifiedModel.from_arm(load_arm("psm"))))


@pytest.mark.parametrize("name", ["mtml", "psm"])
def test_hardware_and_simulation_have_the_same_ports(name):
    config = StationConfig(arms={name: StationArm(arm=name), "other": StationArm(arm="mtmr")})
    lcm = DrakeLcm("memq://")
    for station in (Station(config, hardware=True, lcm=lcm), Station(config), HardwareArmStation(load_arm(name))):
        for port, size in station_ports(load_arm(name)).inputs.items():
            assert station.GetInputPort(port).size() == size
        for port, size in station_ports(load_arm(name)).outputs.items():
            assert station.GetOutputPort(port).size() == size


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("arm: psm", "", r"arms\.side: arm is missing; give an arm's name"),
        ("arm: psm", "arm: pms", r"station\.yaml: arms\.side: .*pms"),
        ("[0, 0, 0.5]", "[0, 0.5]", r"arms\.side: X_PB: translation and rpy must have 3 numbers; got 2 and 3"),
        (
            "1.5707963267948966",
            "90",
            r"arms\.side\.X_PB\.rpy\[0\] is 90; allowed: -6\.3\.\.6\.3 rad; is it in degrees\?",
        ),
        ("seed: 3", "gravity: [0, 981, 0]", r"arms\.side\.gravity\[1\] is 981; allowed: -30\.\.30 m/s\^2"),
        ("contact_model: point", "stiction_tolerance: 0", r"plant\.penetration_allowance and stiction_tolerance"),
        ("[friction]", "[fraction]", r"arms\.side: simulated arm: .*fraction"),
        ("time_step: 0.002,", "time_step: 0.02,", r"plant\.time_step must be above 0 and at most 0\.01 s"),
        ("  side:", "  left side:", 'the name "left side" is not valid; allowed: letters, digits and _'),
        ("plant:", "plan:", r'station\.yaml: key "plan" is unknown; did you mean "plant"\? allowed in a station'),
        ("point", "[", r"station\.yaml: "),
    ],
)
def test_invalid_values_are_reported(path, old, new, message):
    assert FILE.count(old) == 1
    path.write_text(FILE.replace(old, new))
    assert_refused((StationError, ArmError), message, load_station_config, path)


def test_gravity_of_another_base_is_refused(path):
    path.write_text(FILE.replace("seed: 3", "gravity: [0, 9.81, 0]"))
    with pytest.raises(StationError, match=r"arms\.side: X_PB gives the gravity \[0\.0, -9\.81, 0\.0\] m/s\^2"):
        Station(load_station_config(path))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "is empty; allowed in a station file: arms, "),
        ("plant: {time_step: 0.001}", "arms is empty; give the arms by name"),
        ("arms: [psm]", "arms is ['psm']; allowed: a mapping from names to mappings with the keys arm, "),
    ],
)
def test_a_file_without_arms_is_reported(path, text, message):
    path.write_text(text)
    assert_refused(StationError, rf"station\.yaml: {re.escape(message)}", load_station_config, path)


@pytest.mark.parametrize(
    ("directives", "parent", "message"),
    [
        (None, "", r"cell\.dmd\.yaml: "),
        ("directives: [{add_arm: {}}]", "", r"cell\.dmd\.yaml: directive 1 is not valid; allowed: add_model, "),
        ("directives: []", "table::top", r'arms\.side\.X_PB\.parent_frame is "table::top"; not a frame of the'),
        (
            "directives: [{add_model: {name: side, file: package://dvrk_drake/sdf/psm.sdf}}]",
            "",
            r"arms\.side: there is another model of this name in the",
        ),
    ],
)
def test_mistakes_in_the_directives_are_reported(path, directives, parent, message):
    text = FILE.replace("X_PB: {", f'X_PB: {{parent_frame: "{parent}", ')
    path.write_text(f"{text}directives: cell.dmd.yaml\n")
    if directives is not None:
        (path.parent / "cell.dmd.yaml").write_text(directives)
    assert_refused(StationError, message, Station, load_station_config(path))


@pytest.mark.parametrize(
    ("section", "message"),
    [
        ({"rate": 5}, r"\.ros_driver\.rate is 5; allowed: 10\.\.1000 Hz"),
        ({"ratte": 500}, r'\.ros_driver: key "ratte" is unknown; did you mean "rate"\? allowed in arms\.side\.ros_'),
        ({"control_modes": ["jump"]}, r": control_modes contains an unknown mode: \['jump'\]; allowed: position, "),
        ({"namespace": "MTM L"}, ': namespace is "MTM L"; allowed: '),
    ],
)
def test_mistakes_in_the_driver_over_ros_are_reported(path, section, message):
    path.write_text(FILE.replace("    driver:", f"    ros_driver: {section}\n    driver:"))
    assert_refused(StationError, rf"station\.yaml: arms\.side\S*{message}", load_station_config, path)


def test_driver_over_ros_is_chosen_and_has_no_lcm_interface(path):
    path.write_text(FILE.replace("    driver:", "    ros_driver: {domain: 3, model: ros.yaml}\n    driver:"))
    config = load_station_config(path)
    assert config.arms["side"].ros_driver == CrtkDriver(domain=3, model=str(path.parent / "ros.yaml"))
    with pytest.raises(StationError, match="lcm cannot be used with a driver over ROS 2"):
        Station(config, hardware=True, lcm=DrakeLcm("memq://"))


def test_documentation_example_runs(monkeypatch):
    monkeypatch.chdir(ROOT)
    blocks = re.findall(r"```python\n(.*?)```", (ROOT / "docs/lcm.md").read_text(), re.DOTALL)
    (code,) = (block for block in blocks if "load_station_config" in block)
    names: dict = {}
    exec(code, names)
    assert names["simulator"].get_context().get_time() == 0.5


def test_missing_file_is_reported(tmp_path):
    assert_refused(StationError, r"nowhere\.yaml: ", load_station_config, tmp_path / "nowhere.yaml")
