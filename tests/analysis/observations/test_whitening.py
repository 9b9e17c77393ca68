"""Whitening filter: an autoregressive error becomes white, and the filter is linear."""

import numpy as np
from scipy.signal import lfilter

from dvrk_drake.analysis.observations.motion_difference import Whitening

RATE, CUT_OFF = 40.0, 5.0
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
    whitening = Whitening.of(x, 2, RATE, CUT_OFF)
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
