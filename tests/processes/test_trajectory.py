"""Trajectories between poses, and detection of rest."""

import itertools

import numpy as np
import pytest
from sticky_arm import random_poses

from dvrk_drake.models.approach import offset_pose
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.processes.teacher import RestDetector
from dvrk_drake.systems.cubic_trajectory import CubicTrajectory

ARMS = ("mtml", "psm")


@pytest.mark.parametrize("name", ARMS)
def test_trajectory_respects_speed_and_position_limits(name):
    arm = load_arm(name)
    speed = (arm.position_upper - arm.position_lower) / 5.0
    poses = random_poses(arm, 20, margin=0.0)
    for start, end in itertools.pairwise(poses):
        trajectory = CubicTrajectory.rest_to_rest(start, end, speed)
        states = np.array([trajectory.state(t) for t in np.linspace(-1.0, trajectory.duration + 1.0, 400)])
        q, v = np.split(states, 2, axis=1)
        assert np.all(np.abs(v) <= speed * (1 + 1e-9))
        if trajectory.duration > 0.3:  # the speed limit is used
            assert np.max(np.abs(v) / speed) > 0.99
        assert not any(arm.limit_violations(pose, 1e-9) for pose in q)
        np.testing.assert_allclose(q[0], start, atol=1e-12)
        np.testing.assert_allclose(q[-1], end, atol=1e-12)
        assert np.abs(v[[0, -1]]).max() < 1e-12


def test_braking_stays_on_the_path():
    """After a stop at any time, the arm comes to rest between both ends of the trajectory, with decreasing speed."""
    arm = load_arm("mtml")
    start, end = random_poses(arm, 2)
    trajectory = CubicTrajectory.rest_to_rest(start, end, np.full(7, 0.5))
    for t in np.linspace(0, trajectory.duration, 50):
        duration = min(0.3, max(trajectory.duration - t, 1e-3))
        stop = CubicTrajectory.braking(trajectory.state(t), duration)
        states = np.array([stop.state(s) for s in np.linspace(0, duration, 20)])
        share = (states[:, :7] - start) / (end - start)
        assert np.all((share >= -1e-9) & (share <= 1 + 1e-9))
        assert np.all(np.diff(np.abs(states[:, 7:]), axis=0) <= 1e-9)
        np.testing.assert_allclose(states[0], trajectory.state(t), atol=1e-12)
        assert np.abs(states[-1, 7:]).max() < 1e-12


@pytest.mark.parametrize("name", ARMS)
def test_approaches_start_inside_limits(name):
    arm = load_arm(name)
    offset = 0.3 * arm.effort_limits / np.array(arm.gains.kp)
    for pose in random_poses(arm, 200, margin=0.0):
        for side in (-1, 1):
            point = offset_pose(arm, pose, side * offset)
            assert not arm.limit_violations(point, 1e-9)
            assert np.all(side * (point - pose) >= 0)
    middle = random_poses(arm, 1, margin=0.3)[0]
    np.testing.assert_allclose(offset_pose(arm, middle, offset), middle + offset, atol=1e-12)


def test_rest_requires_all_joints_near_one_pose():
    detector = RestDetector(np.array([0.01, 0.001]), 0.5)
    times = np.arange(0, 3, 0.01)
    q = np.column_stack([np.where(times < 1.0, times, 1.0), np.where(times < 1.8, 0.0, 0.1)])
    q += 1e-4 * np.sin(50 * times)[:, None]
    at_rest = np.array([detector.is_at_rest(t, pose) for t, pose in zip(times, q, strict=True)])
    expected = ((times > 1.5) & (times < 1.795)) | (times > 2.3)
    assert np.count_nonzero(at_rest != expected) <= 4
    assert not detector.is_at_rest(9.0, np.array([np.nan, 0.1]))
    creeping = RestDetector(np.array([0.01]), 0.5)
    assert not any(creeping.is_at_rest(t, np.array([0.03 * t])) for t in times)
