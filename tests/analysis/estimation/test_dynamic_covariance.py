"""Standard errors of dynamic parameters, compared with the spread of many simulated experiments."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
import scipy.linalg

from dvrk_drake.analysis.estimation.motion_estimates import (
    ResidualSeries,
    parameter_covariance,
    strong_correlations,
    toeplitz_product,
)
from dvrk_drake.analysis.observations.low_pass import low_pass

pytestmark = pytest.mark.numeric

RATE, CUT_OFF, PERIOD, SECONDS = 100.0, 5.0, 8.0, 32.0
T = np.arange(round(SECONDS * RATE)) / RATE


def series(period):
    return ResidualSeries(slice(0, len(T)), RATE, period)


def noise(generator, count=1):
    return low_pass(generator.normal(size=(len(T), count)), RATE, CUT_OFF)


@pytest.mark.parametrize("repeating", [0.0, 1.0])
def test_standard_errors_are_the_spread_of_repeated_fits(repeating):
    """Two actuators, a motion of four periods, white noise, and optionally an error that repeats in every period."""
    generator = np.random.default_rng(2)
    w = 2 * np.pi * np.arange(1, 4) / PERIOD
    slow, fast = (np.hstack([np.sin(f * w * T[:, None]), np.cos(f * w * T[:, None])]) for f in (1, 5))
    X, weights, prior = [slow, 0.3 * fast + 0.1 * slow], np.array([1.0, 0.3]), 1e-6 * np.eye(6)
    fold = (T % PERIOD / PERIOD * 12).astype(int)
    problem = SimpleNamespace(
        actuator_columns=lambda i, _: (np.arange(6), X[i]),
        to_base=lambda _: np.eye(6),
        fold=fold,
        recording=np.zeros_like(fold),
        num_rigid=0,
        prior=np.zeros(0),
    )
    information = sum(weight * x.T @ x for weight, x in zip(weights, X, strict=True))
    fit = SimpleNamespace(
        information=information,
        prior_precision=prior,
        weights=weights[None],
        effects=np.arange(0),
        lower=np.full(6, -np.inf),
    )
    estimates, predicted = [], []
    for _ in range(100):
        again = noise(generator, 2)[: round(PERIOD * RATE)]
        error = noise(generator, 2) + repeating * np.tile(again, (4, 1))
        sums = sum(w * x.T @ e for w, x, e in zip(weights, X, error.T, strict=True))
        fit.x = np.linalg.solve(information + prior, sums)
        left = error - np.column_stack([x @ fit.x for x in X])
        estimates.append(fit.x)
        predicted.append(np.diag(parameter_covariance(problem, fit, left, CUT_OFF, [series(PERIOD)]).estimates))
    spread, mean = np.std(estimates, axis=0), np.sqrt(np.mean(predicted, axis=0))
    # The standard error of the spread of 100 fits is 7 %.
    np.testing.assert_allclose(mean, spread, rtol=0.2, atol=0)
    assert np.mean(mean / spread) == pytest.approx(1.0, abs=0.1)


def test_uninformed_parameters_keep_the_prior_variance():
    X = np.zeros((len(T), 2))
    X[:, 0] = np.sin(T)
    tau = noise(np.random.default_rng(3))
    prior, weights = np.diag([1.0, 4.0]), np.array([2.0])
    fit = SimpleNamespace(
        information=2.0 * X.T @ X,
        prior_precision=prior,
        weights=weights[None],
        effects=np.arange(0),
        x=np.zeros(2),
        lower=np.full(2, -np.inf),
    )
    problem = SimpleNamespace(
        actuator_columns=lambda i, _: (np.arange(2), X),
        to_base=lambda _: np.eye(2),
        fold=(T // 4).astype(int),
        recording=np.zeros(len(T), dtype=int),
        num_rigid=0,
        prior=np.zeros(0),
    )
    covariance = parameter_covariance(problem, fit, tau, CUT_OFF, [series(None)]).estimates
    assert covariance[1, 1] == pytest.approx(1 / 4.0)
    assert covariance[0, 0] < 0.01


@pytest.mark.parametrize("lags", [1, 40, 301])
def test_product_with_a_covariance_is_that_of_the_matrix(lags):
    generator = np.random.default_rng(lags)
    covariance, X = np.zeros(301), generator.normal(size=(301, 3))
    covariance[:lags] = generator.normal(size=lags)
    covariance[0] = 3.0
    expected = scipy.linalg.toeplitz(covariance) @ X
    np.testing.assert_allclose(toeplitz_product(covariance, X), expected, rtol=0, atol=1e-10)


def test_nearly_equal_columns_are_named():
    generator = np.random.default_rng(1)
    Y = generator.normal(0, 1, (500, 3))
    Y[..., 1] = Y[..., 0] + 0.1 * Y[..., 1]  # correlated by 0.995: the estimates by -0.995
    (pair,) = strong_correlations(("m4 c4x", "m5 c5x", "Izz_1"), np.linalg.inv(Y.T @ Y))
    assert (pair.first, pair.second) == ("m4 c4x", "m5 c5x")
    assert pair.correlation == pytest.approx(-0.995, abs=2e-3)
