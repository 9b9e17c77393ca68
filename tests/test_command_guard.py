"""The watchdog: what it lets pass, what it refuses, when it takes over, and that garbage moves nothing."""

import dataclasses

import numpy as np
import pytest

from dvrk_drake.lcmtypes import lcmt_dvrk_command as Command
from dvrk_drake.lcmtypes import lcmt_dvrk_status as Status
from dvrk_drake.models.arm import load_arm
from dvrk_drake.models.lcm_messages import decode
from dvrk_drake.systems.command_guard import CommandGuard

ARM = load_arm("mtml")
N = ARM.num_joints
LIMIT = ARM.effort_limits
SESSION = 77
Q = np.array([0.1, 0.4, -0.25, 0.6, 0.9, 0.1, 0.5])  # inside all limits
MS = 1000


class Bench:
    """A guard at rest with a clock; the measured state is set by the test."""

    def __init__(self, arm=ARM, **arguments):
        self.arm = arm
        self.guard = CommandGuard(arm, SESSION, **arguments)
        self.utime = 1_700_000_000_000_000
        self.q = Q.copy() if arm is ARM else 0.5 * (arm.position_lower + arm.position_upper)
        self.v, self.effort = np.zeros(arm.num_joints), 0.05 * arm.effort_limits
        self.sequence = 0
        self.output = self.guard.step(self.utime, self.q, self.v, self.effort)

    def command(self, mode=Command.EFFORT, *, sender=5, **fields):
        self.sequence += 1
        command = Command()
        command.utime, command.sequence, command.sender_id = self.utime - 10**15, self.sequence, sender
        command.session_id, command.status_utime = SESSION, self.utime
        command.arm_name, command.control_mode, command.num_joints = self.arm.name, mode, self.arm.num_joints
        command.position, command.velocity, command.effort = (
            list(self.q),
            [0.0] * self.arm.num_joints,
            list(self.effort),
        )
        for name, value in fields.items():
            setattr(command, name, value)
        return command

    def send(self, mode=Command.EFFORT, **fields):
        return self.guard.receive(self.command(mode, **fields), self.utime)

    def tick(self, milliseconds=1):
        for _ in range(milliseconds):
            self.utime += MS
            self.output = self.guard.step(self.utime, self.q, self.v, self.effort)
        return self.output

    def run(self, mode, milliseconds, **fields):
        """A good stream of commands, one a millisecond."""
        for _ in range(milliseconds):
            assert self.send(mode, **fields) == Status.REFUSAL_NONE
            self.tick()
        return self.output

    def started(self, mode=Command.EFFORT):
        self.run(mode, 260)
        assert self.guard.state == {Command.EFFORT: Status.STATE_EFFORT, Command.POSITION: Status.STATE_POSITION}[mode]
        return self


def test_holds_the_first_pose_without_any_command():
    bench = Bench()
    bench.q = Q + 0.01
    output = bench.tick(100)
    assert (output.control_mode, bench.guard.state) == (Command.HOLD, Status.STATE_HOLD)
    np.testing.assert_array_equal(output.position, Q)
    assert not np.any(output.effort)
    assert bench.guard.accepted_modes == 0b1111


@pytest.mark.parametrize("mode", [Command.EFFORT, Command.POSITION])
def test_start_guard_waits_250_ms_of_good_commands(mode):
    bench = Bench()
    for k in range(300):
        assert bench.send(mode) == Status.REFUSAL_NONE
        starting = bench.guard.state == Status.STATE_STARTING
        assert starting == (k < 250)
        assert bench.tick().control_mode == (Command.HOLD if starting else mode)
        assert bench.guard.sender_id == 5


