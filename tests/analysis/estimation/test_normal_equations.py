"""Fits from sums of squares: updates equal new computations and fits to the rows."""

import numpy as np
import pytest
from scipy.optimize import lsq_linear

from dvrk_drake.analysis.estimation.normal_equations import NonNegativeFit, NormalEquations

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
