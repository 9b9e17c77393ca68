"""States of the command guard: accepted commands, start check, expiry and transitions."""

import copy

import numpy as np
import pytest
from guard_bench import ARM, LIMIT, MS, WITH_OFF, Bench, N, Q, modes

from dvrk_drake.lcmtypes import lcmt_dvrk_command as Command
from dvrk_drake.lcmtypes import lcmt_dvrk_status as Status
from dvrk_drake.systems.guard.states import TRANSITIONS, Event, State


def test_holds_the_first_pose_without_any_command():
    bench = Bench()
    bench.q = Q + 0.01
    output = bench.tick(100)
    assert (output.control_mode, bench.guard.state) == (Command.HOLD, Status.STATE_HOLD)
    np.testing.assert_array_equal(output.position, Q)
    assert not np.any(output.effort)
    assert bench.guard.accepted_modes == modes(Command.HOLD, Command.POSITION, Command.EFFORT)


@pytest.mark.parametrize("mode", [Command.EFFORT, Command.POSITION])
def test_start_requires_250_ms_of_valid_commands(mode):
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
def test_start_far_from_present_state_is_refused(mode, fields, code):
    bench = Bench()
    bench.run(mode, 200)
    assert bench.send(mode, **fields) == code
    assert bench.guard.state == Status.STATE_HOLD
    bench.tick()
    bench.run(mode, 250)
    assert bench.guard.state == Status.STATE_STARTING
    bench.run(mode, 1)
    assert bench.guard.state in (Status.STATE_EFFORT, Status.STATE_POSITION)


def test_mode_change_passes_hold_and_start_check():
    bench = Bench().started(Command.EFFORT)
    bench.q = Q + 0.02
    bench.tick()
    output = bench.run(Command.POSITION, 1)
    assert (output.control_mode, bench.guard.state) == (Command.HOLD, Status.STATE_STARTING)
    np.testing.assert_array_equal(output.position, Q + 0.02)
    output = bench.run(Command.POSITION, 249)
    assert output.control_mode == Command.HOLD
    assert bench.run(Command.POSITION, 1).control_mode == Command.POSITION


def test_command_expires_after_50_ms_and_arm_holds():
    bench = Bench().started()
    bench.tick(49)  # the command was received one tick before
    assert bench.output.control_mode == Command.EFFORT
    bench.q = Q + 0.01
    output = bench.tick()
    assert (output.control_mode, bench.guard.state, bench.guard.sender_id) == (Command.HOLD, Status.STATE_HOLD, 0)
    np.testing.assert_array_equal(output.position, Q + 0.01)
    assert (bench.guard.counts.expired, bench.guard.fault_code) == (1, Status.FAULT_NONE)


def test_two_steps_at_one_time_keep_the_sender():
    bench = Bench()
    bench.run(Command.HOLD, 1)
    bench.step()
    assert bench.send(Command.HOLD, sender=6) == Status.REFUSAL_OTHER_SENDER


def test_hold_command_acts_immediately_without_creep():
    bench = Bench().started()
    bench.q = Q + 0.01
    bench.tick()
    bench.run(Command.HOLD, 1)
    for k in range(100):
        bench.q = Q + 0.01 + 1e-4 * k
        output = bench.run(Command.HOLD, 1)
        assert output.control_mode == Command.HOLD
        np.testing.assert_array_equal(output.position, Q + 0.01)


def test_expiry_counts_from_the_answered_measurement():
    bench = Bench().started()
    answered = bench.utime
    bench.tick(41)
    # A late or repeated command does not extend the expiry.
    for _ in range(9):
        assert bench.send(status_utime=answered) == Status.REFUSAL_NONE
        assert bench.tick().control_mode == Command.EFFORT
    assert bench.utime == answered + 50 * MS
    assert bench.send(status_utime=answered) == Status.REFUSAL_NONE
    assert bench.tick().control_mode == Command.HOLD
    assert bench.send(status_utime=answered) == Status.REFUSAL_STALE
    assert (bench.guard.counts.expired, bench.guard.fault_code) == (1, Status.FAULT_NONE)


