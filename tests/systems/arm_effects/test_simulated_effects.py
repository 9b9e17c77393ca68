"""Simulated arm with effects: selection of parts, scenarios, and invalid configurations."""

import xml.etree.ElementTree as ElementTree

import numpy as np
import pytest
from arm_copies import copy_arm
from command_output import assert_refused
from simulated_effects import ARMS

from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.dynamics.kinematics import ArmFrame
from dvrk_drake.errors import ArmError, ScenarioError, StationError
from dvrk_drake.experiments.scenario import HandScenario, load_scenario
from dvrk_drake.experiments.simulation import simulate
from dvrk_drake.models.arm_files import known_arms, load_arm
from dvrk_drake.models.effects_schema import EFFECT_NAMES, ArmEffects, FrictionEffect
from dvrk_drake.models.sdf_model import MODELS_FOLDER
from dvrk_drake.recordings.formats import read_recording
from dvrk_drake.systems.arm_station import ArmStation

pytestmark = [pytest.mark.numeric, pytest.mark.drake_api]


def scenario(arm, *settings):
    parts = ["duration=0.3", "simulated_effects=[all]", "sample_period=0.001"]
    return load_scenario(arm, [*parts, *settings])


def holding_efforts(arm, q):
    """Returns the holding efforts (m, n) of the SDF, and those with the springs and cables of the arm file."""
    models = (IdentifiedModel.from_arm(arm), IdentifiedModel.from_arm(arm, arm.effects.position_dependent))
    return [np.array([model.holding_torque(pose) for pose in q]) for model in models]


@pytest.mark.parametrize("name", known_arms())
def test_motors_can_hold_the_arm_against_its_springs_and_cables(name):
    arm = load_arm(name)
    for efforts in holding_efforts(arm, arm.sample_poses(200, np.random.default_rng(0))):
        assert np.all(np.abs(efforts) + arm.dry_friction() < arm.effort_limits)


