"""Invalid messages of all kinds never move the arm."""

import dataclasses

import numpy as np
import pytest
from guard_bench import ARM, LIMIT, WITH_OFF, Bench, N, Q, Weightless

from dvrk_drake.lcmtypes import lcmt_dvrk_command as Command
from dvrk_drake.lcmtypes import lcmt_dvrk_status as Status
from dvrk_drake.models.lcm_messages import decode
from dvrk_drake.systems.guard.command_guard import CommandGuard


def random_command(bench, generator):
    """Returns a command that is correct in most fields. Any field may have an extreme value."""
    nasty = [0.0, -0.0, np.nan, np.inf, -np.inf, 1e300, -1e6, 1e-320, 3.0]
    whole = [0, 1, -1, 2**63 - 1, -(2**63), 2**31]
    command = bench.command(int(generator.choice([0, 1, 2, 4, 3, 3, 3, 3])))
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


@pytest.mark.parametrize("seed", range(2))
def test_fuzzed_commands_keep_output_limited(seed):
    generator = np.random.default_rng(seed)
    bench = Bench(modes=WITH_OFF)
    limits = bench.guard.limits
    states, codes = set(), set()
    last_effort, last_flags, last_mode = None, None, Command.HOLD
    for k in range(10_000):
        if k % 700 == 0 and bench.guard.state != Status.STATE_EFFORT:
            # An occasional good start, so that fuzzed commands also arrive while commands act.
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
        if generator.random() < 2e-4:
            bench.guard.report_fault("the amplifier is hot")
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
            Status.STATE_FAULT: {Command.OFF, Command.HOLD, Command.EFFORT},
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


def test_settings_are_applied():
    settings = dataclasses.replace(CommandGuard(ARM, 1, Weightless()).settings, start_time=0.1, expiry=0.02)
    bench = Bench(settings=settings)
    bench.run(Command.EFFORT, 101)
    assert bench.guard.state == Status.STATE_EFFORT
    bench.tick(20)
    assert bench.guard.state == Status.STATE_HOLD
