"""Standard errors of the robust fit, and blocks of successive poses."""

import dataclasses

import numpy as np
import pytest

import dvrk_drake as dvrk
from dvrk_drake.analysis.static.linear_fit import blocks, rms, robust_fit
from dvrk_drake.analysis.static.static_identification import identify_static
from dvrk_drake.dynamics.dynamic_regressor import DynamicRegressor
from dvrk_drake.recordings.recording import Recording


def test_standard_errors_consider_degrees_of_freedom():
    """Twelve poses and five parameters: without the correction, the ratio would be sqrt(7 / 12) = 0.76."""
    generator, sigma = np.random.default_rng(0), 0.1
    errors, variances = [], []
    for _ in range(200):
        X, theta = generator.normal(size=(12, 1, 5)), generator.normal(size=5)
        tau = X @ theta + sigma * generator.normal(size=(12, 1))
        fit = robust_fit(X, tau, np.ones((12, 1), bool), np.full(5, 1e-9), np.array([1e-9])).fit
        errors.append(fit.theta - theta)
        variances.append(np.diag(fit.covariance))
    # The relative standard deviation of the ratio over 1000 errors is about 1 / sqrt(2000) + 1 / sqrt(2 * 7 * 200).
    assert np.sqrt(np.mean(variances) / np.mean(np.square(errors))) == pytest.approx(1.0, abs=0.12)


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
