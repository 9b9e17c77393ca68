"""Arms with locked joints: identities with the full arm, and refusals."""

import dataclasses
import threading
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from command_output import assert_refused

from dvrk_drake.dynamics.dynamic_regressor import DynamicRegressor, derive_base_parameters
from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.errors import ArmError, ModelError
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.models.arm_schema import Gains
from dvrk_drake.models.effects_schema import DriveEffect
from dvrk_drake.models.locked_joints import lock_joints
from dvrk_drake.models.plant import holding_torque, make_arm_plant, set_arm_positions, shared_plant
from dvrk_drake.models.sdf_model import MODELS_FOLDER
from dvrk_drake.systems.arm_station import ArmStation, station_ports
from dvrk_drake.systems.gravity_pid_controller import GravityPidController

pytestmark = pytest.mark.drake_api

WRIST = {"roll": 0.4, "wrist_pitch": -0.7, "wrist_yaw": 0.3, "jaw": 0.5}
CASES = [
    ("psm", WRIST),
    ("psm", {"insertion": 0.1}),
    ("mtml", {"wrist_pitch": 0.6, "wrist_yaw": 0.2, "wrist_roll": -1.0}),
    ("mtmr", {"shoulder_pitch": 0.1, "elbow_pitch": 0.2, "wrist_platform": 0.3}),
]


def both(name, locked, count=20):
    """Returns the full arm, the arm with locked joints, and a motion of both arms."""
    full = load_arm(name)
    arm = lock_joints(full, locked)
    free = [full.joint_names.index(joint) for joint in arm.joint_names]
    motion = np.random.default_rng(0).normal(0, 0.5, (3, count, arm.num_joints))
    whole = np.zeros((3, count, full.num_joints))
    whole[:, :, free] = motion
    for joint, position in locked.items():
        whole[0, :, full.joint_names.index(joint)] = position
    return full, arm, free, motion, whole


@pytest.mark.parametrize(("name", "locked"), CASES)
def test_maps_are_those_of_the_full_arm(name, locked):
    full, arm, free, (q, v, _), (Q, V, _) = both(name, locked)
    np.testing.assert_allclose(arm.linkage.position(q), full.linkage.position(Q), atol=1e-12)
    np.testing.assert_allclose(arm.linkage.velocity(v), full.linkage.velocity(V), atol=1e-12)
    np.testing.assert_allclose(arm.transmission.velocity(v), full.transmission.velocity(V)[:, free], atol=1e-12)
    np.testing.assert_allclose(arm.effort_limits, full.effort_limits[free], atol=0)
    np.testing.assert_allclose(arm.gains.kp, np.array(full.gains.kp)[free], atol=0)
    np.testing.assert_allclose(arm.encoder_counts(), full.encoder_counts()[free], atol=1e-13)
    np.testing.assert_allclose(arm.dry_friction(), full.dry_friction()[free], atol=1e-12)
    for pose in arm.sample_poses(20, np.random.default_rng(1)):
        whole = Q[0].copy()
        whole[free] = pose
        assert full.limit_violations(whole, 1e-9) == []


@pytest.mark.parametrize(("name", "locked"), CASES)
def test_dynamics_are_those_of_the_full_arm(name, locked):
    full, arm, free, motion, whole = both(name, locked)
    ours, reference = DynamicRegressor(arm), DynamicRegressor(full)
    tau = ours.torque(*motion, ours.values)
    np.testing.assert_allclose(tau, reference.torque(*whole, reference.values)[:, free], atol=1e-9)
    np.testing.assert_allclose(ours.regressor(*motion) @ ours.values, tau, atol=1e-9)
    base = derive_base_parameters(ours)
    # The efforts depend on the parameters only through the base parameters.
    other = ours.values.copy()
    other[: base.combination.shape[1]] += np.linalg.svd(base.combination)[2][-1]
    np.testing.assert_allclose(ours.regressor(*motion) @ other, tau, atol=1e-7)
    M = reference.mass_matrix(whole[0], reference.values)[:, free][:, :, free]
    np.testing.assert_allclose(ours.mass_matrix(motion[0], ours.values), M, atol=1e-9)


