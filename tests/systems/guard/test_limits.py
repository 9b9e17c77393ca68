"""Limits that the guard enforces: clamping, start of walls and brakes, passivity, and safe state."""

import dataclasses

import numpy as np
import pytest
from guard_bench import ARM, LIMIT, Bench, N, Q

from dvrk_drake.dynamics.identified_model import ControlModel, IdentifiedModel
from dvrk_drake.lcmtypes import lcmt_dvrk_command as Command
from dvrk_drake.lcmtypes import lcmt_dvrk_status as Status
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.models.arm_schema import CoupledLimit
from dvrk_drake.systems.guard.limits import SAFE_DELAY, Follower, GuardLimits
from dvrk_drake.systems.guard.settings import GuardSettings

A, LOWER, UPPER = ARM.limit_matrix()
WIDTH = UPPER - LOWER
KP, KD = np.array(ARM.gains.kp), np.array(ARM.gains.kd)
LIMITS = GuardLimits(ARM, GuardSettings())
E = np.eye(N)
FREE, HALF = np.zeros(N), 0.5 * LIMIT


def flagged(flags):
    """Returns the joints that have a flag, and the flags."""
    return list(np.flatnonzero(flags)), set(int(flag) for flag in flags if flag)


def test_limits_follow_from_the_arm_and_the_settings():
    settings = GuardSettings(
        start_effort=0.2,
        margin=0.02,
        margin_fraction=0.01,
        effort_fraction=0.6,
        effort_rise_time=0.1,
        traverse_time=2.0,
        following_error=0.3,
        following_time=0.4,
    )
    limits = GuardLimits(ARM, settings)
    np.testing.assert_allclose(limits.effort_limits, LIMIT, atol=1e-12)
    np.testing.assert_allclose(limits.command_limits, 0.6 * LIMIT, atol=1e-12)
    np.testing.assert_allclose(limits.start_effort, 0.2 * LIMIT, atol=1e-12)
    np.testing.assert_allclose(limits.margin, np.minimum(0.02, 0.01 * WIDTH), atol=1e-12)
    np.testing.assert_allclose(limits.start_position, limits.margin[:N], atol=1e-12)
    np.testing.assert_allclose(limits.speed, WIDTH[:N] / 2.0, atol=1e-12)
    np.testing.assert_allclose(limits.following_error, 0.3 * WIDTH[:N], atol=1e-12)
    assert limits.following_time == 0.4
    effort, _ = limits.follow_effort(LIMIT, FREE, 0.01)
    np.testing.assert_allclose(effort, 0.1 * LIMIT, atol=1e-12)
    assert limits.names == [*ARM.joint_names, "parallelogram"]


# Poses beyond the limits


@pytest.mark.parametrize("row", range(N + 1))
@pytest.mark.parametrize("side", [-1, 1])
def test_position_limit_fault_starts_at_half_of_the_margin(row, side):
    joint = int(np.flatnonzero(A[row])[0])
    bound = (LOWER if side < 0 else UPPER)[row]
    q = Q.copy()
    # The sum of shoulder and elbow has its own limits and stays inside unless they are tested.
    elsewhere = {(1, 1): -0.6, (1, -1): 0.3, (2, 1): -0.1, (2, -1): 1.0, (N, -1): -0.6, (N, 1): 0.2}
    if (row, side) in elsewhere:
        q[1 if row == 2 else 2] = elsewhere[row, side]

    def at(share):
        pose = q.copy()
        pose[joint] += bound + side * share * LIMITS.margin[row] - A[row] @ q
        return LIMITS.position_limit_fault(pose)

    assert at(-0.5) == at(0.0) == at(0.499) == ""
    assert at(0.501).startswith(f"{LIMITS.names[row]} is at ")
    assert at(0.501).endswith(f", outside its limits {LOWER[row]:.4g}..{UPPER[row]:.4g} rad")


