"""The watchdog's latched faults, and what clears them."""

import numpy as np
import pytest
from guard_bench import ARM, LIMIT, Bench, N, Q

from dvrk_drake.lcmtypes import lcmt_dvrk_command as Command
from dvrk_drake.lcmtypes import lcmt_dvrk_status as Status


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
