"""Latched faults of the command guard and their reset."""

import numpy as np
import pytest
from guard_bench import ARM, LIMIT, MS, SESSION, WITH_OFF, Bench, Heavy, Inert, N, Q, Weightless, modes

from dvrk_drake.lcmtypes import lcmt_dvrk_command as Command
from dvrk_drake.lcmtypes import lcmt_dvrk_status as Status
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.systems.guard.command_guard import CommandGuard
from dvrk_drake.systems.guard.settings import GuardSettings


def test_reset_requires_a_change_of_the_flag():
    bench = Bench(modes=WITH_OFF)
    bench.guard.report_fault("the amplifier is hot")
    assert (bench.guard.fault_code, bench.guard.fault_text) == (Status.FAULT_DRIVER, "the amplifier is hot")
    bench.run(Command.HOLD, 5, reset_fault=True)  # a constant flag is no change to true
    assert bench.guard.state == Status.STATE_FAULT
    bench.run(Command.HOLD, 5)
    assert bench.guard.state == Status.STATE_FAULT
    assert bench.send(Command.EFFORT, reset_fault=True) == Status.REFUSAL_BAD_RESET
    assert bench.guard.accepted_modes == modes(Command.HOLD)
    assert bench.send(Command.OFF) == bench.send(Command.EFFORT) == Status.REFUSAL_FAULT
    bench.tick(500)
    assert bench.guard.state == Status.STATE_FAULT
    bench.run(Command.HOLD, 1)
    bench.run(Command.HOLD, 1, reset_fault=True)
    assert (bench.guard.state, bench.guard.fault_code, bench.guard.fault_text) == (Status.STATE_HOLD, 0, "")


def reset(bench):
    """Resets a fault as a controller would do it. Returns whether the guard accepts efforts again."""
    bench.run(Command.HOLD, 1)
    bench.run(Command.HOLD, 1, reset_fault=True)
    return bench.guard.state == Status.STATE_HOLD


PERSON = (
    "oscillates. 3 faults within 10 s: look at the arm, and press Enter in the terminal of its process, or restart "
    "this process"
)


def test_third_fault_within_ten_seconds_needs_a_person():
    bench = Bench()
    for _ in range(2):
        bench.started().guard.report_fault("oscillates", Status.FAULT_OSCILLATION)
        assert (bench.guard.fault_text, reset(bench)) == ("oscillates", True)
    bench.guard.allow_reset()  # has no effect before it is needed
    bench.started().guard.report_fault("oscillates", Status.FAULT_OSCILLATION)
    assert (bench.guard.fault_text, bench.guard.needs_person) == (PERSON, True)
    for _ in range(2):
        assert not any(reset(bench) for _ in range(20))
        bench.tick(12_000)  # waiting does not help
    assert (bench.guard.fault_text, bench.guard.accepted_modes) == (PERSON, modes(Command.HOLD))
    bench.guard.allow_reset()
    assert (bench.guard.state, bench.guard.fault_text) == (Status.STATE_FAULT, "oscillates")
    assert reset(bench)
    bench.started()


def test_rare_faults_and_faults_of_the_driver_need_no_person():
    bench = Bench()
    for _ in range(4):
        bench.guard.report_fault("oscillates", Status.FAULT_OSCILLATION)
        assert reset(bench)
        bench.tick(5001)
    for _ in range(4):
        bench.guard.report_fault("no power", has_power=False)
        assert reset(bench)


def test_pose_beyond_limit_faults_in_effort_mode():
    bench = Bench().started()
    bench.q = Q.copy()
    bench.q[5] = ARM.position_upper[5] + 0.02
    assert bench.run(Command.EFFORT, 1).control_mode == Command.EFFORT
    bench.q[5] = ARM.position_upper[5] + 0.03
    output = bench.tick()
    assert (output.control_mode, bench.guard.fault_code) == (Command.EFFORT, Status.FAULT_POSITION_LIMIT)
    assert bench.guard.fault_text.startswith("wrist_yaw is at 0.8154 rad, outside its limits")
    np.testing.assert_array_equal(output.position, bench.q)
    bench.run(Command.HOLD, 1)
    bench.run(Command.HOLD, 1, reset_fault=True)
    assert bench.send(Command.EFFORT) == Status.REFUSAL_START_OUTSIDE


