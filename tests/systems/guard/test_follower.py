"""Follower of a command guard: start, following and end of each mode."""

import numpy as np
import pytest
from guard_bench import ARM, LIMIT, Inert, N, Q

from dvrk_drake.lcmtypes import lcmt_dvrk_command as Command
from dvrk_drake.lcmtypes import lcmt_dvrk_status as Status
from dvrk_drake.systems.guard.limits import Follower, GuardLimits
from dvrk_drake.systems.guard.settings import GuardSettings

LIMITS = GuardLimits(ARM, GuardSettings(following_time=0.1))
SAFE_GAINS = STIFFNESS, DAMPING = LIMITS.safe_gains(ARM, Inert())
E, STILL = np.eye(N), np.zeros(N)
RANGE = ARM.position_upper - ARM.position_lower


def at(q=Q):
    follower = Follower(LIMITS, SAFE_GAINS)
    follower.target = q.copy()
    return follower


# Positions


@pytest.mark.parametrize("side", [-1, 1])
def test_lag_up_to_following_time_is_allowed(side):
    """The arm may be between the target and its first-order lag, plus the following error."""
    follower, joint = at(), 4
    follower.begin_position()
    late, dt, error = Q[joint], 1e-3, 0.15 * RANGE[joint]
    for _ in range(100):
        target = follower.follow_position(Q + side * 9.0 * E[joint], STILL, dt).position[joint]
        late += dt / 0.1 * (target - late)
    assert side * (target - late) > 0.5 * error

    def fault_at(position):
        return follower.following_fault(Q + (position - Q[joint]) * E[joint])

    assert fault_at(late - side * 0.999 * error) == fault_at(target + side * 0.999 * error) == fault_at(late) == ""
    assert fault_at(late - side * 1.001 * error) and fault_at(target + side * 1.001 * error)
    # After a step longer than the following time, the filtered target equals the target.
    target = follower.follow_position(Q + side * 9.0 * E[joint], STILL, 0.2).position[joint]
    assert fault_at(target - side * 0.999 * error) == ""
    assert fault_at(target - side * 1.001 * error) and fault_at(target + side * 1.001 * error)


def test_position_start_resets_the_lag():
    follower = at()
    follower.begin_position()
    for _ in range(100):
        follower.follow_position(Q + 9.0 * E[4], STILL, 1e-3)
    target = follower.target
    assert follower.following_fault(target - 1.2 * 0.15 * RANGE[4] * E[4]) == ""
    follower.begin_position()
    assert follower.following_fault(target - 1.01 * 0.15 * RANGE[4] * E[4])
    np.testing.assert_array_equal(follower.target, target)


# A hold


@pytest.mark.parametrize("joint", range(N))
@pytest.mark.parametrize("side", [-1, 1])
@pytest.mark.parametrize("share", [0.3, 1.0, 9.0])
def test_braking_distance_is_allowed_after_latch(joint, side, share):
    error, way = LIMITS.following_error[joint], side * min(share, 1.0) * 0.1 * LIMITS.speed[joint]
    follower, q = at(STILL), Q.copy()
    follower.latch(q, side * share * LIMITS.speed * E[joint])
    q[:] = 9.0
    np.testing.assert_array_equal(follower.target, Q)

    def fault_at(away):
        return bool(follower.following_fault(Q + away * E[joint]))

    assert not fault_at(way + 0.999 * side * error) and fault_at(way + 1.001 * side * error)
    assert not fault_at(-0.999 * side * error) and fault_at(-1.001 * side * error)
    for _ in range(20):
        np.testing.assert_array_equal(follower.hold(0.05).position, Q)
    assert not fault_at(0.999 * side * error) and fault_at(1.001 * side * error)


@pytest.mark.parametrize("side", [-1, 1])
def test_fault_holds_valid_joints_with_bounded_effort(side):
    """The bound is `fault_effort`, or the gravity effort plus a third of it, and the motor's limit."""
    bound, valid = LIMITS.fault_effort, np.ones(N, bool)
    for gravity, most in ((STILL, bound), (0.5 * LIMIT, 0.5 * LIMIT + bound / 3), (0.95 * LIMIT, LIMIT)):
        for away, expected in ((9.0, side * most), (-9.0, -side * bound)):
            output = at().hold_valid_joints(Q - side * 10 * away, STILL, valid, side * gravity, 1.0)
            np.testing.assert_allclose(output.effort, expected, atol=1e-12)
    assert output.control_mode == Command.EFFORT
    # Below the bounds, the efforts follow from the gains of the arm.
    gravity, v = 0.02 * side * LIMIT, side * 0.01 * LIMITS.fault_effort / DAMPING
    q = Q - 0.02 * side * LIMITS.fault_effort / STIFFNESS
    output = at().hold_valid_joints(q, v, valid, gravity, 1.0)
    np.testing.assert_allclose(output.effort, gravity + 0.01 * side * LIMITS.fault_effort, atol=1e-12)
    np.testing.assert_array_equal(output.joint_flags, 0)
    np.testing.assert_array_equal(output.position, q)


# Efforts


@pytest.mark.parametrize("side", [-1, 1])
def test_start_inside_wall_increases_wall_gradually(side):
    q = Q.copy()
    q[0] = (ARM.position_upper if side > 0 else ARM.position_lower)[0]
    push = side * 0.25 * LIMIT * E[0]
    wall = LIMITS.wall_effort(q, STILL)[0]
    assert wall[0] == pytest.approx(-side * 2 * LIMIT[0])  # twice the motor effort, inward
    follower = at(q)
    follower.begin_effort(push, q)
    for share in (0.0, 0.25, 0.5, 1.0):
        output = follower.follow_effort(push, q, STILL, 1e-3, share)
        np.testing.assert_allclose(output.effort, np.clip(push + share * wall, -LIMIT, LIMIT), atol=1e-12)
        assert output.joint_flags[0] == Status.FLAG_POSITION_LIMIT
    # The subtracted effort does not push the arm outward after it has left the wall.
    inside = follower.follow_effort(side * LIMIT * E[0], Q, STILL, 1.0, 0.0)
    np.testing.assert_allclose(inside.effort, side * LIMIT * E[0], atol=1e-12)


@pytest.mark.parametrize("side", [-1, 1])
def test_start_inside_wall_never_pulls_outward(side):
    """The subtracted effort is at most the present effort of the wall, also outside the wall or while braking."""
    q = Q.copy()
    q[0] = (ARM.position_upper if side > 0 else ARM.position_lower)[0]
    follower = at(q)
    follower.begin_effort(STILL, q)
    np.testing.assert_array_equal(follower.follow_effort(STILL, Q, STILL, 1e-3, 0.0).effort, STILL)
    fast = 1.2 * side * LIMITS.speed[0] * E[0]
    brake = LIMITS.restrain_effort(STILL, Q, fast)[0]
    assert side * brake[0] < 0
    np.testing.assert_array_equal(follower.follow_effort(STILL, Q, fast, 1e-3, 0.0).effort, brake)
