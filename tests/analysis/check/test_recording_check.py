"""Checks of simulated motions and poses, and the command `dvrk-drake check`."""

import json
from dataclasses import replace

import numpy as np
import pytest
from check_findings import ARMS, changed, found
from command_output import refusal
from figure_rules import checked_figures
from synthetic_motion import PERIOD, clean_motion

from dvrk_drake.analysis.check.recording_check import check_recording
from dvrk_drake.analysis.observations.observations import Observations
from dvrk_drake.cli import main
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.models.plant import holding_torques
from dvrk_drake.recordings.recording import MIN_ROWS, Recording
from dvrk_drake.recordings.writing import write_recording

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("name", ARMS)
def test_clean_motion_has_only_the_period_as_finding(name):
    report = check_recording(Observations(clean_motion(name), load_arm(name)))
    assert [finding.kind for finding in report.findings] == ["repetition"]
    assert report.period == pytest.approx(PERIOD, abs=1e-4)
    assert report.jitter == 0.0
    assert report.repeated == 0.0
    for joint in report.joints:
        assert joint.velocity_gain == pytest.approx(1, abs=2e-3)
        assert joint.velocity_lag == pytest.approx(0, abs=1e-4)


@pytest.mark.parametrize("name", ARMS)
def test_actuator_coordinates_have_the_same_findings(name):
    arm, recording = load_arm(name), clean_motion(name)
    joint, actuator = (
        check_recording(Observations(r, arm)) for r in (recording, recording.in_actuator_coordinates(arm))
    )
    assert [f.kind for f in joint.findings] == [f.kind for f in actuator.findings]
    for a, b in zip(joint.joints, actuator.joints, strict=True):
        assert a.floor == pytest.approx(b.floor, rel=1e-6)
        assert a.range == pytest.approx(b.range, rel=1e-9)


def test_a_motion_that_does_not_repeat_has_no_floor():
    recording = clean_motion(period=97.0)
    kinds = found(recording)
    assert "no repetition" in kinds
    assert "repetition" not in kinds
    assert {f.severity for fs in kinds.values() for f in fs} <= {"note", "warning"}


def test_detects_a_joint_that_does_not_move():
    still = changed(changed(clean_motion(), "q", 3, lambda x: 0 * x + 0.1), "qd", 3, lambda x: 0 * x)
    kinds = found(still)
    assert [f.joints for f in kinds["never moves"]] == [(3,)]
    assert {f.severity for fs in kinds.values() for f in fs} <= {"note", "warning"}


def test_detects_little_excitation():
    arm = load_arm("psm")
    middle = (arm.position_lower[0] + arm.position_upper[0]) / 2
    small = changed(clean_motion(), "q", 0, lambda x: middle + 0.1 * (x - middle))
    small = changed(small, "qd", 0, lambda x: 0.1 * x)
    finding = found(small)["little excitation"][0]
    assert finding.joints == (0,)
    assert finding.size == pytest.approx(
        0.1 * np.ptp(clean_motion().q[:, 0]) / np.ptp([arm.position_lower[0], arm.position_upper[0]])
    )


def test_detects_joints_that_move_together():
    whole = clean_motion()
    q, qd = whole.q.copy(), whole.qd.copy()
    q[:, 1], qd[:, 1] = 0.5 * q[:, 0], 0.5 * qd[:, 0]
    assert [f.joints for f in found(replace(whole, q=q, qd=qd))["move together"]] == [(0, 1)]


def test_detects_positions_outside_limits():
    arm = load_arm("psm")
    beyond = arm.position_upper[4] + 0.05
    whole = clean_motion()
    finding = found(changed(whole, "q", 4, lambda x: x + beyond - x.max()))["outside limits"][0]
    assert finding.joints == (4,)
    assert finding.size == pytest.approx(0.05)


def poses(arm, count=40):
    q = arm.sample_poses(count, np.random.default_rng(1), margin=0.1)
    return Recording(q, holding_torques(arm, q))