def test_repeated_answer_to_one_measurement_never_starts():
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
def test_single_message_cannot_switch_off(mode):
    bench = Bench(modes=WITH_OFF).started(mode)
    allowed = bench.guard.accepted_modes
    assert not allowed >> Command.OFF & 1
    for _ in range(200):  # also after the expiry, when the arm holds
        assert bench.send(Command.OFF) == Status.REFUSAL_SUDDEN_OFF
        bench.tick()
    assert bench.guard.state == Status.STATE_HOLD
    # The first command of a new sender is also refused, even if another sender commanded HOLD before.
    bench.run(Command.HOLD, 1)
    bench.tick(60)
    assert bench.send(Command.OFF, sender=6) == Status.REFUSAL_SUDDEN_OFF
    assert bench.tick().control_mode == Command.HOLD


@pytest.mark.parametrize("sender", [5, 6])
def test_off_requires_configuration(sender):
    bench = Bench()
    bench.run(Command.HOLD, 1)
    bench.tick(60)  # idle: a new sender may start
    for _ in range(20):
        bench.run(Command.HOLD, 1, sender=sender)
        assert bench.send(Command.OFF, sender=sender) == Status.REFUSAL_BAD_MODE
        assert bench.tick().control_mode == Command.HOLD
    assert bench.guard.state == Status.STATE_HOLD


def test_off_and_return_to_hold():
    bench = Bench(modes=WITH_OFF).started()
    bench.run(Command.HOLD, 1)
    assert bench.run(Command.OFF, 20).control_mode == Command.OFF
    bench.q = Q - 0.05  # the arm fell
    assert bench.tick(200).control_mode == Command.OFF
    assert bench.send(Command.EFFORT) == Status.REFUSAL_BAD_MODE
    assert bench.guard.accepted_modes == modes(Command.OFF, Command.HOLD)
    output = bench.run(Command.HOLD, 1)
    assert output.control_mode == Command.HOLD
    np.testing.assert_array_equal(output.position, Q - 0.05)


def test_accepted_modes_and_the_sender_in_each_state():
    both = modes(Command.HOLD, Command.POSITION, Command.EFFORT)
    bench = Bench(modes=WITH_OFF)
    bench.run(Command.HOLD, 1)
    assert (bench.guard.accepted_modes, bench.guard.sender_id) == (both | modes(Command.OFF), 0)
    for mode in (Command.EFFORT, Command.POSITION):
        bench.run(mode, 1)
        assert (bench.guard.state, bench.guard.accepted_modes, bench.guard.sender_id) == (
            Status.STATE_STARTING,
            both,
            5,
        )
        bench.started(mode)
        assert (bench.guard.accepted_modes, bench.guard.sender_id) == (both, 5)
        assert bench.guard.last_command.control_mode == mode
    accepted = bench.guard.counts.accepted
    bench.run(Command.HOLD, 1)
    assert bench.guard.counts.accepted == accepted + 1 == bench.sequence
    bench.run(Command.OFF, 1)
    assert (bench.guard.accepted_modes, bench.guard.sender_id) == (modes(Command.OFF, Command.HOLD), 0)
    bench.guard.report_fault("x")
    assert (bench.guard.accepted_modes, bench.guard.sender_id) == (modes(Command.HOLD), 0)


@pytest.mark.parametrize("between", [Command.HOLD, Command.POSITION])
def test_another_mode_restarts_the_start_check(between):
    bench = Bench()
    bench.run(Command.EFFORT, 200)
    bench.run(between, 1)
    bench.run(Command.EFFORT, 250)
    assert bench.guard.state == Status.STATE_STARTING
    bench.run(Command.EFFORT, 1)
    assert bench.guard.state == Status.STATE_EFFORT


@pytest.mark.parametrize("allowed", [(), (Command.POSITION,)])
def test_modes_can_be_restricted(allowed):
    bench = Bench(modes=allowed)
    assert bench.guard.accepted_modes == modes(Command.HOLD, *allowed)
    for mode in (Command.EFFORT, Command.POSITION):
        assert bench.send(mode) == (Status.REFUSAL_NONE if mode in allowed else Status.REFUSAL_BAD_MODE)


