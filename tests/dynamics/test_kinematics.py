"""Pose, velocity and inverse kinematics of the hand frame, against Drake and known positions."""

import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from robot_file import write_robot

from dvrk_drake.dynamics.kinematics import ArmFrame
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.models.plant import make_arm_plant, set_arm_positions

pytestmark = [pytest.mark.numeric, pytest.mark.drake_api]

ARMS = ("mtml", "mtmr", "psm")


def dh(theta, a, alpha, d, modified):
    """Returns the transform of one row of a DH table, standard or modified (Craig)."""
    x = RigidTransform(RotationMatrix.MakeXRotation(alpha), [a, 0, 0])
    z = RigidTransform(RotationMatrix.MakeZRotation(theta), [0, 0, d])
    return x @ z if modified else z @ x


HALF = np.pi / 2
#: Rows of the dVRK's DH tables: joint type, a [m], alpha, d [m], offset.
TABLES = {
    "mtml": [
        ("r", 0, HALF, 0, -HALF),
        ("r", 0.2794, 0, 0, -HALF),
        ("r", 0.3645, -HALF, 0, HALF),
        ("r", 0, HALF, 0.1506, 0),
        ("r", 0, -HALF, 0, 0),
        ("r", 0, HALF, 0, -HALF),
        ("r", 0, 0, 0, HALF),
    ],
    "psm": [
        ("r", 0, HALF, 0, HALF),
        ("r", 0, -HALF, 0, -HALF),
        ("p", 0, HALF, -0.4318, 0),
        ("r", 0, 0, 0.4162, 0),
        ("r", 0, -HALF, 0, -HALF),
        ("r", 0.0091, -HALF, 0, -HALF),
    ],
}


#: Pose of the tool frame in the last frame of the table: `tooltip_offset` of LARGE_NEEDLE_DRIVER_400006.json for a PSM.
TOOL = {"psm": RigidTransform(RotationMatrix(np.array([[0.0, -1, 0], [0, 0, 1], [-1, 0, 0]])), [0, 0, 0])}


@pytest.mark.parametrize("name", TABLES)
def test_pose_is_the_product_of_the_dh_table(name):
    arm = load_arm(name)
    kinematics = ArmFrame(arm)
    for q in arm.sample_poses(20, np.random.default_rng(0)):
        X = RigidTransform()
        tool = TOOL.get(name, RigidTransform())
        for value, (kind, a, alpha, d, offset) in zip(q, TABLES[name], strict=False):
            turn, slide = (value, 0.0) if kind == "r" else (0.0, value)
            X = X @ dh(offset + turn, a, alpha, d + slide, modified=name == "psm")
        np.testing.assert_allclose(kinematics.pose(q).GetAsMatrix4(), (X @ tool).GetAsMatrix4(), rtol=0, atol=1e-12)


@pytest.mark.parametrize("name", ARMS)
def test_pose_is_that_of_drake_and_velocity_is_its_derivative(name):
    arm, generator = load_arm(name), np.random.default_rng(0)
    kinematics, plant = ArmFrame(arm), make_arm_plant(arm)
    context, frame = plant.CreateDefaultContext(), plant.GetFrameByName("dh_6" if name == "psm" else "dh_7")
    for q in arm.sample_poses(20, generator):
        set_arm_positions(plant, context, arm, q)
        X = frame.CalcPoseInWorld(context) @ TOOL.get(name, RigidTransform())
        np.testing.assert_allclose(kinematics.pose(q).GetAsMatrix4(), X.GetAsMatrix4(), rtol=0, atol=1e-12)
        v, h = generator.normal(size=7), 1e-6
        ahead, behind = kinematics.pose(q + h * v), kinematics.pose(q - h * v)
        rotation = ahead.rotation().multiply(behind.rotation().inverse()).ToAngleAxis()
        V = np.concatenate([rotation.angle() * rotation.axis(), ahead.translation() - behind.translation()]) / (2 * h)
        np.testing.assert_allclose(kinematics.jacobian(q) @ v, V, rtol=0, atol=1e-7)


@pytest.mark.parametrize("name", ARMS)
def test_inverse_finds_near_poses_within_the_limits(name):
    arm, generator = load_arm(name), np.random.default_rng(2)
    kinematics = ArmFrame(arm)
    lower, upper = arm.position_lower.copy(), arm.position_upper
    if name == "psm":
        lower[2] = 0.03  # at the remote centre of motion, yaw and pitch are not determined
    for q in generator.uniform(lower, upper, (100, 7)):
        goal = np.clip(q + 0.1 * generator.uniform(lower - upper, upper - lower), lower, upper)
        X = kinematics.pose(goal)
        found = kinematics.solve(X, q)
        assert found is not None and np.all((found >= arm.position_lower) & (found <= upper))
        np.testing.assert_allclose(kinematics.pose(found).GetAsMatrix4(), X.GetAsMatrix4(), rtol=0, atol=2e-7)
        same = kinematics.solve(kinematics.pose(q), q)
        np.testing.assert_allclose(same, q, rtol=0, atol=1e-6)


@pytest.mark.parametrize("name", ARMS)
def test_unreachable_poses_are_refused(name):
    arm = load_arm(name)
    kinematics, q = ArmFrame(arm), np.clip(0.1, arm.position_lower, arm.position_upper)
    R = kinematics.pose(q).rotation()
    for far in ([1.0, 1.0, 1.0], [0.0, 0.0, 1e5]):
        assert kinematics.solve(RigidTransform(R, far), q) is None


def test_joints_at_their_limits_cause_no_singular_equations():
    X = RigidTransform(RollPitchYaw(2.123, -0.157, 1.893), [-0.039, 0.231, 0.053])
    assert ArmFrame(load_arm("psm")).solve(X, [0.145, -0.794, 0.085, 1.623, -1.101, 1.266, 1.265]) is None


def test_hand_frame_of_a_urdf_is_its_last_link_or_stated(tmp_path):
    arm = load_arm(write_robot(tmp_path))
    (tmp_path / "crane.yaml").write_text("sdf: crane.urdf\nframes: {hand: tip}\n")
    q = np.array([0.2, 0.1, 0.3])
    X_BH, X_BT = ArmFrame(arm).pose(q), ArmFrame(load_arm(tmp_path / "crane.yaml")).pose(q)
    assert arm.frames.hand == "hand"
    np.testing.assert_allclose((X_BH.inverse() @ X_BT).translation(), [0.1, 0, 0], atol=1e-12)
