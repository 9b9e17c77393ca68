"""Compares the compiled sine and cosine with numpy."""

from __future__ import annotations

import numpy as np
import pytest

from dvrk_drake.dynamics.compiled import sin_cos

pytestmark = pytest.mark.numeric

#: Tolerance for numbers below 1 after a few rounding operations.
ROUNDING = 4 * np.finfo(float).eps


@pytest.mark.parametrize("size", [8.0, 1e6])
def test_equals_numpy(size):
    x = np.random.default_rng(0).uniform(-size, size, 20_000)
    values = np.array([sin_cos(value) for value in x])
    assert np.abs(values - np.column_stack([np.sin(x), np.cos(x)])).max() < ROUNDING


def test_near_multiples_of_90_degrees():
    quarters = np.arange(-9, 10) * np.pi / 2
    for x in np.concatenate([quarters, quarters - np.pi / 4, np.nextafter(quarters, 99), [1e-300, 0.0]]):
        np.testing.assert_allclose(sin_cos(x), [np.sin(x), np.cos(x)], rtol=0, atol=ROUNDING)


def test_small_angles_have_small_relative_errors():
    x = np.logspace(-12, -1, 50)
    assert np.abs([sin_cos(value)[0] / np.sin(value) - 1 for value in x]).max() < ROUNDING


@pytest.mark.parametrize("x", [np.nan, np.inf, -np.inf])
def test_infinity_and_nan_give_nan(x):
    assert np.isnan(sin_cos(x)).all()
