"""`dvrk-drake simulate study`: invalid input gives a one-line error before any simulation."""

import numpy as np
import pytest
from command_output import refusal, refused

from dvrk_drake.cli import main
from dvrk_drake.experiments.study import load_study
from dvrk_drake.models.arm_files import load_arm

STUDY = """
scenario: psm
set: [duration=1, controller.mode=gravity]
random_poses: {count: 3, seed: 1}
measures: [{kind: drift, time: 1, joints: [pitch]}]
"""


@pytest.fixture
def study(tmp_path):
    path = tmp_path / "study.yaml"
    path.write_text(STUDY)
    return path


def study_refusal(capsys, path, *options):
    output = path.parent / "results.csv"
    assert main(["simulate", "study", str(path), "--output", str(output), *options]) == 2
    assert not output.exists()
    return refusal(capsys.readouterr().err)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("scenario: psm", "scenario: psm9"), 'unknown arm "psm9"; did you mean "psm"? known arms: ecm, ecm_si, mtml,'),
        (("scenario: psm", "seeds: [1]"), "scenario is missing"),
        (("scenario: psm", "scenario: psm\nposes: [[0, 0, 0.1, 0, 0, 0]]"), "poses[0] has 6 numbers; PSM has 7 joints"),
        (("scenario: psm", "scenario: psm\nposes: [[9, 0, 0.1, 0, 0, 0, 0]]"), "poses[0]: yaw = 9 is outside"),
        (("scenario: psm", "scenario: psm\nposes: [[0, 0, 0.1, 0, 0, 0, 0]]"), "poses and random_poses exclude each"),
        (("scenario: psm", "scenarios: psm"), 'key "scenarios" is unknown; did you mean "scenario"? allowed in a'),
        (("scenario: psm", "scenario: psm\nseeds: [1, 1]"), "seeds must not contain a number twice; got [1, 1]"),
        (("scenario: psm", "scenario: psm\nseeds: []"), "seeds, variations and measures must not be empty"),
        (("scenario: psm", "scenario: psm\nvariations: [{name: a}, {name: a}]"), "variations must have different"),
        (("scenario: psm", "scenario: psm\nvariations: [{name: a}, {name: b, set: [arm=mtml]}]"), "the same joints"),
        (("scenario: psm", "scenario: psm\nvariations: [{name: a, set: [length=2]}]"), "length"),
        (("kind: drift", "kind: drif"), 'measures[0].kind is "drif"; allowed: settling_time'),
        (("joints: [pitch]", "joints: [elbow]"), "measures[0].joints of drift: unknown joint elbow; joints of PSM:"),
        (("kind: drift", "kind: drift, name: seed"), '"seed" cannot be a column'),
        (("kind: drift", 'kind: drift, name: "a,b"'), '"a,b" cannot be a column'),
        (("}]", "}, {kind: drift, time: 0.5, joints: [yaw]}]"), "measures must have different names"),
        (("time: 1", "time: 2"), "measures[0].time of drift is 2 s; allowed: 0.02..1 s"),
        ((STUDY, ""), "study.yaml"),
    ],
)
def test_invalid_settings_give_one_line_error(change, message, study, capsys):
    study.write_text(STUDY.replace(*change))
    assert message in study_refusal(capsys, study)


def test_rejects_invalid_files_and_outputs(study, tmp_path, capsys):
    assert "no such file" in study_refusal(capsys, tmp_path / "other.yaml")
    assert "--set duration: a setting must be key=value" in study_refusal(capsys, study, "--set", "duration")
    assert "the folder cannot be created" in study_refusal(capsys, study, "--plots", str(study))
    (tmp_path / "folder.csv").mkdir()
    for output, message in (
        (tmp_path / "none" / "r.csv", "cannot be written"),
        (tmp_path / "folder.csv", "is not a regular file"),
        (tmp_path / "r.txt", "must end in .csv"),
    ):
        assert message in refused(capsys, "simulate", "study", study, "--output", output)
    assert study.read_text() == STUDY


def test_command_line_settings_override_file(study):
    load = load_study(study, ["duration=1.5"])
    assert [scenario.duration for scenario in load.scenarios.values()] == [1.5]
    assert load.fingerprint != load_study(study).fingerprint


def test_default_pose_is_start_of_scenario(study):
    study.write_text(STUDY.replace("random_poses: {count: 3, seed: 1}", ""))
    (case,) = load_study(study).cases
    psm = load_arm("psm")
    assert case.start == tuple(np.clip(0.0, psm.position_lower, psm.position_upper))


def test_study_accepts_relative_paths(study, tmp_path, monkeypatch):
    (tmp_path / "scenario.yaml").write_text("arm: psm\nduration: 1\n")
    study.write_text(STUDY.replace("scenario: psm", "scenario: scenario.yaml"))
    monkeypatch.chdir(tmp_path)
    before = load_study("study.yaml").fingerprint
    (tmp_path / "scenario.yaml").write_text("arm: psm\nduration: 1\neffort_noise: 0.01\n")
    assert load_study("study.yaml").fingerprint != before
