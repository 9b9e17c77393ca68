"""Filtering, differentiation and resampling of signals with known results."""

import numpy as np
import pytest

from dvrk_drake.analysis.observations import low_pass as module
from dvrk_drake.analysis.observations.low_pass import ORDER, central_difference, correlation, low_pass, resample

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


def test_low_pass_halves_the_amplitude_at_each_columns_cut_off():
    cut_offs = np.array([10.0, 30.0, 200.0, 500.0])
    x = np.sin(2 * np.pi * np.array([10.0, 30.0, 30.0, 30.0]) * T[:, None])
    y = low_pass(x, RATE, cut_offs)
    for column, frequency, gain in zip(y.T, (10.0, 30.0), (0.5, 0.5), strict=False):
        assert sine_and_cosine(column, frequency)[0] == pytest.approx(gain, abs=1e-3)
    np.testing.assert_array_equal(y[:, 2:], x[:, 2:])  # at half the rate and above a column stays as it is
    np.testing.assert_allclose(low_pass(x[:, 0], RATE, 10.0), y[:, 0], atol=1e-12)
    np.testing.assert_allclose(low_pass(np.full(400, 3.0), RATE, 5.0), 3.0, rtol=1e-9, atol=1e-12)


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
