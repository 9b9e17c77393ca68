"""The watchdog's states: what it lets pass, from when on, and when it takes over."""

import numpy as np
import pytest
from guard_bench import LIMIT, MS, Bench, N, Q, modes

from dvrk_drake.lcmtypes import lcmt_dvrk_command as Command
from dvrk_drake.lcmtypes import lcmt_dvrk_status as Status


def test_holds_the_first_pose_without_any_command():
    bench = Bench()
    bench.q = Q + 0.01
    output = bench.tick(100)
    assert (output.control_mode, bench.guard.state) == (Command.HOLD, Status.STATE_HOLD)
    np.testing.assert_array_equal(output.position, Q)
    assert not np.any(output.effort)
    assert bench.guard.accepted_modes == modes(Command.OFF, Command.HOLD, Command.POSITION, Command.EFFORT)


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


def test_a_command_is_obeyed_until_50_ms_after_the_measurement_that_it_answers_whenever_it_came():
    bench = Bench().started()
    answered = bench.utime
    bench.tick(39)
    # Late, and then again and again: no time is gained by that.
    for _ in range(11):
        assert bench.send(status_utime=answered) == Status.REFUSAL_NONE
        assert bench.tick().control_mode == Command.EFFORT
    assert bench.utime == answered + 50 * MS
    assert bench.send(status_utime=answered) == Status.REFUSAL_NONE
    assert bench.tick().control_mode == Command.HOLD
    assert bench.send(status_utime=answered) == Status.REFUSAL_STALE
    assert (bench.guard.counts.expired, bench.guard.fault_code) == (1, Status.FAULT_NONE)


def test_a_sender_that_answers_one_measurement_for_ever_never_starts():
    bench = Bench()
    answered = bench.utime
    for _ in range(50):
        assert bench.send(status_utime=answered) == Status.REFUSAL_NONE
        bench.tick()
    for _ in range(300):
        bench.send(status_utime=answered)
        bench.tick()
        assert bench.guard.state == Status.STATE_HOLD or bench.utime <= answered + 51 * MS


@pytest.mark.parametrize("mode", [Command.EFFORT, Command.POSITION])
def test_no_single_message_drops_the_arm(mode):
    bench = Bench().started(mode)
    allowed = bench.guard.accepted_modes
    assert not allowed >> Command.OFF & 1
    for _ in range(200):  # also not after the expiry, when the arm holds
        assert bench.send(Command.OFF) == Status.REFUSAL_SUDDEN_OFF
        bench.tick()
    assert bench.guard.state == Status.STATE_HOLD
    # Nor the first one of whoever comes, also when somebody else asked for a hold before.
    bench.run(Command.HOLD, 1)
    bench.tick(60)
    assert bench.send(Command.OFF, sender=6) == Status.REFUSAL_SUDDEN_OFF
    assert bench.tick().control_mode == Command.HOLD


def test_off_and_back():
    bench = Bench().started()
    bench.run(Command.HOLD, 1)
    assert bench.run(Command.OFF, 20).control_mode == Command.OFF
    bench.q = Q - 0.05  # it fell
    assert bench.tick(200).control_mode == Command.OFF
    assert bench.send(Command.EFFORT) == Status.REFUSAL_BAD_MODE
    assert bench.guard.accepted_modes == modes(Command.OFF, Command.HOLD)
    output = bench.run(Command.HOLD, 1)
    assert output.control_mode == Command.HOLD
    np.testing.assert_array_equal(output.position, Q - 0.05)


def test_modes_can_be_restricted():
    bench = Bench(modes=(Command.POSITION,))
    assert bench.send(Command.EFFORT) == Status.REFUSAL_BAD_MODE
    assert bench.guard.accepted_modes == modes(Command.OFF, Command.HOLD, Command.POSITION)
    bench.started(Command.POSITION)
