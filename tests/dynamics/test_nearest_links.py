"""Tests that `nearest_links` returns physically consistent links with given base parameters of gravity."""

import numpy as np
import pytest

from dvrk_drake.dynamics.dynamic_regressor import DynamicRegressor
from dvrk_drake.dynamics.holding_torque import static_model
from dvrk_drake.dynamics.inertial_parameters import link_inertias
from dvrk_drake.dynamics.model_links import MIN_EIGENVALUE_RATIO, nearest_links
from dvrk_drake.dynamics.symbolic_gravity import derive_gravity
from dvrk_drake.models.arm_files import load_arm

pytestmark = pytest.mark.numeric


def other_base_values(arm, size):
    values = derive_gravity(arm).base_values
    return values + size * np.random.default_rng(0).normal(size=len(values)) * np.abs(values).max()


def relative_pseudo_inertias(arm, links):
    """Returns Z (4, 4) of each link, which is the identity for a link of the SDF."""
    factors = [np.linalg.cholesky(link.pseudo_inertia()) for link in link_inertias(arm)]
    return [
        np.linalg.solve(L, np.linalg.solve(L, link.pseudo_inertia()).T) for L, link in zip(factors, links, strict=True)
    ]


@pytest.mark.parametrize(("name", "size"), [("mtml", 0.01), ("mtml", 0.2), ("psm", 0.05)])
def test_links_are_consistent_and_have_the_base_parameters(name, size):
    arm = load_arm(name)
    values = other_base_values(arm, size)
    links = nearest_links(arm, values)
    regressor = DynamicRegressor(arm)
    q = arm.sample_poses(100, np.random.default_rng(1))
    parameters = np.concatenate([*(link.parameters for link in links), np.zeros(len(regressor.rotors))])
    tau = regressor.torque(q, np.zeros_like(q), np.zeros_like(q), parameters)
    expected = static_model(arm).torque(q, values)
    np.testing.assert_allclose(tau, expected, rtol=0, atol=1e-11 * np.abs(expected).max())
    assert min(np.linalg.eigvalsh(Z).min() for Z in relative_pseudo_inertias(arm, links)) > 0.99 * MIN_EIGENVALUE_RATIO


def test_base_parameters_of_the_sdf_give_the_links_of_the_sdf():
    for name in ("mtml", "psm"):
        arm = load_arm(name)
        links = nearest_links(arm, derive_gravity(arm).base_values)
        for before, after in zip(link_inertias(arm), links, strict=True):
            np.testing.assert_allclose(after.parameters, before.parameters, rtol=1e-10, atol=1e-13)


def test_links_are_the_nearest_to_the_sdf():
    """Tests the optimality condition of a projection onto a convex set, with random elements of the set."""
    arm = load_arm("mtml")
    values = other_base_values(arm, 0.2)
    nearest = np.array(relative_pseudo_inertias(arm, nearest_links(arm, values)))
    active = min(np.linalg.eigvalsh(Z).min() for Z in nearest) < 1.5 * MIN_EIGENVALUE_RATIO
    assert active  # The constraint Z > MIN_EIGENVALUE_RATIO is active, so Clarabel computed the result.
    towards_sdf = np.eye(4) - nearest
    generator = np.random.default_rng(2)
    for _ in range(2):
        # The average of links with base parameters symmetric about `values` is an element of the convex set.
        start = values + 0.3 * generator.normal(size=len(values)) * np.abs(values).max()
        middle = np.array(relative_pseudo_inertias(arm, nearest_links(arm, 2 * values - start)))
        other = np.array(relative_pseudo_inertias(arm, nearest_links(arm, start)))
        member = (middle + other) / 2
        assert np.sum(towards_sdf * (member - nearest)) <= 1e-5 * np.linalg.norm(member - nearest)
