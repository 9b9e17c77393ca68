"""Base parameters of the full dynamics: they make the same torque, and are as many as the regressor has rank."""

from __future__ import annotations

import re

import numpy as np
import pytest

from dvrk_drake.dynamics.dynamic_regressor import DynamicRegressor, derive_base_parameters
from dvrk_drake.dynamics.gravity_regressor import derive_gravity
from dvrk_drake.models.arm import load_arm


@pytest.fixture(scope="module", params=["mtml", "psm"])
def model(request):
    return DynamicRegressor(load_arm(request.param))


@pytest.fixture(scope="module")
def reduced(model):
    return derive_base_parameters(model)


def lift(reduced):
    """(p, b) with Y_base = Y lift: phi = lift beta has the base parameters beta and moves like every other such."""
    return reduced.to_links[:, reduced.base.columns]


@pytest.fixture(scope="module")
def Y(model):
    """Returns regressors of states that the reduction did not use."""
    generator = np.random.default_rng(7)
    q = model.arm.sample_poses(300, generator)
    return model.regressor(q, generator.normal(0, 2, q.shape), generator.normal(0, 5, q.shape))


def test_base_regressor_times_base_values_is_the_torque(model, reduced, Y):
    """For the SDF's parameters and for any others."""
    for phi in (model.values, np.random.default_rng(1).normal(0, 1, len(model.values))):
        tau = Y @ phi
        np.testing.assert_allclose(Y @ lift(reduced) @ (reduced.combination @ phi), tau, rtol=0, atol=1e-9)


def test_there_are_as_many_as_the_regressor_has_rank(reduced, Y):
    """At that number the singular values of Y fall to rounding; columns that are rounding alone are left out."""
    columns = Y.reshape(-1, Y.shape[-1])
    size = np.linalg.norm(columns, axis=0)
    seen = size > 1e-9 * size.max()
    singular = np.linalg.svd(columns[:, seen] / size[seen], compute_uv=False)
    rank = len(reduced.base.names)
    assert singular[rank - 1] > 1e-5 * singular[0]
    assert singular[rank] < 1e-10 * singular[0]


def test_what_is_outside_of_the_base_changes_no_torque(model, reduced, Y):
    """The null space of the combinations, all p - b directions of it."""
    null = np.linalg.svd(reduced.combination)[2][len(reduced.base.names) :]
    assert len(null) == len(model.values) - len(reduced.base.names)
    assert np.abs(Y @ null.T).max() < 1e-9 * np.abs(Y).max()


def test_lift_is_a_right_inverse(reduced):
    np.testing.assert_allclose(reduced.combination @ lift(reduced), np.eye(len(reduced.base.names)), rtol=0, atol=1e-9)


def test_at_rest_they_are_those_of_the_gravity_model(reduced, model):
    """Gravity tells as many as `derive_gravity` has, which takes the MTM's rotor 4 for balanced."""
    unbalance = {"m_motor_4 c_motor_4_x", "m_motor_4 c_motor_4_y"}
    balanced = [i for i, name in enumerate(reduced.base.names) if name not in unbalance]
    q = model.arm.sample_poses(50, np.random.default_rng(3))
    rest = np.zeros_like(q)
    static = (model.regressor(q, rest, rest) @ lift(reduced))[..., balanced].reshape(-1, len(balanced))
    assert np.linalg.matrix_rank(static, tol=1e-8) == len(derive_gravity(model.arm).base.names)


def test_names_say_what_they_are(reduced):
    """A name written out in numbers is the combination: its terms and coefficients are those that stand in the row."""
    assert len(set(reduced.base.names)) == len(reduced.base.names)
    for name, unit, row in zip(reduced.base.names, reduced.base.units, reduced.base.combination, strict=True):
        alone = np.flatnonzero(np.abs(row) > 1e-9)
        inertias = [str(reduced.standard_parameters[i]) for i in alone if reduced.standard_parameters[i].is_inertia]
        assert all(inertia in name for inertia in inertias)
        slides = name == "Ia_3"  # the PSM's insertion
        assert slides or bool(inertias) == (unit == "kg m^2")
        # No length squared among what is not an inertia.
        assert inertias or not re.search(r"\^2", name)


def test_the_wrist_of_an_mtm_reads_as_in_the_textbooks():
    """Khalil and Dombre, table 9.3: the last link of a wrist gives Ixx - Iyy, the one before takes the Iyy."""
    names = derive_base_parameters(DynamicRegressor(load_arm("mtmr"))).base.names
    assert {"Ixx_7 - Iyy_7", "Izz_7", "Ixx_6 - Izz_6 + Iyy_7", "m6 c6z + m7 c7z", "Ia_7"} <= set(names)
    assert "L2 (m2+...+m7+m_motor_4) + m2 c2x + m_coupler c_coupler_x" in names
