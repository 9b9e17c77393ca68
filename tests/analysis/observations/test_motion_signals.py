"""Times, velocities and efforts of known motions, and their grid."""

from dataclasses import replace

import numpy as np
import pytest
from motions import friction_everywhere, true_dynamics

import dvrk_drake.analysis.observations.motion_grid as motion_grid_module
from dvrk_drake.analysis.check.effort_lag import CUT_OFF, effort_lag
from dvrk_drake.analysis.observations.motion_difference import drive_efforts, refuse_opposite_efforts
from dvrk_drake.analysis.observations.motion_grid import GRID_RATE, MotionSignals, motion_signals
from dvrk_drake.analysis.observations.observations import Observations
from dvrk_drake.analysis.observations.repetition import CORRELATION_TIME, FOLDS, phase_folds
from dvrk_drake.analysis.observations.true_time import increasing_times, repeated_rows, true_time, velocity_agreement
from dvrk_drake.dynamics.dynamic_section import SignalSettings
from dvrk_drake.errors import RecordingError
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.recordings.recording import Recording

pytestmark = pytest.mark.numeric

ARM = load_arm("mtml")
N = ARM.num_joints
PERIOD = 4.0


def motion(t):
    """Returns q, v, vd (m, n) within the arm's limits, with a period of 4 s."""
    middle, half = (ARM.position_upper + ARM.position_lower) / 2, (ARM.position_upper - ARM.position_lower) / 2
    w, size = 2 * np.pi / PERIOD * np.array([1, 2, 1, 3, 2, 1, 2]), 0.3 * np.minimum(half, 1.0)
    wt = w * t[:, None] + np.arange(N)
    return middle + size * np.sin(wt), size * w * np.cos(wt), -size * w**2 * np.sin(wt)


def recorded(seconds=12.0, rate=200.0):
    t = 5.0 + np.arange(round(seconds * rate) + 1) / rate
    q, v, vd = motion(t)
    return Recording(q=q, qd=v, tau=vd, t=t, source="motion.csv")


@pytest.fixture(scope="module")
def observations():
    return Observations(recorded(), ARM)


@pytest.fixture(scope="module")
def grid(observations):
    return observations.grid


def test_grid_reproduces_the_motion(grid):
    inner = slice(400, -400)
    for found, true in zip((grid.q, grid.v, grid.vd), motion(grid.t), strict=True):
        np.testing.assert_allclose(found[inner], true[inner], atol=0.02 * np.abs(true - true.mean(axis=0)).max())
    assert grid.rate == pytest.approx(200.0)
    np.testing.assert_allclose(np.diff(grid.t), 1 / GRID_RATE, atol=1e-9)
    np.testing.assert_allclose(grid.row_times, 5.0 + np.arange(2401) / 200, atol=1e-9)
    assert grid.inner == slice(120, 2281, 1)  # a twentieth of the motion is left out at each end


def test_parts_give_the_filtered_values_of_the_whole_motion(grid, monkeypatch):
    thinned = replace(Observations(recorded(40.0), ARM).grid, step=3)
    monkeypatch.setattr(motion_grid_module, "PART_ROWS", 1500)
    parts = list(thinned.parts())
    assert len(parts) == 5
    # The square wave has all frequencies, so errors at the ends of the parts would be visible.
    square = np.sign(np.sin(3 * thinned.t))
    expected = thinned.filter_efforts(thinned.at_rows(square, 0))
    found = []
    for part, rows in parts:
        of_part = np.sign(np.sin(3 * part.t))
        found.append(part.filter_rows(part.at_rows(of_part, 0), rows))
    np.testing.assert_allclose(np.concatenate(found), expected, rtol=0, atol=1e-9)
    assert len(expected) == len(thinned.inner_rows) and np.all(np.diff(thinned.inner_rows) == 3)


def test_predicted_efforts_have_the_effort_delay(grid):
    delays = [0.0, 0.004, -0.01, 0.0, 0.02, 0.0, 0.0]
    settings = SignalSettings(50.0, [20.0] * N, 20.0, delays)
    late = replace(grid, settings=settings)
    lines = np.tile((grid.t - 5.0)[:, None], (1, N))
    rows = late.efforts_at_rows(lines)[late.inner]
    np.testing.assert_allclose(rows, grid.row_times[grid.inner, None] - 5.0 - np.array(delays), atol=1e-9)
    # The low-pass filter does not change a straight line.
    np.testing.assert_allclose(late.filter_efforts(late.efforts_at_rows(lines)), rows, atol=1e-3)


