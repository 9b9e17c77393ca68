"""Follower of a command guard: start, following and end of each mode."""

import numpy as np
import pytest
from guard_bench import ARM, LIMIT, Inert, N, Q

from dvrk_drake.lcmtypes import lcmt_dvrk_command as Command
from dvrk_drake.lcmtypes import lcmt_dvrk_status as Status
from dvrk_drake.systems.guard.follower import Follower
from dvrk_drake.systems.guard.limits import GuardLimits
from dvrk_drake.systems.guard.settings import GuardSettings

LIMITS = GuardLimits(ARM, GuardSettings(following_time=0.1))
SAFE_GAINS = STIFFNESS, DAMPING = LIMITS.safe_gains(ARM, Inert())
E, STILL = np.eye(N), np.zeros(N)
RANGE = ARM.position_upper - ARM.position_lower


def at(q=Q):
    follower = Follower(LIMITS, SAFE_GAINS)
    follower.target = q.copy()
    return follower


def test_off_and_hold_output_zero_velocity_and_effort():
    follower = at()
    for output, mode, position in ((follower.off(Q + 1), Command.OFF, Q + 1), (follower.hold(1e-3), Command.HOLD, Q)):
        assert output.control_mode == mode
        np.testing.assert_array_equal(output.position, position)
        for zero in (output.velocity, output.effort, output.joint_flags):
            np.testing.assert_array_equal(zero, STILL)
            zero[:] = 1
        output.position[:] = 9.0
    np.testing.assert_array_equal(follower.hold(1e-3).position, Q)
    np.testing.assert_array_equal(follower.hold(1e-3).velocity, STILL)
    np.testing.assert_array_equal(follower.hold(1e-3).effort, STILL)
    assert np.all(Follower(LIMITS, SAFE_GAINS).hold(1e-3).position == 0.0)


@pytest.mark.parametrize("joint", range(N))
@pytest.mark.parametrize("side", [-1, 1])
def test_is_near_uses_start_tolerance_of_every_joint(joint, side):
    away = side * LIMITS.start_position[joint] * E[joint]
    assert at().is_near(Q + 0.999 * away)
    assert not at().is_near(Q + 1.001 * away)


def test_is_near_includes_the_exact_tolerance():
    follower = at(STILL)
    follower.begin_position()
    assert follower.is_near(LIMITS.start_position)
    assert follower.following_fault(LIMITS.following_error) == ""


# Positions


def test_target_follows_command_at_limited_rate():
    follower = at()
    follower.begin_position()
    goal = Q + 0.02
    for k in range(1, 4):
        output = follower.follow_position(goal, STILL, 1e-3)
        expected = np.minimum(k * 1e-3 * LIMITS.speed, 0.02)
        np.testing.assert_allclose(output.position - Q, expected, atol=1e-12)
        np.testing.assert_array_equal(follower.target, output.position)
        np.testing.assert_array_equal(output.joint_flags != 0, expected < 0.02)
    assert output.control_mode == Command.POSITION
    np.testing.assert_array_equal(output.effort, STILL)
    output = follower.follow_position(goal, 0.01 * LIMITS.speed, 1.0)
    np.testing.assert_allclose(output.position, goal, atol=1e-12)
    np.testing.assert_allclose(output.velocity, 0.01 * LIMITS.speed, atol=1e-12)
    # A change of the output does not change the target.
    output.position[:] = 9.0
    np.testing.assert_allclose(follower.hold(1e-3).position, goal, atol=1e-12)


@pytest.mark.parametrize("joint", range(N))
@pytest.mark.parametrize("side", [-1, 1])
def test_large_following_error_is_detected(joint, side):
    follower = at()
    follower.begin_position()
    away = side * 0.15 * RANGE[joint] * E[joint]
    assert follower.following_fault(Q + 0.999 * away) == ""
    text = follower.following_fault(Q + 1.001 * away)
    assert text.startswith(f"{ARM.joint_names[joint]} is at ")
    assert text.endswith(f"(allowed difference {0.15 * RANGE[joint]:.3g} rad)")
    # The joint with the largest error is reported.
    other = (joint + 1) % N
    assert follower.following_fault(Q + 1.1 * away + 0.5 * RANGE[other] * E[other]).startswith(ARM.joint_names[other])


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


def test_fault_gives_invalid_joints_gravity_effort():
    valid = np.arange(N) != 3
    output = at().hold_valid_joints(Q - 9.0, STILL + 9.0, valid, 0.1 * LIMIT, 1.0)
    assert output.effort[3] == pytest.approx(0.1 * LIMIT[3])
    np.testing.assert_array_equal(output.joint_flags, np.where(valid, 0, Status.FLAG_IMPLAUSIBLE))


@pytest.mark.parametrize("side", [-1, 1])
def test_safe_state_starts_from_present_effort_at_limited_rate(side):
    follower, step = at(), LIMIT * 1e-3 / GuardSettings().effort_rise_time
    follower.begin_safe_state(9.0 * side * LIMIT)
    for k in (1, 2):
        output = follower.hold_valid_joints(Q, STILL, np.ones(N, bool), STILL, 1e-3)
        np.testing.assert_allclose(output.effort, side * (LIMIT - k * step), atol=1e-12)
        output.effort[:] = 9.0


# Efforts


def test_efforts_start_at_measured_ones_at_limited_rate():
    follower, measured = at(), LIMIT * [0.3, -0.3, 0.0, 1.2, -1.2, 0.1, 0.0]
    follower.begin_effort(measured, Q)
    start = np.clip(measured, -LIMIT, LIMIT)
    np.testing.assert_allclose(follower.follow_effort(start, Q, STILL, 1e-3, 0.0).effort, start, atol=1e-12)
    output = follower.follow_effort(start - 0.1 * LIMIT, Q, STILL, 1e-3, 0.5)
    np.testing.assert_allclose(output.effort, np.maximum(start - 0.05 * LIMIT, -LIMIT), atol=1e-12)
    output = follower.follow_effort(start - 0.1 * LIMIT, Q, STILL, 1e-3, 1.0)
    np.testing.assert_allclose(output.effort, np.maximum(start - 0.1 * LIMIT, -LIMIT), atol=1e-12)
    assert output.control_mode == Command.EFFORT
    np.testing.assert_array_equal(output.position, Q)
    np.testing.assert_array_equal(output.velocity, STILL)


def test_effort_start_is_clamped_to_effort_fraction():
    follower = Follower(GuardLimits(ARM, GuardSettings(effort_fraction=0.2)), SAFE_GAINS)
    follower.begin_effort(0.25 * LIMIT, Q)
    np.testing.assert_allclose(follower.follow_effort(LIMIT, Q, STILL, 1e-3, 0.0).effort, 0.2 * LIMIT, atol=1e-12)
    follower.begin_effort(-0.25 * LIMIT, Q)
    np.testing.assert_allclose(follower.follow_effort(-LIMIT, Q, STILL, 1e-3, 0.0).effort, -0.2 * LIMIT, atol=1e-12)


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


def test_flags_of_commands_and_walls_are_combined():
    q = Q.copy()
    q[0] = ARM.position_upper[0]
    follower = at(q)
    follower.begin_effort(STILL, q)
    flags = follower.follow_effort(2 * LIMIT * E[0], q, STILL, 1e-3, 1.0).joint_flags
    assert flags[0] == Status.FLAG_EFFORT_CLAMPED | Status.FLAG_RATE_LIMITED | Status.FLAG_POSITION_LIMIT
    assert not np.any(flags[1:])
