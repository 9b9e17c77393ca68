"""Standard errors of parameters against what many simulated experiments show."""

from __future__ import annotations

import numpy as np
import pytest

from dvrk_drake.analysis.dynamic.parameter_uncertainty import information_matrix, parameter_uncertainty
from dvrk_drake.errors import IdentificationError


def test_standard_errors_are_the_spread_of_repeated_fits():
    """Two joints of different noise, parameters of different size: 4000 fits spread as predicted, to 5 %."""
    generator = np.random.default_rng(0)
    Y = generator.normal(0, 1, (40, 2, 3)) * [1.0, 1e-3, 1e3]
    sigma = np.array([0.1, 2.0])
    uncertainty = parameter_uncertainty(("a", "b", "c"), information_matrix(Y, sigma**2))
    rows = (Y / sigma[:, None]).reshape(-1, 3)
    estimates = np.linalg.lstsq(rows, generator.normal(0, 1, (80, 4000)), rcond=None)[0]
    np.testing.assert_allclose(uncertainty.standard_errors, estimates.std(axis=1), rtol=0.05, atol=0)
    np.testing.assert_allclose(uncertainty.correlation, np.corrcoef(estimates), atol=0.06)
    assert uncertainty.strong_correlations() == []


def test_columns_that_are_almost_the_same_are_named():
    generator = np.random.default_rng(1)
    Y = generator.normal(0, 1, (500, 1, 3))
    Y[..., 1] = Y[..., 0] + 0.1 * Y[..., 1]  # correlated by 0.995: the estimates by -0.995
    uncertainty = parameter_uncertainty(("m4 c4x", "m5 c5x", "Izz_1"), information_matrix(Y, [1.0]))
    (pair,) = uncertainty.strong_correlations()
    assert (pair.first, pair.second) == ("m4 c4x", "m5 c5x")
    assert pair.correlation == pytest.approx(-0.995, abs=2e-3)
    assert "only their scaled sum is well known" in str(pair)


def test_what_the_data_leave_open_is_refused_by_name():
    Y = np.random.default_rng(2).normal(0, 1, (50, 1, 3))
    Y[..., 2] = Y[..., 1]
    with pytest.raises(IdentificationError, match="combination of b, c"):
        parameter_uncertainty(("a", "b", "c"), information_matrix(Y, [1.0]))
    Y[..., 2] = 0.0
    with pytest.raises(IdentificationError, match="nothing of c"):
        parameter_uncertainty(("a", "b", "c"), information_matrix(Y, [1.0]))
    with pytest.raises(IdentificationError, match="must be finite and"):
        parameter_uncertainty(("a", "b"), np.eye(3))
