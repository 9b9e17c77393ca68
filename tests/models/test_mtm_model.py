"""Tests the SDF of the MTM: DH table of the dVRK, Table I of the paper, linkage and inertias."""

import numpy as np
import pytest
from command_output import assert_refused
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.tree import SpatialInertia, UnitInertia

from dvrk_drake.dynamics.kinematics import ArmFrame, inverse_kinematics
from dvrk_drake.errors import ArmError
from dvrk_drake.models.arm_files import known_arms, load_arm
from dvrk_drake.models.plant import make_arm_plant, set_arm_positions, tree_selector

pytestmark = pytest.mark.drake_api

PI = np.pi
#: sawIntuitiveResearchKit share/kinematic/mtm.json, standard DH: theta offset, d, a, alpha.
DVRK_TABLE = [
    (-PI / 2, 0, 0, PI / 2),
    (-PI / 2, 0, 0.2794, 0),
    (PI / 2, 0, 0.3645, -PI / 2),
    (0, 0.1506, 0, PI / 2),
    (0, 0, 0, -PI / 2),
    (-PI / 2, 0, 0, PI / 2),
    (PI / 2, 0, 0, 0),
]
#: Table I of the paper with L1 = 0: sign of q in theta, theta offset, d, a, alpha.
PAPER_TABLE = [
    (1, 0, 0, 0, -PI / 2),
    (-1, PI / 2, 0, 0.2794, 0),
    (-1, -PI / 2, 0, 0.3645, PI / 2),
    (1, 0, 0.1506, 0, -PI / 2),
    (-1, PI, 0, 0, -PI / 2),
    (1, -PI / 2, 0, 0, PI / 2),
    (-1, 0, 0, 0, 0),
]


def dh_transform(theta, d, a, alpha):
    ct, st, ca, sa = np.cos(theta), np.sin(theta), np.cos(alpha), np.sin(alpha)
    return np.array([[ct, -st * ca, st * sa, a * ct], [st, ct * ca, -ct * sa, a * st], [0, sa, ca, d], [0, 0, 0, 1]])


ARM = load_arm("mtml")


@pytest.fixture(scope="module")
def plant():
    return make_arm_plant(ARM)


def poses(arm, count=30, seed=1):
    return arm.sample_poses(count, np.random.default_rng(seed))


@pytest.mark.parametrize("prefix", ["dh", "paper"])
def test_forward_kinematics_equals_both_published_tables(plant, prefix):
    table = [(1, *row) for row in DVRK_TABLE] if prefix == "dh" else PAPER_TABLE
    context = plant.CreateDefaultContext()
    for q in np.random.default_rng(0).uniform(-PI, PI, (50, 7)):
        set_arm_positions(plant, context, ARM, q)
        X_0 = np.eye(4)
        for i, (sign, offset, d, a, alpha) in enumerate(table):
            X_0 = X_0 @ dh_transform(sign * q[i] + offset, d, a, alpha)
            X = plant.GetFrameByName(f"{prefix}_{i + 1}").CalcPose(context, plant.GetFrameByName(f"{prefix}_0"))
            np.testing.assert_allclose(X.GetAsMatrix4(), X_0, rtol=0, atol=1e-12)


def test_paper_base_is_rotated_by_90_degrees(plant):
    X = plant.GetFrameByName("dh_0").CalcPose(plant.CreateDefaultContext(), plant.GetFrameByName("paper_0"))
    assert X.IsNearlyEqualTo(RigidTransform(RotationMatrix.MakeZRotation(PI / 2)), 1e-12)


def test_parallelogram_is_closed_within_the_limits(plant):
    context = plant.CreateDefaultContext()
    corners = np.array(np.meshgrid(*zip(ARM.position_lower[:3], ARM.position_upper[:3], strict=True))).reshape(3, -1).T
    box = np.random.default_rng(2).uniform(ARM.position_lower, ARM.position_upper, (200, 7))
    box[: len(corners), :3] = corners
    (loop,) = ARM.loop_closures
    for q in box:
        set_arm_positions(plant, context, ARM, q)
        gap = plant.GetFrameByName(loop.frame_a).CalcPose(context, plant.GetFrameByName(loop.frame_b)).translation()
        assert np.linalg.norm(gap) < 1e-9


