"""Periodic motions and their files, and the check of all limits of a motion."""

from dataclasses import replace

import numpy as np
import pytest
import yaml

from dvrk_drake.analysis.excitation.motion_limits import (
    MotionLimits,
    motion_violations,
    spectral_derivative,
    tip_positions,
)
from dvrk_drake.analysis.excitation.periodic_motion import FourierBasis, PeriodicMotion
from dvrk_drake.errors import DvrkDrakeError, ExcitationError
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.models.environment import Environment

pytestmark = pytest.mark.drake_api

LIMITS = MotionLimits()


def one_joint(arm, joint, amplitude, period=4.0):
    """Returns a motion of one joint about the middle of its range."""
    basis = FourierBasis.of(period, 3)
    center = arm.sample_poses(300, np.random.default_rng(0), 0.2).mean(axis=0)
    coefficients = np.column_stack([center, np.zeros((arm.num_joints, 4))])
    values = basis.values(np.linspace(0, period, 500))[0, :, 1]
    coefficients[joint, 1] = amplitude / np.abs(values).max()
    return PeriodicMotion.of_coefficients(arm, basis, coefficients, 1)


@pytest.fixture(params=["mtml", "psm"])
def arm(request):
    return load_arm(request.param)


def test_small_motion_has_no_violation(arm):
    assert motion_violations(one_joint(arm, 0, 0.05), arm, LIMITS) == []


def test_each_limit_is_checked(arm):
    """A limit just below the largest value of the motion gives one message, and a limit just above gives none."""
    motion = one_joint(arm, 1, 0.2)
    t = np.arange(4000) / 1000
    largest = [np.abs(x[:, 1]).max() for x in motion.evaluate(t)]
    width = arm.position_upper[1] - arm.position_lower[1]
    speed, acceleration, jerk = largest[1:]
    # The limits depend on each other, so each of them is made loose by a short time.
    loose = {"traverse_time": 0.1, "speed": (100.0, 100.0), "speed_time": 0.1, "acceleration_time": 0.001}
    for factor, expected in ((0.999, 1), (1.001, 0)):
        slow = loose | {"traverse_time": width / (speed * factor)}
        found = motion_violations(motion, arm, replace(LIMITS, effort=1.0, **slow))
        assert len(found) == expected and all(f"speed of {arm.joint_names[1]}" in line for line in found)
        gentle = loose | {"speed_time": width / 0.1 / (acceleration * factor)}
        found = motion_violations(motion, arm, replace(LIMITS, effort=1.0, **gentle))
        assert len(found) == expected and all("acceleration of" in line for line in found)
        smooth = loose | {"acceleration_time": width / 0.1 / 0.1 / (jerk * factor)}
        found = motion_violations(motion, arm, replace(LIMITS, effort=1.0, **smooth))
        assert len(found) == expected and all("jerk of" in line for line in found)


def test_position_limits_include_those_of_the_user(arm):
    motion, name = one_joint(arm, 1, 0.2), arm.joint_names[1]
    q = motion.evaluate(np.arange(4000) / 1000).q[:, 1]
    inside = replace(LIMITS, positions={name: (q.min() - 1e-9, q.max() + 1e-9)})
    assert motion_violations(motion, arm, inside) == []
    outside = replace(LIMITS, positions={name: (q.min() + 1e-6, q.max() + 1e-9)})
    (line,) = motion_violations(motion, arm, outside)
    assert line.startswith(f"position of {name} is {q.min():.6g}")


def test_tip_stays_in_its_box():
    arm = load_arm("psm")
    motion = one_joint(arm, 0, 0.3)
    p = tip_positions(arm, motion.evaluate(np.arange(4000) / 1000).q)
    lower, upper = p.min(axis=0) - 1e-6, p.max(axis=0) + 1e-6
    assert motion_violations(motion, arm, replace(LIMITS, tip_box=(tuple(lower), tuple(upper)))) == []
    upper[0] -= 1e-3
    (line,) = motion_violations(motion, arm, replace(LIMITS, tip_box=(tuple(lower), tuple(upper))))
    assert line.startswith("tip of x is")


def test_table_is_an_obstacle():
    arm = load_arm("psm")
    motion = one_joint(arm, 2, 0.05)
    lowest = tip_positions(arm, motion.evaluate(np.arange(4000) / 1000).q)[:, 2].min()
    assert motion_violations(motion, arm, replace(LIMITS, environment=Environment(lowest - 0.05))) == []
    (line,) = motion_violations(motion, arm, replace(LIMITS, environment=Environment(lowest + 0.01)))
    assert line.startswith("collision of ") and "the table at" in line


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"margin": 0.5}, "margin is 0.5; allowed: 0..0.4"),
        ({"traverse_time": 0.0}, "traverse_time is 0"),
        ({"positions": {"elbow": (0.0, 1.0)}}, 'unknown joint "elbow"'),
        ({"positions": {"yaw": (2.0, 3.0)}}, "yaw: no position is within 2..3; allowed: -1.4292..1.4292"),
        ({"positions": {"yaw": (0.5, 0.5)}}, "yaw: the lower limit 0.5 must be less than the upper limit 0.5"),
    ],
)
def test_wrong_limits_are_rejected(change, message):
    with pytest.raises(ExcitationError) as error:
        replace(LIMITS, **change).of_arm(load_arm("psm"))
    assert message in str(error.value)