@pytest.mark.parametrize(
    ("mode", "fields", "code"),
    [
        (Command.EFFORT, {"effort": list(0.05 * LIMIT + 0.11 * LIMIT)}, Status.REFUSAL_START_FAR),
        (Command.EFFORT, {"effort": list(0.05 * LIMIT - 0.11 * LIMIT)}, Status.REFUSAL_START_FAR),
        (Command.POSITION, {"position": list(Q + 0.06 * np.eye(N)[4])}, Status.REFUSAL_START_FAR),
    ],
)
def test_a_start_far_from_the_present_is_refused_and_starts_the_guard_anew(mode, fields, code):
    bench = Bench()
    bench.run(mode, 200)
    assert bench.send(mode, **fields) == code
    assert bench.guard.state == Status.STATE_HOLD
    bench.tick()
    bench.run(mode, 250)
    assert bench.guard.state == Status.STATE_STARTING
    bench.run(mode, 1)
    assert bench.guard.state in (Status.STATE_EFFORT, Status.STATE_POSITION)


def test_a_gap_while_starting_starts_anew():
    bench = Bench()
    bench.run(Command.EFFORT, 200)
    bench.tick(60)
    assert bench.guard.state == Status.STATE_HOLD
    assert bench.guard.counts.expired == 0
    bench.run(Command.EFFORT, 200)
    assert bench.guard.state == Status.STATE_STARTING


def test_changing_the_mode_goes_through_a_hold_and_the_start_guard():
    bench = Bench().started(Command.EFFORT)
    bench.q = Q + 0.02
    bench.tick()
    output = bench.run(Command.POSITION, 1)
    assert (output.control_mode, bench.guard.state) == (Command.HOLD, Status.STATE_STARTING)
    np.testing.assert_array_equal(output.position, Q + 0.02)
    output = bench.run(Command.POSITION, 249)
    assert output.control_mode == Command.HOLD
    assert bench.run(Command.POSITION, 1).control_mode == Command.POSITION


def test_a_command_expires_after_50_ms_into_a_hold_of_the_pose():
    bench = Bench().started()
    bench.tick(49)  # the command was received one tick before
    assert bench.output.control_mode == Command.EFFORT
    bench.q = Q + 0.01
    output = bench.tick()
    assert (output.control_mode, bench.guard.state, bench.guard.sender_id) == (Command.HOLD, Status.STATE_HOLD, 0)
    np.testing.assert_array_equal(output.position, Q + 0.01)
    assert bench.guard.counts.expired == 1
    # No fault: a sender may start again, guarded as at first.
    bench.run(Command.EFFORT, 250)
    assert bench.guard.state == Status.STATE_STARTING


def test_hold_command_holds_at_once_and_does_not_creep():
    bench = Bench().started()
    bench.q = Q + 0.01
    bench.tick()
    bench.run(Command.HOLD, 1)
    for k in range(100):
        bench.q = Q + 0.01 + 1e-4 * k
        output = bench.run(Command.HOLD, 1)
        assert output.control_mode == Command.HOLD
        np.testing.assert_array_equal(output.position, Q + 0.01)


def test_off_and_back():
    bench = Bench().started()
    assert bench.run(Command.OFF, 1).control_mode == Command.OFF
    bench.q = Q - 0.05  # it fell
    assert bench.tick(200).control_mode == Command.OFF
    assert bench.send(Command.EFFORT) == Status.REFUSAL_BAD_MODE
    assert bench.guard.accepted_modes == 0b0011
    output = bench.run(Command.HOLD, 1)
    assert output.control_mode == Command.HOLD
    np.testing.assert_array_equal(output.position, Q - 0.05)


def test_modes_can_be_restricted():
    bench = Bench(modes=(Command.POSITION,))
    assert bench.send(Command.EFFORT) == Status.REFUSAL_BAD_MODE
    assert bench.guard.accepted_modes == 0b0111
    bench.started(Command.POSITION)


# Refusals


