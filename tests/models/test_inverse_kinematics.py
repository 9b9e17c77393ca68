"""Tests the inverse kinematics of a shaft through a remote centre: all solutions, within limits, for all wrists."""

import numpy as np
import pytest
from pydrake.math import RigidTransform

from dvrk_drake.dynamics.kinematics import ArmFrame
from dvrk_drake.errors import ArmError
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.models.inverse_kinematics import inverse_kinematics

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
