"""Inertial parameters of links, and the convex program for physically consistent ones."""

from __future__ import annotations

import numpy as np
import pytest
from pydrake.math import RigidTransform, RotationMatrix

from dvrk_drake.dynamics.dynamic_regressor import DynamicRegressor
from dvrk_drake.dynamics.holding_torque import static_model
from dvrk_drake.dynamics.inertial_parameters import (
    LinkInertia,
    change_of_frame,
    link_inertias,
    parameters_from_pseudo_inertia,
    pseudo_inertia,
)
from dvrk_drake.dynamics.model_links import MIN_EIGENVALUE_RATIO, nearest_links
from dvrk_drake.dynamics.physical_consistency import (
    LOG_DET_WEIGHT,
    MASS_RANGE,
    TOTAL_MASS_TOLERANCE,
    LinkScale,
    bounding_boxes,
    box_margins,
    consistent_parameters,
    least_eigenvalue_bound,
    log_det_curvature,
)
from dvrk_drake.dynamics.symbolic_gravity import derive_gravity
from dvrk_drake.errors import IdentificationError, ModelError
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.models.plant import make_arm_plant

pytestmark = [pytest.mark.drake_api, pytest.mark.numeric]


@pytest.fixture(scope="module", params=["mtmr", "psm"])
def arm(request):
    return load_arm(request.param)


@pytest.fixture(scope="module")
def links(arm):
    return DynamicRegressor(arm).links


@pytest.fixture(scope="module")
def boxes(arm):
    return bounding_boxes(arm)


@pytest.fixture(scope="module")
def nominal(links):
    return np.concatenate([link.parameters for link in links])


@pytest.fixture(scope="module")
def scale(links):
    return np.concatenate([LinkScale.of(link).deviations for link in links])


def solve(links, boxes, R, b):
    return consistent_parameters(R, b, links, boxes, np.full(len(b), -np.inf))


def log_det_prior(x, links):
    """Returns LOG_DET_WEIGHT times the sum of trace(S0^-1 S) - log det(S0^-1 S) over the links."""
    total = 0.0
    for k, link in enumerate(links):
        floor = least_eigenvalue_bound(link) * np.eye(4)
        ratio = np.linalg.solve(link.pseudo_inertia() - floor, pseudo_inertia(x[10 * k : 10 * k + 10]) - floor)
        total += np.trace(ratio) - np.linalg.slogdet(ratio)[1]
    return LOG_DET_WEIGHT * total


def log_det_slope(own, link):
    """Returns the gradient (10,) of a link's log-det prior with respect to its parameters."""
    floor = least_eigenvalue_bound(link) * np.eye(4)
    S0_inverse, S_inverse = (np.linalg.inv(J - floor) for J in (link.pseudo_inertia(), pseudo_inertia(own)))
    return LOG_DET_WEIGHT * np.array([np.trace((S0_inverse - S_inverse) @ pseudo_inertia(e)) for e in np.eye(10)])


def test_parameters_of_the_sdf_are_not_changed(links, boxes, nominal, scale):
    x = solve(links, boxes, np.diag(1 / scale), nominal / scale)
    assert np.max(np.abs(x - nominal) / scale) < 1e-4


def test_inconsistent_parameters_become_consistent_at_least_cost(links, boxes, nominal, scale):
    """The result satisfies all constraints, and the cost does not decrease towards other consistent parameters."""
    generator = np.random.default_rng(0)
    wanted = nominal + 3 * scale * generator.normal(size=len(nominal))
    x = solve(links, boxes, np.diag(1 / scale), wanted / scale)
    for k, link in enumerate(links):
        own = x[10 * k : 10 * k + 10]
        assert np.linalg.eigvalsh(pseudo_inertia(own))[0] >= least_eigenvalue_bound(link)
        low, high = (share * link.parameters[0] for share in MASS_RANGE)
        assert low * (1 - 1e-6) <= own[0] <= high * (1 + 1e-6)
        assert np.min(box_margins(own, boxes[link.link])) > -1e-5
        com, box = own[1:4] / own[0], boxes[link.link]
        assert np.all(np.abs(com - box.center) <= box.half_width * (1 + 1e-5))
    assert abs(np.sum(x[::10]) / np.sum(nominal[::10]) - 1) <= TOTAL_MASS_TOLERANCE + 1e-6

    def cost(y):
        return 0.5 * np.sum(((y - wanted) / scale) ** 2) + log_det_prior(y, links)

    for other in (nominal, *(nominal * (1 + 0.05 * s) for s in (-1, 1))):
        assert cost(x + 1e-3 * (other - x)) >= cost(x) - 1e-4


def test_priors_determine_directions_without_data(links, boxes, nominal, scale):
    """The gradient of the priors vanishes in directions that the data do not determine."""
    generator = np.random.default_rng(3)
    rows = generator.normal(size=(12, len(nominal))) / scale
    target = rows @ nominal + 2 * generator.normal(size=12)
    stacked = np.vstack([np.diag(1 / scale), 30 * rows])
    R = np.linalg.qr(stacked, mode="r")
    x = solve(links, boxes, R, np.linalg.solve(R.T, stacked.T @ np.append(nominal / scale, 30 * target)))
    np.testing.assert_allclose(rows @ x, target, atol=0.1)
    slope = np.concatenate([log_det_slope(x[10 * k : 10 * k + 10], link) for k, link in enumerate(links)])
    gradient = (x - nominal) / scale + slope * scale
    H = np.eye(len(x)) + log_det_curvature(x, links) * np.outer(scale, scale)

    def gain(directions):  # Decrease of the cost of the priors at its minimum along these directions.
        g = directions @ gradient
        return 0.5 * g @ np.linalg.solve(directions @ H @ directions.T, g)

    null = np.linalg.svd(rows * scale)[2][12:]
    assert gain(null) < 1e-3 < 1e-2 * gain(np.eye(len(x)))


