"""Times, velocities and efforts of known motions are recovered."""

from dataclasses import replace

import numpy as np
import pytest

from dvrk_drake.analysis.check.effort_lag import CUT_OFF, effort_lag
from dvrk_drake.analysis.observations.motion_difference import refuse_opposite_efforts
from dvrk_drake.analysis.observations.motion_grid import MotionSignals, motion_signals
from dvrk_drake.analysis.observations.true_time import increasing_times, repeated_rows, true_time, velocity_agreement
from dvrk_drake.errors import RecordingError
from dvrk_drake.recordings.recording import Recording

pytestmark = pytest.mark.numeric

RATE = 200.0
FREQUENCIES = np.array([0.31, 0.53, 0.83])  # [Hz]
INNER = slice(200, -200)


def motion(t):
    """Returns q, v, vd (m, 3) of joints that oscillate at 0.3 to 1.7 Hz."""
    w = 2 * np.pi * FREQUENCIES
    wt = w * t[:, None]
    q = np.sin(wt) + 0.3 * np.sin(2 * wt + 1.0)
    return q, w * (np.cos(wt) + 0.6 * np.cos(2 * wt + 1.0)), -(w**2) * (np.sin(wt) + 1.2 * np.sin(2 * wt + 1.0))


def recorded(at, t=None):
    """Returns rows at the true times `at`, recorded with the times `t`."""
    q, v, vd = motion(at)
    return Recording(q=q, qd=v, tau=2.0 * vd + q, t=at if t is None else t, source="motion.csv")


# Velocities


@pytest.mark.parametrize(("gain", "lag"), [(1.0, 0.0), (1.2, 0.0), (-1.0, 0.0), (1.0, 0.012), (0.9, -0.006)])
def test_gain_and_lag_of_recorded_velocities_are_estimated(gain, lag):
    t = np.arange(3000) / RATE
    found = velocity_agreement(motion(t)[0], gain * motion(t - lag)[1], RATE)
    np.testing.assert_allclose(found.gain, gain, rtol=0.01, atol=1e-12)
    np.testing.assert_allclose(found.lag, lag, atol=5e-4)
    assert np.all(found.mismatch < 0.01)
    assert np.all(found.agrees == (gain == 1.0 and lag == 0.0))


def test_velocity_of_a_joint_at_rest_is_not_evaluated():
    t = np.arange(2000) / RATE
    q, v, _ = motion(t)
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
    clock = true_time(recorded(at, even))
    assert clock.reconstructed
    assert clock.jitter == pytest.approx(0.2, rel=0.15)
    assert np.std(np.diff(clock.t) - intervals) < 0.02 * np.mean(intervals)
    kept = true_time(recorded(at))
    assert not kept.reconstructed and kept.jitter == 0.0
    np.testing.assert_array_equal(kept.t, at)


def test_repeated_rows_are_omitted():
    t = np.arange(400) / RATE
    whole = recorded(t)
    last = np.arange(400)
    last[[10, 11, 200]] = 9, 9, 199
    polled = replace(whole, q=whole.q[last], qd=whole.qd[last], tau=whole.tau[last])
    np.testing.assert_array_equal(np.flatnonzero(repeated_rows(polled)), [10, 11, 200])
    np.testing.assert_array_equal(true_time(polled).rows, np.setdiff1d(np.arange(400), [10, 11, 200]))
    # If only q repeats, the row is a new measurement. If nothing moves, rows may repeat.
    assert not np.any(repeated_rows(replace(whole, q=whole.q[last])))
    assert not np.any(repeated_rows(replace(polled, qd=np.zeros_like(polled.qd), q=0 * polled.q, tau=0 * polled.q)))


def test_times_that_do_not_increase_are_rejected():
    recording = recorded(np.arange(300) / RATE)
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
    recording = recorded(np.arange(3000) / RATE)
    qd = {"right": recording.qd, "none": None, "of the wrong sign": -recording.qd}[velocities]
    signals = motion_signals(replace(recording, qd=qd), true_time(replace(recording, qd=qd)), 20.0)
    assert signals.rate == pytest.approx(400.0)
    q, v, vd = motion(signals.t)
    inner = slice(400, -400)
    np.testing.assert_allclose(signals.q[inner], q[inner], atol=1e-4)
    np.testing.assert_allclose(signals.v[inner], v[inner], atol=5e-3)
    np.testing.assert_allclose(signals.vd[inner], vd[inner], atol=0.02 * np.abs(vd).max())
    np.testing.assert_allclose(signals.tau[inner], (2.0 * vd + q)[inner], atol=0.05)
    np.testing.assert_array_equal(signals.rows, np.arange(3000))
    with pytest.raises(RecordingError, match="has no efforts"):
        motion_signals(replace(recording, tau=None), true_time(replace(recording, tau=None)), 20.0)


# Efforts


def delayed(lag, coulomb=0.3):
    """Returns signals whose efforts (friction, inertia, gravity) are delayed by `lag` [s]."""
    t = np.arange(6000) / 400.0

    def tau(at):
        q, v, vd = motion(at)
        speed = np.sqrt(np.mean(v**2, axis=0))
        return coulomb * np.tanh(v / (0.1 * speed)) + 0.2 * v + 0.05 * vd + np.sin(q)

    noise = 0.02 * np.random.default_rng(1).normal(size=(len(t), 3))
    return MotionSignals(t, *motion(t), tau(t - lag) + noise, np.arange(len(t)), t)


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
    found = effort_lag(replace(signals, **repeated, t=t, row_times=t, rows=np.arange(len(t))), np.ones(3, bool))
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
    expected, names = motion(t)[0], ("yaw", "pitch", "roll")
    recording = Recording(q=expected, source="motion.csv")
    noise = np.random.default_rng(2).normal(size=expected.shape)
    # Offsets, a scale, noise and efforts that are unrelated to the model are accepted.
    refuse_opposite_efforts(recording, names, 5.0 + 0.2 * expected + 0.1 * noise, expected)
    refuse_opposite_efforts(recording, names, noise, expected)
    refuse_opposite_efforts(recording, names, 0 * expected, expected)
    with pytest.raises(RecordingError, match=r"motion\.csv: .*: pitch \(correlation -0\.\d+\)\. Check the signs"):
        refuse_opposite_efforts(recording, names, expected * [1.0, -1.0, 1.0] + 0.3 * noise, expected)
