"""Filters, periods and noise of signals with known results."""

import numpy as np
import pytest
from scipy.signal import lfilter

from dvrk_drake.analysis.observations import signals as module
from dvrk_drake.analysis.observations.motion_difference import Whitening
from dvrk_drake.analysis.observations.repetition import find_period, repeatability_floor
from dvrk_drake.analysis.observations.signals import (
    MOTION_FREQUENCY,
    ORDER,
    central_difference,
    correlation,
    cut_offs,
    low_pass,
    narrow_band,
    resample,
    spectra,
)

pytestmark = pytest.mark.numeric

RATE = 400.0
T = np.arange(4000) / RATE
INNER = slice(800, -800)  # away from the ends, where the filter swings in


def sine_and_cosine(x, frequency):
    """Returns the coefficients of a signal in sin(2 pi f t) and cos(2 pi f t)."""
    w = 2 * np.pi * frequency * T[INNER]
    return np.linalg.lstsq(np.column_stack([np.sin(w), np.cos(w)]), x[INNER], rcond=None)[0]


@pytest.mark.parametrize("frequency", [2.0, 10.0, 18.0, 20.0, 22.0, 40.0])
def test_low_pass_has_the_butterworth_gain_and_no_delay(frequency):
    in_phase, late = sine_and_cosine(low_pass(np.sin(2 * np.pi * frequency * T), RATE, 20.0), frequency)
    # The gain is Butterworth's |H|^2, because the filter runs both ways. The bilinear transform warps frequencies.
    ratio = np.tan(np.pi * frequency / RATE) / np.tan(np.pi * 20.0 / RATE)
    assert in_phase == pytest.approx(1 / (1 + ratio ** (2 * ORDER)), abs=1e-3)
    assert late == pytest.approx(0.0, abs=1e-3)


def test_correlation_is_the_sum_of_products():
    a, b = np.random.default_rng(0).normal(size=(2, 300)).cumsum(axis=1)
    np.testing.assert_allclose(correlation(a, b), np.correlate(a, b, "full"), rtol=1e-9, atol=1e-6)


def test_too_few_rows_for_the_filter_are_rejected():
    with pytest.raises(ValueError, match="requires more than 21 rows, got 21"):
        low_pass(np.zeros(21), RATE, 10.0)


def test_central_difference_is_exact_inside_a_parabola():
    x = np.column_stack([1.0 + 2.0 * T - 3.0 * T**2, -T])
    v = central_difference(x, RATE)
    np.testing.assert_allclose(v[1:-1], np.column_stack([2.0 - 6.0 * T, np.full(len(T), -1.0)])[1:-1], atol=1e-8)
    # One-sided at the ends: the derivative half a sample inwards.
    np.testing.assert_allclose(v[[0, -1], 0], 2.0 - 6.0 * (T[[0, -1]] + np.array([0.5, -0.5]) / RATE), atol=1e-8)


def test_resampling_does_not_overshoot_and_holds_the_ends():
    t = np.array([0.0, 0.1, 0.15, 0.4, 0.5])
    x = np.array([0.0, 0.0, 1.0, 1.0, 0.5])
    fine = np.linspace(0.0, 0.5, 501)
    y = resample(t, x, fine)
    np.testing.assert_allclose(resample(t, x, t), x, atol=1e-12)
    assert y.min() >= 0.0 and y.max() <= 1.0
    assert np.all(np.diff(y[100:151]) >= 0)
    np.testing.assert_allclose(resample(t, x, np.array([-1.0, 9.0])), [0.0, 0.5], atol=1e-12)
    np.testing.assert_allclose(resample(t, np.outer(t, [2.0, -1.0]), fine), np.outer(fine, [2.0, -1.0]), atol=1e-12)


def test_parts_of_a_long_signal_give_the_result_of_the_whole(monkeypatch):
    generator = np.random.default_rng(0)
    t, x = np.cumsum(generator.uniform(0.5, 2.0, 300)), generator.normal(size=(300, 5))
    times = np.concatenate([np.linspace(t[0] - 1, t[-1] + 1, 700), t[[40, 3]]])
    whole = resample(t, x, times), low_pass(x, RATE, [10.0, 10.0, 10.0, 300.0, 20.0])
    monkeypatch.setattr(module, "MAX_VALUES", 40)
    parts = resample(t, x, times), low_pass(x, RATE, [10.0, 10.0, 10.0, 300.0, 20.0])
    for expected, found in zip(whole, parts, strict=True):
        np.testing.assert_allclose(found, expected, atol=1e-12)


# Periods, repeatability and noise of synthetic signals with known values.


SLOW_RATE = 200.0
TIMES = np.arange(8000) / SLOW_RATE  # 40 s


def repeating(period, t=TIMES):
    """Returns positions (m, 2) of a joint with three harmonics and one with a fast second harmonic."""
    w = 2 * np.pi / period * t
    return np.column_stack([np.sin(w) + 0.5 * np.cos(2 * w) + 0.2 * np.sin(3 * w), np.cos(w) + 0.9 * np.sin(5 * w)])


@pytest.mark.parametrize("period", [2.5, 6.013, 11.7])
def test_the_period_of_a_motion_is_found(period):
    noise = 0.01 * np.random.default_rng(0).normal(size=(len(TIMES), 2))
    assert find_period(repeating(period) + noise, SLOW_RATE) == pytest.approx(period, abs=0.3 / SLOW_RATE)


