"""Names of parameters that are not identifiable separately."""

from __future__ import annotations

import numpy as np
import pytest

from dvrk_drake.analysis.estimation.motion_estimates import strong_correlations

pytestmark = pytest.mark.numeric


def test_nearly_equal_columns_are_named():
    generator = np.random.default_rng(1)
    Y = generator.normal(0, 1, (500, 3))
    Y[..., 1] = Y[..., 0] + 0.1 * Y[..., 1]  # correlated by 0.995: the estimates by -0.995
    (pair,) = strong_correlations(("m4 c4x", "m5 c5x", "Izz_1"), np.linalg.inv(Y.T @ Y))
    assert (pair.first, pair.second) == ("m4 c4x", "m5 c5x")
    assert pair.correlation == pytest.approx(-0.995, abs=2e-3)
