"""Monitors of the guard's own period and of oscillating efforts."""

import numpy as np
import pytest
from guard_bench import ARM, LIMIT, MS, Bench, N, Q, modes

from dvrk_drake.lcmtypes import lcmt_dvrk_command as Command
from dvrk_drake.lcmtypes import lcmt_dvrk_status as Status
from dvrk_drake.systems.guard.measurement import OscillationMonitor, PeriodMonitor
from dvrk_drake.systems.guard.settings import GuardSettings

SETTINGS = GuardSettings()
OSCILLATES = "the effort oscillates"


@pytest.mark.parametrize(("period", "slow"), [(0.001, False), (0.005, False), (0.0051, True), (0.020, True)])
def test_slow_median_period_is_found_after_50_periods(period, slow):
    monitor = PeriodMonitor(SETTINGS)
    faults = [monitor.add(period) for _ in range(200)]
    assert [bool(fault) for fault in faults] == [slow and k >= 50 for k in range(200)]
    assert not slow or faults[-1] == "the median period of the guard is above the allowed 5 ms"
    # Normal periods end the fault.
    faults = [monitor.add(0.001) for _ in range(100)]
    assert [bool(fault) for fault in faults] == [slow and k < 49 for k in range(100)]


@pytest.mark.parametrize(("period", "long"), [(0.040, False), (0.041, True), (0.049, True)])
def test_long_period_is_found_immediately(period, long):
    monitor = PeriodMonitor(SETTINGS)
    assert monitor.add(0.001) == ""
    text = f"the guard was not stepped for {1e3 * period:.0f} ms; 40 ms are allowed"
    assert monitor.add(period) == (text if long else "")
    assert monitor.add(0.001) == ""


def test_slow_guard_holds_until_operator_resumes():
    """With a period of 20 ms, efforts at 0.9 of their limits would act too long on a moving arm."""
    bench = Bench(checks=True)
    bench.run(Command.EFFORT, 260)
    assert bench.guard.state == Status.STATE_EFFORT
    for k in range(60):
        bench.utime += 20 * MS
        bench.send(Command.EFFORT)
        bench.step()
        assert (bench.guard.state == Status.STATE_EFFORT) == (k < 50)
    assert bench.guard.hold_reason == "the median period of the guard is above the allowed 5 ms"
    # No command acts while the period is too long, even after a reset by an operator.
    for reset in (False, True):
        bench.utime += 20 * MS
        assert bench.send(Command.HOLD, reset_fault=reset) == Status.REFUSAL_NONE
        bench.step()
    assert bench.guard.hold_reason == ""
    assert bench.guard.blocked_reason == "the median period of the guard is above the allowed 5 ms"
    assert bench.guard.accepted_modes == modes(Command.HOLD)
    bench.tick()
    bench.utime += MS
    assert bench.send(Command.EFFORT) == Status.REFUSAL_BAD_MODE
    bench.tick(100)
    bench.run(Command.EFFORT, 260)
    assert bench.guard.state == Status.STATE_EFFORT


def test_period_is_measured_by_wall_clock():
    """The clock of a simulated arm counts its ticks and does not show their delay."""
    wall = [10**9]
    bench = Bench(checks=True, wall_clock=lambda: wall[0])
    for _ in range(260):
        wall[0] += MS
        bench.run(Command.EFFORT, 1)
    assert bench.guard.state == Status.STATE_EFFORT
    for late, state in ((39 * MS, Status.STATE_EFFORT), (49 * MS, Status.STATE_HOLD)):
        wall[0] += late
        bench.tick()
        assert bench.guard.state == state
        wall[0] += MS
        assert bench.send(Command.EFFORT) in (Status.REFUSAL_NONE, Status.REFUSAL_RESUME)
    assert bench.guard.hold_reason == "the guard was not stepped for 50 ms; 40 ms are allowed"


def reversals(monitor, wave, seconds=6.0):
    """Returns the time and joint of the detected oscillation of the effort wave(t) (n,), or (None, None)."""
    for k in range(round(1e3 * seconds)):
        effort = wave(1e-3 * k)
        if text := monitor.add(1e-3, effort):
            return 1e-3 * k, ARM.joint_names.index(text.partition(":")[0])
    return None, None


@pytest.mark.parametrize("joint", range(N))
@pytest.mark.parametrize("frequency", [1.5, 5.0, 20.0, 100.0])
def test_oscillating_efforts_are_found(joint, frequency):
    unit = np.eye(N)[joint] * LIMIT
    wave = lambda t: unit * np.sign(np.sin(2 * np.pi * frequency * (t + 1e-4)))  # noqa: E731
    time, found = reversals(OscillationMonitor(SETTINGS, ARM, OSCILLATES), wave)
    assert found == joint
    # Each half period is a reversal. Four reversals are allowed, with exponential decay. The mean settles slowly.
    assert time <= 8 / (2 * frequency) + 0.11


