"""Tests that an exported SDF has the dynamics of the model."""

import dataclasses

import numpy as np
import pytest

from dvrk_drake.cli import main
from dvrk_drake.dynamics.dynamic_regressor import DynamicRegressor
from dvrk_drake.dynamics.dynamic_section import DynamicSection, LinkEstimate, RotorEstimate, SignalSettings
from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.dynamics.inertial_parameters import parameters_from_pseudo_inertia
from dvrk_drake.dynamics.model_links import model_bodies
from dvrk_drake.export.model_writer import write_model
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.models.effects_schema import DriveEffect

pytestmark = pytest.mark.numeric


def dynamic_model(arm: Arm, rotors: dict[str, float]) -> IdentifiedModel:
    """Returns a model with links that differ from the SDF, and with only the given rotors."""
    generator = np.random.default_rng(5)
    model = IdentifiedModel.from_arm(arm)
    links = []
    for link in DynamicRegressor(arm).links:
        X = np.eye(4) + 0.05 * generator.normal(size=(4, 4))
        parameters = parameters_from_pseudo_inertia(X @ link.pseudo_inertia() @ X.T)
        links.append(LinkEstimate(link.link, [float(x) for x in parameters]))
    n = arm.num_joints
    model.dynamics = DynamicSection(
        gravity=[float(x) for x in arm.gravity],
        links=links,
        rotors=[RotorEstimate(name, rotors.get(name, 0.0)) for name in arm.joint_names],
        effects=[DriveEffect(f"actuator.{arm.joint_names[0]}", "viscous", 0.0, 0.02)],
        signals=SignalSettings(50.0, [10.0] * n, 10.0, [0.0] * n),
    )
    return model


def parameters_of(model: IdentifiedModel, regressor: DynamicRegressor) -> np.ndarray:
    phi = [x for link in model.dynamics.links for x in link.parameters] + [r.value for r in model.dynamics.rotors]
    return np.concatenate([phi, np.zeros(len(regressor.values) - len(phi))])


def load_exported(model: IdentifiedModel, path) -> DynamicRegressor:
    arm, bodies = model.arm, model_bodies(model)
    write_model(arm, bodies.links, path, "a test", bodies.rotors)
    return DynamicRegressor(dataclasses.replace(arm, sdf=(str(path),)))


@pytest.mark.parametrize(
    ("name", "rotors"),
    [
        ("mtml", {"outer_yaw": 0.006, "shoulder_pitch": 0.004, "wrist_roll": 2e-5}),
        ("psm", {"yaw": 0.005, "roll": 1e-4}),
    ],
)
def test_exported_sdf_has_the_dynamics_of_the_model(name, rotors, tmp_path):
    arm = load_arm(name)
    model = dynamic_model(arm, rotors)
    original, exported = DynamicRegressor(arm), load_exported(model, tmp_path / "arm.sdf")
    generator = np.random.default_rng(6)
    q = arm.sample_poses(50, generator)
    motion = q, generator.normal(size=q.shape), 5 * generator.normal(size=q.shape)
    expected = original.torque(*motion, parameters_of(model, original))
    actual = exported.torque(*motion, exported.values)
    assert np.abs((actual - expected) / np.abs(expected).max(axis=0)).max() < 1e-12


@pytest.mark.parametrize(("actuator", "link"), [("elbow_pitch", "crank_link"), ("wrist_platform", "motor_4_link")])
def test_motor_of_several_joints_is_part_of_a_link(actuator, link, tmp_path):
    arm = load_arm("mtml")
    row = arm.transmission.matrix[arm.joint_names.index(actuator)]
    assert np.count_nonzero(row) == 2
    inertia = 0.003
    model, without = (dynamic_model(arm, rotors) for rotors in ({actuator: inertia}, {}))
    changed = [
        a.link
        for a, b in zip(model_bodies(model).links, model_bodies(without).links, strict=True)
        if np.abs(a.parameters - b.parameters).max() > 1e-12
    ]
    assert changed == [link]
    q = arm.sample_poses(20, np.random.default_rng(7))
    M = [
        r.mass_matrix(q, r.values)
        for r in (load_exported(model, tmp_path / "a.sdf"), load_exported(without, tmp_path / "b.sdf"))
    ]
    added = M[0] - M[1]
    # Compare the elements of I J' J for the last joint that rotates the motor about its axis.
    j = int(np.flatnonzero(row)[-1])
    np.testing.assert_allclose(added[:, 1:4, j], inertia * np.tile(row[1:4] * row[j], (20, 1)), rtol=0, atol=1e-12)
    assert np.linalg.eigvalsh(M[0]).min() > 0


def test_terms_that_sdf_does_not_support_are_printed(tmp_path, capsys):
    model, path = tmp_path / "model.yaml", tmp_path / "arm.sdf"
    dynamic_model(load_arm("psm"), {"wrist_yaw": 1e-5}).save(model)
    assert main(["export", "--model", str(model), "--sdf", str(path), "--urdf", str(tmp_path / "arm.urdf")]) == 0
    out = capsys.readouterr().out
    assert "couple joints" in out and "wrist_yaw" in out and "1 drive effects" in out