def test_position_limit_fault_names_the_worst_limit():
    q = Q.copy()
    q[4], q[6] = UPPER[4] + 0.6 * LIMITS.margin[4], LOWER[6] - 0.7 * LIMITS.margin[6]
    assert LIMITS.position_limit_fault(q).startswith("wrist_roll is at ")
    q[4] += 0.2 * LIMITS.margin[4]
    assert LIMITS.position_limit_fault(q).startswith("wrist_pitch is at ")


@pytest.mark.parametrize("row", range(N + 1))
@pytest.mark.parametrize("side", [-1, 1])
def test_implausible_pose_starts_at_half_of_the_range(row, side):
    joint = int(np.flatnonzero(A[row])[0])
    middle, width = (LOWER + UPPER) / 2, UPPER - LOWER

    def at(share):
        pose = Q.copy()
        pose[joint] += middle[row] + side * (0.5 + share) * width[row] - A[row] @ Q
        if row in (1, 2):  # the other joint keeps the sum of shoulder and elbow inside
            pose[3 - row] = np.clip(middle[N] - pose[row], LOWER[3 - row], UPPER[3 - row])
        return LIMITS.implausible_pose(pose)

    assert at(-0.5) == at(0.0) == at(0.499) == ""
    assert at(0.501).startswith(f"{LIMITS.names[row]} is at ")
    assert at(0.501).endswith("; check its unit (degrees?) and its zero position")


# The start


def start(mode, q=Q, measured=HALF, **fields):
    command = Command()
    command.control_mode = mode
    command.position, command.velocity, command.effort = list(Q), [0.0] * N, list(HALF)
    for name, value in fields.items():
        setattr(command, name, list(value))
    return LIMITS.refusal_to_start(command, q, measured, gravity=measured)


@pytest.mark.parametrize("joint", range(N))
@pytest.mark.parametrize("side", [-1, 1])
def test_efforts_must_start_near_measured_ones(joint, side):
    far = side * 0.1 * LIMIT[joint] * E[joint]
    assert start(Command.EFFORT, effort=HALF + 0.99 * far) == Status.REFUSAL_NONE
    assert start(Command.EFFORT, effort=HALF + 1.01 * far) == Status.REFUSAL_START_FAR
    # The start is also refused if the present effort exceeds the limit of commands plus the start tolerance.
    most = side * LIMIT * E[joint]
    assert start(Command.EFFORT, measured=1.09 * most, effort=1.05 * most) == Status.REFUSAL_NONE
    assert start(Command.EFFORT, measured=1.11 * most, effort=1.05 * most) == Status.REFUSAL_START_FAR
    outside = Q + (UPPER[joint] + LIMITS.margin[joint] - Q[joint]) * E[joint]
    assert start(Command.EFFORT, q=outside) == Status.REFUSAL_START_OUTSIDE


@pytest.mark.parametrize("joint", range(N))
@pytest.mark.parametrize("side", [-1, 1])
def test_positions_must_start_near_measured_ones(joint, side):
    far = side * LIMITS.margin[joint] * E[joint]
    lead = KP[joint] / KD[joint] * far  # velocity with the same lead
    assert start(Command.POSITION, position=Q + 0.99 * far) == Status.REFUSAL_NONE
    assert start(Command.POSITION, position=Q + 1.01 * far) == Status.REFUSAL_START_FAR
    assert start(Command.POSITION, velocity=0.99 * lead) == Status.REFUSAL_NONE
    assert start(Command.POSITION, velocity=1.01 * lead) == Status.REFUSAL_START_FAR
    # Distance and velocity add up in the same direction, but do not compensate each other.
    assert start(Command.POSITION, position=Q + 0.6 * far, velocity=0.3 * lead) == Status.REFUSAL_NONE
    assert start(Command.POSITION, position=Q + 0.6 * far, velocity=0.6 * lead) == Status.REFUSAL_START_FAR
    assert start(Command.POSITION, position=Q + 0.6 * far, velocity=-0.6 * lead) == Status.REFUSAL_NONE
    assert start(Command.POSITION, position=Q + 1.1 * far, velocity=-0.6 * lead) == Status.REFUSAL_START_FAR
    # Positions may start outside the limits, to return, and with any effort.
    outside = Q + 9.0 * E[joint]
    assert start(Command.POSITION, q=outside, position=outside, measured=2 * LIMIT) == Status.REFUSAL_NONE


