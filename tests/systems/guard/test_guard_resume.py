"""Resume by an operator after a watchdog hold, and expiry by the wall clock in stalls of either side."""

import copy

import numpy as np
import pytest
from guard_bench import MS, WITH_OFF, Bench, N, Q, modes

from dvrk_drake.lcmtypes import lcmt_dvrk_command as Command
from dvrk_drake.lcmtypes import lcmt_dvrk_status as Status
from dvrk_drake.systems.guard.command_stream import WallClock
from dvrk_drake.systems.guard.settings import GuardSettings
from dvrk_drake.systems.lcm.messages import fill_in_guard

MODES = pytest.mark.parametrize("mode", [Command.EFFORT, Command.POSITION])
WAITING = modes(Command.HOLD)
EXPIRED = "the last command expired: it is 51.0 ms old by the arm's clock; 50 ms are allowed"


def expire(bench):
    bench.tick(51)


def jump(bench, mode=None):
    """Simulates a jump of the sender's clock. Its commands are refused until the last accepted one expires."""
    for _ in range(50):
        code = bench.send(mode or bench.output.control_mode, utime=bench.utime)
        assert code == Status.REFUSAL_CLOCK_JUMP
        bench.tick()


def call(bench):
    bench.guard._take_over("the period is 20 ms")


def hold_by_another_sender(bench):
    assert bench.send(Command.HOLD, sender=8) == Status.REFUSAL_NONE


OTHER_HOLD = "sender 8 commanded HOLD"
TAKEOVERS = [(expire, EXPIRED), (jump, EXPIRED), (call, "the period is 20 ms"), (hold_by_another_sender, OTHER_HOLD)]


def waits(bench, reason):
    """Returns whether the guard holds and refuses POSITION and EFFORT of any sender for any time."""
    guard, pose = bench.guard, bench.tick().position
    assert (guard.state, guard.fault_code, guard.hold_reason) == (Status.STATE_HOLD, Status.FAULT_NONE, reason)
    for sender in (5, 6):
        bench.tick(60)
        # The first command may follow a jump of the sender's clock.
        bench.send(Command.HOLD, sender=sender)
        for mode in 150 * [Command.EFFORT, Command.POSITION]:
            bench.tick()
            assert bench.send(mode, sender=sender) == Status.REFUSAL_RESUME
            assert guard.state == Status.STATE_HOLD
    output = bench.tick()
    assert (output.control_mode, guard.accepted_modes, guard.sender_id) == (Command.HOLD, WAITING, 0)
    np.testing.assert_array_equal(output.position, pose)
    status = Status()
    fill_in_guard(status, guard)
    assert (status.fault_text, status.fault_code, status.accepted_modes) == (reason, Status.FAULT_NONE, WAITING)
    return True


@MODES
@pytest.mark.parametrize(("take_over", "reason"), TAKEOVERS)
@pytest.mark.parametrize("operator", [6, 7])
def test_arm_holds_until_operator_resumes(mode, take_over, reason, operator):
    """The operator's command comes from the last sender or from a new one."""
    bench = Bench().started(mode)
    take_over(bench)
    assert waits(bench, reason)
    bench.tick(60)
    bench.run(Command.HOLD, 3, sender=operator)
    assert bench.guard.hold_reason == reason
    bench.run(Command.HOLD, 1, sender=operator, reset_fault=True)
    assert bench.guard.hold_reason == ""
    assert bench.guard.accepted_modes == WAITING | modes(Command.EFFORT, Command.POSITION)
    bench.run(mode, 250, sender=operator)
    assert bench.guard.state == Status.STATE_STARTING
    bench.run(mode, 1, sender=operator)
    assert bench.output.control_mode == mode


@MODES
def test_hold_of_another_sender_ends_control_and_start_check(mode):
    """HOLD is the safe direction, so it needs neither the sender in control nor its sequence."""
    for start in (100, 260):
        bench = Bench()
        bench.run(mode, start)
        ignored, accepted = bench.guard.counts.ignored, bench.guard.counts.accepted
        hold = bench.command(Command.HOLD, sender=8, sequence=-7, utime=0, effort=[np.nan] * N)
        assert bench.guard.receive(hold, bench.utime) == Status.REFUSAL_NONE
        assert (bench.guard.counts.ignored, bench.guard.counts.accepted) == (ignored, accepted + 1)
        assert bench.tick().control_mode == Command.HOLD
        assert bench.send(mode) == Status.REFUSAL_RESUME
        assert waits(bench, OTHER_HOLD)


