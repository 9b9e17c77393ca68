"""Tests the search for the mounting of a robot."""

import dataclasses

import numpy as np
import pytest
from robot_file import write_robot
from robot_motion import ROTORS, robot_motion

import dvrk_drake as dvrk
from dvrk_drake.analysis.check.mounting import MIN_USED_OFFSET, find_mounting
from dvrk_drake.analysis.observations.observations import Observations
from dvrk_drake.models.arm_files import derived_arm_file

#: Quarter turn of the joint swing [rad].
QUARTER_TURN = np.array([0.0, 0.0, np.pi / 2])


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    # The base of this model is at the world, so that gravity is along an axis.
    return write_robot(tmp_path_factory.mktemp("robot"), ('rpy="0.3 0.2 0.1"', 'rpy="0 0 0"'))


def test_stated_mounting_is_kept(path):
    arm = dvrk.load_arm(path)
    assert find_mounting(Observations(robot_motion(arm), arm)) == (arm, [])


def test_gravity_along_another_axis_is_found_and_used(path):
    arm = dvrk.load_arm(path)
    found, (finding,) = find_mounting(Observations(robot_motion(arm.with_gravity([0, 9.81, 0])), arm))
    np.testing.assert_array_equal(found.gravity, [0, 9.81, 0])
    assert finding.kind == "gravity direction" and "(0 9.81 0)" in finding.what


def test_shifted_zero_is_found_and_stored(path, tmp_path):
    arm = dvrk.load_arm(path)
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


def test_mounting_of_an_arm_file_is_not_replaced(path, tmp_path):
    file = tmp_path / "robot.yaml"
    file.write_text(derived_arm_file(path, tmp_path))
    arm = dvrk.load_arm(file)
    report = dvrk.check(robot_motion(arm.with_gravity([0, 9.81, 0])), arm)
    (finding,) = (f for f in report.warnings if f.kind == "gravity direction")
    assert "It is not used" in finding.what and "--gravity 0 9.81 0" in finding.advice
