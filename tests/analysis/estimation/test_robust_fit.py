"""Standard errors of the robust fit, and blocks of successive poses."""

import dataclasses

import numpy as np
import pytest

import dvrk_drake as dvrk
from dvrk_drake.analysis.estimation.robust_fit import blocks, rms, robust_fit
from dvrk_drake.analysis.pose_identification import identify_static
from dvrk_drake.dynamics.dynamic_regressor import DynamicRegressor
from dvrk_drake.models.effects_schema import half_width
from dvrk_drake.recordings.recording import Recording


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
