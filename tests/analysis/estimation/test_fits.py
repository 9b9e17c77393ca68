"""Fits: sums of squares, non-negative unknowns, standard errors, and blocks of successive poses."""

import dataclasses

import numpy as np
import pytest
from scipy.optimize import lsq_linear

import dvrk_drake as dvrk
from dvrk_drake.analysis.estimation.normal_equations import NonNegativeFit, NormalEquations
from dvrk_drake.analysis.estimation.robust_fit import blocks, rms, robust_fit
from dvrk_drake.analysis.pose_identification import identify_static
from dvrk_drake.dynamics.dynamic_regressor import DynamicRegressor
from dvrk_drake.models.effects_schema import half_width
from dvrk_drake.recordings.recording import Recording

pytestmark = pytest.mark.numeric

ROWS, COLUMNS = 300, 14
WEIGHTS = np.array([1.0, 0.3, 5.0])
OWN = [np.arange(0, 9), np.arange(4, 14), np.array([0, 3, 7, 13])]
NON_NEGATIVE = np.arange(COLUMNS) % 2 == 1


@pytest.fixture(scope="module", params=range(6))
def rows(request):
    """Returns columns (r, k) of three actuators, some of them 0, and their efforts (r, 3)."""
    generator = np.random.default_rng(request.param)
    X = np.zeros((3, ROWS, COLUMNS))
    for i, own in enumerate(OWN):
        X[i][:, own] = generator.normal(size=(ROWS, len(own))) @ generator.normal(size=(len(own),) * 2)
    tau = np.einsum("irk,k->ri", X, generator.normal(size=COLUMNS)) + generator.normal(size=(ROWS, 3))
    return X, tau


@pytest.fixture(scope="module")
def total(rows):
    X, tau = rows
    return NormalEquations.of([(own, x[:, own]) for own, x in zip(OWN, X, strict=True)], COLUMNS, tau).total


def test_sums_without_zero_columns_equal_the_full_sums(rows, total):
    X, tau = rows
    full = [np.column_stack([x, t]) for x, t in zip(X, tau.T, strict=True)]
    expected = [rows.T @ rows for rows in full]
    np.testing.assert_allclose(total.dense(), expected, rtol=1e-12, atol=1e-9)
    np.testing.assert_allclose(total.weighted(WEIGHTS), np.tensordot(WEIGHTS, expected, 1), rtol=1e-12, atol=1e-9)
    x = np.random.default_rng(9).normal(size=COLUMNS)
    left = np.sum((tau - np.einsum("irk,k->ri", X, x)) ** 2, axis=0)
    np.testing.assert_allclose(total.squared_errors(x), [left], rtol=1e-10, atol=1e-9)


@pytest.mark.parametrize("used", [np.arange(6), np.array([1, 3, 5]), np.array([0, 2, 4])])
def test_adding_an_unknown_equals_a_fit_with_it(total, used):
    """The Schur complement is used for an unknown of any sign and for one that is not negative."""
    sums, precision = total.weighted(WEIGHTS), np.linspace(0.1, 3.0, COLUMNS)
    fit = NonNegativeFit(sums, precision, NON_NEGATIVE, used, np.arange(8, 12))
    for added in (None, 8, 9, 10, 11):
        chosen = used if added is None else np.append(used, added)
        anew = NonNegativeFit(sums, precision, NON_NEGATIVE, chosen).solve()
        np.testing.assert_allclose(fit.solve(added), anew, rtol=1e-9, atol=1e-12)
        assert set(np.flatnonzero(anew)) <= set(chosen.tolist())


def test_fit_from_sums_equals_fit_to_rows(rows, total):
    X, tau = rows
    precision = np.full(COLUMNS, 0.5)
    A = np.vstack([*(np.sqrt(w) * x for w, x in zip(WEIGHTS, X, strict=True)), np.diag(np.sqrt(precision))])
    b = np.concatenate([*(np.sqrt(w) * t for w, t in zip(WEIGHTS, tau.T, strict=True)), np.zeros(COLUMNS)])
    expected = lsq_linear(A, b, (np.where(NON_NEGATIVE, 0.0, -np.inf), np.inf), tol=1e-14).x
    x = NonNegativeFit(total.weighted(WEIGHTS), precision, NON_NEGATIVE, np.arange(COLUMNS)).solve()
    np.testing.assert_allclose(x, expected, rtol=1e-6, atol=1e-7)
    assert np.any(x[NON_NEGATIVE] == 0) or np.all(expected[NON_NEGATIVE] > 0)


