"""Refused commands of the guard, which lead to a hold."""

import numpy as np
import pytest
from guard_bench import ARM, MS, SESSION, WITH_OFF, Bench, Weightless

from dvrk_drake.lcmtypes import lcmt_dvrk_command as Command
from dvrk_drake.lcmtypes import lcmt_dvrk_status as Status
from dvrk_drake.models.lcm_messages import decode
from dvrk_drake.systems.guard.command_guard import CommandGuard
from dvrk_drake.systems.guard.settings import GuardSettings


@pytest.mark.parametrize(
    ("fields", "code"),
    [
        ({"effort": [0.0] * 6 + [np.nan]}, Status.REFUSAL_NOT_FINITE),
        ({"position": [np.inf] + [0.0] * 6}, Status.REFUSAL_NOT_FINITE),
        ({"velocity": [-1e7] + [0.0] * 6}, Status.REFUSAL_NOT_FINITE),
        ({"control_mode": 0}, Status.REFUSAL_BAD_MODE),
        ({"control_mode": Command().control_mode}, Status.REFUSAL_BAD_MODE),
        ({"control_mode": Command.OFF}, Status.REFUSAL_SUDDEN_OFF),
        ({"control_mode": 5}, Status.REFUSAL_BAD_MODE),
        ({"control_mode": -1}, Status.REFUSAL_BAD_MODE),
        ({"reset_fault": True}, Status.REFUSAL_BAD_RESET),
    ],
)
def test_invalid_commands_are_refused_and_lead_to_hold(fields, code):
    bench = Bench(modes=WITH_OFF).started()
    for _ in range(52):
        assert bench.send(**fields) == code
        bench.tick()
    assert bench.guard.state == Status.STATE_HOLD
    assert (bench.guard.refusal_code, bench.guard.counts.refused, bench.guard.counts.ignored) == (code, 52, 0)


@pytest.mark.parametrize("mode", [Command.EFFORT, Command.POSITION])
@pytest.mark.parametrize(
    ("fields", "code"),
    [
        ({"arm_name": "MTMR"}, Status.REFUSAL_WRONG_ARM),
        ({"arm_name": ""}, Status.REFUSAL_WRONG_ARM),
        ({"num_joints": 6}, Status.REFUSAL_WRONG_SIZE),
        ({"num_joints": -1}, Status.REFUSAL_WRONG_SIZE),
        ({"effort": [0.0] * 6}, Status.REFUSAL_WRONG_SIZE),
        ({"velocity": []}, Status.REFUSAL_WRONG_SIZE),
        ({"sender_id": 0}, Status.REFUSAL_NO_SENDER),
        ({"session_id": SESSION + 1}, Status.REFUSAL_WRONG_SESSION),
        ({"sender_id": 6}, Status.REFUSAL_OTHER_SENDER),
        ({"sender_id": 6, "control_mode": Command.HOLD, "status_utime": 0}, Status.REFUSAL_OTHER_SENDER),
        ({"sender_id": 6, "effort": [np.nan] * 7}, Status.REFUSAL_OTHER_SENDER),
        ({"sender_id": 6, "control_mode": Command.OFF}, Status.REFUSAL_OTHER_SENDER),
        (None, Status.REFUSAL_UNREADABLE),
    ],
)
@pytest.mark.parametrize("watched", [False, True])
def test_foreign_messages_are_counted_and_interrupt_nothing(mode, fields, code, watched):
    bench = Bench()
    bench.run(mode, 100 if watched else 260)
    state = bench.guard.state
    for _ in range(100):
        foreign = None if fields is None else bench.command(mode, **fields)
        assert bench.guard.receive(foreign, bench.utime) == code
        bench.run(mode, 1)
        assert bench.guard.state == state
    bench.run(mode, 60)
    assert bench.guard.output.control_mode == mode
    assert (bench.guard.counts.ignored, bench.guard.ignored_code) == (100, code)
    assert (bench.guard.counts.refused, bench.guard.refusal_code) == (0, Status.REFUSAL_NONE)
    assert (bench.guard.fault_code, bench.guard.sender_id) == (Status.FAULT_NONE, 5)


def test_foreign_messages_do_not_extend_expiry():
    bench = Bench(settings=GuardSettings(resume_automatically=True)).started()
    for _ in range(60):
        bench.send(sender=6)
        bench.guard.receive(decode(Command, b"garbage"), bench.utime)
        bench.tick()
    # A second sender may follow a first one that was silent for the expiry, and passes STARTING.
    assert (bench.guard.state, bench.guard.sender_id) == (Status.STATE_STARTING, 6)
    assert bench.guard.counts.expired == 1


