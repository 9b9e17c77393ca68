"""Links from gravity base parameters alone: they have exactly these, they can exist, and no nearer ones do."""

import numpy as np
import pytest

from dvrk_drake.dynamics.dynamic_regressor import DynamicRegressor
from dvrk_drake.dynamics.gravity_regressor import derive_gravity
from dvrk_drake.dynamics.inertial_parameters import link_inertias
from dvrk_drake.dynamics.model_links import MIN_EIGENVALUE_RATIO, nearest_links
from dvrk_drake.dynamics.static_model import compile_static_model
from dvrk_drake.models.arm import load_arm


def other_base_values(arm, size):
    values = derive_gravity(arm).base_values
    return values + size * np.random.default_rng(0).normal(size=len(values)) * np.abs(values).max()


def relative(arm, links):
    """Z of every link: 1 where it is the SDF's."""
    factors = [np.linalg.cholesky(link.pseudo_inertia()) for link in link_inertias(arm)]
    return [
        np.linalg.solve(L, np.linalg.solve(L, link.pseudo_inertia()).T) for L, link in zip(factors, links, strict=True)
    ]


@pytest.mark.parametrize(("name", "size"), [("mtml", 0.01), ("mtml", 0.2), ("psm", 0.05)])
def test_they_have_the_base_parameters_and_can_exist(name, size):
    arm = load_arm(name)
    values = other_base_values(arm, size)
    links = nearest_links(arm, values)
    regressor = DynamicRegressor(arm)
    q = arm.sample_poses(100, np.random.default_rng(1))
    parameters = np.concatenate([*(link.parameters for link in links), np.zeros(len(regressor.rotors))])
    tau = regressor.torque(q, np.zeros_like(q), np.zeros_like(q), parameters)
    expected = compile_static_model(arm).torque(q, values)
    np.testing.assert_allclose(tau, expected, rtol=0, atol=1e-11 * np.abs(expected).max())
    assert min(np.linalg.eigvalsh(Z).min() for Z in relative(arm, links)) > 0.99 * MIN_EIGENVALUE_RATIO


def test_nothing_changes_where_nothing_is_asked():
    for name in ("mtml", "psm"):
        arm = load_arm(name)
        links = nearest_links(arm, derive_gravity(arm).base_values)
        for before, after in zip(link_inertias(arm), links, strict=True):
            np.testing.assert_allclose(after.parameters, before.parameters, rtol=1e-10, atol=1e-13)


def test_no_feasible_step_towards_the_sdf_remains():
    """At a projection onto a convex set every other member of it lies at an obtuse angle from where one came."""
    arm = load_arm("mtml")
    values = other_base_values(arm, 0.2)
    nearest = np.array(relative(arm, nearest_links(arm, values)))
    active = min(np.linalg.eigvalsh(Z).min() for Z in nearest) < 1.5 * MIN_EIGENVALUE_RATIO
    assert active  # the cone's edge was met, so this was Clarabel's work
    towards_sdf = np.eye(4) - nearest
    generator = np.random.default_rng(2)
    for _ in range(2):
        # Members of the set: bodies of other base parameters, moved to these by the nearest change again.
        start = values + 0.3 * generator.normal(size=len(values)) * np.abs(values).max()
        middle = np.array(relative(arm, nearest_links(arm, 2 * values - start)))
        other = np.array(relative(arm, nearest_links(arm, start)))
        member = (middle + other) / 2  # convex: feasible, and its base parameters are `values`
        assert np.sum(towards_sdf * (member - nearest)) <= 1e-5 * np.linalg.norm(member - nearest)