@pytest.mark.parametrize(
    ("fields", "code"),
    [
        ({"arm_name": "MTMR"}, Status.REFUSAL_WRONG_ARM),
        ({"arm_name": ""}, Status.REFUSAL_WRONG_ARM),
        ({"num_joints": 6}, Status.REFUSAL_WRONG_SIZE),
        ({"num_joints": -1}, Status.REFUSAL_WRONG_SIZE),
        ({"effort": [0.0] * 6}, Status.REFUSAL_WRONG_SIZE),
        ({"velocity": []}, Status.REFUSAL_WRONG_SIZE),
        ({"effort": [0.0] * 6 + [np.nan]}, Status.REFUSAL_NOT_FINITE),
        ({"position": [np.inf] + [0.0] * 6}, Status.REFUSAL_NOT_FINITE),
        ({"velocity": [-1e7] + [0.0] * 6}, Status.REFUSAL_NOT_FINITE),
        ({"sender_id": 0}, Status.REFUSAL_NO_SENDER),
        ({"session_id": SESSION + 1}, Status.REFUSAL_WRONG_SESSION),
        ({"control_mode": 4}, Status.REFUSAL_BAD_MODE),
        ({"control_mode": -1}, Status.REFUSAL_BAD_MODE),
        ({"reset_fault": True}, Status.REFUSAL_BAD_RESET),
    ],
)
def test_bad_commands_are_refused_and_end_in_a_hold(fields, code):
    bench = Bench().started()
    for _ in range(52):
        assert bench.send(**fields) == code
        bench.tick()
    assert bench.guard.state == Status.STATE_HOLD
    assert (bench.guard.refusal_code, bench.guard.counts.refused) == (code, 52)


def test_unreadable_messages_are_refused():
    bench = Bench()
    assert decode(Command, b"garbage") is None
    assert bench.guard.receive(None, bench.utime) == Status.REFUSAL_UNREADABLE


def test_a_command_that_answers_an_old_status_is_stale():
    bench = Bench()
    bench.tick(100)
    assert bench.send(status_utime=bench.utime - 50 * MS) == Status.REFUSAL_NONE
    assert bench.send(status_utime=bench.utime - 50 * MS - 1) == Status.REFUSAL_STALE
    assert bench.send(status_utime=bench.utime + 1) == Status.REFUSAL_STALE  # no such status was ever sent
    assert bench.send(status_utime=0) == Status.REFUSAL_STALE
    unborn = CommandGuard(ARM, SESSION)
    assert unborn.receive(bench.command(), bench.utime) == Status.REFUSAL_STALE


def test_out_of_order_and_duplicates_are_refused_and_gaps_are_counted():
    bench = Bench()
    first = bench.command()
    bench.tick()
    second = bench.command()
    bench.tick()
    assert bench.guard.receive(second, bench.utime) == Status.REFUSAL_NONE
    assert bench.guard.receive(second, bench.utime) == Status.REFUSAL_OUT_OF_ORDER
    assert bench.guard.receive(first, bench.utime) == Status.REFUSAL_OUT_OF_ORDER
    bench.sequence += 3
    bench.tick()
    assert bench.send() == Status.REFUSAL_NONE
    assert bench.guard.counts.lost == 3


@pytest.mark.parametrize("jump", [-MS - 1, -3600 * 10**6, 51 * MS, 3600 * 10**6])
def test_a_jump_of_the_senders_clock_ends_in_a_hold_and_a_new_start(jump):
    bench = Bench().started()
    base = bench.utime - 10**15
    assert bench.send(utime=base + jump) == Status.REFUSAL_CLOCK_JUMP
    assert bench.guard.state == Status.STATE_HOLD
    for _ in range(251):
        bench.tick()
        assert bench.send(utime=bench.utime - 10**15 + jump) == Status.REFUSAL_NONE
    assert bench.guard.state == Status.STATE_EFFORT


def test_the_arms_clock_jumping_forward_expires_and_backward_is_a_fault():
    bench = Bench().started()
    bench.utime += 3600 * 10**6
    assert bench.tick().control_mode == Command.HOLD
    bench.started()
    bench.utime -= 3600 * 10**6
    assert bench.tick().control_mode == Command.HOLD
    assert bench.guard.fault_code == Status.FAULT_CLOCK
    # The reset works on the clock as it is now.
    bench.run(Command.HOLD, 2)
    bench.run(Command.HOLD, 1, reset_fault=True)
    assert bench.guard.state == Status.STATE_HOLD
    bench.started()


