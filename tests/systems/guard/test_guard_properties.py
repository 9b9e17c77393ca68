"""Property test: the output of a guard is finite and inside the limits for any input."""

import dataclasses
from collections import Counter

import numpy as np
import pytest
from guard_bench import SESSION, Weightless
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from dvrk_drake.lcmtypes import lcmt_dvrk_command as Command
from dvrk_drake.lcmtypes import lcmt_dvrk_status as Status
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.models.ranges import RANGE
from dvrk_drake.systems.guard.command_guard import CommandGuard
from dvrk_drake.systems.guard.settings import GuardSettings, PlausibilitySettings
from dvrk_drake.systems.guard.states import Event

ARMS = [
    dataclasses.replace(
        arm,
        gains=dataclasses.replace(arm.gains, kp=[stiffness * x for x in arm.gains.kp]),
        effort_limits=strength * arm.effort_limits,
    )
    for arm in map(load_arm, ("mtml", "mtmr", "psm"))
    for stiffness in (0.5, 1.0, 2.0)
    for strength in (0.7, 1.0)
]
#: Typical wrong values of sensors, networks and models.
STRANGE = (np.nan, np.inf, -np.inf, 0.0, -0.0, 1e300, -1e300, 1e-300, 999999.0, -999999.0, 1e6)


class Broken(Weightless):
    """Model that returns numbers that are not finite or implausible."""

    def __init__(self, number):
        self.number = number

    def gravity_effort(self, q):
        return np.full(len(q), self.number)

    def mass_matrix(self, q):
        return np.full((len(q), len(q)), self.number)


def settings_of(schema):
    """Generates settings with each number anywhere in its range."""
    ranges = {field.name: field.metadata[RANGE] for field in dataclasses.fields(schema) if RANGE in field.metadata}
    whole = {field.name for field in dataclasses.fields(schema) if field.type is int}
    numbers = {
        name: st.integers(int(r.low), int(r.high)) if name in whole else st.floats(r.low, r.high)
        for name, r in ranges.items()
    }
    return st.fixed_dictionaries({}, optional=numbers)


GUARD_SETTINGS, PLAUSIBILITY_SETTINGS = settings_of(GuardSettings), settings_of(PlausibilitySettings)


@st.composite
def configurations(draw):
    """Guard with an arm, a model and settings."""
    arm = draw(st.sampled_from(ARMS))
    model = draw(st.sampled_from([*[Weightless()] * 6, *(Broken(x) for x in (np.nan, np.inf, 1e300, 10.0))]))
    plausibility = PlausibilitySettings(**draw(PLAUSIBILITY_SETTINGS))
    numbers = draw(GUARD_SETTINGS)
    resumes = numbers.get("expiry", 0.0) <= 0.5 and draw(st.booleans())
    chosen = GuardSettings(**numbers, plausibility=plausibility, resume_automatically=resumes)
    return arm, CommandGuard(arm, SESSION, model, chosen)


