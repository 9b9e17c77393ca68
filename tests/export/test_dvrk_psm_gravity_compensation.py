"""Compares the dVRK's gravity-compensation file for a PSM with the model, by an independent evaluation."""

import json
import os

import numpy as np
import pytest
from command_output import assert_refused, refusal, refused
from pydrake.math import RigidTransform, RollPitchYaw

from dvrk_drake.cli import main
from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.errors import ModelError
from dvrk_drake.export.dvrk_psm_gravity_compensation import kinematic_compensation
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.models.effects_schema import DriveEffect

pytestmark = pytest.mark.slow


def dvrk_controller(path, q, pitch):
    """Returns the torques of yaw, pitch and insertion by the recursive Newton-Euler algorithm for the chain at rest.

    `pitch` is `mounting_pitch` in the configuration of the arm [rad].
    """
    gravity = [0.0, -9.81 * np.sin(pitch), -9.81 * np.cos(pitch)]
    joints = json.loads(path.read_text())["DH"]["joints"]
    positions = [q[0], 0, q[1], -q[1], q[1], q[2] / 2, q[2] / 2]
    poses = []
    for joint, position in zip(joints, positions, strict=True):
        prismatic = joint["type"] == "prismatic"
        turn = RigidTransform(RollPitchYaw(0, 0, joint["theta"] + (0 if prismatic else position)), np.zeros(3))
        poses.append(
            RigidTransform(RollPitchYaw(joint["alpha"], 0, 0), np.zeros(3))
            @ RigidTransform(np.array([joint["A"], 0, 0]))
            @ turn
            @ RigidTransform(np.array([0, 0, joint["D"] + (position if prismatic else 0)]))
        )
    down = [poses[0].rotation().inverse() @ np.asarray(gravity)]
    for X in poses[1:]:
        down.append(X.rotation().inverse() @ down[-1])
    force, torque, t = np.zeros(3), np.zeros(3), []
    for i in reversed(range(7)):
        joint = joints[i]
        weight = -joint["mass"] * down[i]
        center = np.array([joint["cx"], joint["cy"], joint["cz"]])
        if i < 6:  # Wrench on link i + 1, expressed in link i.
            X = poses[i + 1]
            force, torque = X.rotation() @ force, X.rotation() @ torque
            torque = torque + np.cross(X.translation(), force)
        force, torque = force + weight, torque + np.cross(center, weight)
        t.append(force[2] if joint["type"] == "prismatic" else torque[2])
    t = t[::-1]
    return np.array([t[0], t[2] - t[3] + t[4], t[6]])


def perturbed_psm():
    model = IdentifiedModel.from_arm(load_arm("psm"))
    generator = np.random.default_rng(7)
    for p in model.base_parameters:
        p.value *= 1 + 0.3 * generator.normal()
    return model


@pytest.mark.parametrize("gravity", [None, [0.0, -4.0, -9.0], [0.0, 6.9367, -6.9367], [0.0, 5.0, 5.0]])
def test_file_gives_the_torque_of_the_model(gravity, tmp_path):
    model = perturbed_psm()
    if gravity is not None:
        model.arm = model.arm.with_gravity(gravity)
        model.base_parameters = IdentifiedModel.from_arm(model.arm).base_parameters
    path = tmp_path / "psm.json"
    file = kinematic_compensation(model)
    file.save(path)
    arm = model.arm
    q = arm.sample_poses(200, np.random.default_rng(8))
    q[:, 3:] = 0.0
    expected = model.holding_torque(q)[:, :3]
    actual = np.array([dvrk_controller(path, pose[:3], file.mounting_pitch) for pose in q])
    np.testing.assert_allclose(actual, expected, rtol=0, atol=1e-9)
    assert np.ptp(expected, axis=0).min() > 0.01
    assert np.all(file.mass >= 0) and np.abs(file.center).max() < 1.0


def test_chain_has_the_dimensions_of_the_arm(tmp_path):
    """The chain has the dimensions of the linkage, and its last frame is frame 3 of the dVRK."""
    path = tmp_path / "psm.json"
    kinematic_compensation(perturbed_psm()).save(path)
    joints = json.loads(path.read_text())["DH"]["joints"]
    assert [j["type"] for j in joints] == ["revolute"] * 5 + ["prismatic"] * 2
    # Distances AO, AB, BE and the distance of E from the shaft, see psm.sdf.
    np.testing.assert_allclose([joints[i]["A"] for i in (2, 3, 4, 5)], [0.516, 0.15, 0.516, 0.042998], atol=1e-6)
    assert joints[6]["D"] == pytest.approx(0.143705 - 0.4318, abs=1e-9)