@pytest.mark.parametrize(
    "wave",
    [
        pytest.param(lambda t: 0.35 * LIMIT * np.sign(np.sin(60 * t)), id="friction that changes its side"),
        pytest.param(lambda t: 0.9 * LIMIT * np.sin(2 * np.pi * 0.25 * t), id="a slow swing of gravity"),
        pytest.param(lambda t: LIMIT * (1.0 if t < 2 else -1.0), id="one reversal"),
        pytest.param(lambda t: LIMIT * (t > 1), id="a steady push"),
    ],
)
def test_normal_efforts_are_no_oscillation(wave):
    assert reversals(OscillationMonitor(SETTINGS, ARM, OSCILLATES), wave) == (None, None)


@pytest.mark.parametrize(("half_period", "restart", "found"), [(0.1, 99, True), (0.1, 4, False), (5.0, 99, False)])
def test_reversals_decay_and_restart_resets_them(half_period, restart, found):
    monitor, joints = OscillationMonitor(SETTINGS, ARM, OSCILLATES), []
    for k in range(20):
        if k % restart == 0:
            monitor.restart()
        effort = (-1.0) ** k * LIMIT
        joints += [monitor.add(1e-3, effort) for _ in range(round(1e3 * half_period))]
    assert any(joints) == found


def test_guard_holds_on_oscillating_commands():
    bench = Bench().started()
    for k in range(2000):
        effort = np.sign(np.sin(2 * np.pi * 10 * 1e-3 * k)) * LIMIT * np.eye(N)[2]
        bench.send(Command.EFFORT, effort=list(effort))
        bench.tick()
        if bench.guard.state == Status.STATE_FAULT:
            break
    assert k < 500
    assert (bench.guard.fault_code, bench.output.control_mode) == (Status.FAULT_OSCILLATION, Command.EFFORT)
    assert bench.guard.fault_text == "elbow_pitch: the commanded effort oscillates"
    np.testing.assert_array_equal(bench.output.position, Q)


@pytest.mark.parametrize("mode", [Command.HOLD, Command.POSITION])
@pytest.mark.parametrize(("share", "oscillates"), [(1.0, True), (0.35, False)])
def test_oscillating_position_controller_is_a_fault(mode, share, oscillates):
    """The controller of the arm may get late measurements, although their time stamps are recent."""
    bench = Bench()
    bench.run(mode, 260)
    state = bench.guard.state
    for k in range(1000):
        bench.effort[4] = share * LIMIT[4] * np.sign(np.sin(2 * np.pi * 10 * 1e-3 * k))
        bench.run(mode, 1)
        if bench.guard.state == Status.STATE_FAULT:
            break
    if not oscillates:
        assert bench.guard.state == state
        return
    assert k < 500
    assert (bench.guard.fault_code, bench.output.control_mode) == (Status.FAULT_OSCILLATION, Command.EFFORT)
    assert bench.guard.fault_text.endswith(
        ": the measured effort oscillates while the arm's own position controller acts"
    )
    assert bench.guard.fault_text.startswith(ARM.joint_names[4])


def test_constant_full_effort_is_no_oscillating_command():
    """The joint moves between the command and the wall. The command itself is constant."""
    bench, joint = Bench().started(), 5
    upper = ARM.position_upper[joint]
    for k in range(3000):
        bench.send(Command.EFFORT, effort=list(bench.effort * (np.arange(N) != joint) + LIMIT * np.eye(N)[joint]))
        bench.q[joint] = upper - 0.05 * (1 + np.sin(2 * np.pi * 5 * 1e-3 * k))
        bench.tick()
        if bench.guard.state == Status.STATE_FAULT:
            break
    assert bench.guard.fault_code == Status.FAULT_OSCILLATION
    text = "wrist_yaw: the joint moves to and fro between the command and a soft wall or the speed limit"
    assert bench.guard.fault_text == text


LATE = "commands arrive too late: the median age of the last 20 is above the allowed 15 ms"


@pytest.mark.parametrize("mode", [Command.EFFORT, Command.POSITION])
@pytest.mark.parametrize(("age", "late"), [(15, False), (16, True), (49, True)])
def test_late_commands_lead_to_hold(mode, age, late):
    """A flood of messages delays commands. They have not expired, but the control loop is unstable."""
    bench = Bench().started(mode)
    state = bench.guard.state
    for k in range(40):
        assert bench.send(mode, status_utime=bench.utime - age * MS) in (Status.REFUSAL_NONE, Status.REFUSAL_RESUME)
        bench.tick()
        held = late and k >= 10
        assert (bench.guard.state, bench.guard.hold_reason) == ((Status.STATE_HOLD, LATE) if held else (state, ""))
    bench.run(Command.HOLD, 1)
    bench.run(Command.HOLD, 1, reset_fault=True)
    assert bench.started(mode).guard.hold_reason == ""


def test_few_late_commands_act():
    bench = Bench().started()
    for k in range(400):
        assert bench.send(status_utime=bench.utime - 40 * MS * (k % 20 < 10)) == Status.REFUSAL_NONE
        bench.tick()
    assert bench.guard.state == Status.STATE_EFFORT


def test_age_by_the_wall_clock_counts():
    wall = [10**9]
    bench = Bench(wall_clock=lambda: wall[0])
    for k in range(300):
        wall[0] += MS
        command = bench.command()
        if k > 270:
            wall[0] += 16 * MS
        if bench.guard.receive(command, bench.utime) != Status.REFUSAL_NONE:
            break
        bench.tick()
        wall[0] += 0
    assert bench.guard.hold_reason == LATE
