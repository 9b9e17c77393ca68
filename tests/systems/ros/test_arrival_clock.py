"""Time and rate of measurements whose stamps come from another clock. The tests set both clocks."""

import numpy as np
import pytest

from dvrk_drake.systems.ros import arrival_clock
from dvrk_drake.systems.ros.arrival_clock import ArrivalClock

MS = 1_000_000  # [ns]
DAY = 86_400 * 10**9  # [ns]
START = 1_795_257_600 * 10**9  # time of day at which the monotonic clock is 0 [ns]


class Clocks:
    """Clocks of this computer, in place of the module `time`."""

    def __init__(self):
        self.now = 5_000 * MS

    def time_ns(self):
        return START + self.now

    def monotonic_ns(self):
        return self.now


@pytest.fixture
def clocks(monkeypatch):
    clocks = Clocks()
    monkeypatch.setattr(arrival_clock, "time", clocks)
    return clocks


def age(clock, clocks, stamp, *, delay=0.0):
    """Returns the age of a measurement that arrives `delay` [ms] from now [ms], and the text of a jump."""
    clocks.now += round(delay * MS)
    utime, jump = clock.convert(stamp, clocks.now)
    return 1e-3 * (clock.now() - utime), jump


@pytest.mark.parametrize("offset", [0, DAY, -DAY])
def test_constant_offset_of_the_clocks_is_no_age(clocks, offset):
    clock = ArrivalClock()
    for _ in range(300):
        clocks.now += MS
        assert age(clock, clocks, START + clocks.now + offset) == (0.0, "")


def test_clock_is_the_time_of_day_and_does_not_jump_with_it(clocks, monkeypatch):
    clock = ArrivalClock()
    assert clock.now() == (START + clocks.now) // 1000
    before = clock.now()
    monkeypatch.setattr(clocks, "time_ns", lambda: 0)
    clocks.now += 7 * MS
    assert clock.now() - before == 7000


def test_late_message_has_its_delay_as_age(clocks):
    clock = ArrivalClock()
    for _ in range(100):
        clocks.now += MS
        assert age(clock, clocks, START + clocks.now, delay=0.4)[0] == pytest.approx(0.0)
    stamp = START + clocks.now
    assert age(clock, clocks, stamp + MS, delay=31.0) == (pytest.approx(29.6, abs=0.05), "")
    # The shortest delay remains the reference. It increases by 1 ms per second.
    assert age(clock, clocks, START + clocks.now, delay=0.4) == (pytest.approx(0.0, abs=0.05), "")


def test_delay_that_begins_later_is_detected_for_minutes(clocks):
    clock = ArrivalClock()
    for _ in range(1000):
        clocks.now += MS
        age(clock, clocks, START + clocks.now)
    clocks.now += 200 * MS
    for _ in range(100_000):
        clocks.now += MS
        late = age(clock, clocks, START + clocks.now - 200 * MS)[0]
    assert late == pytest.approx(99.8, abs=0.1)


def test_long_gap_is_no_jump(clocks):
    clock = ArrivalClock()
    for pause in (1, 200_000, 1):
        clocks.now += pause * MS
        assert age(clock, clocks, START + clocks.now) == (pytest.approx(0.0), "")


@pytest.mark.parametrize("drift", [1e-3, 2e-4, -2e-4, -1e-3])
def test_drift_of_the_clocks_is_no_age(clocks, drift):
    clock = ArrivalClock()
    ages = []
    for k in range(60_000):
        clocks.now += MS
        ages.append(age(clock, clocks, START + round(k * MS * (1 + drift)))[0])
    assert max(ages) <= 0.01
    assert min(ages) >= 0.0


@pytest.mark.parametrize("jump", [0.2, 3600.0, -0.002, -3600.0])
def test_jump_of_the_stamp_is_reported_once(clocks, jump):
    clock = ArrivalClock()
    for _ in range(200):
        clocks.now += MS
        age(clock, clocks, START + clocks.now)
    clocks.now += MS
    shift = round(1e9 * jump)
    _, text = age(clock, clocks, START + clocks.now + shift)
    assert text == f"the time stamp changed by {jump + 0.001:.3f} s since the previous message"
    assert clock.rate is None
    for _ in range(100):
        clocks.now += MS
        assert age(clock, clocks, START + clocks.now + shift) == (0.0, "")
    assert clock.rate == pytest.approx(1000.0)


def test_times_increase_over_jumps(clocks):
    clock, times = ArrivalClock(), []
    generator = np.random.default_rng(1)
    for _ in range(2000):
        clocks.now += MS
        stamp = START + clocks.now + int(generator.choice([0, 0, 0, DAY, -DAY, 300_000, -(2**40)]))
        times.append(clock.convert(stamp, clocks.now)[0])
        assert times[-1] <= clock.now()
    assert np.all(np.diff(times) > 0)


def test_repeated_stamp_has_the_same_time(clocks):
    clock = ArrivalClock()
    clocks.now += MS
    stamp = START + clocks.now
    first = clock.convert(stamp, clocks.now)
    clocks.now += 40 * MS
    assert clock.convert(stamp, clocks.now) == first
    assert age(clock, clocks, stamp)[0] == pytest.approx(40.0)


@pytest.mark.parametrize("rate", [100.0, 500.0, 1000.0, 1500.0])
def test_rate_is_the_median_and_ignores_gaps(clocks, rate):
    clock = ArrivalClock()
    assert clock.rate is None
    for k in range(120):
        step = 10 if k % 10 == 0 else 1
        clocks.now += round(step * 1e9 / rate)
        clock.convert(START + clocks.now, clocks.now)
        assert (clock.rate is None) == (k < 99)
    assert clock.rate == pytest.approx(rate, rel=1e-3)