def test_rejects_a_model_that_the_file_cannot_represent():
    model = perturbed_psm()
    model.effects = [DriveEffect("joint.pitch", "offset", 0.0, 0.1), DriveEffect("joint.yaw", "offset", 0.0, 0.02)]
    file = kinematic_compensation(model)  # The dry friction of the pitch is 0.285 N m.
    np.testing.assert_allclose(file.loss.difference, [0.02, 0.1, 0.0], rtol=0, atol=1e-9)
    assert file.loss.causes == ("effect joint.yaw offset", "effect joint.pitch offset", "")
    with pytest.raises(
        ModelError, match=r"pitch 0\.1 N m \(3\.0 %.*cause: effect joint.pitch off.*--gc-tolerance 0\.1"
    ):
        kinematic_compensation(model, 0.05)
    model.effects[0].coefficient = 0.3
    with pytest.raises(ModelError, match=r"pitch 0\.3 N m \(9\.0 % of the effort limit, allowed: 0\.285 N m"):
        kinematic_compensation(model)
    model.joints[1].feedforward_scale = 0.0
    assert_refused(ModelError, "feedforward is disabled for pitch", kinematic_compensation, model)
    heavy = perturbed_psm()
    (net,) = (p for p in heavy.base_parameters if "- m_counterweight" in p.name and p.name.startswith("(m3"))
    net.value = -0.2
    assert_refused(ModelError, r"net mass on the insertion joint is -0\.2 kg", kinematic_compensation, heavy)
    net.value = -0.01  # Its weight is less than the dry friction.
    light = kinematic_compensation(heavy)
    assert not light.mass[5:].any() and light.loss.causes[2] == "negative net mass on the insertion joint"
    assert light.loss.difference[2] == pytest.approx(0.01 * 9.81, rel=1e-2)
    assert_refused(ModelError, "is not a PSM", kinematic_compensation, IdentifiedModel.from_arm(load_arm("mtml")))


def test_insertion_without_feedforward_has_no_torque():
    model = perturbed_psm()
    before = kinematic_compensation(model)
    model.joints[2].feedforward_scale = 0.0
    file = kinematic_compensation(model)
    np.testing.assert_allclose(file.loss.difference, 0.0, atol=1e-9)
    assert before.mass[6] > 0 and file.mass[6] == 0
    assert file.mass[5] == pytest.approx(2 * before.mass[6], rel=1e-9)


def test_gravity_that_mounting_pitch_cannot_express_is_refused(tmp_path, capsys, monkeypatch):
    """The difference is computed with the gravity of the controller, not with that of the model."""
    monkeypatch.chdir(tmp_path)
    nominal = load_arm("psm")
    for name, gravity in {"pitch": [0.0, 6.9367, -6.9367], "roll": [6.9367, 0.0, -6.9367]}.items():
        IdentifiedModel.from_arm(nominal.with_gravity(gravity)).save(f"{name}.yaml")
    command = ["export", "--dvrk-kinematic-gc", "gc.json", "--model"]
    error = refused(capsys, *command, "roll.yaml")
    assert "cause: sideways base tilt of 45 deg, which mounting_pitch cannot express" in error
    assert not os.path.exists("gc.json")
    assert main([*command, "pitch.yaml"]) == 0
    printed = " ".join(capsys.readouterr().out.split())
    assert 'enter "kinematic_gc": "gc.json", "mounting_pitch": -0.785398 in the arm\'s JSON' in printed
    # An SDF has no gravity vector of the base frame. One line states it.
    assert main(["export", "--model", "roll.yaml", "--sdf", "roll.sdf"]) == 0
    printed = " ".join(capsys.readouterr().out.split())
    assert "Not exported: gravity (6.937, 0.000, -6.937) m/s^2 in the base frame" in printed
    assert printed.count("m/s^2") == 1


def test_mounting_pitch_of_the_configuration_is_checked(tmp_path, capsys, monkeypatch):
    """The configuration is given, or lies beside the file. The controller uses 0 if it has no mounting_pitch."""
    monkeypatch.chdir(tmp_path)
    IdentifiedModel.from_arm(load_arm("psm").with_gravity([0.0, 6.9367, -6.9367])).save("psm.yaml")
    command = ["export", "--model", "psm.yaml", "--dvrk-kinematic-gc", "gc.json", "--overwrite"]
    required = "rad, but the gravity vector of the model requires -0.785398 rad. The controller's torque of"
    beside, other = tmp_path / "arm.json", tmp_path / "other.txt"
    for content, message in {
        '{"kinematic_gc": "gc/gc.json" /* none */}': f"arm.json: mounting_pitch is 0 {required}",
        '{"kinematic-gc": "gc.json", "mounting-pitch": 0.785398}': f"arm.json: mounting_pitch is 0.785398 {required}",
        '{"kinematic_gc": "gc.json", "mounting_pitch": -45}': "arm.json: mounting_pitch is -45; allowed: a number",
    }.items():
        beside.write_text(content)
        assert message in refused(capsys, *command) and not os.path.exists("gc.json")
    beside.write_text('{"kinematic_gc": "other.json"}')
    assert main(command) == 0
    other.write_text('{"mounting_pitch": -0.785398, // -45.0 degrees, "https://a"\n "kinematic_gc": "gc.json"}')
    capsys.readouterr()
    assert main([*command, "--configuration", "other.txt"]) == 0
    printed = " ".join(capsys.readouterr().out.split())
    assert "are equal at rest" not in printed  # -0.785398 has six digits
    assert "Compared with the mounting_pitch of other.txt, -0.785398 rad" in printed
    assert main(["export", "--arm", "psm", "--sdf", "a.sdf", "--configuration", "other.txt"]) == 2
    assert "--configuration requires --dvrk-kinematic-gc" in refusal(capsys.readouterr().err)


def test_rejected_export_writes_no_file(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    model = perturbed_psm()
    model.effects = [DriveEffect("joint.pitch", "offset", 0.0, 0.1)]
    model.save("model.yaml")
    arguments = ["export", "--model", "model.yaml", "--sdf", "model.sdf", "--dvrk-kinematic-gc", "gc.json"]
    assert main([*arguments, "--gc-tolerance", "1e-9"]) == 2
    assert "cannot represent this model" in capsys.readouterr().err
    assert os.listdir() == ["model.yaml"]
    assert main([*arguments, "--gc-tolerance", "10"]) == 0
    assert {"model.sdf", "gc.json"} < set(os.listdir())