@pytest.mark.parametrize("ending", ["refused", "expired", "fault and reset"])
def test_ended_start_keeps_held_pose(ending):
    bench = Bench()
    bench.run(Command.EFFORT, 100)
    bench.q = Q - 0.01  # the arm has moved
    bench.tick()
    if ending == "refused":
        assert bench.send(effort=list(LIMIT)) == Status.REFUSAL_START_FAR
    elif ending == "expired":
        bench.tick(60)
    else:
        bench.guard.report_fault("x")
        bench.tick()
        np.testing.assert_array_equal(bench.output.position, Q)
        bench.run(Command.HOLD, 1)
        bench.run(Command.HOLD, 1, reset_fault=True)
    output = bench.tick()
    assert (output.control_mode, bench.guard.state) == (Command.HOLD, Status.STATE_HOLD)
    np.testing.assert_array_equal(output.position, Q)


def test_positions_start_from_the_held_pose():
    bench = Bench()
    bench.q = Q - 0.01
    bench.tick()
    output = bench.run(Command.POSITION, 251, position=list(Q))
    assert output.control_mode == Command.POSITION
    np.testing.assert_array_equal(output.position, Q)


def test_wall_effort_increases_over_start_time():
    bench = Bench(q=[ARM.position_upper[0], *Q[1:]])
    bench.effort = np.zeros(N)
    bench.run(Command.EFFORT, 250)
    for k in range(260):
        share = min(k / 250, 1.0)
        # The wall has twice the motor effort there.
        expected = -min(2 * share, 1.0) * LIMIT[0]
        assert bench.run(Command.EFFORT, 1).effort[0] == pytest.approx(expected, abs=0.01 * LIMIT[0])
    # Afterwards, efforts do not depend on the start.
    bench.run(Command.EFFORT, 250)
    bench.q = Q.copy()
    np.testing.assert_allclose(bench.run(Command.EFFORT, 1).effort, np.zeros(N), atol=1e-12)


def test_pose_beyond_limit_is_no_fault_in_position_mode():
    bench = Bench(modes=WITH_OFF)
    for mode in (Command.HOLD, Command.OFF):
        bench.run(mode, 1)
    bench.q[5] = ARM.position_upper[5] + 0.04  # the arm is moved by hand
    bench.tick()
    bench.run(Command.HOLD, 1)
    bench.started(Command.POSITION)
    assert bench.tick().position[5] == bench.q[5]
    assert bench.guard.fault_code == Status.FAULT_NONE


def test_backward_arm_clock_discards_sender():
    bench = Bench().started()
    bench.utime -= 10**6
    bench.step()
    assert bench.guard.fault_code == Status.FAULT_CLOCK
    # On the old clock, the command would be out of order and come from a second sender.
    bench.sequence = 0
    assert bench.send(Command.HOLD, sender=6) == Status.REFUSAL_NONE
    bench.tick()
    assert bench.send(Command.HOLD, sender=6, reset_fault=True) == Status.REFUSAL_NONE
    assert (bench.guard.state, bench.guard.sender_id) == (Status.STATE_HOLD, 0)


def test_sender_clock_jump_does_not_disturb_hold():
    bench = Bench()
    bench.run(Command.HOLD, 1)
    bench.q = Q - 0.01
    bench.tick()
    assert bench.send(Command.HOLD, utime=bench.utime) == Status.REFUSAL_CLOCK_JUMP
    np.testing.assert_array_equal(bench.tick().position, Q)
    bench.guard.report_fault("x")
    assert bench.send(Command.HOLD, utime=bench.utime) == Status.REFUSAL_CLOCK_JUMP
    assert bench.guard.state == Status.STATE_FAULT