def test_old_hold_of_another_sender_is_ignored():
    bench = Bench().started()
    for status_utime in (bench.utime - 51 * MS, bench.utime + 1, 0):
        code = bench.send(Command.HOLD, sender=8, status_utime=status_utime)
        assert (code, bench.guard.state) == (Status.REFUSAL_OTHER_SENDER, Status.STATE_EFFORT)


def test_hold_of_another_sender_does_not_reset():
    bench = Bench(modes=WITH_OFF)
    bench.run(Command.HOLD, 1)
    bench.run(Command.OFF, 1)
    assert bench.send(Command.HOLD, sender=8) == Status.REFUSAL_OTHER_SENDER
    assert bench.guard.state == Status.STATE_OFF
    bench = Bench().started()
    bench.guard.report_fault("fault")
    for reset in (False, True):
        assert bench.send(Command.HOLD, sender=8, reset_fault=reset) == Status.REFUSAL_OTHER_SENDER
    assert bench.guard.state == Status.STATE_FAULT


def test_constant_reset_flag_does_not_resume():
    bench = Bench().started()
    expire(bench)
    bench.run(Command.HOLD, 5, sender=6, reset_fault=True)
    assert bench.guard.hold_reason == EXPIRED


@MODES
@pytest.mark.parametrize("take_over", [take_over for take_over, _ in TAKEOVERS])
def test_setting_enables_automatic_resume(mode, take_over):
    bench = Bench(settings=GuardSettings(resume_automatically=True)).started(mode)
    take_over(bench)
    assert (bench.guard.state, bench.guard.hold_reason) == (Status.STATE_HOLD, "")
    bench.tick(60)
    bench.run(mode, 250, sender=6)
    assert bench.guard.state == Status.STATE_STARTING
    bench.run(mode, 1, sender=6)
    assert bench.output.control_mode == mode


@MODES
def test_hold_command_and_ended_start_need_no_resume(mode):
    bench = Bench().started(mode)
    bench.run(Command.HOLD, 1)
    bench.tick(200)
    assert (bench.guard.hold_reason, bench.guard.counts.expired) == ("", 0)
    bench.run(mode, 100)
    bench.tick(60)  # a start that expires
    bench.run(mode, 100)
    jump(bench, mode)
    assert (bench.guard.state, bench.guard.hold_reason) == (Status.STATE_HOLD, "")


def test_silence_during_mode_change_requires_resume():
    bench = Bench(checks=False).started(Command.EFFORT)
    bench.run(Command.POSITION, 100)
    assert bench.guard.state == Status.STATE_STARTING
    bench.tick(60)
    assert bench.guard.hold_reason
    assert bench.send(Command.EFFORT) == Status.REFUSAL_RESUME


@pytest.mark.parametrize(
    "bad", [{"position": [np.nan] * N}, {"control_mode": 0}, {"position": list(Q + 9)}, {"effort": [1e308] * N}]
)
def test_refusal_during_mode_change_requires_resume(bad):
    bench = Bench().started()
    fields = {"control_mode": Command.POSITION, "position": list(Q)}
    bench.send(**fields)
    bench.tick()
    assert bench.guard.state == Status.STATE_STARTING
    assert bench.send(**{**fields, **bad}) != Status.REFUSAL_NONE
    assert bench.tick().control_mode == Command.HOLD
    assert bench.guard.hold_reason.startswith("a command was refused during the start check: ")
    bench.tick(1000)
    assert bench.send(Command.EFFORT) == Status.REFUSAL_RESUME


def test_refused_commands_do_not_block_reset():
    bench = Bench().started()
    expire(bench)
    for k in range(200):
        if k % 40 == 0:
            assert bench.send(Command.EFFORT) in (Status.REFUSAL_RESUME, Status.REFUSAL_OTHER_SENDER)
        if k > 100:
            assert bench.send(Command.HOLD, sender=6, reset_fault=k > 150) == Status.REFUSAL_NONE
        bench.tick()
    assert bench.guard.hold_reason == ""


