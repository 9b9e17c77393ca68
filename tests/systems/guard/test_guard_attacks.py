"""Attempts to bypass the guard: edges of limits, clocks, messages, settings, power loss."""

import dataclasses

import numpy as np
import pytest
from guard_bench import ARM, LIMIT, MS, SESSION, Bench, Heavy, N, Q, Weightless

from dvrk_drake.errors import StationError
from dvrk_drake.lcmtypes import lcmt_dvrk_command as Command
from dvrk_drake.lcmtypes import lcmt_dvrk_status as Status
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.systems.guard.command_guard import CommandGuard
from dvrk_drake.systems.guard.settings import GuardSettings
from dvrk_drake.systems.lcm.messages import fill_in_guard

A, LOWER, UPPER = ARM.limit_matrix()


# The arm's clock


def test_stopped_clock_is_a_fault():
    bench = Bench().started()
    for _ in range(10):
        output = bench.step()
    assert output.control_mode == Command.EFFORT
    output = bench.step()
    assert (output.control_mode, bench.guard.fault_code) == (Command.HOLD, Status.FAULT_CLOCK)


@pytest.mark.parametrize("seconds", [1e-6, 0.011, 0.0499, 3.0, 1e9])
def test_long_step_moves_at_most_10_ms(seconds):
    for mode in (Command.EFFORT, Command.POSITION):
        bench = Bench().started(mode)
        before = bench.output
        bench.send(mode, effort=list(-LIMIT), position=list(Q + 5.0))
        bench.utime += round(1e6 * seconds)
        output = bench.step()
        assert output.control_mode == (mode if seconds <= 0.05 else Command.HOLD)
        dt = min(seconds, 0.01)
        if seconds <= 0.05 and mode == Command.EFFORT:
            np.testing.assert_allclose(before.effort - output.effort, dt / 0.02 * LIMIT, atol=1e-9)
        assert np.all(np.abs(output.effort - before.effort) <= dt / 0.02 * LIMIT + 1e-12) or seconds > 0.05
        assert np.all(np.abs(output.position - before.position) <= dt * bench.guard.limits.speed + 1e-12)


# The messages


def test_sequence_jump_keeps_status_encodable():
    bench = Bench()
    for sender in (5, 6):
        assert bench.send(Command.HOLD, sequence=-(2**63), sender=sender) == Status.REFUSAL_NONE
        bench.tick()
        assert bench.send(Command.HOLD, sequence=2**63 - 1, sender=sender) == Status.REFUSAL_SEQUENCE_JUMP
        assert bench.send(Command.HOLD, sequence=-(2**63) + 1000, sender=sender) == Status.REFUSAL_NONE
        bench.tick(60)
    status = Status()
    fill_in_guard(status, bench.guard)
    assert Status.decode(status.encode()).num_lost == 2 * 999


def test_change_of_accepted_command_has_no_effect():
    bench = Bench()
    for _ in range(260):
        command = bench.command(effort=np.array(bench.effort))
        assert bench.guard.receive(command, bench.utime) == Status.REFUSAL_NONE
        bench.tick()
    command.effort[:] = np.nan
    np.testing.assert_allclose(bench.tick().effort, 0.05 * LIMIT, atol=1e-12)


def test_change_of_output_does_not_change_guard():
    bench = Bench().started()
    for array in (bench.output.position, bench.output.velocity, bench.output.effort):
        array[:] = 1.0
    np.testing.assert_array_equal(bench.output.velocity, np.ones(N))
    np.testing.assert_allclose(bench.tick().effort, 0.05 * LIMIT, atol=1e-12)
    np.testing.assert_array_equal(bench.run(Command.HOLD, 1).position, Q)


def test_session_zero_is_refused():
    with pytest.raises(StationError, match="session_id must not be 0"):
        CommandGuard(ARM, 0, Weightless())


# Configuration


@pytest.mark.parametrize("mode", [-1, 99])
def test_unknown_modes_are_refused(mode):
    with pytest.raises(StationError, match=rf"modes must be POSITION, EFFORT or OFF; got \[{mode}\]"):
        CommandGuard(ARM, 1, Weightless(), None, [mode])


def test_later_changes_of_settings_are_checked():
    settings = GuardSettings()
    settings.expiry = 9.0
    with pytest.raises(StationError, match=r"guard settings: expiry is 9; allowed: 0\.002\.\.1 s"):
        CommandGuard(ARM, SESSION, Weightless(), settings)


def test_effort_fraction_clamps_and_refuses_a_dropping_start():
    bench = Bench(settings=GuardSettings(effort_fraction=0.1)).started()
    output = bench.run(Command.EFFORT, 50, effort=list(LIMIT))
    np.testing.assert_allclose(output.effort, 0.1 * LIMIT, atol=1e-12)
    assert np.all(output.joint_flags & Status.FLAG_EFFORT_CLAMPED)
    # The wall still has the full effort.
    bench.q = Q.copy()
    bench.q[0] = ARM.position_upper[0]
    assert bench.run(Command.EFFORT, 1, effort=list(LIMIT)).effort[0] == -LIMIT[0]
    bench = Bench(settings=GuardSettings(effort_fraction=0.1), model=Heavy()).at_rest()
    bench.effort = np.sign(bench.effort) * 0.21 * LIMIT
    bench.tick()
    assert bench.send(Command.EFFORT) == Status.REFUSAL_START_FAR


# Feed-forward velocity