# Faults


def test_two_senders_at_once_are_a_latched_fault():
    bench = Bench().started()
    assert bench.send(sender=6) == Status.REFUSAL_OTHER_SENDER
    output = bench.tick()
    assert (output.control_mode, bench.guard.fault_code) == (Command.HOLD, Status.FAULT_DUPLICATE_SENDER)
    assert "5" in bench.guard.fault_text and "6" in bench.guard.fault_text
    assert bench.guard.accepted_modes == 0b0010
    for _ in range(400):
        assert bench.send() == Status.REFUSAL_FAULT
        assert bench.tick().control_mode == Command.HOLD


def test_the_other_sender_is_noticed_while_only_holding_and_while_refused():
    bench = Bench()
    bench.run(Command.HOLD, 3)
    assert bench.send(Command.HOLD, sender=6) == Status.REFUSAL_OTHER_SENDER
    bench = Bench()
    assert bench.send(effort=list(LIMIT)) == Status.REFUSAL_START_FAR
    assert bench.send(sender=6) == Status.REFUSAL_OTHER_SENDER


def test_a_sender_may_follow_one_that_is_silent_but_starts_anew():
    bench = Bench().started()
    bench.tick(51)
    assert bench.send(sender=6) == Status.REFUSAL_NONE
    assert bench.guard.state == Status.STATE_STARTING
    assert bench.guard.fault_code == Status.FAULT_NONE


def test_only_a_meant_reset_clears_a_fault():
    bench = Bench()
    bench.guard.report_fault("the amplifier is hot")
    assert (bench.guard.fault_code, bench.guard.fault_text) == (Status.FAULT_DRIVER, "the amplifier is hot")
    bench.run(Command.HOLD, 5, reset_fault=True)  # always true is no change to true
    assert bench.guard.state == Status.STATE_FAULT
    bench.run(Command.HOLD, 5)
    assert bench.guard.state == Status.STATE_FAULT
    assert bench.send(Command.EFFORT, reset_fault=True) == Status.REFUSAL_BAD_RESET
    assert bench.send(Command.OFF) == Status.REFUSAL_FAULT
    bench.tick(500)
    assert bench.guard.state == Status.STATE_FAULT
    bench.run(Command.HOLD, 1)
    bench.run(Command.HOLD, 1, reset_fault=True)
    assert (bench.guard.state, bench.guard.fault_code, bench.guard.fault_text) == (Status.STATE_HOLD, 0, "")


def test_a_pose_beyond_a_limit_faults_while_efforts_act_and_is_held():
    bench = Bench().started()
    bench.q = Q.copy()
    bench.q[5] = ARM.position_upper[5] + 0.02
    assert bench.run(Command.EFFORT, 1).control_mode == Command.EFFORT
    bench.q[5] = ARM.position_upper[5] + 0.03
    output = bench.tick()
    assert (output.control_mode, bench.guard.fault_code) == (Command.HOLD, Status.FAULT_POSITION_LIMIT)
    assert bench.guard.fault_text.startswith("wrist_yaw = 0.8154 is beyond")
    np.testing.assert_array_equal(output.position, bench.q)
    bench.run(Command.HOLD, 1)
    bench.run(Command.HOLD, 1, reset_fault=True)
    assert bench.send(Command.EFFORT) == Status.REFUSAL_START_OUTSIDE


def test_the_coupled_limit_faults_too():
    bench = Bench().started()
    bench.q = Q.copy()
    bench.q[1:3] = 0.2, -0.2 - 0.36  # each inside its own limits
    bench.tick()
    assert bench.guard.fault_text == "parallelogram = -0.36 is beyond -0.33..0.68"