BAD = GuardSettings().plausibility.bad_samples


@pytest.mark.parametrize("which", ["q", "v"])
@pytest.mark.parametrize(("value", "joints"), [(np.nan, [3]), (np.inf, [0, 5]), (1e9, [3]), (np.nan, range(N))])
def test_invalid_measurements_lead_to_hold_then_fault(which, value, joints):
    bench = Bench(model=Inert()).at_rest().started()
    good, invalid = getattr(bench, which), np.isin(np.arange(N), joints)
    setattr(bench, which, np.where(invalid, value, good))
    for _ in range(BAD):
        output = bench.tick()
        assert (output.control_mode, bench.guard.state) == (Command.HOLD, Status.STATE_HOLD)
        np.testing.assert_array_equal(output.position, Q)
    output = bench.tick()
    assert (output.control_mode, bench.guard.fault_code) == (Command.EFFORT, Status.FAULT_MEASUREMENT)
    assert bench.guard.fault_text.startswith(", ".join(ARM.joint_names[j] for j in joints) + ": the measured position")
    np.testing.assert_allclose(output.effort, Heavy().gravity_effort(Q), rtol=0, atol=1e-12)
    np.testing.assert_array_equal(output.joint_flags, Status.FLAG_IMPLAUSIBLE * invalid)
    # The other joints are regulated. Otherwise, an unstable arm falls (a wrist pitch reached 30 rad/s in 0.5 s).
    bench.q = bench.q + 0.01
    stiffness, _ = bench.guard.limits.safe_gains(ARM, Inert())
    output = bench.tick(30)
    assert np.all((output.effort < Heavy().gravity_effort(Q) - 0.002 * stiffness) == ~invalid)
    bench.q = bench.q - 0.01
    # A reset while the measurement is still invalid leads to a fault again.
    healthy = {"position": list(Q), "effort": [0.0] * N}
    for reset in (False, True):
        bench.send(Command.HOLD, reset_fault=reset, **healthy)
        assert bench.tick().control_mode == Command.EFFORT
    # Valid measurements at another pose change nothing until a reset. Then this pose is held.
    setattr(bench, which, good)
    bench.q = Q - 0.03
    output = bench.tick(100)
    assert output.control_mode == Command.EFFORT
    np.testing.assert_allclose(output.effort[invalid], Heavy().gravity_effort(Q)[invalid], rtol=0, atol=1e-12)
    bench.run(Command.HOLD, 1)
    output = bench.run(Command.HOLD, 1, reset_fault=True)
    assert (output.control_mode, bench.guard.fault_code) == (Command.HOLD, Status.FAULT_NONE)
    np.testing.assert_array_equal(output.position, Q - 0.03)


@pytest.mark.parametrize("mode", [Command.HOLD, Command.POSITION, Command.EFFORT])
def test_arm_with_invalid_effort_is_regulated(mode):
    """The regulation of the arm does not need the measured efforts."""
    bench = Bench(model=Heavy(), checks=True).at_rest()
    bench.run(mode, 260)
    bench.effort[3] = np.nan
    text = "wrist_platform: the measured effort is not a finite number"
    for k in range(300):
        bench.q = Q + 1e-5 * k  # the checks of efforts do not report the joint, whose effort is constant
        bench.v = np.full(N, 1e-2)
        output = bench.tick()
        assert output.control_mode == Command.HOLD
        np.testing.assert_allclose(output.position, Q, rtol=0, atol=1e-9)
        assert bench.guard.hold_reason == ("" if mode == Command.HOLD else text)
        assert bench.guard.fault_text == (text if k >= BAD else "")
    # A fault of the regulation is detected, and the safe state regulates all joints.
    bench.q = bench.q + 0.005
    assert bench.tick().control_mode == Command.HOLD
    bench.q = bench.q + 0.1 * np.eye(N)[0]
    output = bench.tick()
    assert output.control_mode == Command.EFFORT
    np.testing.assert_array_equal(output.joint_flags, Status.FLAG_IMPLAUSIBLE * (np.arange(N) == 0))
    # The fault can be reset only with a valid effort.
    for effort, state in ((np.nan, Status.STATE_FAULT), (0.0, Status.STATE_HOLD)):
        bench.effort[3], bench.v = effort, np.zeros(N)
        bench.tick()
        for reset in (False, True):
            bench.send(Command.HOLD, effort=[0.0] * N, reset_fault=reset)
            bench.tick()
        assert bench.guard.state == state


