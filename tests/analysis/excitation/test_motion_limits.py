"""The check of a motion finds every exceeded limit, and uses Drake's dynamics and geometry."""

from dataclasses import replace

import numpy as np
import pytest

from dvrk_drake.analysis.excitation.motion_limits import (
    MotionLimits,
    first_collision,
    motion_violations,
    tip_positions,
)
from dvrk_drake.analysis.excitation.periodic_motion import FourierBasis, PeriodicMotion
from dvrk_drake.errors import ExcitationError
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


def test_coupled_limit_is_checked():
    arm = load_arm("mtml")
    (coupled,) = arm.coupled_limits
    motion = one_joint(arm, 1, 0.7)
    center = np.array(motion.center)
    center[1:3] = [0.4, 0.3]
    lines = motion_violations(replace(motion, center=center.tolist()), arm, LIMITS)
    assert any(f"position of {coupled.name}" in line for line in lines)


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


def test_first_collision_is_found():
    arm = load_arm("psm")
    q = np.tile(arm.sample_poses(1, np.random.default_rng(0)), (5, 1))
    q[:, 2] = [0.05, 0.1, 0.15, 0.2, 0.24]
    heights = tip_positions(arm, q)[:, 2]
    assert np.all(np.diff(heights) < 0)
    row, what = first_collision(arm, q, Environment(float(heights[3] + heights[2]) / 2))
    assert row <= 3 and "the table" in what
    assert first_collision(arm, q) is None


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