class Script:
    """Generates measurements and commands near each other and inside the arm's range, and some extreme ones."""

    def __init__(self, draw, arm, guard):
        self.arm, self.guard, self.n = arm, guard, arm.num_joints
        self.random = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
        self.strange = draw(st.sampled_from([0.0, 0.001, 0.02]))
        self.utime, self.sequence, self.sender_id = 10**15, 0, 5
        self.q = arm.sample_poses(1, self.random)[0]
        self.low = self.high = self.q
        self.mode = draw(st.sampled_from([Command.HOLD, Command.POSITION, Command.EFFORT]))

    def numbers(self, values):
        """Returns the values, some of them replaced by extreme ones."""
        values = np.array(values, float)
        replaced = self.random.random(len(values)) < self.strange
        values[replaced] = self.random.choice(STRANGE, np.count_nonzero(replaced))
        return values

    def command(self):
        self.sequence += 1
        command = Command()
        command.utime, command.sequence, command.sender_id = self.utime, self.sequence, self.sender_id
        command.session_id, command.status_utime = SESSION, self.utime
        command.arm_name, command.num_joints, command.control_mode = self.arm.name, self.n, self.mode
        if self.random.random() < self.strange:
            command.control_mode = int(self.random.integers(-128, 128))
        if self.random.random() < 0.02:
            command.control_mode, command.reset_fault = Command.HOLD, bool(self.sequence % 2)
        size = self.random.choice([0.0, 0.01, 1.0, 100.0])
        command.position = self.numbers(self.q + size * self.random.normal(size=self.n)).tolist()
        command.velocity = self.numbers(size * self.random.normal(size=self.n)).tolist()
        command.effort = self.numbers(size * self.arm.effort_limits * self.random.normal(size=self.n)).tolist()
        return command

    def step(self):
        """Returns the output of the guard for one period."""
        self.utime += int(self.random.choice([1000, 1000, 1000, 0, 3000, 60_000, -1000], p=_PERIODS))
        self.guard.receive(self.command() if self.random.random() < 0.97 else None, self.utime)
        size = self.random.choice([1e-5, 1e-3, 1e-2, 1.0], p=[0.9, 0.08, 0.01, 0.01])
        change = size * self.random.normal(size=self.n)
        self.q = self.q + change
        age = int(self.random.choice([0, 10_000, 100_000, -5], p=[0.97, 0.01, 0.01, 0.01]))
        v = self.numbers(change / 1e-3)
        effort = self.numbers(size * self.random.normal(size=self.n))
        q = self.numbers(self.q)
        measured = np.where(np.abs(q) < 1e6, q, self.q)
        self.low, self.high = np.minimum(self.low, measured), np.maximum(self.high, measured)
        return self.guard.step(self.utime, self.utime - age, q, v, effort)


_PERIODS = [0.5, 0.3, 0.15, 0.01, 0.02, 0.01, 0.01]


#: Control modes of the output in each state. In all other states, the arm holds.
ALLOWED = {
    Status.STATE_OFF: {Command.OFF},
    Status.STATE_FAULT: {Command.OFF, Command.HOLD, Command.EFFORT},
    Status.STATE_POSITION: {Command.POSITION},
    Status.STATE_EFFORT: {Command.EFFORT},
}


def check(data, modes):
    """Runs a script through a guard and counts the modes of its output."""
    arm, guard = data.draw(configurations())
    script = Script(data.draw, arm, guard)
    guard.step(script.utime, script.utime, script.q, np.zeros(script.n), np.zeros(script.n))
    if script.mode != Command.HOLD:
        # Commands act immediately, without the periods of the start check.
        guard._in_force.replace(script.command())
        guard._stream.accept(guard.last_command, script.utime)
        guard._change(Event.START)
        guard._change({Command.POSITION: Event.ACT_POSITION, Command.EFFORT: Event.ACT_EFFORT}[script.mode])
    for _ in range(10):
        output = script.step()
        modes[output.control_mode, guard.state] += 1
        assert output.control_mode in ALLOWED.get(guard.state, {Command.HOLD})
        assert output.control_mode == Command.EFFORT or not np.any(output.effort)
        for numbers in (output.position, output.velocity, output.effort):
            assert numbers.shape == (script.n,) and np.all(np.isfinite(numbers))
        assert np.all(np.abs(output.effort) <= arm.effort_limits * (1 + 1e-12))
        assert np.all(np.abs(output.velocity) <= guard.limits.speed * (1 + 1e-12))
        # The target is inside the limits, or at a measured pose.
        low, high = np.minimum(arm.position_lower, script.low), np.maximum(arm.position_upper, script.high)
        assert np.all((output.position >= low - 1e-9) & (output.position <= high + 1e-9))


def check_many(count):
    modes = Counter()
    decorate = settings(max_examples=count, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))
    decorate(given(st.data())(lambda data: check(data, modes)))()
    # Commands must act and faults must occur, otherwise the test is not meaningful.
    print(f"{count} configurations: {dict(modes)}")
    for mode, state in (
        (Command.EFFORT, Status.STATE_EFFORT),
        (Command.POSITION, Status.STATE_POSITION),
        (Command.EFFORT, Status.STATE_FAULT),
        (Command.HOLD, Status.STATE_HOLD),
        (Command.HOLD, Status.STATE_FAULT),
    ):
        assert modes[mode, state] > count / 10


@pytest.mark.parametrize("count", [300, pytest.param(5_000, marks=pytest.mark.slow)])
def test_output_is_finite_and_limited_for_any_input(count):
    check_many(count)