def test_few_invalid_measurements_in_hold_are_tolerated():
    bench = Bench()
    for _ in range(3):
        bench.q = Q * np.nan
        assert bench.tick(BAD).control_mode == Command.HOLD
        bench.q = Q.copy()
        bench.tick()
    assert (bench.guard.state, bench.guard.hold_reason) == (Status.STATE_HOLD, "")
    np.testing.assert_array_equal(bench.output.position, Q)


@pytest.mark.parametrize("joint", range(N))
@pytest.mark.parametrize("side", [-1, 1])
def test_wrong_velocity_at_start_has_no_lasting_effect(joint, side):
    """The speed limit brakes at this sample only. The start does not subtract this effort later."""
    bench = Bench().at_rest()
    commanded = bench.effort.copy()
    while bench.guard.state != Status.STATE_EFFORT:
        bench.v = 3.0 * side * bench.guard.limits.speed * np.eye(N)[joint]
        bench.send(Command.EFFORT, effort=list(commanded))
        bench.tick()
    bench.v = np.zeros(N)
    for _ in range(300):
        bench.send(Command.EFFORT, effort=list(commanded))
        np.testing.assert_allclose(bench.tick().effort, commanded, rtol=0, atol=1e-12)


def test_reset_does_not_hold_an_unmeasured_pose():
    bench = Bench(modes=WITH_OFF, checks=True, model=Heavy()).at_rest()
    good = bench.q
    # In OFF, neither HOLD nor the reset of a fault switches the power on.
    bench.run(Command.HOLD, 5)
    bench.run(Command.OFF, 5)
    bench.q = good * np.nan
    bench.tick()
    healthy = {"position": list(good), "effort": [0.0] * N}
    for _ in range(10):
        assert bench.send(Command.HOLD, **healthy) == Status.REFUSAL_STALE
        assert bench.tick().control_mode == Command.OFF
    bench.tick(BAD)
    assert (bench.guard.state, bench.output.control_mode) == (Status.STATE_FAULT, Command.OFF)
    for reset in (False, True, False, True):
        bench.send(Command.HOLD, reset_fault=reset, **healthy)
        assert bench.tick().control_mode == Command.OFF
    bench.q = good - 0.1
    bench.tick()
    for reset in (False, True):
        bench.send(Command.HOLD, reset_fault=reset)
        output = bench.tick()
    assert (output.control_mode, bench.guard.state) == (Command.HOLD, Status.STATE_HOLD)
    np.testing.assert_array_equal(output.position, good - 0.1)
    # With power, the arm is held at the first valid pose after the loss, not at the pose before it.
    bench.q = good * np.nan
    bench.tick(BAD + 5)
    bench.run(Command.HOLD, 1, **healthy)
    bench.send(Command.HOLD, reset_fault=True, **healthy)
    bench.q = good
    bench.tick()
    assert bench.guard.state == Status.STATE_FAULT
    bench.run(Command.HOLD, 1)
    output = bench.run(Command.HOLD, 1, reset_fault=True)
    np.testing.assert_array_equal(output.position, good)