@pytest.mark.parametrize(("seconds", "rate"), [(1.9, 200.0), (12.0, 45.0)])
def test_short_and_coarse_motions_are_rejected(seconds, rate):
    with pytest.raises(RecordingError, match=rf"motion\.csv: .* {seconds} s at {rate:g} Hz. .* at least 2 s"):
        _ = Observations(recorded(seconds, rate), ARM).grid


# Folds


def test_folds_of_a_periodic_motion_follow_the_phase(observations, grid):
    assert observations.period == pytest.approx(PERIOD, abs=1e-3)
    fold, edge = phase_folds(grid, PERIOD)
    t = grid.row_times[grid.inner]
    # With 200 rows per second and 800 per period, a row and the row one period later are in the same fold.
    np.testing.assert_array_equal(fold[800:1600], fold[:800])
    np.testing.assert_allclose(np.bincount(fold[:800]), 800 / FOLDS, atol=1)
    phase = (t - t[0]) % PERIOD
    since = phase - fold * PERIOD / FOLDS
    # Without the rows at the end of the time, which rounding errors assign.
    inside, outside = CORRELATION_TIME - 1e-6, CORRELATION_TIME + 1e-6
    assert np.all(edge[:, 0][since < inside]) and not np.any(edge[:, 0][since > outside])
    until = PERIOD / FOLDS - since
    assert np.all(edge[:, 1][until < inside]) and not np.any(edge[:, 1][until > outside])


def test_folds_of_an_aperiodic_motion_are_contiguous(grid):
    fold, _ = phase_folds(grid, None, 5)
    assert np.all(np.diff(fold) >= 0)
    np.testing.assert_allclose(np.bincount(fold), len(fold) / 5, atol=1)
    slow = Observations(recorded(), ARM)
    slow.grid = replace(grid, q=np.linspace(0, 1, 4000)[:, None] * np.ones(N))
    assert slow.period is None


# Efforts


def test_parts_of_the_efforts_add_up_to_the_model(grid):
    t = np.arange(0, 8, 1e-3)
    effects = friction_everywhere(ARM, (t, *motion(t)))
    model = true_dynamics(ARM, np.random.default_rng(0), effects)
    efforts = drive_efforts(model, grid)
    whole = grid.filter_efforts(grid.efforts_at_rows(model.effort(grid.q, grid.v, grid.vd)))
    size = np.sqrt(np.mean(whole**2, axis=0))
    np.testing.assert_allclose(efforts.total() / size, whole / size, atol=1e-6)
    parts = efforts.friction_part("dry") + efforts.friction_part("viscous")
    np.testing.assert_allclose((efforts.other + parts) / size, whole / size, atol=1e-6)
    # Viscous friction is proportional to the actuators' speeds.
    speed = grid.filter_efforts(grid.efforts_at_rows(ARM.transmission.velocity(grid.v)))
    viscous = [effect.coefficient for effect in effects if effect.kind == "viscous"]
    np.testing.assert_allclose(efforts.friction_part("viscous") / size, speed * viscous / size, atol=1e-6)
    assert set(efforts.friction) == {(effect.coordinate, part) for effect in effects for part in ("dry", "viscous")}
    assert np.all(efforts.friction_part("dry").std(axis=0) > 0.1 * size)


# Times, velocities and efforts of known motions are recovered.


RATE = 200.0
FREQUENCIES = np.array([0.31, 0.53, 0.83])  # [Hz]


def oscillation(t):
    """Returns q, v, vd (m, 3) of joints that oscillate at 0.3 to 1.7 Hz."""
    w = 2 * np.pi * FREQUENCIES
    wt = w * t[:, None]
    q = np.sin(wt) + 0.3 * np.sin(2 * wt + 1.0)
    return q, w * (np.cos(wt) + 0.6 * np.cos(2 * wt + 1.0)), -(w**2) * (np.sin(wt) + 1.2 * np.sin(2 * wt + 1.0))


