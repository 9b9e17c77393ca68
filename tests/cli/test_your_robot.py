"""Runs the commands for a robot of which only a model file exists: one prismatic joint, one mimic joint."""

import pytest
from robot_file import write_robot
from robot_motion import robot_motion

import dvrk_drake as dvrk
from dvrk_drake.cli import main


@pytest.mark.slow
def test_commands_accept_a_model_file(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    write_robot(tmp_path)
    arm = dvrk.load_arm("crane.urdf")
    for seed in (0, 1):
        dvrk.write_recording(robot_motion(arm, seed), f"motion_{seed}.csv")
    commands = [
        "arm-file crane.urdf --output crane.yaml",
        "check motion_0.csv --arm crane.urdf --json check.json",
        "identify motion_0.csv --arm crane.urdf --output model.yaml --report report.html",
        "validate motion_1.csv --model model.yaml --json validation.json",
        "predict motion_1.csv --model model.yaml --output predicted.csv",
        "recalibrate motion_1.csv --model model.yaml --output today.yaml",
        "payload motion_1.csv --model model.yaml",
        "excite --arm crane.urdf --static 12 --output poses.yaml",
        "simulate --arm crane.yaml --set duration=0.2",
        "model --arm crane.urdf --format c --output gravity.c",
        "tune --arm crane.urdf --method model --output gains.yaml",
        "export --model model.yaml --sdf identified.sdf",
        "export --model model.yaml --urdf identified.urdf",
    ]
    for command in commands:
        assert main(command.split()) == 0, (command, capsys.readouterr())
    # What was exported is again a model file.
    for name in ("identified.sdf", "identified.urdf"):
        assert dvrk.load_arm(name).joint_names == arm.joint_names