@pytest.mark.parametrize("which", ["q", "v", "effort"])
@pytest.mark.parametrize("value", [np.nan, np.inf, 1e9])
def test_a_lost_measurement_turns_the_motors_off_until_a_reset(which, value):
    bench = Bench().started()
    good = getattr(bench, which)
    setattr(bench, which, np.where(np.arange(N) == 3, value, good))
    output = bench.tick()
    assert (output.control_mode, bench.guard.fault_code) == (Command.OFF, Status.FAULT_MEASUREMENT)
    assert np.all(np.isfinite(output.position))
    # A reset while it is still lost faults again.
    healthy = {"position": list(Q), "effort": [0.0] * N}
    for reset in (False, True):
        bench.send(Command.HOLD, reset_fault=reset, **healthy)
        assert bench.tick().control_mode == Command.OFF
    # Found again, at another pose: off until reset, then held where it is.
    setattr(bench, which, good)
    bench.q = Q - 0.03
    assert bench.tick(100).control_mode == Command.OFF
    bench.run(Command.HOLD, 1)
    output = bench.run(Command.HOLD, 1, reset_fault=True)
    assert output.control_mode == Command.HOLD
    np.testing.assert_array_equal(output.position, Q - 0.03)


def test_a_reset_just_before_the_measurement_is_found_again_holds_the_pose_that_is_found():
    bench = Bench().started()
    bench.q = Q * np.nan
    bench.tick()
    healthy = {"position": list(Q)}
    bench.send(Command.HOLD, **healthy)
    bench.tick()
    bench.send(Command.HOLD, reset_fault=True, **healthy)
    bench.q = Q - 0.03  # it fell meanwhile
    output = bench.tick()
    assert output.control_mode == Command.HOLD
    np.testing.assert_array_equal(output.position, Q - 0.03)


def test_a_fault_while_off_stays_off():
    bench = Bench()
    bench.run(Command.OFF, 1)
    bench.guard.report_fault("x")
    assert bench.tick().control_mode == Command.OFF
    bench.run(Command.HOLD, 1)
    assert bench.run(Command.HOLD, 1, reset_fault=True).control_mode == Command.HOLD


# Limits


def test_efforts_are_clamped_and_limited_in_rate_from_the_measured_one():
    bench = Bench().started()
    np.testing.assert_allclose(bench.output.effort, 0.05 * LIMIT)
    for k in range(1, 30):
        output = bench.run(Command.EFFORT, 1, effort=list(10 * LIMIT))
        np.testing.assert_allclose(output.effort, np.minimum(0.05 + 0.05 * k, 1.0) * LIMIT, rtol=1e-12)
        assert np.all(output.joint_flags & Status.FLAG_EFFORT_CLAMPED)
        assert k == 19 or np.all((output.joint_flags & Status.FLAG_RATE_LIMITED != 0) == (k < 19))  # 19: by rounding


@pytest.mark.parametrize("row", range(N + 1))
@pytest.mark.parametrize("side", [-1, 1])
def test_a_soft_wall_turns_outward_effort_inward_before_each_limit(row, side):
    bench = Bench()
    limits = bench.guard.limits
    a, bound = limits.A[row], (limits.lower if side < 0 else limits.upper)[row]
    joints = np.flatnonzero(a)
    command = np.where(a != 0, side * np.sign(a) * LIMIT, 0.0)

    def settled(depth, rate=0.0):
        """Effort and flags at `depth` of its width into the wall."""
        q = Q.copy()
        # The sum of joints 2 and 3 stays in the middle of its range, unless it is the limit in question.
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
    np.testing.assert_allclose(effort, command)
    assert not np.any(flags[joints] & (Status.FLAG_POSITION_LIMIT | Status.FLAG_COUPLED_LIMIT))
    effort, flags = settled(0.25)
    assert np.all(effort[joints] * command[joints] < LIMIT[joints] ** 2)
    assert np.all(flags[joints] == (Status.FLAG_COUPLED_LIMIT if row >= N else Status.FLAG_POSITION_LIMIT))
    effort, _ = settled(0.5)
    assert np.all(effort[joints] * np.sign(command[joints]) <= 1e-12)  # nothing outward is left
    effort, _ = settled(1.0)
    np.testing.assert_allclose(effort, -command)
    # One width before the wall, but there within Kd/Kp at this speed.
    seconds = max(np.divide(ARM.gains.kd, ARM.gains.kp)[joints])
    effort, _ = settled(-1.0, 2 * limits.wall_width[row] / (seconds * (a @ a)))
    np.testing.assert_allclose(effort, -command)
    # It never pulls: on the way out it lets go.
    effort, _ = settled(0.5, -0.6 * limits.wall_width[row] / (seconds * (a @ a)))
    np.testing.assert_allclose(effort, command)