def test_a_motion_that_does_not_repeat_has_no_period():
    generator = np.random.default_rng(1)
    assert find_period(np.cumsum(generator.normal(size=(2000, 2)), axis=0), SLOW_RATE) is None
    assert find_period(np.zeros((2000, 2)), SLOW_RATE) is None
    assert find_period(np.column_stack([TIMES, TIMES**2]), SLOW_RATE) is None
    # At 1.1 periods the overlap is too short.
    assert find_period(repeating(36.0), SLOW_RATE) is None


@pytest.mark.parametrize("noise", [0.0, 0.05, 0.3])
def test_repeatability_floor_equals_the_noise_share(noise):
    signal = repeating(5.0)
    tau = signal + noise * np.random.default_rng(2).normal(size=signal.shape)
    floor = repeatability_floor(tau, SLOW_RATE, 5.0, SLOW_RATE)  # a cut-off that lets all pass
    rms = np.sqrt(np.mean(signal**2, axis=0) + noise**2)
    np.testing.assert_allclose(floor, noise / rms, rtol=0.05, atol=1e-9)
    tau[:, 1] = 0.0
    assert np.isnan(repeatability_floor(tau, SLOW_RATE, 5.0, SLOW_RATE)[1])


@pytest.mark.parametrize("period", [5.0, None])
def test_spectra_separate_noise_from_signal(period):
    deviation = np.array([0.02, 0.2])
    signal = repeating(1.0)  # several times in each piece that a periodogram is made of
    x = signal + deviation * np.random.default_rng(3).normal(size=(len(TIMES), 2))
    of = spectra(x, SLOW_RATE, period)
    # White noise of variance s^2 has the density 2 s^2 / rate. The integral of a density is the variance.
    np.testing.assert_allclose(np.median(of.noise, axis=0), 2 * deviation**2 / SLOW_RATE, rtol=0.15, atol=1e-12)
    np.testing.assert_allclose(
        np.sum(of.signal, axis=0) * of.frequency[1], np.var(signal, axis=0), rtol=0.1, atol=1e-12
    )


def test_cut_off_is_where_noise_exceeds_the_signal():
    generator = np.random.default_rng(4)
    tones = np.arange(0.4, 12.0, 0.2)
    phases = generator.uniform(0, 2 * np.pi, len(tones))
    signal = np.sum(np.sin(2 * np.pi * tones * TIMES[:, None] + phases), axis=1)
    x = np.column_stack([signal, np.sin(2 * np.pi * 0.2 * TIMES)]) + 0.05 * generator.normal(size=(len(TIMES), 2))
    found = cut_offs(spectra(x, SLOW_RATE, 5.0))
    # The spectrum is smoothed over five lines of 0.4 Hz, and the window of a periodogram leaks into adjacent lines.
    assert 12.0 <= found[0] < 15.0
    assert MOTION_FREQUENCY <= found[1] < 4.0


def test_narrow_band_of_noise_is_detected():
    generator = np.random.default_rng(5)
    quiet = repeating(5.0) + 0.02 * generator.normal(size=(len(TIMES), 2))
    assert narrow_band(spectra(quiet, SLOW_RATE, 5.0), 0) is None
    # A tone with a random phase drift, so that it does not repeat with the motion.
    phase = 2 * np.pi * 40.0 * TIMES + np.cumsum(0.1 * generator.normal(size=len(TIMES)))
    hum = quiet + 0.3 * np.sin(phase)[:, None] * [1.0, 0.0]
    band = narrow_band(spectra(hum, SLOW_RATE, 5.0), 0)
    assert band.lower < 40.0 < band.upper < 45.0
    assert band.lower > 35.0
    assert band.share == pytest.approx(np.sqrt(0.3**2 / 2 / np.var(hum[:, 0])), rel=0.25)
    assert narrow_band(spectra(hum, SLOW_RATE, 5.0), 1) is None


# Whitening filter: an autoregressive error becomes white, and the filter is linear.


AR_RATE, CUT_OFF = 40.0, 5.0
STEP = 4


def autoregression(coefficients, rows, generator):
    """Returns a signal whose rows k, k + STEP, k + 2 STEP, ... are an autoregression, for each k < STEP."""
    x = np.empty(rows * STEP)
    for first in range(STEP):
        x[first::STEP] = lfilter([1.0], [1.0, *(-np.array(coefficients))], generator.normal(size=rows))
    return x


def test_estimates_the_autoregression_and_whitens():
    generator = np.random.default_rng(0)
    true = np.array([[1.2, -0.5], [0.0, 0.0]])
    x = np.column_stack([autoregression(coefficients, 5000, generator) for coefficients in true])
    whitening = Whitening.of(x, 2, AR_RATE, CUT_OFF)
    assert whitening.step == STEP and whitening.num_removed == 2 * STEP
    np.testing.assert_allclose(whitening.coefficients, true, atol=0.03)
    for channel in range(2):
        white = whitening(x[:, channel], channel)
        assert len(white) == len(x) - whitening.num_removed
        assert abs(np.corrcoef(white[STEP:], white[:-STEP])[0, 1]) < 0.02


def test_whitening_is_linear():
    generator = np.random.default_rng(1)
    x, y = generator.normal(size=(2, 100, 3))
    whitening = Whitening(np.array([[0.5, -0.2]]), 3)
    np.testing.assert_allclose(whitening(x + 2 * y, 0), whitening(x, 0) + 2 * whitening(y, 0), atol=1e-12)
    np.testing.assert_array_equal(Whitening.none(1)(x, 0), x)
