"""Assumptions on robots of a model file: delay of the efforts, bounding boxes and friction."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest
from robot_file import write_robot
from robot_motion import robot_motion

import dvrk_drake as dvrk
from dvrk_drake.analysis.estimation.motion_effects import common_delay
from dvrk_drake.analysis.motion_identification import motion_problem
from dvrk_drake.analysis.observations.observations import Observations
from dvrk_drake.dynamics.actuator_effects import ActuatorEffect
from dvrk_drake.dynamics.dry_friction_bound import MIN_TRAVEL, REST_TIME, DryFrictionBound
from dvrk_drake.dynamics.physical_consistency import WIDENING, bounding_boxes


@pytest.fixture(scope="module")
def arm(tmp_path_factory):
    return dvrk.load_arm(write_robot(tmp_path_factory.mktemp("robot")))


@pytest.fixture(scope="module")
def motion(arm):
    return robot_motion(arm, seconds=5.0)


@pytest.mark.parametrize("delay", [0.0, 0.012])
def test_delay_of_all_efforts(arm, motion, delay):
    tau = np.column_stack([np.interp(motion.t - delay, motion.t, x) for x in motion.tau.T])
    observations = [Observations(dataclasses.replace(motion, tau=tau), arm)]
    np.testing.assert_allclose(common_delay(motion_problem(observations), observations), delay, rtol=0, atol=0.002)


def test_known_friction_bounds_presliding_only(arm, motion):
    problem = motion_problem([Observations(motion, arm)])
    known = dataclasses.replace(problem, friction=np.full(3, 1e-3))
    changed = known.effect_precision > problem.effect_precision
    presliding = np.array([effect.kind == "presliding" for effect in problem.columns.effects])
    np.testing.assert_array_equal(changed, presliding)


def test_friction_efforts(arm, motion):
    problem = motion_problem([Observations(motion, arm)])
    effects = [(e.coordinate, e.kind) for e in problem.columns.effects]
    used = np.array([effects.index(("actuator.turn", "offset")), effects.index(("actuator.lift", "viscous"))])
    friction = problem.friction_efforts(used, np.array([5.0, 2.0]))
    expected = 2.0 * np.sqrt(np.mean(problem.columns.shapes[1][:, used[1]] ** 2))
    np.testing.assert_allclose(friction, [0.0, expected, 0.0], rtol=1e-9, atol=1e-12)


def test_gears_rest_despite_noise_of_the_velocity(arm):
    gear = SimpleNamespace(arm=arm, effects=[ActuatorEffect("actuator.turn", "presliding", 1e-5)], coefficients=[2.0])
    bound = DryFrictionBound(gear)
    state, q = bound.start(), np.zeros(3)
    for turn in (0.5, 0.0):  # moves over twice the travel, then rests
        bound.update(state, q + turn, np.full(3, 1.0), 0.01)
    noise = 0.1 * MIN_TRAVEL[0] / REST_TIME
    for _ in range(200):
        bound.update(state, q, np.full(3, noise), 0.01)
    np.testing.assert_allclose(bound.covariance(state)[0, 0], 4.0 / 3.0, rtol=0.05, atol=0)


def test_boxes_without_collision_shapes_are_wider(tmp_path):
    # If a mesh were missing, all shapes would be omitted.
    mesh = (
        '<visual><geometry><mesh filename="package://crane_description/meshes/no_such_file.obj"/></geometry></visual>'
    )
    arm = dvrk.load_arm(write_robot(tmp_path, (mesh, "")))
    boxes, margin = bounding_boxes(arm), arm.identification.bounding_shapes[0].margin
    np.testing.assert_allclose(boxes["column"].half_width, np.array([0.05, 0.05, 0.2]) + margin, rtol=0, atol=1e-9)
    # The half widths of the solid box are sqrt(3 (tr(I) / 2 - I) / m) about the centre of mass, and 0.05 m along x is
    # the centre of mass of the hand. No joint follows.
    w = np.sqrt(3 * (0.00095 - np.array([0.0004, 0.0008, 0.0007])) / 0.4)
    lower, upper = np.minimum(0, np.array([0.05, 0, 0.02]) - w), np.maximum(0, np.array([0.05, 0, 0.02]) + w)
    np.testing.assert_allclose(boxes["hand"].half_width, WIDENING * ((upper - lower) / 2 + margin), rtol=0, atol=1e-9)