@pytest.mark.parametrize("mode", [Command.HOLD, Command.POSITION, Command.EFFORT])
def test_copy_is_independent(mode):
    """Drake copies the guard with its context before every step."""
    bench = Bench()
    bench.run(mode, 260)
    other = copy.copy(bench)
    other.guard = copy.deepcopy(bench.guard)
    before = vars(other.guard.counts).copy()
    bench.run(Command.HOLD, 3)
    bench.guard.report_fault("x", has_power=False)
    bench.q = Q - 0.02
    bench.tick()
    assert vars(other.guard.counts) == before
    assert other.guard.fault_code == Status.FAULT_NONE
    other.run(mode, 300)
    assert (other.output.control_mode, other.guard.fault_code) == (mode, Status.FAULT_NONE)
    # Equal inputs then give equal outputs.
    duplicate = copy.copy(other)
    duplicate.guard = copy.deepcopy(other.guard)
    for guarded in (other, duplicate):
        guarded.run(mode, 20, position=list(Q + 0.01), effort=list(0.5 * LIMIT))
    for name in ("position", "velocity", "effort", "joint_flags"):
        np.testing.assert_array_equal(getattr(other.output, name), getattr(duplicate.output, name))


# Tests of the table of transitions of the command guard.


def after(event):
    """Returns the codes of all states that follow the event."""
    return {state.code for state in TRANSITIONS[event].values()}


def rows():
    """Returns all transitions: state, event, next state."""
    return [(state, event, after) for event, states in TRANSITIONS.items() for state, after in states.items()]


def test_each_state_is_reached_from_hold():
    reached, new = set(), {State.HOLD}
    while new:
        reached |= new
        new = {next_state for state, _, next_state in rows() if state in reached} - reached
    assert reached == set(State)


def test_each_state_but_a_fault_leads_to_hold_and_to_a_fault():
    for state in State:
        is_fault = state.code == Status.STATE_FAULT
        assert (state in TRANSITIONS[Event.HOLD]) != is_fault
        assert (state in TRANSITIONS[Event.RESET]) == is_fault
        assert (state in TRANSITIONS[Event.FAULT]) != is_fault
        assert (state in TRANSITIONS[Event.WATCHDOG]) == state.has_stream


def test_only_a_start_check_leads_to_commands_that_act():
    for state, event, next_state in rows():
        if next_state in (State.POSITION, State.EFFORT):
            assert state.code == Status.STATE_STARTING and event in (Event.ACT_POSITION, Event.ACT_EFFORT)


def test_only_a_reset_ends_a_fault():
    for state, event, next_state in rows():
        if state.code == Status.STATE_FAULT and next_state.code != Status.STATE_FAULT:
            assert event is Event.RESET and next_state is State.HOLD


def test_motors_get_power_only_by_hold_or_reset():
    for state, event, next_state in rows():
        if not state.is_powered and next_state.is_powered:
            assert event in (Event.HOLD, Event.RESET) and next_state is State.HOLD


def test_foreign_messages_do_not_end_start():
    bench = Bench()
    bench.run(Command.EFFORT, 100)
    for _ in range(160):
        assert bench.guard.receive(None, bench.utime) == Status.REFUSAL_UNREADABLE
        assert bench.guard.receive(bench.command(sender=9, arm_name="PSM1"), bench.utime) == Status.REFUSAL_WRONG_ARM
        bench.run(Command.EFFORT, 1)
    assert bench.guard.state == Status.STATE_EFFORT
    assert (bench.guard.ignored_code, bench.guard.counts.ignored) == (Status.REFUSAL_WRONG_ARM, 320)
    # Refused messages of the sender end the start.
    bench = Bench()
    bench.run(Command.EFFORT, 100)
    assert bench.send(effort=[np.nan] * N) == Status.REFUSAL_NOT_FINITE
    assert bench.guard.state == Status.STATE_HOLD


def test_refused_command_keeps_command_in_force():
    for mode in (Command.EFFORT, Command.POSITION):
        bench = Bench().started(mode)
        assert bench.send(mode, num_joints=3) == Status.REFUSAL_WRONG_SIZE
        assert bench.tick().control_mode == mode