def test_reset_after_invalid_position_holds_measured_pose():
    """Tests also a pose near the target. Until the reset, the other joints are held and damped."""
    bench = Bench(checks=True, model=Inert()).at_rest()
    bench.tick(100)
    bench.q = Q + 0.015 * np.eye(N)[0]
    bench.tick()
    assert bench.guard.fault_text == "outer_yaw: the position jumps"
    bench.v = 0.02 * LIMIT / bench.guard._follower._damping * np.eye(N)[1]
    bench.q = bench.q + 1e-3 * bench.v
    output = bench.tick()
    expected = Heavy().gravity_effort(Q)[1] - 0.02 * LIMIT[1]
    assert output.effort[1] == pytest.approx(expected, abs=0.002 * LIMIT[1])
    bench.v = np.zeros(N)
    bench.tick()
    healthy = {"position": list(bench.q), "effort": [0.0] * N}
    bench.run(Command.HOLD, 1, **healthy)
    output = bench.run(Command.HOLD, 1, reset_fault=True, **healthy)
    assert output.control_mode == Command.HOLD
    np.testing.assert_array_equal(output.position, bench.q)


def test_reset_without_fault_has_no_effect():
    bench = Bench()
    bench.q = Q * np.nan
    for reset in (False, True):
        bench.send(Command.HOLD, position=list(Q), effort=[0.0] * N, reset_fault=reset)
        bench.tick()
    assert (bench.guard.state, bench.guard.fault_text) == (Status.STATE_HOLD, "")


def test_no_power_before_first_valid_measurement():
    guard = CommandGuard(ARM, SESSION, Weightless())
    output = guard.step(0, 0, Q * np.nan, 0 * Q, 0 * Q)
    assert (output.control_mode, guard.fault_code) == (Command.OFF, Status.FAULT_MEASUREMENT)
    assert np.all(np.isfinite(output.position))


def test_fault_in_off_keeps_power_off():
    bench = Bench(modes=WITH_OFF)
    bench.run(Command.HOLD, 1)
    bench.run(Command.OFF, 1)
    bench.guard.report_fault("x")
    assert bench.tick().control_mode == Command.OFF
    bench.run(Command.HOLD, 1)
    assert bench.run(Command.HOLD, 1, reset_fault=True).control_mode == Command.HOLD


def test_implausible_first_pose_is_a_fault():
    degrees = Q.copy()
    degrees[0] = 40.0
    bench = Bench(q=degrees, modes=WITH_OFF)
    guard = bench.guard
    assert (guard.state, guard.fault_code) == (Status.STATE_FAULT, Status.FAULT_MEASUREMENT)
    assert guard.fault_text == (
        "outer_yaw is at 40 rad, far outside its limits -0.6981..1.134 rad; "
        "check its unit (degrees?) and its zero position"
    )
    assert bench.output.control_mode == Command.OFF  # no pose was held
    bench.q = Q
    assert bench.tick().control_mode == Command.OFF
    assert guard.state == Status.STATE_FAULT
    bench.run(Command.HOLD, 1)
    bench.run(Command.HOLD, 1, reset_fault=True)
    assert guard.state == Status.STATE_HOLD
    np.testing.assert_array_equal(bench.tick().position, Q)
    bench.started()


def gap(bench):
    bench.started(Command.POSITION)
    bench.utime += 150 * MS


def off(bench):
    bench.run(Command.HOLD, 1)
    bench.run(Command.OFF, 1)


def lost_power(bench):
    bench.guard.report_fault("disabled", has_power=False)


def lost_measurements(bench):
    bench.q = Q * np.nan
    bench.tick(150)


@pytest.mark.parametrize("begin", [gap, off, lost_power, lost_measurements])
def test_pose_far_beyond_limits_is_never_held(begin):
    bench = Bench(modes=WITH_OFF, model=Heavy(), checks=True).at_rest()
    begin(bench)
    bench.q = np.degrees(Q)
    for k in range(3 * BAD):
        bench.utime += MS
        bench.output = bench.step()
        if bench.output.control_mode in (Command.HOLD, Command.POSITION):
            assert np.abs(bench.output.position).max() < np.abs(Q).max() + 0.1
        bench.send(Command.HOLD, position=list(Q), reset_fault=k % 2 == 1)
    assert bench.tick().control_mode != Command.HOLD
    assert begin is lost_power or "outer_yaw is at 5.73 rad, far outside" in bench.guard.fault_text
    bench.q = Q
    bench.tick()
    bench.run(Command.HOLD, 1)
    bench.run(Command.HOLD, 1, reset_fault=True)
    assert (bench.tick().control_mode, bench.guard.fault_code) == (Command.HOLD, Status.FAULT_NONE)


