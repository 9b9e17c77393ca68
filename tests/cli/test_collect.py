"""Tests of the command collect with a simulated sticking arm instead of the network."""

import os
import sys
from types import SimpleNamespace

import numpy as np
import pytest
from sticky_arm import PERIOD, StickyArm, near_poses

from dvrk_drake.analysis.excitation.pose_file import load_poses, save_poses
from dvrk_drake.cli import main
from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.processes.arm_controller import ArmController
from dvrk_drake.recordings.formats import read_recording


@pytest.fixture
def simulated(monkeypatch):
    """Makes `main` control a StickyArm, and returns the settings of the simulation."""
    arm = load_arm("mtml")
    what = SimpleNamespace(stopped=lambda sticky: False, off_at=None, arms=[])

    opened = SimpleNamespace(next_status=lambda _: what.arms[-1].status(), close=lambda: None)

    def start(connection, mode):
        connection.ready()
        controller = ArmController(arm, IdentifiedModel.from_arm(arm), mode, PERIOD)
        what.arms.append(StickyArm(arm, IdentifiedModel.from_arm(arm), np.zeros(7), near_poses()[0]))
        return controller, opened

    def control(link, controller, stopped, report, on_status):
        sticky = what.arms[-1]
        while not stopped():
            status, time = sticky.status(), PERIOD * sticky.ticks
            sticky.off = sticky.ticks == what.off_at
            sticky.step(controller.answer(status, time, on_status(status, time)))

    monkeypatch.setattr("dvrk_drake.processes.arm_session.ArmSession.start", start)
    monkeypatch.setattr("dvrk_drake.processes.arm_session.ArmSession.open_lcm_link", lambda *_: opened)
    monkeypatch.setattr("dvrk_drake.processes.arm_session.control", control)
    monkeypatch.setattr(
        "dvrk_drake.processes.simulated_arm.stop_on_signals", lambda: lambda: what.stopped(what.arms[-1])
    )
    return what


def test_collect_stops_and_continues(simulated, tmp_path, capsys):
    poses, output = tmp_path / "p.yaml", tmp_path / "o.csv"
    save_poses(near_poses(2), load_arm("mtml"), poses)
    command = ["collect", "poses", str(poses), "--arm", "mtml", "--output", str(output)]
    command += ["--traverse-time", "1", "--no-both-sides"]
    simulated.stopped = lambda sticky: sticky.ticks > 1000
    assert main(command) == 130
    captured = capsys.readouterr()
    assert f"{output}: 0 of 2 poses" in captured.out and captured.err == "dvrk-drake: interrupted\n"

    simulated.stopped, simulated.off_at = lambda sticky: output.exists() and sticky.ticks > 2900, 2900
    assert main(command) == 2
    captured = capsys.readouterr()
    assert f"{output}: 1 of 2 poses" in captured.out
    assert captured.err.startswith("dvrk-drake: error: the guard of MTML holds the arm")
    assert captured.err.count("\n") == 1

    simulated.stopped, simulated.off_at = lambda sticky: False, None
    assert main(command) == 0
    assert "1 poses of MTML remain" in capsys.readouterr().out
    assert main(command) == 0
    assert f"{output}: contains all 2 poses already" in capsys.readouterr().out
    assert len(simulated.arms) == 3  # the last command did not control the arm
    np.testing.assert_allclose(read_recording(output).q, near_poses(2), atol=2e-3)


def test_collect_teaches_poses(simulated, tmp_path, monkeypatch, capsys):
    poses, arm = tmp_path / "p.yaml", load_arm("mtml")
    reading, writing = os.pipe()
    monkeypatch.setattr(sys, "stdin", os.fdopen(reading))
    os.close(writing)
    simulated.stopped = lambda sticky: sticky.ticks > 3000
    assert main(["collect", "teach", str(poses), "--arm", "mtml", "--at-rest"]) == 0
    np.testing.assert_allclose(load_poses(poses, arm), near_poses(1), atol=0.01)
    assert "pose 1 recorded\n" in capsys.readouterr().out
