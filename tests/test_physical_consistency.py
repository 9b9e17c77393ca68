"""The convex program: parameters that a body can have, nearest to what the rows say."""

import numpy as np
import pytest

from dvrk_drake.dynamics.dynamic_regressor import DynamicRegressor
from dvrk_drake.dynamics.inertial_parameters import pseudo_inertia
from dvrk_drake.dynamics.physical_consistency import (
    COM_REACH,
    LEAST_COM_REACH,
    MASS_RANGE,
    LinkScale,
    consistent_parameters,
    least_eigenvalue_bound,
)
from dvrk_drake.errors import IdentificationError
from dvrk_drake.models.arm import load_arm


@pytest.fixture(scope="module", params=["mtmr", "psm"])
def links(request):
    return DynamicRegressor(load_arm(request.param)).links


def solve(links, wanted):
    scale = np.concatenate([LinkScale.of(link).deviations for link in links])
    R = np.diag(1 / scale)
    return consistent_parameters(R, wanted / scale, links, np.full(len(scale), -np.inf), scale)


def test_what_can_exist_is_not_touched(links):
    wanted = np.concatenate([link.parameters for link in links])
    scale = np.concatenate([LinkScale.of(link).deviations for link in links])
    # An interior point keeps away from the edge, where the SDF's rods without a width are, by the solver's tolerance.
    assert np.max(np.abs(solve(links, wanted) - wanted) / scale) < 1e-4


def test_what_cannot_exist_becomes_the_nearest_that_can(links):
    generator = np.random.default_rng(0)
    scale = np.concatenate([LinkScale.of(link).deviations for link in links])
    truth = np.concatenate([link.parameters for link in links])
    wanted = truth + 3 * scale * generator.normal(size=len(truth))
    x = solve(links, wanted)
    for k, link in enumerate(links):
        own, size = x[10 * k : 10 * k + 10], LinkScale.of(link)
        assert np.linalg.eigvalsh(pseudo_inertia(own))[0] >= least_eigenvalue_bound(link)
        low, high = (share * size.mass for share in MASS_RANGE)
        assert low * (1 - 1e-6) <= own[0] <= high * (1 + 1e-6)
        reach = max(COM_REACH * size.gyration, LEAST_COM_REACH)
        assert np.all(np.abs(own[1:4] / own[0] - size.com) <= reach * (1 + 1e-5))
    # The projection onto a convex set: no feasible point makes an obtuse angle with what was projected.
    gap = (wanted - x) / scale
    assert gap @ ((truth - x) / scale) <= 1e-4 * np.linalg.norm(gap) ** 2


def test_bounds_are_kept(links):
    n = 10 * len(links)
    scale = np.concatenate([*(LinkScale.of(link).deviations for link in links), [1e-5]])
    wanted = np.concatenate([*(link.parameters for link in links), [-1.0]])
    lower = np.append(np.full(n, -np.inf), 1e-6)
    x = consistent_parameters(np.diag(1 / scale), wanted / scale, links, lower, scale)
    assert x[-1] == pytest.approx(1e-6, rel=1e-3)


def test_a_program_that_has_no_solution_is_refused(links):
    n = 10 * len(links)
    scale = np.concatenate([LinkScale.of(link).deviations for link in links])
    lower = np.full(n, -np.inf)
    lower[0] = 100 * links[0].parameters[0]  # more than the range of the mass allows
    with pytest.raises(IdentificationError, match="did not converge: Clarabel says"):
        consistent_parameters(np.diag(1 / scale), np.ones(n), links, lower, scale)