def test_start_tolerance_is_inclusive():
    measured = LIMITS.command_limits + LIMITS.start_effort
    assert start(Command.EFFORT, measured=FREE, effort=LIMITS.start_effort) == Status.REFUSAL_NONE
    assert start(Command.EFFORT, measured=measured, effort=measured) == Status.REFUSAL_NONE
    assert start(Command.POSITION, q=FREE, position=LIMITS.start_position) == Status.REFUSAL_NONE


# Efforts


@pytest.mark.parametrize("sign", [-1, 1])
def test_efforts_follow_clamped_command_at_limited_rate(sign):
    command = sign * LIMIT * np.array([0.2, 1.0, 1.5, 0.04, 0.0, 3.0, -2.0])
    effort, flags = LIMITS.follow_effort(command, FREE, 1e-3)
    np.testing.assert_allclose(effort, sign * LIMIT * [0.05, 0.05, 0.05, 0.04, 0.0, 0.05, -0.05], atol=1e-12)
    clamped, late = Status.FLAG_EFFORT_CLAMPED, Status.FLAG_RATE_LIMITED
    both = clamped | late
    np.testing.assert_array_equal(flags, [late, late, both, 0, 0, both, both])
    effort, flags = LIMITS.follow_effort(command, sign * LIMIT * [0.19, 0.99, 1, 0.04, 0, 1, -1], 1e-3)
    np.testing.assert_allclose(effort, sign * LIMIT * [0.2, 1.0, 1.0, 0.04, 0.0, 1.0, -1.0], atol=1e-12)
    np.testing.assert_array_equal(flags, [0, 0, clamped, 0, 0, clamped, clamped])
    np.testing.assert_array_equal(LIMITS.follow_effort(command, HALF, 0.0)[0], HALF)


@pytest.mark.parametrize("joint", range(N))
@pytest.mark.parametrize("side", [-1, 1])
def test_fast_joint_is_braked(joint, side):
    limits = GuardLimits(ARM, GuardSettings(traverse_time=50.0))  # so slow that the speed does not affect the wall
    push, speed = side * LIMIT * E[joint], side * limits.speed * E[joint]
    for share, left in ((0.0, 1.0), (1.0, 1.0), (1.125, 0.5), (1.25, 0.0), (1.375, -0.5), (1.5, -1.0), (3.0, -1.0)):
        effort, flags = limits.restrain_effort(push, Q, share * speed)
        np.testing.assert_allclose(effort, left * push, atol=1e-12)
        assert flagged(flags) == (([joint], {Status.FLAG_SPEED_LIMIT}) if share > 1 else ([], set()))
    # A fast joint is braked with up to the full motor effort.
    np.testing.assert_allclose(limits.restrain_effort(FREE, Q, 1.1 * speed)[0], -0.4 * push, atol=1e-12)
    np.testing.assert_allclose(limits.restrain_effort(FREE, Q, 9.0 * speed)[0], -push, atol=1e-12)


def test_wall_stiffness_is_limited():
    """With a delay of one period, a stiffer wall would chatter. A softer one would be wider than necessary."""
    motors = [max(LIMIT[row != 0] / np.abs(row[row != 0])) for row in A]
    stiffness = 2 * np.array(motors)[:, None] * A**2 / LIMITS.wall_width[:, None] / KP
    assert np.all(stiffness <= 4.0 * (1 + 1e-9))
    assert np.all(LIMITS.wall_width >= np.minimum(0.05, 0.05 * WIDTH))
    wider = LIMITS.wall_width > np.minimum(0.05, 0.05 * WIDTH) * (1 + 1e-9)
    np.testing.assert_allclose(stiffness.max(axis=1)[wider], 4.0, atol=1e-12)