def test_plant_has_the_locked_positions():
    full, arm, _, (q, *_), (Q, *_) = both("psm", WRIST, 1)
    plant = make_arm_plant(full)
    contexts = plant.CreateDefaultContext(), plant.CreateDefaultContext()
    set_arm_positions(plant, contexts[0], arm, q[0])
    set_arm_positions(plant, contexts[1], full, Q[0])
    np.testing.assert_allclose(*(plant.GetPositions(context) for context in contexts), atol=1e-12)


def test_equal_arguments_give_the_same_arm():
    arm = load_arm("psm")
    locked = lock_joints(arm, WRIST)
    assert locked is lock_joints(arm, dict(reversed(WRIST.items())))
    assert lock_joints(arm, {}) is arm
    assert locked.joint_names == ("yaw", "pitch", "insertion") and locked.locked_joints == WRIST
    assert locked.with_gravity([0, 1, -9]).locked_joints == WRIST
    twice = lock_joints(lock_joints(arm, {"roll": 0.4}), {k: WRIST[k] for k in list(WRIST)[1:]})
    assert twice.joint_names == locked.joint_names and twice.locked_joints == WRIST


def test_bounds_of_coupled_limits_include_locked_joints():
    arm = lock_joints(load_arm("mtml"), {"outer_yaw": 0.1})
    assert arm.coupled_limits == load_arm("mtml").coupled_limits
    sample = load_arm("mtml").coupled_limits[0]
    weighted = dataclasses.replace(sample, coefficients={"outer_yaw": 2.0, "shoulder_pitch": 1.0})
    arm = dataclasses.replace(load_arm("mtml"), coupled_limits=(weighted,))
    (limit,) = lock_joints(arm, {"outer_yaw": 0.1}).coupled_limits
    assert limit.coefficients == {"shoulder_pitch": 1.0}
    assert limit.lower == pytest.approx(sample.lower - 0.2, abs=1e-12)
    assert limit.upper == pytest.approx(sample.upper - 0.2, abs=1e-12)


@pytest.mark.parametrize(
    ("name", "locked", "message"),
    [
        ("psm", {"rol": 0}, 'PSM has no joint "rol" to lock; did you mean "roll"\\? allowed: yaw, pitch'),
        ("psm", {"roll": 9}, "locked joint roll = 9 is outside its limits; allowed: -4.538..4.538 rad"),
        ("psm", {"insertion": float("nan")}, "insertion = nan is outside its limits; allowed: 0..0.24 m"),
        ("psm", {"jaw": 0}, "wrist_pitch, wrist_yaw, jaw are coupled by the transmission; lock all of these joints"),
        ("mtml", {"wrist_platform": 0}, "shoulder_pitch, elbow_pitch, wrist_platform are coupled by the transmission"),
        ("psm", {**WRIST, "yaw": 0, "pitch": 0, "insertion": 0.1}, "all joints are locked; allowed: at least one"),
        (
            "mtml",
            {"shoulder_pitch": 1.0, "elbow_pitch": 0.5, "wrist_platform": 0.0},
            "the locked joints violate the limit parallelogram = 1.5; allowed: -0.33..0.68",
        ),
    ],
)
def test_refusals_state_what_is_accepted(name, locked, message):
    assert_refused(ArmError, message, lock_joints, load_arm(name), locked)


def test_a_locked_joint_is_locked_once():
    with pytest.raises(ArmError, match=r"joint roll is already locked at 0\.4"):
        lock_joints(lock_joints(load_arm("psm"), WRIST), {"roll": 0.4})