def test_jump_far_beyond_limits_cannot_be_reset():
    bench = Bench(model=Heavy(), checks=True).at_rest().started()
    bench.q = np.degrees(Q)
    bench.tick()
    assert bench.guard.fault_code == Status.FAULT_IMPLAUSIBLE
    for reset in (False, True):
        bench.run(Command.HOLD, 1, position=list(Q), reset_fault=reset)
    assert bench.guard.state == Status.STATE_FAULT


def test_efforts_require_finite_model_gravity():
    bench = Bench(model=Heavy(), checks=True).at_rest()
    bench.guard._plausibility.gravity = np.full(N, np.nan)
    assert bench.send() == Status.REFUSAL_START_GRAVITY


def test_caller_cannot_change_commanded_effort():
    bench = Bench(model=Heavy(), checks=True).at_rest().started()
    for _ in range(60):
        bench.effort = 0.0 * LIMIT
        bench.run(Command.EFFORT, 1, effort=list(0.6 * LIMIT)) if bench.guard.fault_code == 0 else None
        bench.output.effort[:] = 0.0
    assert "does not follow the commanded effort" in bench.guard.fault_text


def test_prismatic_joint_in_millimetres_is_reported():
    arm = load_arm("psm")
    guard = CommandGuard(arm, SESSION, Weightless())
    q = np.zeros(7)
    q[2] = 120.0
    guard.step(0, 0, q, 0 * q, 0 * q)
    text = "insertion is at 120 m, far outside its limits 0..0.24 m; check its unit (mm?) and its zero position"
    assert guard.fault_text == text


@pytest.mark.parametrize("mode", [Command.HOLD, Command.POSITION, Command.EFFORT])
def test_old_measurement_is_invalid(mode):
    bench = Bench()
    bench.run(mode, 260)
    for _ in range(20):  # the same measurement, until it is 20 ms old
        bench.age += MS
        assert bench.run(mode, 1).control_mode == mode
    bench.age += MS
    bench.tick()
    assert bench.guard.state == Status.STATE_HOLD
    old = "the measurement is 0.021 s old; allowed: 0 to 0.02 s"
    assert bench.guard.hold_reason == ("" if mode == Command.HOLD else old)
    output = bench.tick(BAD)
    assert (output.control_mode, bench.guard.fault_code) == (Command.EFFORT, Status.FAULT_MEASUREMENT)
    assert bench.guard.fault_text == old


RANGE = ARM.position_upper - ARM.position_lower


@pytest.mark.parametrize("joint", range(N))
@pytest.mark.parametrize("side", [-1, 1])
def test_joint_that_does_not_follow_is_a_fault(joint, side):
    away = side * 0.15 * RANGE[joint] * np.eye(N)[joint]
    bench = Bench().started(Command.POSITION)
    bench.q = Q + 0.99 * away
    bench.run(Command.POSITION, 200, position=list(Q))
    bench.q = Q + 1.01 * away
    output = bench.tick()
    assert (output.control_mode, bench.guard.fault_code) == (Command.EFFORT, Status.FAULT_FOLLOWING)
    assert bench.guard.fault_text.startswith(f"{ARM.joint_names[joint]} is at ")
    np.testing.assert_array_equal(output.position, bench.q)


