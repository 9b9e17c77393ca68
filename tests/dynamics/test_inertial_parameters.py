"""Tests inertial parameters of a link against point masses, Drake's spatial inertia and the pseudo-inertia."""

from __future__ import annotations

import numpy as np
import pytest
from pydrake.math import RigidTransform, RotationMatrix

from dvrk_drake.dynamics.inertial_parameters import (
    LinkInertia,
    change_of_frame,
    link_inertias,
    parameters_from_pseudo_inertia,
)
from dvrk_drake.errors import ModelError
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.models.plant import make_arm_plant

pytestmark = [pytest.mark.numeric, pytest.mark.drake_api]


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