def test_position_effects_of_locked_and_other_joints_are_refused():
    psm = load_arm("psm")
    mixed = {"bend": np.array([0.0, 1.0, 0.0, 0.0, 1.0, 0.0, 0.0])}
    with_friction = dataclasses.replace(psm, friction_coordinates=psm.friction_coordinates | mixed)
    locked = lock_joints(with_friction, WRIST)
    np.testing.assert_allclose(locked.friction_coordinates["bend"], [0.0, 1.0, 0.0], atol=0)
    spring = dataclasses.replace(psm.effects, springs=[DriveEffect("bend", "spring", 1.0, 0.1)])
    with pytest.raises(ArmError, match="bend has position-dependent effects"):
        lock_joints(dataclasses.replace(with_friction, effects=spring), WRIST)


def test_model_file_restores_the_locked_joints(tmp_path):
    arm = lock_joints(load_arm("psm"), WRIST)
    for dynamics in (False, True):
        model = IdentifiedModel.from_arm(arm, dynamics=dynamics)
        model.save(tmp_path / "m.yaml")
        again = IdentifiedModel.load(tmp_path / "m.yaml")
        assert again.arm is arm and again == model
    with pytest.raises(ModelError, match=r"valid only with locked joints \(roll = 0.4, .*\).*allowed: a model of the"):
        IdentifiedModel.load(tmp_path / "m.yaml", load_arm("psm"))
    assert IdentifiedModel.load(tmp_path / "m.yaml", arm).arm is arm
    text = (tmp_path / "m.yaml").read_text()
    (tmp_path / "bad.yaml").write_text(text.replace("roll: 0.4", "roll: 9.0"))
    with pytest.raises(ModelError, match="locked joint roll = 9 is outside its limits"):
        IdentifiedModel.load(tmp_path / "bad.yaml")


def controller(arm):
    return GravityPidController(IdentifiedModel.from_arm(arm))


@pytest.mark.parametrize("create", [ArmStation, station_ports, controller])
def test_stations_and_controllers_require_all_joints(create):
    with pytest.raises(ArmError, match=r"PSM has locked joints \(roll = 0.4, .*\), but a .* requires all joints"):
        create(lock_joints(load_arm("psm"), WRIST))


def test_an_arm_and_its_parts_cannot_be_modified():
    arm = lock_joints(load_arm("psm"), {"roll": 0})
    for change in (
        lambda: setattr(arm, "name", "other"),
        lambda: setattr(arm.gains, "kp", [1.0]),
        lambda: arm.gains.kp.__setitem__(0, 1.0),
        lambda: arm.gains.kp.append(1.0),
        lambda: arm.position_lower.__setitem__(0, 1.0),
        lambda: arm.linkage.matrix.__setitem__((0, 0), 1.0),
        arm.friction_coordinates.clear,
        arm.effects.friction.pop,
        lambda: setattr(arm.effects.friction[0], "coefficient", 0.0),
        lambda: arm.effects.encoder.resolution.update(yaw=1.0),
        lambda: setattr(arm.identification, "base_may_tilt", True),
        lambda: arm.locked_joints.update(yaw=0.0),
    ):
        with pytest.raises((ArmError, AttributeError, ValueError)):
            change()
    gains = Gains(*([1.1 * x for x in values] for values in vars(arm.gains).values()))
    assert dataclasses.replace(arm, gains=gains).gains == gains
    gains.kp[0] = 2.0  # The arm has a copy.


def test_threads_get_the_same_arm(tmp_path):
    """The threads request an arm file that was not loaded before, its tilted arm, its locked arm and its plant."""
    (tmp_path / "arm.yaml").write_text((MODELS_FOLDER / "arms" / "psm.yaml").read_text())
    start = threading.Barrier(4)

    def load(_):
        start.wait()
        arm = load_arm(tmp_path / "arm.yaml")
        locked = lock_joints(arm.with_gravity([0, -1, -9.7]), {"roll": 0})
        return arm, locked, shared_plant(locked)

    with ThreadPoolExecutor(4) as pool:
        results = list(pool.map(load, range(4)))
    assert all(a is b for result in results for a, b in zip(result, results[0], strict=True))