@pytest.mark.parametrize("row", range(N + 1))
def test_wall_is_passive(row):
    """Checks the work over closed paths of the limit's coordinate through the wall at several speeds."""
    a = A[row] / (A[row] @ A[row])
    middle = Q + (0.5 * (LOWER + UPPER)[row] - A[row] @ Q) * a
    amplitude = 0.5 * WIDTH[row]
    phase = np.linspace(0, 2 * np.pi, 401)
    for rate in (0.0, 1.0, 5.0):
        c, dc = amplitude * np.sin(phase), amplitude * rate * np.cos(phase)
        force = []
        for x, dx in zip(c, dc, strict=True):
            wall = LIMITS.restrain_effort(FREE, middle + x * a, dx * a)[0]
            force.append(wall @ a)
        force = np.array(force)
        work = np.sum(0.5 * (force[1:] + force[:-1]) * np.diff(c))
        size = np.sum(np.abs(0.5 * (force[1:] + force[:-1]) * np.diff(c)))
        assert size > 0
        assert work <= 1e-9 * size
        if rate:
            assert work < -1e-3 * size


# Positions


@pytest.mark.parametrize("sign", [-1, 1])
def test_targets_are_limited_in_rate_and_range(sign):
    step = LIMITS.speed * 1e-3
    command = Q + sign * step * [0.5, 0.5, 0.0, 1.0, 2.0, 0.0, 90.0]
    target, flags = LIMITS.limit_position(command, Q, 1e-3)
    np.testing.assert_allclose(target - Q, sign * step * [0.5, 0.5, 0.0, 1.0, 1.0, 0.0, 1.0], atol=1e-12)
    np.testing.assert_array_equal(flags[[0, 1, 2, 5]], 0)
    np.testing.assert_array_equal(flags[[4, 6]], Status.FLAG_RATE_LIMITED)
    near = Q.copy()
    bound = UPPER[5] if sign > 0 else LOWER[5]
    near[5] = bound - sign * 0.5 * step[5]
    target, flags = LIMITS.limit_position(near + sign * step * E[5], near, 1e-3)
    assert target[5] == bound
    assert flags[5] & Status.FLAG_POSITION_LIMIT
    assert not np.any(np.delete(flags, 5))
    np.testing.assert_array_equal(np.delete(target, 5), np.delete(Q, 5))


@pytest.mark.parametrize("side", [-1, 1])
def test_joints_stop_together_on_coupled_limit(side):
    bound = (UPPER if side > 0 else LOWER)[N]
    last = Q.copy()
    last[1:3] = bound / 2 - side * 0.001
    wanted = last + side * np.array([0.001, 0.003, 0.001, 0.0, 0.0, 0.0, 0.001])
    target, flags = LIMITS.limit_position(wanted, last, 0.01)
    # These joints reach the limit after half of the distance. The other joints move the whole distance.
    np.testing.assert_allclose(target - last, side * np.array([0.001, 0.0015, 0.0005, 0, 0, 0, 0.001]), atol=1e-12)
    np.testing.assert_array_equal(flags, np.where(A[N] != 0, Status.FLAG_COUPLED_LIMIT, 0))
    # Motions along the limit and away from it are not limited.
    for change in ([0.0, 0.002, -0.002], [0.0, -side * 0.002, 0.0]):
        on = target + np.array([*change, 0, 0, 0, 0])
        moved, flags = LIMITS.limit_position(on, target, 0.01)
        np.testing.assert_allclose(moved, on, atol=1e-9)


