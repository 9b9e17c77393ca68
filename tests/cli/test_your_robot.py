"""Runs the commands that need no network for random robots of which only a model file exists."""

import numpy as np
import pytest
import yaml
from robot_file import random_motion, random_robot

import dvrk_drake as dvrk
from dvrk_drake.analysis.estimation.point_mass import point_mass_parameters
from dvrk_drake.cli import main, support
from dvrk_drake.dynamics.inertial_parameters import LinkInertia, link_inertias

STUDY = {
    "scenario": "random.urdf",
    "set": ["duration=0.1", "controller.mode=gravity"],
    "random_poses": {"count": 2, "seed": 0},
    "measures": [{"kind": "effort_share"}],
}
#: A hand moves the arm by its last link.
SCENARIO = {
    "arm": "random.urdf",
    "duration": 0.3,
    "controller": {"mode": "gravity"},
    "hand": {"path": [{"time": 0.0, "pose": [0.0, 0.0, 0.0]}, {"time": 0.2, "pose": [0.02, 0.02, 0.02]}]},
}


@pytest.mark.slow
def test_commands_accept_a_model_file(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    arm = dvrk.load_arm(random_robot(tmp_path, 0))
    for k in (0, 1):
        dvrk.write_recording(random_motion(arm, k), f"motion_{k}.csv")
    q = arm.sample_poses(40, np.random.default_rng(0))
    dvrk.write_recording(dvrk.Recording(q=q, tau=dvrk.IdentifiedModel.from_arm(arm).holding_torque(q)), "poses.csv")
    assert arm.num_joints == 3 and len(arm.tree_joint_names) == 4 and arm.frames.hand == "link_4"
    for name, content in (("study", STUDY), ("scenario", SCENARIO)):
        (tmp_path / f"{name}.yaml").write_text(yaml.safe_dump(content))
    commands = [
        "arm-file random.urdf --output random.yaml",
        "check motion_0.csv --arm random.urdf --json check.json",
        "convert motion_0.csv --output joint.csv --arm random.urdf",
        "identify motion_0.csv --arm random.urdf --output model.yaml --report report.html",
        "validate motion_1.csv --model model.yaml --json validation.json",
        "predict motion_1.csv --model model.yaml --output predicted.csv",
        "identify poses.csv --arm random.urdf --output static.yaml --report static.html",
        "validate poses.csv --model model.yaml --report poses.html",
        "identify recalibrate motion_1.csv --model model.yaml --output today.yaml",
        "payload motion_1.csv --model model.yaml",
        "excite --arm random.urdf --static 12 --output poses.yaml",
        "excite --arm random.urdf --duration 6 --period 6 --harmonics 4 --starts 1 --output motion.yaml",
        "simulate --arm random.yaml --set duration=0.2 --set controller.mode=guide",
        "simulate scenario.yaml --output held.csv",
        "simulate transparency --arm random.urdf --path motion_0.csv --speed 5",
        "simulate study study.yaml --output study.csv --workers 1",
        "equations --arm random.urdf --format c --output gravity.c",
        "simulate tune --arm random.urdf --method model --output gains.yaml",
        "export --model model.yaml --sdf identified.sdf",
        "export --model model.yaml --urdf identified.urdf",
        "export --model model.yaml --mjcf identified.xml",
        "view --arm random.urdf",
    ]
    # The page shows the arm once, instead of until the operator stops it.
    monkeypatch.setattr(support, "until_stopped", lambda meshcat, update: update())
    for command in commands:
        assert main(command.split()) == 0, (command, capsys.readouterr())
    # What was exported is again a model file.
    for name in ("identified.sdf", "identified.urdf"):
        assert dvrk.load_arm(name).joint_names == arm.joint_names


@pytest.mark.slow
def test_payload_of_an_arm_ten_times_as_large(tmp_path):
    arm = dvrk.load_arm(random_robot(tmp_path, 1, 10.0))
    links = {link.link: link for link in link_inertias(arm)}
    mass, position = 0.3 * sum(link.parameters[0] for link in links.values()), np.array([1.5, -2.0, 1.0])
    hand = links["link_4"].parameters + point_mass_parameters(mass, position)
    loaded = {**links, "link_4": LinkInertia("link_4", hand)}
    empty, with_payload = (
        random_motion(arm, inertias={name: link.to_spatial_inertia() for name, link in which.items()})
        for which in (links, loaded)
    )
    found = dvrk.payload(empty, with_payload, arm, "link_4").payload.body
    np.testing.assert_allclose(found.mass, mass, rtol=0.05, atol=0)
    np.testing.assert_allclose(found.position, position, atol=0.2)


@pytest.mark.parametrize("size", [0.1, 10.0])
def test_arms_of_other_sizes_are_loaded(size, tmp_path):
    (folder := tmp_path / "usual").mkdir()
    arm, usual = (dvrk.load_arm(random_robot(*where)) for where in ((tmp_path, 0, size), (folder, 0)))
    q = usual.sample_poses(3, np.random.default_rng(0))
    scaled = np.where(usual.prismatic, size, 1.0)
    tau = [dvrk.IdentifiedModel.from_arm(which).holding_torque(x) for which, x in ((usual, q), (arm, q * scaled))]
    np.testing.assert_allclose(tau[1] / arm.effort_limits, tau[0] / usual.effort_limits, atol=1e-9)