def test_positions_move_at_their_rate_and_stop_at_the_limits():
    bench = Bench().started(Command.POSITION)
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
        np.testing.assert_allclose(last[free], (upper if sign > 0 else lower)[:N][free])
        assert last[1] + last[2] == pytest.approx((upper if sign > 0 else lower)[N])
        assert not np.any(output.velocity)


def test_velocity_feed_forward_passes_where_the_position_is_followed():
    bench = Bench().started(Command.POSITION)
    output = bench.run(Command.POSITION, 1, velocity=[0.01] * N)
    np.testing.assert_array_equal(output.velocity, np.full(N, 0.01))
    output = bench.run(Command.POSITION, 1, velocity=[100.0] * N)
    # Shoulder and elbow together would lead to the coupled limit: test_command_guard_attacks.py.
    free = [0, 3, 4, 5, 6]
    np.testing.assert_array_equal(output.velocity[free], bench.guard.limits.speed[free])


def test_holding_after_position_commands_keeps_the_target_unless_the_arm_is_elsewhere():
    bench = Bench().started(Command.POSITION)
    bench.q = Q - 0.01  # it sags
    bench.tick()
    np.testing.assert_array_equal(bench.run(Command.HOLD, 1).position, Q)
    bench = Bench().started(Command.POSITION)
    bench.q = Q - 0.2  # it is pushed away
    bench.tick()
    np.testing.assert_array_equal(bench.run(Command.HOLD, 1).position, Q - 0.2)


@pytest.mark.parametrize("name", ["mtmr", "psm"])
def test_other_arms(name):
    arm = load_arm(name)
    bench = Bench(arm)
    bench.started(Command.EFFORT)
    output = bench.run(Command.EFFORT, 50, effort=list(100 * arm.effort_limits))
    np.testing.assert_allclose(output.effort, arm.effort_limits)


# Garbage


def random_command(bench, generator):
    """A command that is right in most fields, so that it gets far; any field may be wrong in a nasty way."""
    nasty = [0.0, -0.0, np.nan, np.inf, -np.inf, 1e300, -1e6, 1e-320, 3.0]
    whole = [0, 1, -1, 2**63 - 1, -(2**63), 2**31]
    command = bench.command(int(generator.choice([0, 1, 2, 3, 3, 3, 3])))
    for name in ("position", "velocity", "effort"):
        if generator.random() < 0.2:
            values = generator.normal(size=N) * 10.0 ** generator.integers(-3, 5)
            setattr(command, name, list(values))
        if generator.random() < 0.03:
            getattr(command, name)[generator.integers(N)] = float(generator.choice(nasty))
        if generator.random() < 0.01:
            setattr(command, name, [0.0] * int(generator.integers(0, 12)))
    for name in ("utime", "sequence", "sender_id", "session_id", "status_utime", "num_joints"):
        if generator.random() < 0.004:
            setattr(command, name, whole[generator.integers(len(whole))])
    if generator.random() < 0.01:
        command.control_mode = int(generator.integers(-128, 128))
    command.reset_fault = bool(generator.random() < 0.05)
    return command


