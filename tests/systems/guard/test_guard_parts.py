"""Unit tests of measurements, command streams and settings at the edges of the accepted ranges."""

import re
from dataclasses import fields
from itertools import product

import numpy as np
import pytest
from guard_bench import Bench

from dvrk_drake.errors import StationError
from dvrk_drake.lcmtypes import lcmt_dvrk_command as Command
from dvrk_drake.lcmtypes import lcmt_dvrk_status as Status
from dvrk_drake.models.ranges import RANGE
from dvrk_drake.processes.control import LiveStatusMaker
from dvrk_drake.systems.driver import DvrkDriver
from dvrk_drake.systems.guard.command_stream import CommandStream
from dvrk_drake.systems.guard.limits import is_finite
from dvrk_drake.systems.guard.measurement import Measurement
from dvrk_drake.systems.guard.settings import _WEAKER_IF_SMALLER as WEAKER_IF_SMALLER
from dvrk_drake.systems.guard.settings import GuardSettings, PlausibilitySettings
from dvrk_drake.systems.lcm.messages import fill_in_guard

# Measurements

GOOD = np.arange(3.0)
MS, NOW = 1000, 10**9


def measurement():
    """Returns a valid measurement of three joints that is 25 ms old."""
    measured = Measurement(("a", "b", "c"), 20_000)
    measured.advance(NOW - 25 * MS)
    assert measured.store(NOW - 25 * MS, GOOD, GOOD, GOOD) == ""
    assert measured.dt == np.inf
    measured.advance(NOW)
    return measured


def test_measurement_is_copied():
    measured, q = measurement(), GOOD.copy()
    measured.store(NOW, q, q, q)
    q[:] = 9.0
    np.testing.assert_array_equal(measured.q, GOOD)


def test_clock_returns_elapsed_time():
    measured = Measurement(("a", "b", "c"), 20_000)
    assert measured.utime is None and measured.q is None
    assert measured.advance(5_000_000) == (0.0, "")
    assert measured.advance(5_002_500) == (pytest.approx(2.5e-3), "")
    assert measured.utime == 5_002_500
    dt, problem = measured.advance(5_001_500)
    assert dt == pytest.approx(-1e-3) and problem == "the arm's clock went back by 0.001000 s"
    assert measured.advance(5_002_500) == (pytest.approx(1e-3), "")


def test_stopped_clock_is_reported():
    measured = Measurement(("a", "b", "c"), 20_000)
    for k in range(25):
        assert (measured.advance(1000)[1] == "the arm's clock stands still") == (k >= 10)
    for k in range(12):  # after an advance of the clock, the count restarts
        assert (measured.advance(2000)[1] != "") == (k > 10)


@pytest.mark.parametrize(("age", "good"), [(-1, False), (0, True), (20_000, True), (20_001, False)])
def test_measurement_age_is_checked(age, good):
    measured = measurement()
    problem = measured.store(NOW - age, GOOD + 1, GOOD + 2, GOOD + 3)
    assert (problem == "") == good
    assert measured.num_invalid == (not good)
    for kept, added in ((measured.q, 1), (measured.v, 2), (measured.effort, 3)):
        np.testing.assert_array_equal(kept, GOOD + added if good else GOOD)
    assert good or "allowed: 0 to 0.02 s" in problem


BAD_SIZES = [np.zeros(2), np.zeros(4), np.zeros((1, 3))]
BAD_NUMBERS = [[0, np.nan, 0], [1e6, 0, 0], [0, 0, -1e6]]


@pytest.mark.parametrize(("which", "bad"), [*product(range(3), BAD_SIZES), *product(range(2), BAD_NUMBERS)], ids=str)
def test_measurement_size_and_numbers_are_checked(which, bad):
    measured = measurement()
    vectors = [GOOD, GOOD, GOOD]
    vectors[which] = bad
    for count in (1, 2):
        text = measured.store(NOW, *vectors)
        if np.shape(bad) == (3,):
            joint = int(np.argmax(~(np.abs(bad) < 1e5)))
            assert text == f"{'abc'[joint]}: the measured position or velocity is not a finite number"
            np.testing.assert_array_equal(measured.invalid_pose, np.arange(3) == joint)
        else:
            assert text == "the measurement is not 3 positions, velocities and efforts"
            assert measured.invalid_pose.all()
        assert (measured.num_invalid, measured.is_pose_valid) == (count, False)
    # The last valid number replaces an invalid one.
    q = np.where(measured.invalid_pose, GOOD, bad) if which == 0 and np.shape(bad) == (3,) else GOOD
    np.testing.assert_array_equal(measured.q, q)
    assert measured.store(NOW, GOOD, GOOD, GOOD) == ""
    assert measured.num_invalid == 0


