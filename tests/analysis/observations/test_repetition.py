"""Periods, repeatability and noise of synthetic signals with known values."""

import numpy as np
import pytest

from dvrk_drake.analysis.observations.noise import MOTION_FREQUENCY, cut_offs, narrow_band, spectra
from dvrk_drake.analysis.observations.observations import Observations
from dvrk_drake.analysis.observations.repetition import find_period, motion_floor, repeatability_floor
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.recordings.recording import Recording

pytestmark = pytest.mark.numeric

RATE = 200.0
T = np.arange(8000) / RATE  # 40 s


def repeating(period, t=T):
    """Returns positions (m, 2) of a joint with three harmonics and one with a fast second harmonic."""
    w = 2 * np.pi / period * t
    return np.column_stack([np.sin(w) + 0.5 * np.cos(2 * w) + 0.2 * np.sin(3 * w), np.cos(w) + 0.9 * np.sin(5 * w)])


@pytest.mark.parametrize("period", [2.5, 6.013, 11.7])
def test_the_period_of_a_motion_is_found(period):
    noise = 0.01 * np.random.default_rng(0).normal(size=(len(T), 2))
    assert find_period(repeating(period) + noise, RATE) == pytest.approx(period, abs=0.3 / RATE)


def test_a_motion_that_does_not_repeat_has_no_period():
    generator = np.random.default_rng(1)
    assert find_period(np.cumsum(generator.normal(size=(2000, 2)), axis=0), RATE) is None
    assert find_period(np.zeros((2000, 2)), RATE) is None
    assert find_period(np.column_stack([T, T**2]), RATE) is None
    # At 1.1 periods the overlap is too short.
    assert find_period(repeating(36.0), RATE) is None


@pytest.mark.parametrize("noise", [0.0, 0.05, 0.3])
def test_repeatability_floor_equals_the_noise_share(noise):
    signal = repeating(5.0)
    tau = signal + noise * np.random.default_rng(2).normal(size=signal.shape)
    floor = repeatability_floor(tau, RATE, 5.0, RATE)  # a cut-off that lets all pass
    rms = np.sqrt(np.mean(signal**2, axis=0) + noise**2)
    np.testing.assert_allclose(floor, noise / rms, rtol=0.05, atol=1e-9)
    tau[:, 1] = 0.0
    assert np.isnan(repeatability_floor(tau, RATE, 5.0, RATE)[1])


def test_lost_rows_do_not_change_the_repeatability():
    arm, t = load_arm("psm"), np.arange(1000) / 50
    phase = 2 * np.pi / 5 * t[:, None] * np.array([1, 2, 1, 3, 2, 1, 3]) + np.arange(7)
    noise = np.random.default_rng(6).normal(size=phase.shape)
    q = (arm.position_lower + arm.position_upper) / 2 + 0.2 * (arm.position_upper - arm.position_lower) * np.sin(phase)
    whole = Recording(q, arm.effort_limits * (0.2 * np.cos(phase) + 0.002 * noise), t=t, coordinates="actuator")
    floors = []
    for recording in (whole, whole.select(np.delete(np.arange(1000), [300, 666]))):
        grid = Observations(recording, arm).grid
        floors.append(motion_floor(recording.tau, grid, 5.0))
    # Two interpolated rows hardly change an RMS value of 1000 rows.
    np.testing.assert_allclose(floors[1], floors[0], rtol=0.1, atol=1e-6)


@pytest.mark.parametrize("period", [5.0, None])
def test_spectra_separate_noise_from_signal(period):
    deviation = np.array([0.02, 0.2])
    signal = repeating(1.0)  # several times in each piece that a periodogram is made of
    x = signal + deviation * np.random.default_rng(3).normal(size=(len(T), 2))
    of = spectra(x, RATE, period)
    # White noise of variance s^2 has the density 2 s^2 / rate. The integral of a density is the variance.
    np.testing.assert_allclose(np.median(of.noise, axis=0), 2 * deviation**2 / RATE, rtol=0.15, atol=1e-12)
    np.testing.assert_allclose(
        np.sum(of.signal, axis=0) * of.frequency[1], np.var(signal, axis=0), rtol=0.1, atol=1e-12
    )


def test_cut_off_is_where_noise_exceeds_the_signal():
    generator = np.random.default_rng(4)
    tones = np.arange(0.4, 12.0, 0.2)
    phases = generator.uniform(0, 2 * np.pi, len(tones))
    signal = np.sum(np.sin(2 * np.pi * tones * T[:, None] + phases), axis=1)
    x = np.column_stack([signal, np.sin(2 * np.pi * 0.2 * T)]) + 0.05 * generator.normal(size=(len(T), 2))
    found = cut_offs(spectra(x, RATE, 5.0))
    # The spectrum is smoothed over five lines of 0.4 Hz, and the window of a periodogram leaks into adjacent lines.
    assert 12.0 <= found[0] < 15.0
    assert MOTION_FREQUENCY <= found[1] < 4.0


def test_narrow_band_of_noise_is_detected():
    generator = np.random.default_rng(5)
    quiet = repeating(5.0) + 0.02 * generator.normal(size=(len(T), 2))
    assert narrow_band(spectra(quiet, RATE, 5.0), 0) is None
    # A tone with a random phase drift, so that it does not repeat with the motion.
    phase = 2 * np.pi * 40.0 * T + np.cumsum(0.1 * generator.normal(size=len(T)))
    hum = quiet + 0.3 * np.sin(phase)[:, None] * [1.0, 0.0]
    band = narrow_band(spectra(hum, RATE, 5.0), 0)
    assert band.lower < 40.0 < band.upper < 45.0
    assert band.lower > 35.0
    assert band.share == pytest.approx(np.sqrt(0.3**2 / 2 / np.var(hum[:, 0])), rel=0.25)
    assert narrow_band(spectra(hum, RATE, 5.0), 1) is None