def test_motor_4_couples_elbow_and_platform(plant):
    """Checks that rotor 4, which rotates by 0.6697 q3 + q4, adds J_4' I J_4 to the mass matrix G' M G."""
    context = plant.CreateDefaultContext()
    G = np.zeros((plant.num_velocities(), 7))
    G[tree_selector(plant, ARM)] = ARM.linkage.matrix
    body = plant.GetBodyByName("motor_4_link")
    for q in poses(ARM, 5):
        context = plant.CreateDefaultContext()
        set_arm_positions(plant, context, ARM, q)
        full = G.T @ plant.CalcMassMatrix(context) @ G
        M = body.default_spatial_inertia()
        I_Bo = M.CalcRotationalInertia().CopyToFullMatrix3()
        less = SpatialInertia(M.get_mass(), M.get_com(), UnitInertia(*np.diag(I_Bo / M.get_mass()) * [1, 1, 0.5]))
        body.SetSpatialInertiaInBodyFrame(context, less)
        difference = full - G.T @ plant.CalcMassMatrix(context) @ G
        J_4 = ARM.transmission.matrix[3]
        np.testing.assert_allclose(difference[1:4, 1:4], 0.5 * I_Bo[2, 2] * np.outer(J_4, J_4)[1:4, 1:4], atol=1e-12)
        assert np.linalg.eigvalsh(full).min() > 0
    assert I_Bo[2, 2] == pytest.approx(10.53**2 * 1e-6, rel=1e-4)


def test_transmission_conserves_power():
    generator = np.random.default_rng(5)
    qd, tau_actuator = generator.normal(size=7), generator.normal(size=7)
    tau_joint = ARM.transmission.pull_back_effort(tau_actuator)
    assert ARM.transmission.velocity(qd) @ tau_actuator == pytest.approx(qd @ tau_joint, rel=1e-12)
    a = ARM.transmission.position([0, 0.3, 0.2, 0.1, 0, 0, 0])
    np.testing.assert_allclose(a, [0, 0.3, 0.5, 0.6697 * 0.2 + 0.1, 0, 0, 0], atol=1e-12)


def test_left_and_right_share_the_mechanism_and_differ_in_limits():
    left, right = load_arm("MTML"), load_arm("mtmr")
    assert known_arms() == ["ecm", "ecm_si", "mtml", "mtmr", "psm", "psm_si"]
    np.testing.assert_allclose([left.position_lower[0], left.position_upper[0]], [-0.698132, 1.13446], atol=1e-9)
    np.testing.assert_allclose([right.position_lower[3], right.position_upper[3]], [-1.6580, 3.5779], atol=1e-9)
    np.testing.assert_allclose(
        left.effort_limits, [1.86083, 3.21662, 1.95978, 0.309013, 0.0968438, 0.0968438, 0.0228759], atol=1e-9
    )


def test_sampled_poses_respect_all_limits():
    samples = ARM.sample_poses(500, np.random.default_rng(0), margin=0.05)
    assert all(not ARM.limit_violations(q) for q in samples)
    assert np.abs(samples[:, 1] + samples[:, 2]).max() < 0.68
    assert ARM.limit_violations([0, 1.0, 0.5, 0, 0, 0, 0]) == ["parallelogram = 1.5 is outside -0.33..0.68"]


def test_sampling_fails_if_coupled_limit_is_rarely_met():
    import dataclasses

    lower = ARM.position_lower.copy()
    lower[1:3] = [0.6, 0.0799999]
    with pytest.raises(ArmError, match="almost no pose within the position limits"):
        dataclasses.replace(ARM, position_lower=lower).sample_poses(5, np.random.default_rng(0))


def test_sdf_friction_is_refused(tmp_path):
    from dvrk_drake.models.sdf_model import compose_sdf, read_sdf_facts

    path = tmp_path / "a.sdf"
    path.write_text(
        '<sdf version="1.9"><model name="a"><link name="base_link"/><joint name="j" type="revolute">'
        "<axis><xyz>0 0 1</xyz><dynamics><friction>1</friction></dynamics></axis></joint></model></sdf>"
    )
    with pytest.raises(ArmError, match="joint j of the SDF has <friction>, which Drake ignores"):
        read_sdf_facts(compose_sdf([str(path)]))