@pytest.mark.parametrize(("bad", "joint"), [(np.nan, 0), (-np.inf, 1), (1e6, 2)])
def test_invalid_effort_is_replaced_by_last_valid_one(bad, joint):
    measured, effort = measurement(), GOOD + 3.0
    effort[joint] = bad
    text = f"{'abc'[joint]}: the measured effort is not a finite number"
    # A repeated measurement does not end the problem.
    for q in (GOOD + 1, GOOD + 9):
        assert measured.store(NOW, q, GOOD + 2, effort) == text
    assert (measured.num_invalid, measured.is_pose_valid) == (1, True)
    np.testing.assert_array_equal(measured.q, GOOD + 1)
    np.testing.assert_array_equal(measured.invalid_effort, np.arange(3) == joint)
    np.testing.assert_array_equal(measured.effort, np.where(np.arange(3) == joint, GOOD, GOOD + 3))
    measured.advance(NOW + MS)
    assert measured.store(NOW + MS, GOOD, GOOD, GOOD) == ""
    assert measured.num_invalid == 0 and not measured.invalid_effort.any()


def test_interval_is_between_valid_measurements():
    measured = measurement()
    measured.advance(NOW + 7 * MS)
    measured.store(NOW + 2 * MS, GOOD * np.nan, GOOD, GOOD)
    measured.store(NOW + 5 * MS, GOOD, GOOD, GOOD)
    assert measured.dt == pytest.approx(30e-3, abs=1e-12)


def test_repeated_and_older_measurements():
    measured = measurement()
    assert measured.store(NOW, GOOD + 1, GOOD, GOOD) == ""
    assert measured.store(NOW, GOOD + 2, GOOD, GOOD) == "" and measured.dt == 0.0
    problem = measured.store(NOW - 2 * MS, GOOD + 3, GOOD, GOOD)
    assert problem == "the measurement is 0.002000 s older than the previous one" and measured.num_invalid == 1
    np.testing.assert_array_equal(measured.q, GOOD + 1)
    # After the arm's clock went back, earlier times are not compared.
    measured.advance(NOW - 1000 * MS)
    assert measured.store(NOW - 1000 * MS, GOOD, GOOD, GOOD) == "" and measured.dt == np.inf


@pytest.mark.parametrize(("number", "finite"), [(0.99e6, True), (1e6, False), (-1e6, False), (np.nan, False)])
def test_is_finite_bounds_the_sum_to_a_million(number, finite):
    assert is_finite([0.0, number, 1.0]) == is_finite([number, 0.0]) == finite


# Streams of commands


class Stream:
    """Stream of a sender whose clock is a million seconds behind the arm's."""

    def __init__(self, **fields):
        self.stream = CommandStream(expiry=50 * MS, clock_tolerance=30 * MS, sequence_jump=1000, **fields)
        self.sequence = 0

    def send(self, utime, mode=Command.HOLD, *, sender=5, ahead=0, step=1, reset=False):
        """Returns the refusal of a command that arrives at `utime`, or the result of accepting it."""
        self.sequence += step
        command = Command()
        command.sender_id, command.sequence, command.utime = sender, self.sequence, utime - 10**12 + ahead
        command.control_mode, command.reset_fault = mode, reset
        code = self.stream.refusal(command, utime)
        return code if code else self.stream.accept(command, utime)


@pytest.mark.parametrize(("silence", "code"), [(50 * MS, Status.REFUSAL_OTHER_SENDER), (50 * MS + 1, False)])
def test_second_sender_requires_silence(silence, code):
    stream = Stream()
    assert stream.send(0) is False
    assert stream.send(silence, sender=6) == code
    assert stream.stream.sender_id == (5 if code else 6)
    # A refused command does not block other senders, even if it is repeated.
    stream = Stream()
    stream.send(0)
    assert stream.send(40 * MS, step=0) == Status.REFUSAL_OUT_OF_ORDER
    assert stream.send(80 * MS, sender=6) is False


@pytest.mark.parametrize(
    ("step", "code"),
    [
        (-1, Status.REFUSAL_OUT_OF_ORDER),
        (0, Status.REFUSAL_OUT_OF_ORDER),
        (1, 0),
        (1000, 0),
        (1001, Status.REFUSAL_SEQUENCE_JUMP),
        (2**62, Status.REFUSAL_SEQUENCE_JUMP),
    ],
)
def test_sequence_order_and_jumps(step, code):
    stream = Stream()
    stream.send(0)
    assert stream.send(MS, step=step) == code
    if code:
        assert stream.send(2 * MS, step=1 - step) is False  # the refused command changed nothing