@pytest.mark.parametrize("seed", range(4))
def test_fuzz_never_an_unlimited_output(seed):
    generator = np.random.default_rng(seed)
    bench = Bench()
    limits = bench.guard.limits
    states, codes = set(), set()
    last_effort, last_flags, last_mode = None, None, Command.HOLD
    for k in range(10_000):
        if k % 700 == 0 and bench.guard.state != Status.STATE_EFFORT:
            # Now and then a good start, so that the fuzz also meets a guard that acts.
            bench.tick(60)
            bench.q, bench.v, bench.effort = Q.copy(), np.zeros(N), 0.05 * LIMIT
            bench.tick()
            bench.sequence = max(bench.sequence, 10**6 * (1 + k))
            for reset in (False, True):
                bench.send(Command.HOLD, reset_fault=reset, sender=100 + k)
                bench.tick()
            for _ in range(252):
                bench.send(sender=100 + k)
                bench.tick()
            last_mode = Command.HOLD
        command = random_command(bench, generator)
        if generator.random() < 0.9 and command.sender_id == 5 and bench.guard.sender_id:
            command.sender_id = bench.guard.sender_id
        codes.add(bench.guard.receive(None if generator.random() < 0.01 else command, bench.utime))
        bench.q = np.clip(bench.q + generator.normal(size=N) * 2e-3, ARM.position_lower - 0.1, ARM.position_upper + 0.1)
        bench.v = generator.normal(size=N)
        bench.effort = bench.output.effort + generator.normal(size=N) * 0.01 * LIMIT
        if generator.random() < 5e-4:
            bench.q[generator.integers(N)] = np.nan
        output = bench.tick()
        bench.q = np.nan_to_num(bench.q)

        assert bench.guard.state in range(6)
        states.add(bench.guard.state)
        for vector in (output.position, output.velocity, output.effort):
            assert vector.shape == (N,) and np.all(np.isfinite(vector))
        assert np.all(np.abs(output.effort) <= LIMIT)
        assert np.all(np.abs(output.velocity) <= limits.speed)
        expected = {
            Status.STATE_OFF: {Command.OFF},
            Status.STATE_FAULT: {Command.OFF, Command.HOLD},
            Status.STATE_POSITION: {Command.POSITION},
            Status.STATE_EFFORT: {Command.EFFORT},
        }
        assert output.control_mode in expected.get(bench.guard.state, {Command.HOLD})
        if output.control_mode != Command.EFFORT:
            assert not np.any(output.effort)
        elif last_mode == Command.EFFORT:
            free = ((output.joint_flags | last_flags) & ~(Status.FLAG_EFFORT_CLAMPED | Status.FLAG_RATE_LIMITED)) == 0
            assert np.all(np.abs(output.effort - last_effort)[free] <= LIMIT[free] / 20 * (1 + 1e-9))
        last_effort, last_flags, last_mode = output.effort, output.joint_flags, output.control_mode
    assert {Status.STATE_OFF, Status.STATE_HOLD, Status.STATE_EFFORT, Status.STATE_FAULT} <= states
    assert len(codes) > 10


def test_fuzzed_bytes_never_act():
    generator = np.random.default_rng(1)
    bench = Bench()
    good = bench.command(effort=list(LIMIT)).encode()
    for k in range(10_000):
        data = bytearray(good if k % 2 else generator.bytes(int(generator.integers(0, 300))))
        for _ in range(generator.integers(0, 8)):
            if data:
                data[generator.integers(len(data))] = generator.integers(256)
        if k % 3 == 0:
            data = data[: generator.integers(len(data) + 1)]
        bench.guard.receive(decode(Command, bytes(data)), bench.utime)
        output = bench.tick()
        assert output.control_mode in (Command.HOLD, Command.OFF)
        assert not np.any(output.effort)


def test_settings_are_taken():
    settings = dataclasses.replace(CommandGuard(ARM, 1).settings, start_time=0.1, expiry=0.02)
    bench = Bench(settings=settings)
    bench.run(Command.EFFORT, 101)
    assert bench.guard.state == Status.STATE_EFFORT
    bench.tick(20)
    assert bench.guard.state == Status.STATE_HOLD