@pytest.mark.parametrize("copied", [{"effort": [np.nan] * N}, {"reset_fault": True}, {"mode": Command.OFF}])
def test_replayed_command_does_not_interrupt_start(copied):
    bench = Bench()
    for k in range(300):
        bench.run(Command.EFFORT, 1)
        if k % 100 == 50:
            copy_of = {"mode": Command.EFFORT, **copied}
            command = bench.command(copy_of.pop("mode"), **copy_of)
            command.sequence = 2**62
            assert bench.guard.receive(command, bench.utime) == Status.REFUSAL_SEQUENCE_JUMP
    assert bench.guard.state == Status.STATE_EFFORT


def test_first_hold_reason_is_kept():
    bench = Bench().started()
    expire(bench)
    call(bench)
    assert bench.guard.hold_reason == EXPIRED


def test_watchdog_keeps_off_and_fault():
    bench = Bench(modes=WITH_OFF)
    bench.run(Command.HOLD, 1)
    bench.run(Command.OFF, 1)
    call(bench)
    assert (bench.guard.state, bench.tick().control_mode, bench.guard.hold_reason) == (
        Status.STATE_OFF,
        Command.OFF,
        "",
    )
    bench = Bench()
    bench.guard.report_fault("the amplifier is hot", has_power=False)
    call(bench)
    assert (bench.guard.state, bench.tick().control_mode, bench.guard.hold_reason) == (
        Status.STATE_FAULT,
        Command.OFF,
        "",
    )


def test_off_keeps_pending_resume():
    bench = Bench(modes=WITH_OFF).started()
    expire(bench)
    bench.run(Command.HOLD, 1)
    assert bench.run(Command.OFF, 1).control_mode == Command.OFF
    bench.run(Command.HOLD, 1)
    assert bench.guard.hold_reason == EXPIRED
    assert bench.send() == Status.REFUSAL_RESUME


def test_reset_clears_fault_and_pending_resume():
    bench = Bench().started()
    expire(bench)
    bench.guard.report_fault("the amplifier is hot")
    status = Status()
    fill_in_guard(status, bench.guard)
    assert status.fault_text == "the amplifier is hot"
    bench.run(Command.HOLD, 1)
    bench.run(Command.HOLD, 1, reset_fault=True)
    assert (bench.guard.fault_code, bench.guard.hold_reason) == (Status.FAULT_NONE, "")


# Expiry by the wall clock


class WallBench(Bench):
    """Test bench with a wall clock that advances with the arm's clock except in a stall."""

    def __init__(self, **arguments):
        self.stalled = 0
        self.utime = 0  # before the guard is created
        super().__init__(wall_clock=lambda: self.utime + self.stalled - 10**14, **arguments)

    def stall(self, milliseconds):
        """Stops the guard's process and the arm's clock. No command is received and no step is executed."""
        self.stalled += round(milliseconds * MS)


@MODES
@pytest.mark.parametrize("first", ["receive", "step"])
@pytest.mark.parametrize(
    ("milliseconds", "continues"), [(20, True), (48, True), (48.001, False), (50, False), (200, False), (1000, False)]
)
def test_bridge_stall_expires_command_by_wall_clock(mode, first, milliseconds, continues):
    """The first event after the stall is a command or a step. The command was 1 ms old on arrival."""
    bench = WallBench().started(mode)
    assert bench.send(mode, status_utime=bench.utime - MS) == Status.REFUSAL_NONE
    bench.stall(milliseconds)
    bench.utime += MS
    if first == "receive":
        assert bench.send(mode) == (Status.REFUSAL_NONE if continues else Status.REFUSAL_RESUME)
    bench.q = Q + 1e-3
    bench.output = output = bench.step()
    guard = bench.guard
    if continues:
        assert (output.control_mode, guard.counts.expired, guard.hold_reason) == (mode, 0, "")
        assert first == "receive" or bench.send(mode) == Status.REFUSAL_NONE
        bench.tick()
        bench.run(mode, 200)
        return
    assert (output.control_mode, guard.state, guard.counts.expired) == (Command.HOLD, Status.STATE_HOLD, 1)
    age = milliseconds + 2
    reason = f"the last command expired: it is {age:.1f} ms old by the wall clock; 50 ms are allowed"
    assert waits(bench, reason)