@pytest.mark.parametrize(
    ("ahead", "jumps"),
    [(0, False), (30 * MS, False), (30 * MS + 1, True), (-30 * MS, False), (-30 * MS - 1, True), (-40 * MS, True)],
)
def test_sender_clock_must_advance_with_arm_clock(ahead, jumps):
    stream = Stream()
    stream.send(0)
    assert stream.send(40 * MS, ahead=ahead) == (Status.REFUSAL_CLOCK_JUMP if jumps else 0)
    if jumps:  # the refused command changed nothing
        assert stream.send(41 * MS) is False


def test_reset_is_a_change_from_false_to_true():
    stream = Stream()
    requested = [
        stream.send(k * MS, reset=reset) for k, reset in enumerate([True, True, False, True, True, False, True])
    ]
    assert requested == [False, False, False, True, False, False, True]
    # The flag of another sender does not count.
    stream.send(8 * MS)
    assert stream.send(60 * MS, sender=6, reset=True) is False


def test_stopped_sender_clock_is_a_jump():
    stream = Stream()
    stream.send(0)
    assert stream.send(1, ahead=-1) == Status.REFUSAL_CLOCK_JUMP
    assert stream.send(2, ahead=-1) is False  # it advanced since the last accepted command


def test_missing_commands_are_counted():
    stream = Stream()
    for k, step in enumerate((5, 1, 3, 1, 2)):
        stream.send(k * MS, step=step)
    assert stream.stream.lost == 2 + 1
    stream.send(9 * MS, step=2**62)
    assert stream.stream.lost == 2 + 1
    stream.send(10 * MS, step=1 - 2**62 + 999)
    assert stream.stream.lost == 2 + 1 + 999


# Settings


def of_a_check(name, value):
    """Returns settings in which a setting of the plausibility checks has the value."""
    return GuardSettings(plausibility=PlausibilitySettings(**{name: value}))


def numbers(schema):
    """Returns each number of a schema: name, default and range."""
    return [(f.name, f.default, f.metadata[RANGE]) for f in fields(schema) if type(f.default) in (int, float)]


#: All settings: prefix in messages, function that creates the settings, name, default and range.
SETTINGS = [
    *(("", lambda name, value: GuardSettings(**{name: value}), *row) for row in numbers(GuardSettings)),
    *(("plausibility.", of_a_check, *row) for row in numbers(PlausibilitySettings)),
]
#: Names of the tests, which must be equal in all processes.
each_setting = pytest.mark.parametrize(
    ("prefix", "create", "name", "default", "allowed"), SETTINGS, ids=[setting[2] for setting in SETTINGS]
)


@each_setting
def test_each_setting_has_bounds(prefix, create, name, default, allowed):
    for value in (allowed.low, default, allowed.high):
        create(name, value)
    step = 1 if isinstance(default, int) else 1e-9
    text = re.escape(f"guard settings: {prefix}{name} is ") + f".*; allowed: {allowed.low:g}"
    for value in (allowed.low - step, allowed.high + step, np.nan):
        with pytest.raises(StationError, match=text):
            create(name, value)


@each_setting
def test_settings_weaker_than_defaults_are_named(prefix, create, name, default, allowed):
    weaker, stronger = allowed.low, allowed.high
    if name not in WEAKER_IF_SMALLER:
        weaker, stronger = stronger, weaker
    assert create(name, default).weaker_than_default() == create(name, stronger).weaker_than_default() == ""
    text = f"{name} is {weaker:g} (default: {default:g})" if weaker != default else ""
    assert create(name, weaker).weaker_than_default() == text


@pytest.mark.parametrize("value", ["false", 1, None])
def test_resume_requires_operator_by_default(value):
    assert GuardSettings().resume_automatically is False
    assert GuardSettings(resume_automatically=True).weaker_than_default().startswith("resume_automatically is true")
    with pytest.raises(StationError, match="guard settings: resume_automatically must be true or false; got"):
        GuardSettings(resume_automatically=value)


def test_late_commands_do_not_act_again_without_an_operator():
    GuardSettings(expiry=0.5, resume_automatically=True)
    with pytest.raises(StationError, match=r"expiry is 0\.51; allowed with resume_automatically: up to 0\.5 s"):
        GuardSettings(expiry=0.51, resume_automatically=True)


def test_weaker_settings_are_in_the_status_and_warned():
    settings = GuardSettings(expiry=0.1)
    status = Status()
    fill_in_guard(status, Bench(settings=settings).guard)
    assert status.weaker_settings == "expiry is 0.1 (default: 0.05)"
    live = LiveStatusMaker(5, status).make(status, 1.0, 0)
    assert live.problem == "guard settings weaker than the defaults: expiry is 0.1 (default: 0.05)"
    weaker = "the guard protects the arm less than with its default settings: expiry is 0.1 (default: 0.05)"
    assert DvrkDriver(guard=settings).warnings() == [weaker] and DvrkDriver().warnings() == []
    assert "adds its own gravity compensation" in DvrkDriver(gravity_compensation=True).warnings()[0]