@pytest.mark.parametrize(
    ("fields", "code"),
    [
        ({"sequence": 2**62}, Status.REFUSAL_SEQUENCE_JUMP),
        ({"sequence": -(2**62)}, Status.REFUSAL_OUT_OF_ORDER),
        ({"utime": 2**62}, Status.REFUSAL_CLOCK_JUMP),
        ({"utime": 0}, Status.REFUSAL_CLOCK_JUMP),
        ({"status_utime": 2**62}, Status.REFUSAL_STALE),
        ({"status_utime": 0}, Status.REFUSAL_STALE),
    ],
)
@pytest.mark.parametrize("watched", [False, True])
def test_copied_sender_id_does_not_interrupt_the_stream(fields, code, watched):
    bench = Bench()
    bench.run(Command.EFFORT, 100 if watched else 260)
    for _ in range(200):
        spoofed = bench.command(effort=[1e3] * 7, **fields)
        assert bench.guard.receive(spoofed, bench.utime) == code
        output = bench.run(Command.EFFORT, 1)
    assert bench.guard.state == Status.STATE_EFFORT
    np.testing.assert_allclose(output.effort, bench.effort, atol=1e-12)
    assert (bench.guard.counts.refused, bench.guard.counts.lost) == (200, 200)


def test_answer_to_an_old_status_is_stale():
    bench = Bench()
    bench.tick(100)
    assert bench.send(status_utime=bench.utime - 50 * MS) == Status.REFUSAL_NONE
    assert bench.send(status_utime=bench.utime - 50 * MS - 1) == Status.REFUSAL_STALE
    assert bench.send(status_utime=bench.utime + 1) == Status.REFUSAL_STALE  # no such status was ever sent
    assert bench.send(status_utime=0) == Status.REFUSAL_STALE
    unborn = CommandGuard(ARM, SESSION, Weightless())
    assert unborn.receive(bench.command(), bench.utime) == Status.REFUSAL_STALE


@pytest.mark.parametrize("jump", [-51 * MS, -3600 * 10**6, 51 * MS, 3600 * 10**6])
def test_sender_clock_jump_leads_to_hold_and_restart(jump):
    bench = Bench(settings=GuardSettings(resume_automatically=True)).started()
    base = bench.utime - 10**15
    for _ in range(50):
        assert bench.send(utime=base + jump) == Status.REFUSAL_CLOCK_JUMP
        assert bench.guard.state == Status.STATE_EFFORT
        bench.tick()
        base += MS
    for _ in range(251):
        bench.tick()
        assert bench.guard.state in (Status.STATE_HOLD, Status.STATE_STARTING)
        assert bench.send(utime=bench.utime - 10**15 + jump) == Status.REFUSAL_NONE
    assert bench.guard.state == Status.STATE_EFFORT


# A driver that cannot execute commands safely blocks POSITION and EFFORT.


ACTIVE = (Command.POSITION, Command.EFFORT)
REASON = "the rate is too low"


def accepts(guard, mode):
    return bool(guard.accepted_modes >> mode & 1)


@pytest.mark.parametrize("mode", ACTIVE)
def test_blocked_guard_refuses_commands_and_states_the_reason(mode):
    bench = Bench()
    bench.guard.block(REASON)
    assert bench.guard.blocked_reason == REASON
    assert not any(accepts(bench.guard, active) for active in ACTIVE)
    for _ in range(400):
        assert bench.send(mode) == Status.REFUSAL_BAD_MODE
        assert bench.tick().control_mode == Command.HOLD
    assert bench.guard.session_id == SESSION
    assert bench.guard.state == Status.STATE_HOLD


@pytest.mark.parametrize("mode", ACTIVE)
def test_block_is_no_fault_and_ends_with_an_empty_reason(mode):
    bench = Bench()
    bench.guard.block(REASON)
    bench.tick(50)
    bench.guard.block("")
    assert bench.guard.blocked_reason == ""
    assert all(accepts(bench.guard, active) for active in ACTIVE)
    bench.started(mode)
    bench.guard.block("")  # a driver repeats the empty reason
    assert bench.tick().control_mode == mode


@pytest.mark.parametrize("mode", ACTIVE)
def test_block_ends_acting_commands_until_a_resume(mode):
    bench = Bench().started(mode)
    bench.guard.block(REASON)
    assert bench.tick().control_mode == Command.HOLD
    bench.guard.block("")
    # Commands have acted, so an operator must resume.
    assert bench.guard.hold_reason == bench.guard.blocked_reason == REASON
    assert bench.send(mode) == Status.REFUSAL_RESUME
    bench.send(Command.HOLD)
    bench.tick()
    bench.send(Command.HOLD, reset_fault=True)
    bench.tick()
    assert bench.guard.blocked_reason == ""
    bench.started(mode)


def test_block_during_the_start_check_needs_no_resume():
    bench = Bench()
    bench.run(Command.EFFORT, 100)
    assert bench.guard.state == Status.STATE_STARTING
    bench.guard.block(REASON)
    assert bench.guard.state == Status.STATE_HOLD
    bench.guard.block("")
    assert bench.guard.blocked_reason == ""
    bench.started()


def test_block_does_not_change_off_or_fault():
    bench = Bench(modes=(Command.OFF, *ACTIVE))
    bench.send(Command.HOLD)
    bench.tick()
    bench.send(Command.OFF)
    bench.tick()
    bench.guard.block(REASON)
    assert bench.guard.state == Status.STATE_OFF
    bench.guard.report_fault("the amplifier is hot")
    bench.guard.block(REASON)
    assert (bench.guard.state, bench.guard.fault_text) == (Status.STATE_FAULT, "the amplifier is hot")