# Tests a custom instrument: other links, other joints, files outside the package.


PROBE_SDF = """<?xml version="1.0"?>
<sdf version="1.9">
  <model name="probe">
    <link name="probe_link">
      <pose>0 0 0.0156 0 0 0</pose>
      <inertial>
        <pose>0.02 0 -0.1 0 0 0</pose>
        <mass>0.1</mass>
        <inertia><ixx>1e-4</ixx><iyy>1e-4</iyy><izz>1e-5</izz><ixy>0</ixy><ixz>0</ixz><iyz>0</iyz></inertia>
      </inertial>
      <collision name="tip"><geometry><sphere><radius>0.01</radius></sphere></geometry></collision>
    </link>
    <joint name="roll" type="revolute">
      <parent>insertion_link</parent>
      <child>probe_link</child>
      <axis><xyz>0 0 -1</xyz><limit><lower>-3</lower><upper>3</upper><effort>0.3</effort></limit></axis>
    </joint>
    <frame name="dh_4" attached_to="probe_link"><pose degrees="true">0 0 0 180 0 -90</pose></frame>
  </model>
</sdf>
"""
PROBE_YAML = """sdf: probe.sdf
joints: [roll]
position_limits: {roll: [-3.0, 3.0]}
gains: {kp: [0.4], kd: [0.01], ki: [1.6]}
"""
LIMITS = "position_limits: {yaw: [-1.588, 1.588], pitch: [-0.925, 0.925], insertion: [0.0, 0.24]}\n"


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "probe.sdf").write_text(PROBE_SDF)
    (tmp_path / "probe.yaml").write_text(PROBE_YAML)
    (tmp_path / "arm.yaml").write_text(f"name: PSM\nmechanism: psm\ninstrument: probe.yaml\n{LIMITS}")
    (tmp_path / "bare.yaml").write_text(f"name: PSM\nmechanism: psm\n{LIMITS}")
    return tmp_path


def test_custom_instrument_is_attached_to_the_arm(folder):
    arm = load_arm(str(folder / "arm.yaml"))
    assert arm.joint_names == ("yaw", "pitch", "insertion", "roll")
    plant = make_arm_plant(arm)
    context = plant.CreateDefaultContext()
    q = np.array([0.5, 0.3, 0.1, 0.7])
    set_arm_positions(plant, context, arm, q)
    torque = IdentifiedModel.from_arm(arm).holding_torque(q)
    np.testing.assert_allclose(torque, holding_torque(plant, context, arm), atol=1e-12)
    assert abs(torque[3]) > 1e-3  # its centre of mass is off the shaft axis


@pytest.mark.parametrize(("name", "hand"), [("arm.yaml", "probe_link"), ("bare.yaml", "dh_3")])
def test_hand_holds_the_instrument_if_there_is_one(folder, name, hand):
    frames = load_arm(str(folder / name)).frames
    assert (frames.hand, frames.remote_center, frames.shaft) == (hand, "dh_0", "")


@pytest.mark.parametrize("name", ["arm.yaml", "bare.yaml"])
def test_custom_instrument_is_simulated_without_self_collision(folder, name):
    station = ArmStation(load_arm(str(folder / name)), closure="ball")
    context = station.CreateDefaultContext()
    query = station.GetOutputPort("query_object").Eval(context)
    assert not query.inspector().GetCollisionCandidates()


def test_missing_instrument_file_is_named(folder):
    (folder / "bad.yaml").write_text((folder / "arm.yaml").read_text().replace("probe.yaml", "gone.yaml"))
    assert_refused(ArmError, r"bad\.yaml: instrument .*gone\.yaml does not exist", load_arm, str(folder / "bad.yaml"))