@pytest.mark.parametrize("row", range(N + 1))
@pytest.mark.parametrize("side", [-1, 1])
def test_wall_effort_exceeds_all_pushing_motors(row, side):
    yaw, pitch = ARM.joint_names[0], ARM.joint_names[4]
    arm = coupled(*[CoupledLimit("cable", {yaw: -2.0, pitch: 0.5}, -0.5, 0.5)] * (row == N))
    limits = GuardLimits(arm, GuardSettings(traverse_time=100.0, margin=0.001))
    a, bound, effort = limits.A[row], (limits.lower if side < 0 else limits.upper)[row], arm.effort_limits
    joints = np.flatnonzero(a)
    motor = max(effort[joints] / np.abs(a[joints]))
    np.testing.assert_allclose(limits.wall_width[row], max(2 * motor * a**2 / (4 * np.array(arm.gains.kp))), atol=1e-12)
    push = side * np.sign(a) * effort

    def pushed(depth, rate=0.0):
        """Returns effort and flags at a depth in the wall, as a share of its width, with a rate of the coordinate."""
        q = Q + (bound + side * (depth - 1) * limits.wall_width[row] - a @ Q) / (a @ a) * a
        return limits.restrain_effort(push, q, rate * side * a / (a @ a))

    np.testing.assert_allclose(pushed(-0.01)[0], push, atol=1e-12)
    applied, flags = pushed(0.3)
    np.testing.assert_allclose(applied, np.clip(push - 0.6 * side * motor * a, -effort, effort), atol=1e-12)
    assert flagged(flags) == (
        list(joints),
        {Status.FLAG_COUPLED_LIMIT if row == N else Status.FLAG_POSITION_LIMIT},
    )
    assert np.all((pushed(0.5)[0] * push)[joints] <= 1e-12)  # no outward effort remains
    np.testing.assert_allclose(pushed(1.0)[0], -push, atol=1e-12)
    # The wall acts earlier at high speed, by the largest Kd/Kp of these joints, and not on a joint that leaves it.
    seconds = max((np.array(arm.gains.kd) / np.array(arm.gains.kp))[joints])
    rate = 1e-3
    np.testing.assert_allclose(
        pushed(0.3, rate)[0], pushed(0.3 + seconds * rate / limits.wall_width[row])[0], rtol=1e-9, atol=1e-12
    )
    np.testing.assert_allclose(pushed(0.5, -0.6 * limits.wall_width[row] / seconds)[0], push, atol=1e-12)


def coupled(*limits):
    """Returns the arm with other coupled limits. Joints differ in effort and in Kd/Kp."""
    gains = dataclasses.replace(ARM.gains, kd=list(KP * np.linspace(0.05, 0.2, N)))
    return dataclasses.replace(ARM, coupled_limits=limits, effort_limits=LIMIT * np.linspace(1, 2, N), gains=gains)


def test_conflicting_coupled_limits_stop_target():
    yaw, shoulder, elbow = ARM.joint_names[:3]
    first = CoupledLimit("first", {shoulder: 1.0, elbow: 1.0}, -1.0, Q[1] + Q[2])
    second = CoupledLimit("second", {shoulder: 1.0, yaw: 1.0}, Q[0] + Q[1], 2.0)
    limits = GuardLimits(coupled(first, second), GuardSettings())
    # The shoulder would have to move for the elbow, which the second limit prevents.
    wanted = Q + np.array([-0.001, -0.001, 0.001, 0.001, 0.0, 0.0, 0.0])
    last = Q.copy()
    target, flags = limits.limit_position(wanted, last, 0.01)
    np.testing.assert_array_equal(target, Q)
    assert target is not last
    assert np.all(flags[[0, 1]] == Status.FLAG_COUPLED_LIMIT)
    # With only one of these limits, the target moves.
    for alone in (first, second):
        limits = GuardLimits(coupled(alone), GuardSettings())
        assert limits.limit_position(wanted, Q, 0.01)[0][3] == pytest.approx(Q[3] + 0.001)


# Feed-forward velocities