def test_keys_of_an_arm_file_replace_those_of_its_mechanism(tmp_path):
    path = tmp_path / "arm.yaml"
    path.write_text("name: X\nmechanism: mtm\nsdf: package://dvrk_drake/sdf/mtmr.sdf\neffort_cut_off: 7.0\n")
    arm, right = load_arm(path), load_arm("mtmr")
    assert (arm.identification.effort_cut_off, arm.sdf, arm.gains.kp) == (7.0, right.sdf, right.gains.kp)
    path.write_text("name: X\nmechanism: mtm\n")
    assert_refused(ArmError, r"arm\.yaml: sdf is missing; state the path of the model", load_arm, path)


def test_stops_of_a_plant_do_not_depend_on_the_recorded_zeros():
    arm = load_arm("mtmr")
    plants = [make_arm_plant(one) for one in (arm, arm.with_position_offsets({"outer_yaw": 0.3, "wrist_yaw": -0.2}))]
    for name in arm.joint_names:
        limits = [
            np.concatenate([joint.position_lower_limits(), joint.position_upper_limits()])
            for joint in (plant.GetJointByName(name) for plant in plants)
        ]
        np.testing.assert_allclose(limits[1], limits[0], atol=1e-12)


# Tests the inverse kinematics of a shaft through a remote centre: all solutions, within limits, for all wrists.


#: One arm for each kind of wrist: standard, of length 0, snake-like, none.
ARMS = ["psm", "psm_si", "psm_si+STAPLER_45_410298", "psm+NEEDLE_DRIVER_400117", "ecm"]


@pytest.mark.parametrize("name", ARMS)
def test_solutions_contain_the_pose_and_reach_it(name):
    arm, generator = load_arm(name), np.random.default_rng(1)
    frame = ArmFrame(arm)
    for q in arm.sample_poses(10, generator):
        X = frame.pose(q)
        poses = inverse_kinematics(arm, X, rest=q)
        np.testing.assert_allclose(poses[0], q, atol=1e-6)  # the nearest one
        for pose in poses:
            assert not arm.limit_violations(pose, 1e-12)
            np.testing.assert_allclose(frame.pose(pose).GetAsMatrix4(), X.GetAsMatrix4(), atol=1e-9)


@pytest.mark.parametrize("name", ARMS[:-1])
def test_another_method_finds_no_other_solution(name):
    arm, generator = load_arm(name), np.random.default_rng(2)
    frame, (q,) = ArmFrame(arm), arm.sample_poses(1, generator)
    poses = inverse_kinematics(arm, frame.pose(q), rest=q)
    for start in arm.sample_poses(10, generator):
        start[6:] = q[6:]
        if (other := frame.solve(frame.pose(q), start)) is not None:
            assert np.abs(poses - other).max(axis=1).min() < 1e-5, other


def test_turns_of_the_roll_are_separate_solutions():
    arm = load_arm("psm")
    q = np.array([0.2, 0.1, 0.1, 2.5, 0.3, 0.2, 0.4])
    poses = inverse_kinematics(arm, ArmFrame(arm).pose(q), rest=q)
    np.testing.assert_allclose(poses[:, 3], [2.5, 2.5 - 2 * np.pi], atol=1e-9)
    np.testing.assert_allclose(poses[:, 6], 0.4, atol=0)  # the jaw rests


def test_unreachable_poses_have_no_solution():
    arm = load_arm("psm")
    R = ArmFrame(arm).pose(np.zeros(7)).rotation()
    for p in ([0.0, 0.0, -1.0], [0.3, 0.3, 0.3], [0.0, 0.0, 0.0]):
        assert inverse_kinematics(arm, RigidTransform(R, p)).shape == (0, 7)


def test_arms_without_a_shaft_are_refused():
    with pytest.raises(ArmError, match="MTML: the arm has no shaft that yaw, pitch, insertion and roll move"):
        inverse_kinematics(load_arm("mtml"), RigidTransform())
    with pytest.raises(ArmError, match=r"rest has the shape \(3,\); allowed: \(7,\)"):
        inverse_kinematics(load_arm("psm"), RigidTransform([0.0, 0.0, -0.1]), rest=np.zeros(3))