def recorded_at(at, t=None):
    """Returns rows at the true times `at`, recorded with the times `t`."""
    q, v, vd = oscillation(at)
    return Recording(q=q, qd=v, tau=2.0 * vd + q, t=at if t is None else t, source="motion.csv")


# Velocities


@pytest.mark.parametrize(("gain", "lag"), [(1.0, 0.0), (1.2, 0.0), (-1.0, 0.0), (1.0, 0.012), (0.9, -0.006)])
def test_gain_and_lag_of_recorded_velocities_are_estimated(gain, lag):
    t = np.arange(3000) / RATE
    found = velocity_agreement(oscillation(t)[0], gain * oscillation(t - lag)[1], RATE)
    np.testing.assert_allclose(found.gain, gain, rtol=0.01, atol=1e-12)
    np.testing.assert_allclose(found.lag, lag, atol=5e-4)
    assert np.all(found.mismatch < 0.01)
    assert np.all(found.agrees == (gain == 1.0 and lag == 0.0))


def test_velocity_of_a_joint_at_rest_is_not_evaluated():
    t = np.arange(2000) / RATE
    q, v, _ = oscillation(t)
    q[:, 1] = 0.4
    v[:, 2] = 0.0
    found = velocity_agreement(q, v, RATE)
    assert np.isnan(found.gain[1]) and np.isnan(found.lag[1])
    assert (found.gain[2], found.mismatch[2]) == (0.0, 1.0)
    np.testing.assert_array_equal(found.agrees, [True, False, False])


# Times


def test_true_times_follow_from_positions_and_velocities():
    generator = np.random.default_rng(0)
    intervals = generator.gamma(25.0, 1 / (25.0 * RATE), 2000)  # 20 % jitter
    at = np.concatenate([[0.0], np.cumsum(intervals)])
    even = np.linspace(at[0], at[-1], len(at))
    clock = true_time(recorded_at(at, even))
    assert clock.reconstructed
    assert clock.jitter == pytest.approx(0.2, rel=0.15)
    assert np.std(np.diff(clock.t) - intervals) < 0.02 * np.mean(intervals)
    kept = true_time(recorded_at(at))
    assert not kept.reconstructed and kept.jitter == 0.0
    np.testing.assert_array_equal(kept.t, at)


def test_repeated_rows_are_omitted():
    t = np.arange(400) / RATE
    whole = recorded_at(t)
    last = np.arange(400)
    last[[10, 11, 200]] = 9, 9, 199
    polled = replace(whole, q=whole.q[last], qd=whole.qd[last], tau=whole.tau[last])
    np.testing.assert_array_equal(np.flatnonzero(repeated_rows(polled)), [10, 11, 200])
    np.testing.assert_array_equal(true_time(polled).rows, np.setdiff1d(np.arange(400), [10, 11, 200]))
    # If only q repeats, the row is a new measurement. If nothing moves, rows may repeat.
    assert not np.any(repeated_rows(replace(whole, q=whole.q[last])))
    assert not np.any(repeated_rows(replace(polled, qd=np.zeros_like(polled.qd), q=0 * polled.q, tau=0 * polled.q)))


def test_times_that_do_not_increase_are_rejected():
    recording = recorded_at(np.arange(300) / RATE)
    for row, t in ((150, 0.7), (150, 0.745)):
        times = recording.t.copy()
        times[row] = t
        with pytest.raises(RecordingError, match=r"motion\.csv, row 151: t = 0\.7\d* s is not greater than 0\.745"):
            increasing_times(replace(recording, t=times))
    with pytest.raises(RecordingError, match="the recording has no times"):
        increasing_times(replace(recording, t=None))


# Both together


@pytest.mark.parametrize("velocities", ["right", "none", "of the wrong sign"])
def test_signals_reproduce_the_motion(velocities):
    recording = recorded_at(np.arange(3000) / RATE)
    qd = {"right": recording.qd, "none": None, "of the wrong sign": -recording.qd}[velocities]
    signals = motion_signals(replace(recording, qd=qd), true_time(replace(recording, qd=qd)), 20.0)
    assert signals.rate == pytest.approx(400.0)
    q, v, vd = oscillation(signals.t)
    inner = slice(400, -400)
    np.testing.assert_allclose(signals.q[inner], q[inner], atol=1e-4)
    np.testing.assert_allclose(signals.v[inner], v[inner], atol=5e-3)
    np.testing.assert_allclose(signals.vd[inner], vd[inner], atol=0.02 * np.abs(vd).max())
    np.testing.assert_allclose(signals.tau[inner], (2.0 * vd + q)[inner], atol=0.05)
    with pytest.raises(RecordingError, match="has no efforts"):
        motion_signals(replace(recording, tau=None), true_time(replace(recording, tau=None)), 20.0)