@pytest.mark.parametrize("joint", [0, 3, 4, 5, 6])
@pytest.mark.parametrize("side", [-1, 1])
def test_feedforward_velocity_stops_at_limit(joint, side):
    fast, slow = side * LIMITS.speed * E[joint], side * 0.5 * LIMITS.speed * E[joint]
    for velocity in (fast, slow):
        np.testing.assert_allclose(LIMITS.limit_velocity(velocity, Q), velocity, atol=1e-12)
    bound = (UPPER if side > 0 else LOWER)[joint]
    lead = KD[joint] / KP[joint] * LIMITS.speed[joint]
    for share in (0.5, 0.25, 0.0):
        target = Q + (bound - side * share * lead - Q[joint]) * E[joint]
        velocity = LIMITS.limit_velocity(fast, target)
        np.testing.assert_allclose(velocity, share * side * LIMITS.speed * E[joint], atol=1e-9)
        np.testing.assert_allclose(LIMITS.limit_velocity(-slow, target), -slow, atol=1e-12)  # inward


def test_no_feedforward_velocity_with_limited_position():
    flags = np.array([0, 1, 2, 4, 8, 16, 0], np.int8)
    velocity = 0.1 * LIMITS.speed
    followed = LIMITS.follow_velocity(velocity, velocity, flags, 1.0)
    np.testing.assert_array_equal(followed, np.where(flags == 0, velocity, 0.0))


@pytest.mark.parametrize("side", [-1, 1])
def test_feedforward_velocity_is_limited_in_size_and_rate(side):
    """Kd times the velocity is an effort, and changes at most as fast as a commanded effort."""
    none, step = np.zeros(N, np.int8), LIMIT / KD * 1e-3 / GuardSettings().effort_rise_time
    velocity = -side * LIMITS.speed
    for _ in range(3):
        last, velocity = velocity, LIMITS.follow_velocity(side * 99.0 * np.ones(N), velocity, none, 1e-3)
        np.testing.assert_allclose(side * (velocity - last), np.minimum(step, LIMITS.speed - side * last), atol=1e-12)
    np.testing.assert_array_equal(
        LIMITS.follow_velocity(side * 99.0 * np.ones(N), velocity, none, 99.0), side * LIMITS.speed
    )


@pytest.mark.parametrize("joint", range(N))
@pytest.mark.parametrize("side", [-1, 1])
def test_effort_start_requires_gravity_effort(joint, side):
    """The tolerance is 0.1 of the limit, dry friction, and `hand_effort` on a wrist."""
    allowed = 0.1 * LIMIT[joint] + ARM.dry_friction()[joint] + 0.06
    command = Command()
    command.control_mode = Command.EFFORT
    for factor, code in ((0.999, Status.REFUSAL_NONE), (1.001, Status.REFUSAL_START_GRAVITY)):
        measured = side * 0.1 * LIMIT
        gravity = measured + side * factor * allowed * np.eye(N)[joint]
        command.effort = list(measured)
        assert LIMITS.refusal_to_start(command, Q, measured, gravity) == code


def test_hand_effort_on_a_prismatic_joint_is_a_force():
    arm = load_arm("psm")
    efforts = GuardSettings().plausibility.hand_efforts(arm)
    np.testing.assert_allclose(efforts * np.where(arm.prismatic, 0.1, 1.0), 0.06, atol=1e-12)
    assert np.count_nonzero(arm.prismatic) == 1


def test_dry_friction_comes_from_arm_file():
    friction = ARM.dry_friction()
    assert friction[0] == pytest.approx(0.061 + 0.034, abs=1e-12)
    # The elbow's actuator turns with the shoulder as well, and the platform's with the elbow, by 0.6697.
    assert friction[1] == pytest.approx(0.039 + 0.028 + 0.064 + 0.026, abs=1e-12)
    assert friction[2] == pytest.approx(0.064 + 0.026 + 0.045 + 0.6697 * (0.019 + 0.013), abs=1e-12)


