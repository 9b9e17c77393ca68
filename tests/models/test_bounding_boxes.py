"""Tests the bounding boxes of links and their use as bounds of the mass distribution."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from dvrk_drake.dynamics.inertial_parameters import LinkInertia, link_inertias
from dvrk_drake.dynamics.physical_consistency import BoundingBox, bounding_boxes, box_margins, reached_bounds
from dvrk_drake.errors import ArmError
from dvrk_drake.models.arm_files import known_arms, load_arm
from dvrk_drake.models.arm_schema import BoundingShapes, BoxCorners


@pytest.mark.parametrize("name", known_arms())
def test_links_of_the_sdf_fit_their_boxes(name):
    arm = load_arm(name)
    boxes = bounding_boxes(arm)
    assert list(boxes) == [link.link for link in link_inertias(arm)]
    for link in link_inertias(arm):
        assert np.all(box_margins(link.parameters, boxes[link.link]) > 0.05), link.link


def test_box_encloses_collision_shapes_with_margin_of_its_file():
    boxes = bounding_boxes(load_arm("psm"))
    # The collision shape in psm.sdf is a box of 0.028 x 0.536 x 0.02 m about (0, 0.258, 0).
    np.testing.assert_allclose(boxes["bottom_bar_link"].lower, [-0.054, -0.05, -0.05], atol=1e-9)
    np.testing.assert_allclose(boxes["bottom_bar_link"].upper, [0.054, 0.566, 0.05], atol=1e-9)
    # The shaft of the instrument has a radius of 4.2 mm, and the margin of the instrument is 1 cm.
    assert boxes["roll_link"].half_width[0] == pytest.approx(0.0142, abs=2e-4)


def point_mass(mass, p):
    moments = np.sum(np.square(p)) - np.square(p)
    products = [-p[0] * p[1], -p[0] * p[2], -p[1] * p[2]]
    return mass * np.concatenate([[1.0], p, moments, products])


def test_margin_of_a_point_depends_on_distance_from_centre():
    """Checks that the margin is 1 - (d / w)^2 on each axis, with the distance d from the centre and the half width w.

    The margin of a body inside the box is positive.
    """
    box = BoundingBox(np.array([-0.1, 0.0, 0.2]), np.array([0.3, 0.2, 0.3]))
    p = np.array([0.2, 0.1, 0.32])
    expected = 1 - ((p - box.center) / box.half_width) ** 2
    np.testing.assert_allclose(box_margins(point_mass(0.7, p), box), expected, atol=1e-12)
    inside = np.random.default_rng(0).uniform(box.lower, box.upper, (20, 3))
    body = sum(point_mass(0.05, point) for point in inside)
    assert np.all(box_margins(body, box) >= 0)


def test_active_bounds_are_named():
    box = BoundingBox(np.full(3, -0.1), np.full(3, 0.1))
    nominal = LinkInertia("link", point_mass(1.0, np.zeros(3)))
    assert reached_bounds(nominal.parameters, nominal, box) == []
    assert reached_bounds(5 * nominal.parameters, nominal, box) == ["mass is 5 x the mass in the SDF"]
    far = point_mass(0.1, np.array([0.0, 0.1, 0.0]))
    assert reached_bounds(far, nominal, box) == [
        "mass is 0.1 x the mass in the SDF",
        "mass reaches its bounding box along y",
    ]


def with_shapes(arm, shapes):
    return dataclasses.replace(arm, identification=dataclasses.replace(arm.identification, bounding_shapes=(shapes,)))


def test_link_without_shapes_gets_a_box_around_its_inertia():
    arm = load_arm("mtmr")
    boxes = bounding_boxes(with_shapes(arm, BoundingShapes(margin=0.0)))
    link = next(link for link in link_inertias(arm) if link.link == "motor_4_link")
    # The solid box is the smallest box for which the second moments can be those of a body of uniform density.
    assert np.all(box_margins(link.parameters, boxes["motor_4_link"]) >= 2 / 3 - 1e-9)


def test_invalid_bounds_are_refused():
    arm = load_arm("mtmr")
    box = BoxCorners([0, 0, 0], [1, -1, 1])
    with pytest.raises(ArmError, match="lower and upper of crank_link must be three numbers each"):
        shapes = dataclasses.replace(arm.identification.bounding_shapes[0], boxes={"crank_link": box})
        bounding_boxes(with_shapes(arm, shapes))
    with pytest.raises(ArmError, match=r"boxes: .* has no link elbow"):
        shapes = dataclasses.replace(arm.identification.bounding_shapes[0], boxes={"elbow": box})
        bounding_boxes(with_shapes(arm, shapes))