@pytest.mark.parametrize(
    ("name", "coordinates", "files"),
    [
        ("mtmr", "actuator", ["trajectories/mtm_one.csv", "trajectories/mtm_earlier_day.csv"]),
        ("mtmr", "joint", ["mtm_static/mtm_2015_good72.csv"]),
        ("mtmr", "joint", ["mtm_static/mtmr_2017_sweep40.csv", "mtm_static/mtmr_2017_coupled12_may10.csv"]),
        ("psm", "wpi", ["trajectories/psm_one.csv", "trajectories/psm_one_no_weight.csv"]),
    ],
)
def test_springs_and_cables_bring_the_sdf_nearer_to_real_arms(shared_data, name, coordinates, files):
    """Friction and dynamics are part of the efforts, so the sum over the recordings of an arm is compared."""
    arm, squares = load_arm(name), np.zeros(2)
    moved = {effect.coordinate.partition(".")[2] for effect in arm.effects.position_dependent}
    joints = [j for j, joint in enumerate(arm.joint_names) if joint in moved]
    for file in files:
        recording = read_recording(shared_data / file, arm, coordinates=coordinates)
        every = slice(None, None, max(1, len(recording.q) // 200))
        tau = recording.measured_effort()[every]
        error = [(tau - efforts) / arm.effort_limits for efforts in holding_efforts(arm, recording.q[every])]
        squares += [np.mean(each[:, joints] ** 2) for each in error]
    assert squares[1] < squares[0]


@pytest.mark.parametrize("name", ["mtml", pytest.param("psm", marks=pytest.mark.slow)])
def test_seed_gives_identical_bits(name):
    one, two, other = (simulate(scenario(name, f"seed={seed}")).recording for seed in (5, 5, 6))
    for field in ("q", "qd", "tau"):
        np.testing.assert_array_equal(getattr(one, field), getattr(two, field))
    assert np.any(one.tau != other.tau)


@pytest.mark.slow
@pytest.mark.parametrize("name", ARMS)
def test_gravity_controller_holds_arm_with_effects(name):
    arm = load_arm(name)
    path = simulate(load_scenario(name, ["duration=2", "simulated_effects=[all]"])).recording.q
    # Cables and springs, which are not in its model, deflect it by torque / gain until its integral has grown.
    assert np.abs(path - path[0]).max() < 0.1
    rest = [part for part in EFFECT_NAMES if part not in ("cables", "springs")]
    recording = simulate(load_scenario(name, ["duration=2", f"simulated_effects={rest}"])).recording
    resolution = np.array([arm.effects.encoder.resolution[joint] for joint in arm.joint_names])
    counts = arm.transmission.position(recording.q - recording.q[0]) / resolution
    # Presliding alone is a few counts of the fine encoders: 3 mrad under its load.
    assert np.all(np.abs(counts * resolution) < np.maximum(2 * resolution, 0.003))
    assert np.all(np.abs(recording.tau) <= 1.1 * arm.effort_limits)


def test_unknown_part_is_an_error(tmp_path):
    with pytest.raises(ScenarioError, match="simulated arm: unknown effect frction"):
        load_scenario("mtml", ["simulated_effects=[frction]"])
    for old, new, message in (
        ("stops: true", "stopps: true", "stopps"),
        ("outer_yaw: 1.861", "outer_jaw: 1.861", "effects.saturation: unknown actuator outer_jaw"),
        ("outer_yaw: 1.861", "outer_yaw: -1.861", "effects.saturation.outer_yaw is -1.861; allowed: 0.001..1e.06 N m"),
        ("measurement: 1", "measurement: -1", "effects.delay.measurement is -1; allowed: 0..100 time steps"),
        ("presliding, scale: 0.015", "stiction, scale: 0.015", "effects.friction of actuator.wrist_roll: kind is"),
        ("scale: 0.015", "scale: 0.0", "scale is 0; allowed for kind presliding: a positive number"),
        ("coefficient: 0.0011", "coefficient: -0.0011", "coefficient is -0.0011; allowed for kind presliding: 0"),
    ):
        folder = tmp_path / message
        folder.mkdir()
        path = copy_arm(folder, "mtml", mechanism=lambda text, old=old, new=new: text.replace(old, new))
        assert_refused(ArmError, message, load_arm, path)


def test_unknown_coordinate_is_refused():
    arm = load_arm("mtml")
    nowhere = ArmEffects(friction=[FrictionEffect("actuator.elbow", "presliding", 0.01, 0.1)])
    with pytest.raises(StationError, match=r'coordinate is "actuator\.elbow"; allowed: actuator\.outer_yaw'):
        ArmStation(arm, effects=nowhere)


def test_no_sdf_has_friction_tags():
    """Drake ignores them without a message. Friction is stated in the YAML files."""
    paths = {path.name: path for path in (MODELS_FOLDER / "sdf").glob("*.sdf")}
    assert {"mtmr.sdf", "psm.sdf"} <= set(paths)
    for name, path in paths.items():
        assert not list(ElementTree.parse(path).iter("friction")), name


TWO_POSES = [[0.0, 0.2, -0.2, 0.0, 0.5, 0.0, 0.0], [0.3, 0.35, -0.1, 0.3, 0.8, 0.2, 0.4]]
HAND = [
    f"hand.path=[{{time: 0.1, pose: {TWO_POSES[0]}}}, {{time: 0.7, pose: {TWO_POSES[1]}}}]",
    f"start={TWO_POSES[0]}",
]


@pytest.mark.slow
def test_hand_moves_and_releases_the_arm():
    settings = ["duration=2.2", "controller.mode=gravity", "simulated_effects=[all]", *HAND]
    simulation = simulate(load_scenario("mtml", settings))
    frame = ArmFrame(load_arm("mtml"), "dh_7")
    force = np.linalg.norm(simulation.hand[:, 3:], axis=1)
    gripped = (simulation.time >= 0.1) & (simulation.time <= 0.7)
    assert np.all(force[~gripped] == 0.0)
    assert 0.5 < force[gripped].max() <= HandScenario().grip.max_force
    way = [np.linalg.norm(frame.pose(q).translation() - frame.pose(TWO_POSES[1]).translation()) for q in TWO_POSES]
    k = np.flatnonzero(gripped)[-1]
    reached = frame.pose(simulation.state_true[k, :7]).translation() - frame.pose(TWO_POSES[1]).translation()
    assert np.linalg.norm(reached) < 0.2 * way[0]
    # Friction stops it where the hand released it. The remaining motion is oscillation of the friction springs.
    assert np.ptp(simulation.state_true[-50:, :7], axis=0).max() < 5e-3


@pytest.mark.slow
def test_model_with_cables_and_springs_holds_exactly():
    """With gravity compensation alone and without friction, no effort moves the arm."""
    parts = ["simulated_effects=[cables, springs]", "duration=1", "controller.mode=gravity", f"start={TWO_POSES[1]}"]
    moved = {}
    for effects in ("[]", "[cables, springs]"):
        path = simulate(load_scenario("mtml", [*parts, f"controller.compensated_effects={effects}"])).state_true
        moved[effects] = np.abs(path[:, :7] - path[0, :7]).max()
    assert moved["[cables, springs]"] < 1e-3
    assert moved["[]"] > 0.05


def test_saturation_limits_fast_motion():
    """0.05 to 0.9 rad in 0.25 s needs more than the shoulder's motor limit, but less than the joint limit."""
    arm = load_arm("mtml")
    low, high = [0, 0.05, 0, 0, 0, 0, 0], [0, 0.6, -0.5, 0, 0, 0, 0]
    settings = [f"start={low}", f"targets=[{{time: 0.2, pose: {high}}}]", "duration=0.4"]
    error, effort = {}, {}
    for parts in ("[]", "[saturation]"):
        simulation = simulate(load_scenario("mtml", [*settings, f"simulated_effects={parts}"]))
        error[parts] = np.abs(simulation.recording.q - simulation.desired).max()
        effort[parts] = np.abs(arm.transmission.inverse.pull_back_effort(simulation.recording.tau)).max(axis=0)
    limit = np.array([arm.effects.saturation[joint] for joint in arm.joint_names])
    assert np.any(effort["[]"] > 1.1 * limit)
    assert np.all(effort["[saturation]"] <= limit * (1 + 1e-9))
    assert error["[saturation]"] > 1.2 * error["[]"]


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ("hand.path=[{time: 0.1, pose: [0, 0, 0, 0, 0, 0, 0]}]", "hand.path must have 2 or more poses"),
        ("hand.path=[{time: 0.1, pose: [0, 0, 0]}]", r"hand.path\[0\].pose has 3 numbers"),
        ("hand.grip=1", "allowed"),
        ("controller.compensated_effects=[friction]", 'controller.compensated_effects is "friction"; allowed:'),
        ("controller.friction_ratio=0.5", 'controller.friction_ratio requires controller.mode "gravity"'),
    ],
)
def test_invalid_scenario_is_refused(setting, message):
    assert_refused(ScenarioError, message, load_scenario, "mtml", [setting])
