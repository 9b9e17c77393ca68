"""Compares exported gravity-compensation files with the model, evaluated by the dVRK's own controller."""

import json

import numpy as np
import pytest
from dvrk_judge import judge

from dvrk_drake.cli import main
from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.export.dvrk_mtm_gravity_compensation import (
    CompensationOptions,
    compensation_loss,
)
from dvrk_drake.export.dvrk_mtm_gravity_compensation_file import GravityCompensationFile, controller_torque
from dvrk_drake.export.dvrk_psm_gravity_compensation import kinematic_compensation
from dvrk_drake.models.arm_files import load_arm

pytestmark = pytest.mark.slow

COULOMB = np.array([0.05, 0.06, 0.04, 0.02, 0.01, 0.005, 0.0])
#: The 20000 poses of an export do not contain the largest difference exactly.
SAMPLING = 1.15


def poses_and_velocities(arm, count=600):
    """Returns poses within the joint limits, and speeds of 0, inside the dead band, between, and at full friction."""
    generator = np.random.default_rng(21)
    q = arm.sample_poses(count, generator)
    v = generator.uniform(-0.6, 0.6, q.shape)
    v[: count // 3] *= 0.02
    v[: count // 10] = 0.0
    return q, v


def expected_torque(model, q, v, options):
    """Returns the holding torque plus the share of the friction that the controller adds at the velocities v."""
    band, full = np.array(options.dead_band), np.array(options.saturation)
    speed = np.abs(v)
    share = np.where(speed <= band, 0.0, np.where(speed >= full, 1.0, (speed - band) / (full - band)))
    friction = np.array(options.friction_ratio) * share * np.sign(v) * options.coulomb
    return model.holding_torque(q) + np.where(model.feedforward_scale > 0, friction, 0.0)


def identified(shared_data, folder, recording, arm, *options):
    path = folder / "model.yaml"
    if not path.exists():
        assert main(["identify", str(shared_data / recording), "--arm", arm, *options, "--output", str(path)]) == 0
    return IdentifiedModel.load(path)


RECORDINGS = [("mtm_static/mtm_2015_good72.csv", "mtmr"), ("mtm_static/mtmr_2017_sweep40.csv", "mtmr")]


@pytest.mark.parametrize("source", ["mtml", "mtmr", *RECORDINGS])
def test_command_exports_within_the_tolerance_at_the_first_try(source, shared_data, tmp_path, capsys):
    if isinstance(source, str):
        model, given = IdentifiedModel.from_arm(load_arm(source)), ["--arm", source]
    else:
        model = identified(shared_data, tmp_path, *source)
        given = ["--model", str(tmp_path / "model.yaml")]
    path = tmp_path / "gc.json"
    capsys.readouterr()
    assert main(["export", *given, "--dvrk-gc", str(path), "--coulomb", *map(str, COULOMB)]) == 0
    out = " ".join(capsys.readouterr().out.split())
    loss = compensation_loss(GravityCompensationFile.load(path), model)
    assert all(f"{x:.2g}" in out for x in loss.difference if x > 1e-9)
    options = CompensationOptions(coulomb=tuple(COULOMB))
    q, v = poses_and_velocities(model.arm)
    actual = judge(shared_data, "judge", path, np.hstack([q, v]))
    difference = np.abs(actual - expected_torque(model, q, v, options)).max(axis=0)
    assert np.all(difference <= SAMPLING * loss.difference + 1e-12)
    assert np.all(difference <= model.arm.dry_friction())
    # At the poses of the export, the controller has the differences that the export states.
    poses = judge(shared_data, "judge", path, np.hstack([loss.poses, 0 * loss.poses]))
    stated = np.abs(poses - model.holding_torque(loss.poses)).diagonal()
    np.testing.assert_allclose(stated, loss.difference, rtol=0, atol=1e-12)


def test_torques_of_any_file_equal_those_of_the_controller(shared_data, tmp_path):
    generator = np.random.default_rng(4)
    path = tmp_path / "gc.json"
    GravityCompensationFile(
        positive=generator.normal(0, 0.1, 40),
        negative=generator.normal(0, 0.1, 40),
        torque_lower=np.full(7, -0.3),
        torque_upper=np.array([0.4, 0.5, 0.3, 0.2, 0.1, 0.1, 0.0]),
        dead_band=np.full(7, 0.02),
        saturation=np.full(7, 0.4),
        friction_ratio=generator.uniform(0, 1, 7),
    ).save(path, "MTML", "test")
    q, v = poses_and_velocities(load_arm("mtml"))
    for file in (path, *sorted((shared_data / "gc_json").glob("gc-*.json"))):
        actual = judge(shared_data, "judge", file, np.hstack([q, v]))
        np.testing.assert_allclose(controller_torque(GravityCompensationFile.load(file), q, v), actual, atol=1e-12)


@pytest.mark.parametrize("insertion", [True, False])
@pytest.mark.parametrize("recording", [None, "psm_three_joints/psm1_1.csv", "psm_three_joints/psm2_1.csv"])
def test_file_of_a_psm(recording, insertion, shared_data, tmp_path):
    model = IdentifiedModel.from_arm(load_arm("psm"))
    locked = ("--locked", "roll=0", "wrist_pitch=0", "wrist_yaw=0", "jaw=0")
    if recording is not None:
        model = identified(shared_data, tmp_path, recording, "psm", *locked)
    if not insertion:
        model.joints[2].feedforward_scale = 0.0
    # Not the default tolerance, because the offsets and cables of a motion can exceed it.
    file = kinematic_compensation(model, 10.0)
    path = tmp_path / "psm.json"
    file.save(path)
    q = model.arm.sample_poses(300, np.random.default_rng(9))
    q[:, 3:] = 0.0
    actual = judge(shared_data, "judge_psm", path, q[:, :3])
    difference = np.abs(actual - model.holding_torque(q)[:, :3]).max(axis=0)
    assert np.all(difference <= SAMPLING * file.loss.difference + 1e-12)
    gravity = len(model.base_parameters)
    torque = model.static_model.regressor(q)[:, :3, :gravity] @ model.theta[:gravity] * [1, 1, insertion]
    # The file contains exactly the gravity of the links, unless the counterweight is heavier than what it balances.
    is_exact = file.mass[5:].any()
    assert is_exact or recording == "psm_three_joints/psm2_1.csv"
    np.testing.assert_allclose(actual, torque, rtol=0, atol=1e-12 if is_exact else 0.01)


def test_version_1_file_has_the_torque_of_the_controller(shared_data):
    path = shared_data / "cases" / "gc-v1.json"
    q, _ = poses_and_velocities(load_arm("mtmr"), 100)
    actual = judge(shared_data, "judge", path, np.hstack([q, 0 * q]))
    np.testing.assert_allclose(controller_torque(GravityCompensationFile.load(path), q), actual, rtol=0, atol=1e-12)


def test_file_of_a_tilted_psm(shared_data, tmp_path):
    """The program of the controller has an upright base, so the test adds the tilt to the first joint of the file."""
    model = IdentifiedModel.from_arm(load_arm("psm").with_gravity([0.0, 6.9367, -6.9367]))
    file = kinematic_compensation(model)
    path = tmp_path / "psm.json"
    file.save(path)
    content = json.loads(path.read_text())
    content["DH"]["joints"][0]["alpha"] += file.mounting_pitch
    path.write_text(json.dumps(content))
    q = model.arm.sample_poses(100, np.random.default_rng(9))
    q[:, 3:] = 0.0
    expected = model.holding_torque(q)[:, :3]
    np.testing.assert_allclose(judge(shared_data, "judge_psm", path, q[:, :3]), expected, rtol=0, atol=1e-9)
