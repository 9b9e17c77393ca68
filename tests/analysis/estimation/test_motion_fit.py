"""Selection of drive effects, and standard errors of dynamic parameters."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import scipy.linalg

from dvrk_drake.analysis.estimation.estimator import Estimator, Prior, StepwiseSelection
from dvrk_drake.analysis.estimation.motion_columns import drive_effects, optional_effects
from dvrk_drake.analysis.estimation.motion_estimates import (
    ResidualSeries,
    parameter_covariance,
    strong_correlations,
    toeplitz_product,
)
from dvrk_drake.analysis.estimation.normal_equations import NormalEquations
from dvrk_drake.analysis.observations.signals import low_pass
from dvrk_drake.errors import ArmError
from dvrk_drake.models.arm_files import load_arm

pytestmark = pytest.mark.numeric

FOLDS, ROWS = 12, 1200


def arm_with_known_effects(**known):
    arm = load_arm("psm")
    known_effects = {f"actuator.{joint}": kinds for joint, kinds in known.items()}
    return replace(arm, identification=replace(arm.identification, known_effects=known_effects))


def moving(arm):
    q = arm.sample_poses(30, np.random.default_rng(0))
    return SimpleNamespace(q=q, v=np.random.default_rng(1).normal(size=q.shape))


def of(effects, coordinate):
    return {(e.kind, e.scale if "cable" in e.kind else 0.0) for e in effects if e.coordinate == coordinate}


def test_effects_of_the_arm_file_are_mandatory():
    arm = arm_with_known_effects(pitch=["cable 1"], jaw=["asymmetric friction"])
    always, candidates = drive_effects(arm, [moving(arm)]), optional_effects(arm, [moving(arm)])
    assert not set(always) & set(candidates)
    assert {("cable sine", 1.0), ("cable cosine", 1.0)} <= of(always, "actuator.pitch")
    # A known position-dependent torque excludes other such candidates, but not friction.
    assert of(candidates, "actuator.pitch") == {(k, 0.0) for k in ("coulomb forward", "stribeck")}
    assert ("coulomb forward", 0.0) in of(always, "actuator.jaw")
    assert {("spring", 0.0), ("cable sine", 2.0)} <= of(candidates, "actuator.jaw")
    # Prismatic coordinates have no cable effects.
    assert not any("cable" in kind for kind, _ in of(candidates, "actuator.insertion"))


@pytest.mark.parametrize(
    ("known", "message"),
    [
        (
            {"pitch": ["magnet"]},
            'actuator.pitch: unknown effect "magnet". Allowed: spring, cable 1, cable 2, asymmetric friction',
        ),
        ({"elbow": ["spring"]}, "unknown coordinate actuator.elbow. Allowed: actuator.yaw"),
        ({"insertion": ["cable 1"]}, "cable sine requires a revolute coordinate, but actuator.insertion is prismatic"),
    ],
)
def test_invalid_known_effects_are_rejected(known, message):
    arm = arm_with_known_effects(**known)
    with pytest.raises(ArmError, match=message):
        drive_effects(arm, [moving(arm)])


def equations(generator, true):
    X = generator.normal(size=(ROWS, len(true)))
    tau = X @ true + 0.3 * generator.normal(size=ROWS)
    fold = np.arange(ROWS) * FOLDS // ROWS
    place = np.arange(ROWS) * FOLDS % ROWS / ROWS
    return X, tau, fold, np.column_stack([place < 0.1, place >= 0.9])


def test_held_out_folds_exclude_adjoining_rows():
    X, tau, fold, edge = equations(np.random.default_rng(0), np.ones(3))
    whole = NormalEquations.of([(np.arange(3), X)], 3, tau[:, None], fold, edge)
    for first in (0, 4, 10, 11):
        out = np.isin(fold, [first, (first + 1) % FOLDS])
        touches = ((fold == (first - 1) % FOLDS) & edge[:, 1]) | ((fold == (first + 2) % FOLDS) & edge[:, 0])
        rows = np.column_stack([X, tau])
        kept = rows[~(out | touches)]
        np.testing.assert_allclose(whole.without_fold(first, 2).dense()[0], kept.T @ kept, atol=1e-9)
        of_both = whole.of_fold(first).dense() + whole.of_fold((first + 1) % FOLDS).dense()
        np.testing.assert_allclose(of_both[0], rows[out].T @ rows[out], atol=1e-9)
        others = whole.without(first, 2)
        assert others.folds == FOLDS - 2
        np.testing.assert_allclose(others.total.dense()[0], kept.T @ kept, atol=1e-9)
        # A second held-out fold, with its adjoining rows.
        second = others.without_fold(3)
        out = fold == (first + 2 + 3) % FOLDS
        touches |= ((fold == (first + 4) % FOLDS) & edge[:, 1]) | ((fold == (first + 6) % FOLDS) & edge[:, 0])
        kept = rows[~(out | touches | np.isin(fold, [first, (first + 1) % FOLDS]))]
        np.testing.assert_allclose(second.dense()[0], kept.T @ kept, atol=1e-9)


def test_present_effects_are_selected_and_noise_is_not():
    """One mandatory column, one that explains half of the effort, and twenty of noise; also with two folds held out."""
    true = np.zeros(22)
    true[:2] = 1.0
    for seed in range(5):
        X, tau, fold, edge = equations(np.random.default_rng(seed), true)
        selection = StepwiseSelection(
            equations=NormalEquations.of([(np.arange(22), X)], 22, tau[:, None], fold, edge),
            efforts=np.array([[np.sum(tau[fold == f] ** 2)] for f in range(FOLDS)]),
            prior=Prior(np.zeros(22), np.ones(22), np.zeros(22, dtype=bool)),
            independent=0.1 * np.bincount(fold)[:, None],
            num_rigid=0,
        )
        for part in (selection, selection.without(4, 2)):
            np.testing.assert_array_equal(part.select(np.array([0]), np.arange(1, 22)), [0, 1])


def test_recordings_are_weighted_by_their_error_variances():
    """The estimate is that of generalized least squares for the noise of each recording and actuator."""
    generator = np.random.default_rng(0)
    true, noise = np.ones(3), np.array([[1.0, 0.2], [0.1, 0.6]])
    recording = np.arange(ROWS) % FOLDS // (FOLDS // 2)
    X = generator.normal(size=(2, ROWS, 3))
    tau = (X @ true).T + noise[recording] * generator.normal(size=(ROWS, 2))
    fold = np.arange(ROWS) % FOLDS
    columns = [(np.arange(3), x) for x in X]
    estimator = Estimator(
        equations=NormalEquations.of(columns, 3, tau, fold, recording=recording),
        prior=Prior(np.zeros(3), np.full(3, 1e-6), np.zeros(3, dtype=bool)),
        efforts=np.array([np.sum(tau[fold == f] ** 2, axis=0) for f in range(FOLDS)]),
        independent=np.outer(np.bincount(fold), np.ones(2)),
    )
    x = estimator.fit(estimator.all)
    # The standard deviation of a standard deviation of 600 values is 3 %.
    np.testing.assert_allclose(estimator.weights**-0.5, noise, rtol=0.1, atol=0)
    weights = estimator.weights[recording].T.ravel()
    expected = np.linalg.solve(
        (X.reshape(-1, 3).T * weights) @ X.reshape(-1, 3), X.reshape(-1, 3).T @ (weights * tau.T.ravel())
    )
    np.testing.assert_allclose(x, expected, rtol=1e-4, atol=0)
    # Without one recording, its weights are 0.
    half = estimator.without(0, FOLDS // 2)
    half.fit(half.all)
    assert np.all(half.weights[0] == 0) and np.all(half.weights[1] > 0)


# Standard errors of dynamic parameters, compared with the spread of many simulated experiments.


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