@pytest.mark.parametrize("name", ["mtml", "mtmr", "psm"])
def test_feedforward_velocity_stays_inside_limits(name):
    arm = load_arm(name)
    A, lower, upper = arm.limit_matrix()
    look_ahead = np.array(arm.gains.kd) / np.array(arm.gains.kp)
    bench = Bench(arm).started(Command.POSITION)
    bench.follows = True
    generator = np.random.default_rng(2)
    for q in arm.sample_poses(8, generator):
        # The motion there takes up to the traverse time.
        bench.run(Command.POSITION, 520, position=list(q))
        bench.run(Command.POSITION, 1, position=list(q), velocity=list(1e5 * generator.normal(size=arm.num_joints)))
        ahead = bench.output.position + look_ahead * bench.output.velocity
        assert np.all((A @ ahead <= upper + 1e-9) & (A @ ahead >= lower - 1e-9))
        assert np.any(bench.output.velocity)


# Limits


def test_wall_next_to_start_acts_immediately():
    """For outward efforts from the start of the wall, the wall has its full effort immediately."""
    q = Q.copy()
    q[0] = UPPER[0] - 0.05
    efforts = []
    for acting in (1, 500):
        bench = Bench(q=q)
        bench.run(Command.EFFORT, 250 + acting)
        bench.q = q + 0.04 * np.eye(N)[0]
        efforts.append(bench.run(Command.EFFORT, 30, effort=list(LIMIT)).effort[0])
    assert efforts[0] == pytest.approx(efforts[1]) and efforts[1] < 0


def test_targets_stay_inside_coupled_limit():
    """Targets jump between all corners of the range of shoulder and elbow."""
    bench = Bench()
    limits = bench.guard.limits
    generator = np.random.default_rng(0)
    target = Q.copy()
    for k in range(20_000):
        if k % 40 == 0:
            command = Q.copy()
            command[1:3] = np.where(generator.random(2) < 0.5, LOWER[1:3], UPPER[1:3]) + generator.choice([-9, 0, 9])
        target, _ = limits.limit_position(command, target, 0.01)
        assert np.all((A @ target <= UPPER + 1e-9) & (A @ target >= LOWER - 1e-9))


def test_target_outside_limits_only_returns():
    limits = Bench().guard.limits
    generator = np.random.default_rng(1)
    for _ in range(300):
        target = Q + generator.normal(size=N)
        for _ in range(20):
            before = A @ target
            target, _ = limits.limit_position(Q + 3 * generator.normal(size=N), target, 0.01)
            after = A @ target
            assert np.all(after <= np.maximum(UPPER, before) + 1e-9)
            assert np.all(after >= np.minimum(LOWER, before) - 1e-9)


@pytest.mark.parametrize("excess", [0.0, 0.0249, 0.0251, 0.3])
def test_reset_outside_limits_holds_and_refuses_efforts(excess):
    bench = Bench().started()
    bench.q = Q.copy()
    bench.q[0] = UPPER[0] + 0.3
    bench.tick()
    assert bench.guard.fault_code == Status.FAULT_POSITION_LIMIT
    bench.q[0] = UPPER[0] + excess
    bench.tick()
    bench.run(Command.HOLD, 1)
    output = bench.run(Command.HOLD, 1, reset_fault=True)
    assert (output.control_mode, bench.guard.state) == (Command.HOLD, Status.STATE_HOLD)
    code = bench.send(Command.EFFORT)
    assert code == (Status.REFUSAL_START_OUTSIDE if excess > 0.025 else Status.REFUSAL_NONE)


# A real arm's power


def test_arm_after_power_loss_is_held_at_measured_pose():
    for mode in (Command.HOLD, Command.POSITION):
        bench = Bench()
        bench.run(mode, 260)
        for _ in range(100):
            bench.guard.report_fault("operating state DISABLED", has_power=False)
            output = bench.tick()
            assert (output.control_mode, bench.guard.fault_code) == (Command.OFF, Status.FAULT_DRIVER)
            bench.q = bench.q - 0.003
        bench.run(Command.HOLD, 1)
        output = bench.run(Command.HOLD, 1, reset_fault=True)
        assert output.control_mode == Command.HOLD
        np.testing.assert_array_equal(output.position, bench.q)


def test_power_loss_during_fault_keeps_first_text():
    bench = Bench()
    bench.guard.report_fault("the amplifier is hot")
    assert bench.tick().control_mode == Command.HOLD
    bench.guard.report_fault("operating state DISABLED", has_power=False)
    assert bench.tick().control_mode == Command.OFF
    assert bench.guard.fault_text == "the amplifier is hot"


# Invalid messages of all kinds never move the arm.


def test_settings_are_applied():
    settings = dataclasses.replace(CommandGuard(ARM, 1, Weightless()).settings, start_time=0.1, expiry=0.02)
    bench = Bench(settings=settings)
    bench.run(Command.EFFORT, 101)
    assert bench.guard.state == Status.STATE_EFFORT
    bench.tick(20)
    assert bench.guard.state == Status.STATE_HOLD


def test_controllers_alternating_at_expiry_never_act():
    for gap, ignored in ((50 * MS, 20), (50 * MS + 1, 0)):
        bench = Bench()
        for k in range(40):
            bench.send(sender=5 + k % 2)
            bench.utime += gap
            bench.step()
            assert bench.guard.output.control_mode == Command.HOLD
        assert bench.guard.counts.ignored >= (ignored > 0) and bench.guard.fault_code == Status.FAULT_NONE