@MODES
@pytest.mark.parametrize(
    ("milliseconds", "continues"), [(20, True), (50, True), (51, False), (200, False), (1000, False)]
)
def test_sender_stall_expires_command_by_arm_clock(mode, milliseconds, continues):
    bench = WallBench().started(mode)
    bench.run(mode, 1)  # received one tick before the time that the bench has now
    bench.tick(milliseconds - 1)
    code = bench.send(mode)
    assert code == (Status.REFUSAL_NONE if continues else Status.REFUSAL_RESUME)
    assert bench.tick().control_mode == (mode if continues else Command.HOLD)
    assert continues == (bench.guard.hold_reason == "")


def test_answer_to_old_measurement_has_its_wall_clock_age():
    bench = WallBench().started()
    assert bench.send(status_utime=bench.utime - 40 * MS) == Status.REFUSAL_NONE
    bench.stall(10)
    bench.step()
    assert bench.guard.state == Status.STATE_EFFORT
    bench.stall(0.001)
    bench.step()
    assert bench.guard.state == Status.STATE_HOLD


def test_delayed_command_has_age_of_its_measurement():
    """A command that waits in the socket of a stopped process is recent by the arm's clock."""
    bench = WallBench().started()
    answered = bench.utime
    bench.stall(30)
    bench.tick()
    assert bench.send(status_utime=answered) == Status.REFUSAL_NONE
    bench.stall(19)
    assert bench.step().control_mode == Command.EFFORT
    bench.stall(0.001)
    assert bench.step().control_mode == Command.HOLD
    assert bench.guard.hold_reason.startswith("the last command expired: it is 50.0 ms old by the wall clock")


def test_measurements_have_wall_clock_times():
    now = [10**6]
    clock = WallClock(lambda: now[0])
    clock.note(5000, 200)
    now[0] += 3000
    clock.note(5000, 200)  # a repeated measurement
    clock.note(8000, 0)
    assert clock.time_of(5000, 1) == 10**6 - 200
    assert clock.time_of(8000, 1) == clock.now() == 10**6 + 3000
    assert clock.time_of(7000, 1500) == clock.now() - 1500  # never recorded
    for utime in range(10_000, 12_000):
        clock.note(utime, 0)
    now[0] += 50
    assert clock.time_of(8000, 7) == clock.now() - 7  # long ago
    assert clock.time_of(10_000, 7) == clock.now() - 50
    clock.forget()
    assert clock.time_of(11_999, 7) == clock.now() - 7


def test_wall_times_are_forgotten_if_the_arm_clock_goes_back():
    """Measurements have the same times as earlier ones, but they are recent."""
    bench = WallBench().started()
    bench.utime -= 200 * MS
    bench.stall(300)
    bench.step()
    assert bench.guard.fault_code == Status.FAULT_CLOCK
    for reset in (False, True):
        bench.run(Command.HOLD, 1, reset_fault=reset)
    bench.started()


def test_stall_while_starting_needs_no_resume():
    bench = WallBench()
    bench.run(Command.EFFORT, 200)
    bench.stall(60)
    bench.tick()
    assert (bench.guard.state, bench.guard.hold_reason, bench.guard.counts.expired) == (Status.STATE_HOLD, "", 0)
    bench.run(Command.EFFORT, 250)
    assert bench.guard.state == Status.STATE_STARTING


def test_arm_clock_expires_with_stopped_wall_clock():
    bench = Bench(wall_clock=lambda: 0).started()
    bench.tick(49)
    assert bench.output.control_mode == Command.EFFORT
    assert bench.tick().control_mode == Command.HOLD
    assert bench.guard.hold_reason == EXPIRED


def test_held_pose_does_not_expire():
    bench = WallBench()
    bench.run(Command.HOLD, 1)
    bench.stall(1000)
    bench.q = Q - 0.01
    np.testing.assert_array_equal(bench.tick().position, Q)
    assert bench.guard.hold_reason == ""


def test_copies_share_only_the_wall_clock():
    bench = WallBench().started()
    other = copy.deepcopy(bench.guard)
    bench.stall(60)
    bench.tick()
    assert (bench.guard.state, other.state, other.hold_reason) == (Status.STATE_HOLD, Status.STATE_EFFORT, "")
    other.step(bench.utime, bench.utime, Q, np.zeros(N), bench.effort)
    assert other.hold_reason == bench.guard.hold_reason != ""