def test_curvature_is_the_second_derivative(links, nominal, scale):
    step = 1e-6 * scale * np.random.default_rng(1).normal(size=len(nominal))
    H = log_det_curvature(nominal, links) @ step
    for k, link in enumerate(links):
        chosen = slice(10 * k, 10 * k + 10)
        up, down = (log_det_slope((nominal + sign * step)[chosen], link) for sign in (0.5, -0.5))
        assert np.max(np.abs(up - down - H[chosen])) < 1e-3 * np.max(np.abs(H[chosen]))


def test_lower_bounds_are_satisfied(links, boxes, nominal, scale):
    scale, wanted = np.append(scale, 1e-5), np.append(nominal, -1.0)
    lower = np.append(np.full(len(nominal), -np.inf), 1e-6)
    x = consistent_parameters(np.diag(1 / scale), wanted / scale, links, boxes, lower)
    assert x[-1] == pytest.approx(1e-6, rel=1e-3)


def test_rejects_a_program_without_a_solution(links, boxes, nominal, scale):
    lower = np.full(len(nominal), -np.inf)
    lower[0] = 100 * links[0].parameters[0]  # Exceeds the upper bound of the mass.
    with pytest.raises(IdentificationError, match=r"did not converge \(Clarabel: "):
        consistent_parameters(np.diag(1 / scale), nominal / scale, links, boxes, lower)


# Tests inertial parameters of a link against point masses, Drake's spatial inertia and the pseudo-inertia.


def parameters_of_points(p, masses):
    """Returns the parameters (10,) of point masses at p (k, 3) from their definition."""
    inertia = sum(m * ((x @ x) * np.eye(3) - np.outer(x, x)) for m, x in zip(masses, p, strict=True))
    return np.array([masses.sum(), *(masses @ p), *np.diag(inertia), inertia[0, 1], inertia[0, 2], inertia[1, 2]])


@pytest.fixture
def points():
    generator = np.random.default_rng(0)
    return generator.normal(0, 0.3, (7, 3)), generator.uniform(0.1, 1, 7)


def test_pseudo_inertia_equals_its_definition(points):
    p, masses = points
    homogeneous = np.column_stack([p, np.ones(7)])
    J = LinkInertia("link", parameters_of_points(p, masses)).pseudo_inertia()
    np.testing.assert_allclose(J, (homogeneous.T * masses) @ homogeneous, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(
        parameters_from_pseudo_inertia(J), parameters_of_points(p, masses), rtol=1e-12, atol=1e-12
    )


def test_change_of_frame_transforms_the_points(points):
    p_F, masses = points
    X_LF = RigidTransform(RotationMatrix.MakeXRotation(0.4) @ RotationMatrix.MakeZRotation(-1.2), [0.3, -0.1, 0.7])
    p_L = (X_LF @ p_F.T).T
    np.testing.assert_allclose(
        change_of_frame(X_LF) @ parameters_of_points(p_F, masses), parameters_of_points(p_L, masses), rtol=0, atol=1e-12
    )


def test_conversion_to_drake_and_back(points):
    parameters = parameters_of_points(*points)
    M_LLo_L = LinkInertia("link", parameters).to_spatial_inertia()
    assert M_LLo_L.IsPhysicallyValid()
    back = LinkInertia.from_spatial_inertia("link", M_LLo_L).parameters
    np.testing.assert_allclose(back, parameters, rtol=0, atol=1e-12)


def test_rejects_inconsistent_inertias(points):
    parameters = parameters_of_points(*points)
    with pytest.raises(ModelError, match="link: mass -1 kg must be positive"):
        LinkInertia("link", np.array([-1.0, *parameters[1:]])).to_spatial_inertia()
    flat = parameters.copy()
    flat[4] += 10 * parameters[4:7].sum()  # Ixx exceeds Iyy + Izz.
    with pytest.raises(ModelError, match="not physically consistent"):
        LinkInertia("link", flat).to_spatial_inertia()


@pytest.mark.parametrize("name", ["mtml", "psm"])
def test_links_of_an_arm_are_all_moving_bodies(name):
    arm = load_arm(name)
    links = {inertia.link: inertia for inertia in link_inertias(arm)}
    plant = make_arm_plant(arm)
    assert len(links) == len(arm.tree_joint_names)
    assert sum(link.parameters[0] for link in links.values()) + plant.GetBodyByName("base_link").default_mass() == (
        pytest.approx(plant.CalcTotalMass(plant.CreateDefaultContext()))
    )
    assert all(np.linalg.eigvalsh(link.pseudo_inertia())[0] > 0 for link in links.values())


# Tests that `nearest_links` returns physically consistent links with given base parameters of gravity.


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
