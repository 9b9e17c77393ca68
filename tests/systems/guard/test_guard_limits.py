"""Limits of effort, rate and position that the guard enforces."""

import numpy as np
import pytest
from guard_bench import ARM, LIMIT, Bench, N, Q

from dvrk_drake.lcmtypes import lcmt_dvrk_command as Command
from dvrk_drake.lcmtypes import lcmt_dvrk_status as Status
from dvrk_drake.models.arm_files import load_arm


def test_efforts_are_clamped_and_limited_in_rate():
    bench = Bench().started()
    np.testing.assert_allclose(bench.output.effort, 0.05 * LIMIT, atol=1e-12)
    for k in range(1, 30):
        output = bench.run(Command.EFFORT, 1, effort=list(10 * LIMIT))
        np.testing.assert_allclose(output.effort, np.minimum(0.05 + 0.05 * k, 1.0) * LIMIT, rtol=0, atol=1e-12)
        assert np.all(output.joint_flags & Status.FLAG_EFFORT_CLAMPED)
        assert k == 19 or np.all((output.joint_flags & Status.FLAG_RATE_LIMITED != 0) == (k < 19))  # 19: by rounding


@pytest.mark.parametrize("row", range(N + 1))
@pytest.mark.parametrize("side", [-1, 1])
def test_soft_wall_reverses_outward_effort(row, side):
    bench = Bench()
    limits = bench.guard.limits
    a, bound = limits.A[row], (limits.lower if side < 0 else limits.upper)[row]
    joints = np.flatnonzero(a)
    command = np.where(a != 0, side * np.sign(a) * LIMIT, 0.0)

    def settled(depth, rate=0.0):
        """Returns effort and flags at `depth`, as a share of the width of the wall."""
        q = Q.copy()
        # The sum of joints 2 and 3 stays in the middle of its range, unless its limit is tested.
        q[1:3] = {
            (1, 1): (0.0, -0.6),
            (1, -1): (0.0, 0.3),
            (2, 1): (-0.1, 0.0),
            (2, -1): (1.0, 0.0),
            (7, -1): (0.0, -0.6),
        }.get((row, side), (0.2, 0.0))
        q[joints[0]] += (bound - side * (1 - depth) * limits.wall_width[row] - a @ q) / a[joints[0]]
        return limits.restrain_effort(command, q, rate * side * a)

    effort, flags = settled(-0.01)
    np.testing.assert_allclose(effort, command, atol=1e-12)
    assert not np.any(flags[joints] & (Status.FLAG_POSITION_LIMIT | Status.FLAG_COUPLED_LIMIT))
    effort, flags = settled(0.25)
    assert np.all(effort[joints] * command[joints] < LIMIT[joints] ** 2)
    assert np.all(flags[joints] == (Status.FLAG_COUPLED_LIMIT if row >= N else Status.FLAG_POSITION_LIMIT))
    effort, _ = settled(0.5)
    assert np.all(effort[joints] * np.sign(command[joints]) <= 1e-12)  # no outward effort remains
    effort, _ = settled(1.0)
    np.testing.assert_allclose(effort, -command, atol=1e-12)
    # The joint is one width before the wall, but reaches it within Kd/Kp at this speed.
    seconds = max(np.divide(ARM.gains.kd, ARM.gains.kp)[joints])
    effort, _ = settled(-1.0, 2 * limits.wall_width[row] / (seconds * (a @ a)))
    np.testing.assert_allclose(effort, -command, atol=1e-12)
    # The wall exerts no effort on a joint that moves out of it.
    effort, _ = settled(0.5, -0.6 * limits.wall_width[row] / (seconds * (a @ a)))
    np.testing.assert_allclose(effort, command, atol=1e-12)


def test_positions_are_limited_in_rate_and_range():
    bench = Bench().started(Command.POSITION)
    bench.follows = True
    limits = bench.guard.limits
    A, lower, upper = ARM.limit_matrix()
    last = bench.output.position
    np.testing.assert_array_equal(last, Q)
    for sign in (1, -1):
        for _ in range(1500):
            output = bench.run(Command.POSITION, 1, position=list(Q + sign * 100.0))
            assert np.all(np.abs(output.position - last) <= limits.speed * 1e-3 * (1 + 1e-9))
            assert np.all((A @ output.position <= upper + 1e-9) & (A @ output.position >= lower - 1e-9))
            last = output.position
        free = [0, 3, 4, 5, 6]
        np.testing.assert_allclose(last[free], (upper if sign > 0 else lower)[:N][free], atol=1e-12)
        assert last[1] + last[2] == pytest.approx((upper if sign > 0 else lower)[N])
        assert not np.any(output.velocity)


def test_hold_after_position_keeps_near_target():
    bench = Bench().started(Command.POSITION)
    bench.q = Q - 0.01  # the arm sags
    bench.tick()
    np.testing.assert_array_equal(bench.run(Command.HOLD, 1).position, Q)
    bench = Bench().started(Command.POSITION)
    bench.q = Q - 0.2  # the arm is pushed away
    bench.tick()
    np.testing.assert_array_equal(bench.run(Command.HOLD, 1).position, Q - 0.2)


@pytest.mark.parametrize("name", ["mtmr", "psm"])
def test_limits_of_other_arms(name):
    arm = load_arm(name)
    bench = Bench(arm)
    bench.started(Command.EFFORT)
    output = bench.run(Command.EFFORT, 50, effort=list(100 * arm.effort_limits))
    np.testing.assert_allclose(output.effort, arm.effort_limits, atol=1e-12)