# Gains of the safe state


@pytest.fixture(scope="module", params=["mtml", pytest.param("mtmr", marks=pytest.mark.slow), "psm"])
def safe_arm(request):
    """Returns an arm, its model, its limits, and the stiffness and damping of its safe state."""
    arm = load_arm(request.param)
    model, limits = ControlModel(IdentifiedModel.from_arm(arm)), GuardLimits(arm, GuardSettings())
    return arm, model, limits, limits.safe_gains(arm, model)


@pytest.mark.parametrize(("delay", "least"), [(0.0, 30.0), (SAFE_DELAY, 30.0), (2 * SAFE_DELAY, 0.0)])
def test_safe_gains_have_phase_margin_at_every_pose(safe_arm, delay, least):
    """The loop is L = m (s + k) / s^2 exp(-s T) for each eigenvalue m of M^-1 D."""
    arm, model, _, (stiffness, damping) = safe_arm
    k = stiffness / damping
    np.testing.assert_allclose(k, k[0], rtol=1e-12, atol=0)
    poses = arm.sample_poses(100, np.random.default_rng(1))
    m = np.array([np.linalg.eigvals(np.linalg.solve(model.mass_matrix(q), np.diag(damping))).real for q in poses])
    assert m.min() > 0
    crossover = np.sqrt(0.5 * (m**2 + m * np.sqrt(m**2 + 4 * k[0] ** 2)))
    margin = np.degrees(np.arctan2(crossover, k[0]) - crossover * delay)
    assert margin.min() > least
    # With the gains of the position controller, the loop is unstable at the largest delay.
    assert (m * np.array(arm.gains.kd)[0] / damping[0]).max() * SAFE_DELAY > 0.5 * np.pi


@pytest.mark.parametrize("delay", [*(pytest.param(ms, marks=pytest.mark.slow) for ms in (0, 10, 20)), 30])
@pytest.mark.parametrize("joint", range(7))
def test_safe_state_stops_every_joint_with_late_measurements(safe_arm, joint, delay):
    """A joint comes to rest, with the mass matrix of the arm, without friction.

    The measurement is late by the delay, and by 7 ms for filters and messages.
    """
    arm, model, limits, gains = safe_arm
    q0 = 0.5 * (arm.position_lower + arm.position_upper)
    M = model.mass_matrix(q0)
    acceleration = np.linalg.inv(M)
    follower, ones, zero = Follower(limits, gains), np.ones(7, bool), np.zeros(7)
    follower.latch(q0, zero)
    q, v = q0.copy(), 0.1 * limits.speed * np.eye(7)[joint]
    history = [(q, v)] * (delay + 7)
    energy = 0.5 * v @ M @ v
    for _ in range(3500):
        history.append((q, v))
        effort = follower.hold_valid_joints(*history[-delay - 7], ones, zero, 1e-3).effort
        v = v + 1e-3 * acceleration @ effort
        q = q + 1e-3 * v
    assert 0.5 * (v @ M @ v + (q - q0) @ (gains[0] * (q - q0))) < 0.05 * energy  # the slowest pole is at 0.6 1/s


# In the guard


def test_efforts_are_clamped_and_limited_in_rate():
    bench = Bench().started()
    np.testing.assert_allclose(bench.output.effort, 0.05 * LIMIT, atol=1e-12)
    for k in range(1, 30):
        output = bench.run(Command.EFFORT, 1, effort=list(10 * LIMIT))
        np.testing.assert_allclose(output.effort, np.minimum(0.05 + 0.05 * k, 1.0) * LIMIT, rtol=0, atol=1e-12)
        assert np.all(output.joint_flags & Status.FLAG_EFFORT_CLAMPED)
        assert k == 19 or np.all((output.joint_flags & Status.FLAG_RATE_LIMITED != 0) == (k < 19))  # 19: by rounding


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
