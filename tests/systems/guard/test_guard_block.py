"""A driver that cannot execute commands safely blocks POSITION and EFFORT."""

import pytest
from guard_bench import SESSION, Bench

from dvrk_drake.lcmtypes import lcmt_dvrk_command as Command
from dvrk_drake.lcmtypes import lcmt_dvrk_status as Status
from dvrk_drake.systems.guard.settings import GuardSettings

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


def test_resume_does_not_end_the_block():
    bench = Bench().started()
    bench.guard.block(REASON)
    bench.tick()
    bench.send(Command.HOLD)
    bench.tick()
    bench.send(Command.HOLD, reset_fault=True)
    bench.tick()
    assert bench.guard.hold_reason == ""
    assert bench.guard.blocked_reason == REASON
    assert bench.send() == Status.REFUSAL_BAD_MODE


def test_block_during_the_start_check_needs_no_resume():
    bench = Bench()
    bench.run(Command.EFFORT, 100)
    assert bench.guard.state == Status.STATE_STARTING
    bench.guard.block(REASON)
    assert bench.guard.state == Status.STATE_HOLD
    bench.guard.block("")
    assert bench.guard.blocked_reason == ""
    bench.started()


def test_block_ends_with_automatic_resume():
    bench = Bench(settings=GuardSettings(resume_automatically=True)).started()
    bench.guard.block(REASON)
    bench.tick()
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
