"""Robots of a model file: mounting, delay of the efforts, bounding boxes and friction."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest
from robot_file import ROTORS, robot_motion, write_robot

import dvrk_drake as dvrk
from dvrk_drake.analysis.check.mounting import MIN_USED_OFFSET, find_mounting
from dvrk_drake.analysis.estimation.motion_effects import common_delay
from dvrk_drake.analysis.motion_identification import motion_problem
from dvrk_drake.analysis.observations.observations import Observations
from dvrk_drake.dynamics.actuator_effects import ActuatorEffect
from dvrk_drake.dynamics.momentum_observer import MIN_TRAVEL, REST_TIME, REVERSAL_SHARE, DryFrictionBound
from dvrk_drake.dynamics.physical_consistency import WIDENING, bounding_boxes
from dvrk_drake.models.arm_files import derived_arm_file


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


def test_presliding_is_uncertain_after_a_reversal(arm):
    travel, coefficient = 0.02, 2.0
    model = SimpleNamespace(
        arm=arm, effects=[ActuatorEffect("actuator.turn", "presliding", travel)], coefficients=[coefficient]
    )
    bound = DryFrictionBound(model)
    state, q, turn = bound.start(), np.zeros(3), np.array([1.0, 0.0, 0.0])
    deviations = []
    for step in np.repeat([0.001, -0.001], 100):
        q = q + step * turn
        bound.update(state, q, step / 0.001 * turn, 0.001)
        deviations.append(np.sqrt(bound.covariance(state)[0, 0]))
    within = np.arange(2, 2 * travel / 0.001 - 1, dtype=int)  # after the start, and after the reversal
    np.testing.assert_allclose(np.array(deviations)[within], coefficient / np.sqrt(3.0), atol=1e-9)
    np.testing.assert_allclose(np.array(deviations)[100 + within], REVERSAL_SHARE * coefficient, atol=1e-9)
    np.testing.assert_allclose(np.array(deviations)[[60, 99, 160, 199]], 0.0, atol=1e-9)


def test_reversal_share_is_the_error_between_two_travels():
    """Errors of the best combination of elements with travels 1 and 10/3 for an element with a travel between them."""
    d, ratios = np.linspace(0, 20 / 3, 2001)[:-1], []  # until both slide
    short, long = (np.minimum(d / w - 1, 1) for w in (1.0, 10 / 3))
    for w in (10 / 3) ** np.linspace(0, 1, 41):
        true = np.minimum(d / w - 1, 1)
        share = np.clip((short - long) @ (true - long) / np.sum((short - long) ** 2), 0, 1)
        stated = share * (d < 2) + (1 - share)
        error = true - share * short - (1 - share) * long
        ratios.append(np.mean(error**2) / np.mean(stated**2))
    np.testing.assert_allclose(np.sqrt(np.mean(ratios)), REVERSAL_SHARE, atol=0.01)


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


# Tests the search for the mounting of a robot.


#: Quarter turn of the joint swing [rad].
QUARTER_TURN = np.array([0.0, 0.0, np.pi / 2])


@pytest.fixture(scope="module")
def level_base(tmp_path_factory):
    # The base of this model is at the world, so that gravity is along an axis.
    return write_robot(tmp_path_factory.mktemp("robot"), ('rpy="0.3 0.2 0.1"', 'rpy="0 0 0"'))


def test_stated_mounting_is_kept(level_base):
    arm = dvrk.load_arm(level_base)
    assert find_mounting(Observations(robot_motion(arm), arm)) == (arm, [])


def test_gravity_along_another_axis_is_found_and_used(level_base):
    arm = dvrk.load_arm(level_base)
    found, (finding,) = find_mounting(Observations(robot_motion(arm.with_gravity([0, 9.81, 0])), arm))
    np.testing.assert_array_equal(found.gravity, [0, 9.81, 0])
    assert finding.kind == "gravity direction" and "(0 9.81 0)" in finding.what


def test_zero_that_differs_by_a_half_turn_is_found(level_base):
    arm = dvrk.load_arm(level_base)
    true = robot_motion(arm)
    found, _ = find_mounting(Observations(dataclasses.replace(true, q=true.q + 2 * QUARTER_TURN), arm))
    assert found.position_offsets == {"swing": pytest.approx(-np.pi)}


@pytest.mark.parametrize(
    ("gravity", "text"), [([0, 9.81, 0], "do not determine both"), ([0, 0, 9.81], "do not determine how")]
)
def test_unknown_gravity_and_zeros_are_reported(level_base, gravity, text):
    arm = dvrk.load_arm(level_base)
    true = robot_motion(arm.with_gravity(gravity))
    *_, finding = find_mounting(Observations(dataclasses.replace(true, q=true.q + QUARTER_TURN), arm))[1]
    assert finding.kind == "mounting" and text in finding.what and "position_offsets" in finding.advice


def test_shifted_zero_is_found_and_stored(level_base, tmp_path):
    arm = dvrk.load_arm(level_base)
    true = robot_motion(arm)
    shifted = dataclasses.replace(true, q=true.q + QUARTER_TURN)
    result = dvrk.identify(shifted, arm)
    assert {w.kind for w in result.warnings} == {"joint zero"}
    result.save(tmp_path / "model.yaml")
    model = dvrk.IdentifiedModel.load(tmp_path / "model.yaml")
    assert model.arm.position_offsets == {"swing": pytest.approx(-np.pi / 2)}
    other = robot_motion(arm, seed=1)
    validation = dvrk.validate(model, dataclasses.replace(other, q=other.q + QUARTER_TURN))
    assert max(validation.relative_errors.values()) < 0.05
    # The model file states no rotors. The inertia of the first joint is that of the links and of the rotor.
    rotors = [rotor.value for rotor in model.dynamics.rotors]
    assert rotors[1] == pytest.approx(ROTORS[1], abs=2.0)


@pytest.mark.slow
@pytest.mark.parametrize("offset", [0.5, 2.2])
def test_any_zero_that_gravity_shows_is_found(shared_data, offset):
    folder = shared_data / "other_robots" / "ur10e"
    if not folder.is_dir():
        pytest.skip(f"needs {folder}")
    arm = dvrk.load_arm(folder / "ur10e.urdf")
    true = dvrk.read_recording(folder / "motion_30s.csv", arm)
    shifted = dataclasses.replace(true, q=true.q + offset * np.eye(6)[2])
    found, (finding,) = find_mounting(Observations(shifted, arm))
    assert (finding.kind, finding.joints) == ("joint zero", (2,))
    np.testing.assert_allclose(finding.size, -offset, rtol=0, atol=0.1)
    is_used = offset > MIN_USED_OFFSET
    assert found.position_offsets == ({arm.joint_names[2]: finding.size} if is_used else {})
    assert ("This is used" if is_used else "It is not used") in finding.what


@pytest.mark.slow
def test_gravity_and_shifted_zeros_are_found_together(shared_data):
    folder = shared_data / "other_robots" / "ar5"
    if not folder.is_dir():
        pytest.skip(f"needs {folder}")
    arm = dvrk.load_arm(folder / "ar5.urdf")
    true = dvrk.read_recording(folder / "motion.csv", arm)
    offsets = np.array([0.0, np.pi / 2, 0.0, -np.pi / 2, 0.0, 0.0, 0.0])
    found, _ = find_mounting(Observations(dataclasses.replace(true, q=true.q - offsets), arm))
    np.testing.assert_array_equal(found.gravity, [9.81, 0, 0])
    np.testing.assert_allclose([found.position_offsets.get(n, 0.0) for n in arm.joint_names], offsets, atol=1e-9)


def test_mounting_of_an_arm_file_is_not_replaced(level_base, tmp_path):
    file = tmp_path / "robot.yaml"
    file.write_text(derived_arm_file(level_base, tmp_path))
    arm = dvrk.load_arm(file)
    report = dvrk.check(robot_motion(arm.with_gravity([0, 9.81, 0])), arm)
    (finding,) = (f for f in report.warnings if f.kind == "gravity direction")
    assert "It is not used" in finding.what and "--gravity 0 9.81 0" in finding.advice