def test_gain_too_small_for_the_wall_of_the_guard():
    arm = load_arm("psm")
    soft = replace(arm, gains=replace(arm.gains, kp=[arm.gains.kp[0] / 100, *arm.gains.kp[1:]]))
    with pytest.raises(ExcitationError, match=r"soft wall of the guard covers the whole range of yaw.* State gains"):
        LIMITS.of_arm(soft)
    assert LIMITS.of_arm(replace(soft, source="psm.urdf")).speed[0] == LIMITS.of_arm(arm).speed[0]


# Periodic motions that start and end at rest, and their files.


ARM = load_arm("psm")
PERIOD, HARMONICS = 4.0, 5


@pytest.fixture
def motion():
    coefficients = np.random.default_rng(0).normal(size=(ARM.num_joints, 2 * HARMONICS - 1))
    return PeriodicMotion.of_coefficients(ARM, FourierBasis.of(PERIOD, HARMONICS), coefficients, 2)


def test_functions_of_the_basis_are_independent_and_at_rest():
    basis = FourierBasis.of(PERIOD, HARMONICS)
    start = basis.values(np.array([0.0, PERIOD]))
    np.testing.assert_allclose(start[1:3], 0.0, atol=1e-11)  # velocities and accelerations
    values = basis.values(np.linspace(0, PERIOD, 50, endpoint=False))
    assert np.linalg.matrix_rank(values[0]) == values.shape[2] == 2 * HARMONICS - 1
    weights = np.vstack([basis.sines, basis.cosines])
    np.testing.assert_allclose(weights.T @ weights, np.eye(2 * HARMONICS - 2), atol=1e-12)


def test_derivatives_match_the_positions(motion):
    t = np.arange(1000) * PERIOD / 1000
    q, *derivatives = motion.evaluate(t)
    for order, found in enumerate(derivatives, start=1):
        expected = spectral_derivative(q, PERIOD, order)
        # At time 0, the jerk of the motion is 0, and the jerk of the periodic function is not.
        np.testing.assert_allclose(found[1:], expected[1:], atol=1e-9 * np.abs(expected).max())


def test_motion_repeats_and_is_at_rest_outside(motion):
    t = np.linspace(0.1, 3.9, 7)
    first, second = motion.evaluate(t), motion.evaluate(t + PERIOD)
    np.testing.assert_allclose(first.q, second.q, atol=1e-12)
    assert motion.duration == 2 * PERIOD
    outside = motion.evaluate([-1.0, 0.0, motion.duration, motion.duration + 5])
    np.testing.assert_allclose(outside.q, outside.q[:1] * np.ones((4, 1)), atol=1e-12)
    assert not np.any(outside.v) and not np.any(outside.vd)
    # There is no step of velocity or acceleration at the ends.
    near = motion.evaluate([1e-7, motion.duration - 1e-7])
    assert np.abs(near.v).max() < 1e-5 and np.abs(near.vd).max() < 1e-3


def test_file_contains_the_motion(motion, tmp_path):
    path = tmp_path / "motion.yaml"
    motion.save(path)
    assert PeriodicMotion.load(path, ARM) == motion
    with pytest.raises(DvrkDrakeError, match="exists"):
        motion.save(path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"arm": "MTML"}, 'arm is "MTML", but the selected arm is PSM'),
        ({"format": "dvrk_drake motion 2"}, 'format is "dvrk_drake motion 2"; allowed: "dvrk_drake motion 1"'),
        ({"format": "dvrk_drake poses 1", "poses": []}, 'format is "dvrk_drake poses 1"; allowed'),
        ({"period": 0}, "period"),
        ({"period": ...}, "period is missing"),
        ({"center": [0.0] * 6}, "must have 7 elements each"),
        ({"sine": [[0.1, 0.2]] * 7}, "the same number of coefficients"),
        ({"sine": [[0.1] * 5] * 7}, "does not begin at rest"),
        ({"colour": 1}, "colour"),
    ],
)
def test_wrong_files_are_rejected(motion, tmp_path, change, message):
    path = tmp_path / "motion.yaml"
    motion.save(path)
    content = yaml.safe_load(path.read_text()) | change
    path.write_text(yaml.safe_dump({key: value for key, value in content.items() if value is not ...}))
    with pytest.raises(ExcitationError) as error:
        PeriodicMotion.load(path, ARM)
    assert message in str(error.value) and str(path) in str(error.value)