def test_poses_have_no_signals():
    arm = load_arm("mtml")
    recording = poses(arm)
    noise = np.random.default_rng(3).normal(size=recording.tau.shape)
    recording = replace(recording, tau=recording.tau + 1e-3 * noise)
    report = check_recording(Observations(recording, arm))
    assert report.kind == "poses"
    assert report.findings == ()
    assert report.joints[1].effort > 0
    assert report.joints[1].velocity_gain is None


def test_warns_of_a_motion_without_times():
    motion = clean_motion("psm")
    rows = replace(motion, t=None, qd=None)
    assert [finding.kind for finding in check_recording(Observations(rows, load_arm("psm"))).warnings].count(
        "no times"
    ) == 1
    apart = replace(rows, q=rows.q[::30], tau=rows.measured_effort()[::30], lines=None)
    assert all(finding.kind != "no times" for finding in check_recording(Observations(apart, load_arm("psm"))).findings)


def test_refuses_another_number_of_joints():
    assert found(Recording(np.zeros((5, 6)), np.zeros((5, 6))))["unusable"][0].severity == "refusal"


def test_refuses_a_recording_without_efforts():
    assert found(replace(clean_motion(), tau=None))["unusable"][0].severity == "refusal"


def test_motion_without_velocities():
    kinds = found(replace(clean_motion(), qd=None))
    assert set(kinds) == {"no velocities", "repetition"}


@pytest.mark.parametrize("rows", [1, 2, 99, 100, 150, 600, 1010, 1500, 2100])
def test_only_motions_of_few_rows_are_refused(rows):
    whole = clean_motion()
    short = replace(whole, q=whole.q[:rows], qd=whole.qd[:rows], tau=whole.tau[:rows], t=whole.t[:rows])
    refusals = check_recording(Observations(short, load_arm("psm"))).refusals
    assert [finding.kind for finding in refusals] == (["too few rows"] if 1 < rows < MIN_ROWS else [])


def test_arm_at_rest_without_efforts():
    whole = clean_motion()
    still = replace(whole, q=whole.q * 0 + whole.q[0], qd=0 * whole.qd, tau=0 * whole.tau)
    assert set(found(still)) == {"never moves", "no effort", "no repetition"}


def test_command_prints_findings_and_writes_json(tmp_path, capsys, monkeypatch):
    path, output = tmp_path / "motion.csv", tmp_path / "check.json"
    write_recording(changed(clean_motion(), "qd", 4, lambda x: 1.1 * x), path)
    with checked_figures(monkeypatch):
        assert main(["check", str(path), "--arm", "psm", "--json", str(output), "--plots", str(tmp_path / "p")]) == 0
    assert (tmp_path / "p" / "spectra.png").stat().st_size > 10_000
    text = " ".join(capsys.readouterr().out.split())
    assert "warning: wrist_pitch: qd5 is 1.1 times dq/dt" in text
    report = json.loads(output.read_text())
    assert report["period"] == pytest.approx(PERIOD, abs=1e-4)
    assert {f["kind"] for f in report["findings"]} >= {"velocity disagrees", "repetition"}


def test_command_plots_no_spectra_of_poses(tmp_path, capsys):
    write_recording(poses(load_arm("mtml")), tmp_path / "poses.csv")
    arguments = ["check", str(tmp_path / "poses.csv"), "--arm", "mtml", "--plots", str(tmp_path / "plots")]
    assert main(arguments) == 0
    assert "spectra require a motion with efforts" in capsys.readouterr().err


def test_command_refuses_with_exit_code_2(tmp_path, capsys):
    path = tmp_path / "motion.csv"
    whole = clean_motion()
    write_recording(replace(whole, t=1000 * whole.t), path)
    assert main(["check", str(path), "--arm", "psm"]) == 2
    captured = capsys.readouterr()
    assert "milliseconds" in refusal(captured.err) and "milliseconds" not in captured.out
    assert captured.out.startswith("Verdict: unusable (wrong time)")