# Efforts


def delayed(lag, coulomb=0.3):
    """Returns signals whose efforts (friction, inertia, gravity) are delayed by `lag` [s]."""
    t = np.arange(6000) / 400.0

    def tau(at):
        q, v, vd = oscillation(at)
        speed = np.sqrt(np.mean(v**2, axis=0))
        return coulomb * np.tanh(v / (0.1 * speed)) + 0.2 * v + 0.05 * vd + np.sin(q)

    noise = 0.02 * np.random.default_rng(1).normal(size=(len(t), 3))
    return MotionSignals(t, *oscillation(t), tau(t - lag) + noise)


@pytest.mark.parametrize("lag", [-0.01, 0.0, 0.005, 0.018])
def test_delay_of_the_efforts_is_estimated(lag):
    found = effort_lag(delayed(lag), np.ones(3, bool))
    np.testing.assert_allclose(found.lag, lag, atol=1e-3)
    assert np.all(found.determined == (lag != 0.0))
    assert np.all(found.standard_error < 1e-3)
    # A step of friction is not fitted completely at another time.
    np.testing.assert_allclose(found.coulomb, 0.3, rtol=0.02 if lag == 0.0 else 0.5, atol=1e-12)
    assert np.all(found.gain >= 1.0)


def test_friction_of_efforts_with_the_wrong_sign_is_negative():
    signals = delayed(0.0)
    found = effort_lag(replace(signals, tau=-signals.tau), np.ones(3, bool))
    np.testing.assert_allclose(found.coulomb, -0.3, rtol=0.02, atol=1e-12)
    assert np.all(np.abs(found.coulomb) > 5 * found.coulomb_error)


def test_significance_of_friction_does_not_grow_with_repetitions():
    """Repetitions of a motion have the same errors of the simple model, so they are no further evidence."""
    signals = delayed(0.0)
    once = effort_lag(signals, np.ones(3, bool))
    repeated = {name: np.tile(getattr(signals, name), (8, 1)) for name in ("q", "v", "vd", "tau")}
    t = np.arange(len(repeated["q"])) / signals.rate
    found = effort_lag(replace(signals, **repeated, t=t), np.ones(3, bool))
    # The ends of the motion are omitted once instead of eight times.
    np.testing.assert_allclose(found.coulomb / found.coulomb_error, once.coulomb / once.coulomb_error, rtol=0.1, atol=0)


def test_a_joint_or_an_effort_at_rest_has_no_lag():
    signals = delayed(0.01)
    tau = signals.tau.copy()
    tau[:, 2] = 0.0
    found = effort_lag(replace(signals, tau=tau), np.array([True, False, True]))
    np.testing.assert_array_equal(np.isnan(found.lag), [False, True, True])
    np.testing.assert_array_equal(found.determined, [True, False, False])
    assert signals.rate > 2 * CUT_OFF


def test_efforts_opposite_to_the_model_are_rejected():
    t = np.arange(1000) / RATE
    expected, names = oscillation(t)[0], ("yaw", "pitch", "roll")
    recording = Recording(q=expected, source="motion.csv")
    noise = np.random.default_rng(2).normal(size=expected.shape)
    # Offsets, a scale, noise and efforts that are unrelated to the model are accepted.
    refuse_opposite_efforts(recording, names, 5.0 + 0.2 * expected + 0.1 * noise, expected)
    refuse_opposite_efforts(recording, names, noise, expected)
    refuse_opposite_efforts(recording, names, 0 * expected, expected)
    with pytest.raises(RecordingError, match=r"motion\.csv: .*: pitch \(correlation -0\.\d+\)\. Check the signs"):
        refuse_opposite_efforts(recording, names, expected * [1.0, -1.0, 1.0] + 0.3 * noise, expected)