# Standard errors of the robust fit, and blocks of successive poses.


def test_intervals_consider_degrees_of_freedom():
    """Twelve poses and five parameters: without the correction, the ratio would be sqrt(7 / 12) = 0.76."""
    generator, sigma = np.random.default_rng(0), 0.1
    errors, variances, freedom, inside = [], [], [], []
    for _ in range(200):
        X, theta = generator.normal(size=(12, 1, 5)), generator.normal(size=5)
        tau = X @ theta + sigma * generator.normal(size=(12, 1))
        robust = robust_fit(X, tau, np.ones((12, 1), bool), np.full(5, 1e-9), np.array([1e-9]))
        errors.append(robust.fit.theta - theta)
        variances.append(np.diag(robust.fit.covariance))
        freedom.append(robust.degrees_of_freedom)
        widths = [half_width(v**0.5, f) for v, f in zip(variances[-1], robust.degrees_of_freedom, strict=True)]
        inside.append(np.abs(errors[-1]) < widths)
    # The relative standard deviation of the ratio over 1000 errors is about 1 / sqrt(2000) + 1 / sqrt(2 * 7 * 200).
    assert np.sqrt(np.mean(variances) / np.mean(np.square(errors))) == pytest.approx(1.0, abs=0.12)
    # A rejected outlier leaves six degrees of freedom.
    assert np.median(freedom) == pytest.approx(7.0, abs=0.2)
    # Three standard deviations of the share. With the normal distribution, 91 % of the intervals contain the value.
    assert np.mean(inside) == pytest.approx(0.95, abs=0.021)


def test_degrees_of_freedom_of_two_joints():
    """A parameter on which the noise of one joint acts has the degrees of freedom of this joint."""
    generator = np.random.default_rng(1)
    X, usable = generator.normal(size=(40, 2, 2)), np.ones((40, 2), bool)
    X[:, 0, 1] = X[:, 1, 0] = 0.0
    usable[10:, 0] = False
    tau = 0.1 * generator.normal(size=(40, 2))
    # A prior that determines a parameter leaves many degrees of freedom.
    found = [
        robust_fit(X, tau, usable, np.array([1e-9, prior]), np.full(2, 1e-9)).degrees_of_freedom
        for prior in (1e-9, 1e9)
    ]
    np.testing.assert_allclose(found[0], [9, 39], rtol=0.15, atol=0)
    assert found[1][1] > 1e5


def test_blocks_are_successive_and_of_similar_size():
    assert blocks(23, 10).tolist() == sorted(blocks(23, 10).tolist())
    assert set(np.bincount(blocks(23, 10))) == {2, 3}
    assert blocks(8, 10).tolist() == list(range(8))


@pytest.mark.slow
def test_cross_validation_holds_out_neighbouring_poses():
    """A sweep with a smooth error that no effect represents: the error at a pose is predicted from its neighbours."""
    arm = dvrk.lock_joints(dvrk.load_arm("psm"), {"roll": 0.0, "wrist_pitch": 0.0, "wrist_yaw": 0.0, "jaw": 0.0})
    s = np.linspace(0, 1, 60)
    q = np.stack([0.5 * np.sin(2 * np.pi * s), -0.7 + 1.4 * s, 0.06 + 0.12 * s], axis=1)
    regressor = DynamicRegressor(arm)
    tau = regressor.torque(q, 0 * q, 0 * q, regressor.values)
    tau[:, 1] += 0.1 * np.sin(5 * np.pi * s)
    recording = Recording(q=q, tau=tau, source="sweep")
    order = np.random.default_rng(0).permutation(60)
    mixed = identify_static(dataclasses.replace(recording, q=q[order], tau=tau[order]), arm)
    result = identify_static(recording, arm)
    errors = [rms(r.cross_validation_residuals[:, 1]) for r in (result, mixed)]
    assert errors[0] > 1.1 * errors[1]