def test_stuck_arm_during_motion_is_a_fault():
    bench = Bench().started(Command.POSITION)
    target = Q - 0.5 * RANGE * np.eye(N)[0]
    for k in range(1000):  # noqa: B007
        bench.send(Command.POSITION, position=list(np.maximum(target, ARM.position_lower + 0.1)))
        bench.tick()
        if bench.guard.fault_code == Status.FAULT_FOLLOWING:
            break
    # The target crosses 0.15 of the range in 75 ms, a half in 250 ms; one that is late by 200 ms is far away by then.
    assert 75 < k < 350
    assert bench.output.control_mode == Command.EFFORT


def test_following_lag_is_no_fault():
    """A PD controller without feedforward at the highest speed lags by Kd/Kp. This is no fault."""
    late = np.array(ARM.gains.kd) / np.array(ARM.gains.kp)
    bench = Bench().started(Command.POSITION)
    worst = 0.0
    for k in range(4000):
        goal = Q.copy()
        goal[0] = ARM.position_lower[0] if k // 1000 % 2 else ARM.position_upper[0]
        goal[4] = ARM.position_upper[4] if k // 700 % 2 else ARM.position_lower[4]
        assert bench.send(Command.POSITION, position=list(goal)) == Status.REFUSAL_NONE
        bench.q = bench.q + 1e-3 / late * (bench.output.position - bench.q)
        bench.tick()
        worst = max(worst, np.abs((bench.output.position - bench.q) / RANGE).max())
    assert bench.guard.state == Status.STATE_POSITION
    assert worst > 0.2  # more than is allowed without a lag


@pytest.mark.parametrize("mode", [Command.HOLD, Command.POSITION, Command.EFFORT])
def test_safe_state_changes_effort_at_limited_rate(mode):
    """Also a fault at full speed reverses the effort in the time of a commanded effort."""
    bench = Bench(model=Inert())
    bench.at_rest().run(mode, 260)
    if mode == Command.EFFORT:
        bench.run(mode, 60, effort=list(LIMIT))
    bench.effort = last = LIMIT.copy()
    bench.tick()
    bench.v = 99.0 * np.ones(N)
    bench.guard.report_fault("x", Status.FAULT_OSCILLATION)
    for _ in range(40):
        effort = bench.tick().effort
        assert np.all(np.abs(effort - last) <= 0.05 * LIMIT + 1e-12)
        last = effort.copy()
        effort[:] = 9.0  # a change of the output does not change the guard
    np.testing.assert_allclose(last, -0.3 * LIMIT, atol=1e-12)


def test_oscillation_after_another_fault_starts_the_safe_state():
    bench = Bench()
    bench.guard.report_fault("x", Status.FAULT_CLOCK)
    assert bench.tick().control_mode == Command.HOLD
    bench.q = Q + 0.16 * RANGE * np.eye(N)[4]
    assert bench.tick().control_mode == Command.EFFORT
    assert (bench.guard.fault_code, bench.guard.fault_text) == (Status.FAULT_CLOCK, "x")
    reset(bench)
    assert bench.tick().control_mode == Command.HOLD
    np.testing.assert_array_equal(bench.output.position, bench.q)


def test_safe_state_without_finite_gravity_holds_the_pose():
    """The arm's own controller then regulates the pose of that moment, without the model."""
    model = Inert()
    bench = Bench(model=model)
    bench.at_rest().run(Command.EFFORT, 260)
    bench.guard.report_fault("x", Status.FAULT_OSCILLATION)
    assert bench.tick().control_mode == Command.EFFORT
    model.gravity_effort = lambda q: np.full(N, np.nan)
    assert bench.tick().control_mode == Command.HOLD
    bench.q = Q + 1e-3
    for _ in range(3):
        np.testing.assert_array_equal(bench.tick().position, Q)
        assert bench.output.control_mode == Command.HOLD


def test_first_pose_slightly_beyond_limit_is_held():
    q = Q.copy()
    q[0] = ARM.position_upper[0] + 0.4 * (ARM.position_upper[0] - ARM.position_lower[0])
    bench = Bench(q=q)
    assert bench.guard.state == Status.STATE_HOLD
    np.testing.assert_array_equal(bench.output.position, q)
