"""Conversion of JointState messages to measurements, without DDS."""

import numpy as np
import pytest

from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.systems.ros import crtk_client
from dvrk_drake.systems.ros.crtk_client import ArrivalClock, JointStateReader, shown
from dvrk_drake.systems.ros.messages import Header, JointState, Time

pytest.importorskip("cyclonedds", reason="needs cyclonedds")


MTML, PSM = load_arm("mtml"), load_arm("psm")
STAMP = Header(Time(1_795_257_600, 1))
MS = 1_000_000
ROWS = np.arange(21.0).reshape(3, 7) / 10


def message(names=MTML.joint_names, rows=ROWS, header=STAMP):
    return JointState(header, list(names), *(list(map(float, row)) for row in rows))


def read(sent, arm=MTML):
    return JointStateReader(arm, "/A/measured_js").read(sent, 7)


def test_message_is_converted():
    found = read(message())
    np.testing.assert_array_equal([found.q, found.v, found.effort], ROWS)
    assert (found.stamp, found.arrival, found.problem) == (1_795_257_600 * 10**9 + 1, 7, "")


def test_joints_may_be_in_any_order_and_have_others_between():
    reader = JointStateReader(MTML, "/A/measured_js")
    for seed in range(5):
        names = np.random.default_rng(seed).permutation([*MTML.joint_names, "gripper"])
        values = {name: k for k, name in enumerate(MTML.joint_names)} | {"gripper": np.nan}
        rows = [[values[name] + 10 * row for name in names] for row in range(3)]
        found = reader.read(message(names, rows), 0)
        np.testing.assert_array_equal(found.q, range(7))
        np.testing.assert_array_equal(found.effort, range(20, 27))
        assert not found.problem


@pytest.mark.parametrize(
    ("sent", "problem"),
    [
        (message(header=Header()), "/A/measured_js: header stamp 0 marks invalid data. Home the arm"),
        (
            message(MTML.joint_names[1:], ROWS[:, 1:]),
            "/A/measured_js has the joints shoulder_pitch, elbow_pitch, wrist_platform, wrist_pitch, wrist_yaw, "
            "wrist_roll; MTML also needs outer_yaw",
        ),
        (
            message(rows=[ROWS[0], ROWS[1, :6], []]),
            "/A/measured_js has 7 positions, 6 velocities and 0 efforts; required: 7 each",
        ),
        (message([], [[], [], []]), "/A/measured_js has the joints none; MTML also needs outer_yaw, shoulder_pitch"),
        (message([]), "/A/measured_js has the joints none; MTML also needs outer_yaw, shoulder_pitch"),
        (message(["a\nb"] * 7), "/A/measured_js has the joints 'a\\nb', 'a\\nb', 'a\\nb'"),
        *(
            (message(rows=np.where(value == ROWS, bad, ROWS)), "/A/measured_js: a position or velocity is not finite")
            for bad in (np.nan, np.inf, -np.inf)
            for value in (0.3, 1.0)
        ),
    ],
)
def test_message_that_cannot_be_used_has_no_numbers(sent, problem):
    found = read(sent)
    assert found.problem.startswith(problem)
    assert "\n" not in found.problem and len(found.problem) < 500
    assert np.isnan([found.q, found.v, found.effort]).all()


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_effort_that_is_not_finite_is_passed_on(bad):
    rows = np.where(ROWS == 2.0, bad, ROWS)
    found = read(message(rows=rows))
    np.testing.assert_array_equal([found.q, found.v, found.effort], rows)
    assert found.problem == ""


def jaw(header=STAMP, values=(0.1, 0.2, 0.3)):
    return JointState(header, ["jaw"], *([value] for value in values))


def psm_message():
    return message(PSM.joint_names[:6], ROWS[:, :6])


def test_jaw_has_messages_of_its_own():
    reader = JointStateReader(PSM, "/PSM1/measured_js")
    reader.read_jaw(jaw(), 100 * MS)
    found = reader.read(psm_message(), 101 * MS)
    np.testing.assert_allclose([found.q[6], found.v[6], found.effort[6]], [0.1, 0.2, 0.3], rtol=0, atol=1e-12)
    np.testing.assert_array_equal(found.q[:6], ROWS[0, :6])
    # The age of the jaw does not change the time of arrival, from which the difference of the clocks is determined.
    assert (found.arrival, found.problem) == (101 * MS, "")


@pytest.mark.parametrize(
    ("sent", "arrival"),
    [
        (None, 0),
        (jaw(Header()), 100 * MS),
        (JointState(STAMP, ["jaw"], [0.1], [0.1], []), 100 * MS),
        (JointState(STAMP, ["jaw"], [0.1, 0.2], [0.1], [0.1]), 100 * MS),
    ],
)
def test_missing_or_invalid_jaw_is_a_problem(sent, arrival):
    reader = JointStateReader(PSM, "/PSM1/measured_js")
    if sent is not None:
        reader.read_jaw(jaw(), 99 * MS)
        reader.read_jaw(sent, arrival)
    found = reader.read(psm_message(), 100 * MS)
    assert found.problem == "no valid message on /PSM1/jaw/measured_js"
    assert np.isnan(found.q).all()


@pytest.mark.parametrize(("period", "accepted"), [(1, 20), (10, 2), (30, 2)])
def test_jaw_is_out_of_date_after_20_ms_and_2_measurements(period, accepted):
    """A dVRK may publish at 100 Hz with a delay of several periods, first the arm and then the jaw."""
    reader = JointStateReader(PSM, "/PSM1/measured_js")
    reader.read_jaw(jaw(), 100 * MS)
    found = [reader.read(psm_message(), (100 + k * period) * MS) for k in range(1, 30)]
    assert [not each.problem for each in found] == [k <= accepted for k in range(1, 30)]
    reader.read_jaw(jaw(), 2000 * MS)
    assert not reader.read(psm_message(), 2001 * MS).problem


def test_jaw_that_is_not_finite_is_a_problem():
    reader = JointStateReader(PSM, "/PSM1/measured_js")
    reader.read_jaw(jaw(values=(0.1, np.nan, 0.1)), 100 * MS)
    assert "not finite" in reader.read(psm_message(), 100 * MS).problem


def test_received_text_is_short_and_on_one_line():
    assert shown("ENABLED") == "ENABLED"
    assert shown("a\nb") == "'a\\nb'"
    assert len(shown("x" * 10**6)) < 50


# Time and rate of measurements whose stamps come from another clock. The tests set both clocks.


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
    monkeypatch.setattr(crtk_client, "time", clocks)
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
