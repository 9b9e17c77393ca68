"""Tests torque, number and names of the base parameters of the full dynamics."""

from __future__ import annotations

import re

import numpy as np
import pytest

from dvrk_drake.dynamics.dynamic_regressor import DynamicRegressor, derive_base_parameters
from dvrk_drake.dynamics.symbolic_gravity import derive_gravity
from dvrk_drake.models.arm_files import load_arm

pytestmark = pytest.mark.numeric


@pytest.fixture(scope="module", params=["mtml", "psm"])
def model(request):
    return DynamicRegressor(load_arm(request.param))


@pytest.fixture(scope="module")
def reduced(model):
    return derive_base_parameters(model)


def lift(reduced):
    """Returns a matrix (p, b) with Y_base = Y lift. phi = lift beta has the base parameters beta."""
    return reduced.to_links[:, reduced.base.columns]


@pytest.fixture(scope="module")
def Y(model, reduced):
    """Returns the regressor at states that were not used to derive the base parameters."""
    generator = np.random.default_rng(7)
    q = model.arm.sample_poses(300, generator)
    Y = model.regressor(q, generator.normal(0, 2, q.shape), generator.normal(0, 5, q.shape))
    return Y[..., : len(reduced.to_links)]  # without terms that couple two rotors


def test_base_regressor_times_base_values_is_the_torque(model, reduced, Y):
    """Tests the parameters of the SDF and random parameters."""
    p = Y.shape[-1]
    for phi in (model.values[:p], np.random.default_rng(1).normal(0, 1, p)):
        tau = Y @ phi
        np.testing.assert_allclose(Y @ lift(reduced) @ (reduced.combination @ phi), tau, rtol=0, atol=1e-9)


def test_number_equals_the_rank_of_the_regressor(reduced, Y):
    """The number of singular values above rounding errors equals the number of base parameters.

    Columns that contain only rounding errors are omitted.
    """
    columns = Y.reshape(-1, Y.shape[-1])
    size = np.linalg.norm(columns, axis=0)
    nonzero = size > 1e-9 * size.max()
    singular = np.linalg.svd(columns[:, nonzero] / size[nonzero], compute_uv=False)
    rank = len(reduced.base.names)
    assert singular[rank - 1] > 1e-5 * singular[0]
    assert singular[rank] < 1e-10 * singular[0]


def test_null_space_does_not_change_the_torque(reduced, Y):
    """Tests all p - b directions of the null space of the combinations."""
    null = np.linalg.svd(reduced.combination)[2][len(reduced.base.names) :]
    assert len(null) == Y.shape[-1] - len(reduced.base.names)
    assert np.abs(Y @ null.T).max() < 1e-9 * np.abs(Y).max()


def test_rank_at_rest_equals_that_of_the_gravity_model(reduced, model):
    """The regressor at rest has the rank of `derive_gravity`, which assumes that the MTM's rotor 4 is balanced."""
    unbalance = {"m_motor_4 c_motor_4_x", "m_motor_4 c_motor_4_y"}
    balanced = [i for i, name in enumerate(reduced.base.names) if name not in unbalance]
    q = model.arm.sample_poses(50, np.random.default_rng(3))
    rest = np.zeros_like(q)
    static = (model.regressor(q, rest, rest)[..., : len(reduced.to_links)] @ lift(reduced))[..., balanced].reshape(
        -1, len(balanced)
    )
    assert np.linalg.matrix_rank(static, tol=1e-8) == len(derive_gravity(model.arm).base.names)


def test_names_and_units_match_the_combination(reduced):
    """Each name contains all inertias of its combination, and its unit matches the name."""
    assert len(set(reduced.base.names)) == len(reduced.base.names)
    for name, unit, row in zip(reduced.base.names, reduced.base.units, reduced.base.combination, strict=True):
        used = [reduced.standard_parameters[i] for i in np.flatnonzero(np.abs(row) > 1e-9)]
        inertias = [str(parameter) for parameter in used if parameter.is_inertia]
        assert all(inertia in name for inertia in inertias)
        prismatic = name == "Ia_3"  # Rotor of the PSM's insertion.
        assert prismatic or bool(inertias) == (unit == "kg m^2")
        # Only inertias have coefficients with squared lengths.
        assert inertias or not re.search(r"\^2", name)


def test_names_of_the_mtm_wrist_agree_with_the_textbook():
    """The base parameters agree with Khalil and Dombre, table 9.3: Iyy of the last link is part of the link before."""
    names = derive_base_parameters(DynamicRegressor(load_arm("mtmr"))).base.names
    assert {"Ixx_7 - Iyy_7", "Izz_7", "Ixx_6 - Izz_6 + Iyy_7", "m6 c6z + m7 c7z", "Ia_7"} <= set(names)
    assert "L2 (m2+...+m7+m_motor_4) + m2 c2x + m_coupler c_coupler_x" in names
