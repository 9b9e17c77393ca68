"""Verdict on each joint of a model: the rule, its evidence, and its use in `validate` and `run`."""

from __future__ import annotations

import dataclasses
import json
import os
import subprocess
import sys
from types import SimpleNamespace

import numpy as np
import pytest
from command_output import refusal

from dvrk_drake.analysis.static.static_identification import MIN_TORQUE
from dvrk_drake.analysis.static.validation import validate_static
from dvrk_drake.analysis.verdict import (
    GOOD_RATIO,
    SMALL_ERROR,
    USABLE_RATIO_AT_REST,
    USABLE_RATIO_IN_MOTION,
    cross_validated_verdicts,
    judge,
    rule_text,
    unfit,
    worst,
)
from dvrk_drake.cli import main
from dvrk_drake.cli.lcm import model_warning
from dvrk_drake.dynamics.dynamic_section import ActuatorStatistics, DynamicSection
from dvrk_drake.dynamics.identified_model import IdentifiedModel, ValidationSummary
from dvrk_drake.errors import ModelError
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.recordings.reading import read_recording
from dvrk_drake.recordings.recording import Recording, write_recording


@pytest.mark.parametrize(
    ("effort", "error", "at_rest", "in_motion"),
    [
        (1.0, 0.34, "good", "good"),
        (1.0, 0.36, "usable", "usable"),
        (1.0, 0.51, "usable", "do not use"),
        (1.0, 0.99, "usable", "do not use"),
        (1.0, 1.01, "do not use", "do not use"),
        # The effort limit is 10, so errors up to 0.2 are small at any ratio.
        (0.01, 0.19, "usable", "usable"),
        (0.01, 0.21, "do not use", "do not use"),
        (0.01, 0.003, "good", "good"),
        (0.0, 0.1, "not judged", "not judged"),
        (1.0, float("nan"), "not judged", "not judged"),
    ],
)
def test_rule_of_the_verdict(effort, error, at_rest, in_motion):
    assert judge(effort, error, 10.0, in_motion=False) == at_rest
    assert judge(effort, error, 10.0, in_motion=True) == in_motion
    assert judge(effort, error, 10.0, in_motion=False, commanded=False) == "off"


def test_printed_rule_contains_the_thresholds():
    for number in (f"{GOOD_RATIO:g}", f"{USABLE_RATIO_AT_REST:g}", f"{100 * SMALL_ERROR:g} %"):
        assert f"up to {number}" in rule_text(in_motion=False)
    for ratio in (GOOD_RATIO, USABLE_RATIO_IN_MOTION, SMALL_ERROR):
        assert f"up to {100 * ratio:g} %" in rule_text(in_motion=True)


def test_the_worst_verdict_and_the_joints_that_fail():
    verdicts = {"a": "off", "b": "good", "c": "usable", "d": "good"}
    assert worst(verdicts) == ("usable", ["c"])
    assert worst({"a": "off", "b": "good"}) == ("good", ["b"])
    assert worst({**verdicts, "e": "not judged"}) == ("not judged", ["e"])
    assert worst({**verdicts, "e": "not judged", "f": "do not use"}) == ("do not use", ["f"])
    assert unfit(verdicts, "usable") == []
    assert unfit(verdicts, "good") == ["c (usable)"]
    assert unfit({"a": "do not use", "b": "not judged"}, "usable") == ["a (do not use)", "b (not judged)"]


@pytest.mark.parametrize("name", ["mtmr", "psm"])
def test_small_error_is_below_friction_and_above_noise(name):
    """Small errors are below the dry friction of each joint but the PSM's roll, ten times above the effort noise."""
    arm = load_arm(name)
    friction = dict.fromkeys(arm.joint_names, 0.0)
    for effect in arm.effects.friction:
        joint = effect.coordinate.split(".")[-1]
        if effect.kind == "presliding" and joint in friction:
            friction[joint] += effect.coefficient
    for joint, limit in zip(arm.joint_names, arm.effort_limits, strict=True):
        assert arm.effects.effort.noise[joint] < 0.1 * SMALL_ERROR * limit
        assert (friction[joint] > SMALL_ERROR * limit) == (joint != "roll")
    assert SMALL_ERROR == MIN_TORQUE


ARM = load_arm("mtmr")


@pytest.fixture(scope="module")
def truth():
    return IdentifiedModel.from_arm(ARM)


def poses(truth, seed=0, count=20):
    q = ARM.sample_poses(count, np.random.default_rng(seed), margin=0.05)
    return Recording(q=q, tau=truth.holding_torque(q) + 0.05 * ARM.effort_limits)


def wrong_model(truth):
    """Returns a model in which joints 1 and 7 are off and all others are exact."""
    joints = [dataclasses.replace(j, feedforward_scale=0.0) if i in (0, 6) else j for i, j in enumerate(truth.joints)]
    return dataclasses.replace(truth, joints=joints)


def test_disabled_joint_is_off_and_a_wrong_one_fails(truth):
    recording = poses(truth)
    tau = truth.holding_torque(recording.q)
    tau[:, 1] *= 0.3
    model = wrong_model(truth)
    verdicts = validate_static(model, dataclasses.replace(recording, tau=tau)).verdicts
    assert verdicts == {
        "outer_yaw": "off",
        "shoulder_pitch": "do not use",
        "elbow_pitch": "good",
        "wrist_platform": "good",
        "wrist_pitch": "good",
        "wrist_yaw": "good",
        "wrist_roll": "off",
    }
    tau[:, 4] = 0.0
    assert validate_static(model, dataclasses.replace(recording, tau=tau)).verdicts["wrist_pitch"] == "not judged"


def test_measurements_at_a_stop_are_excluded(truth):
    """One pose is at the shoulder's stop with ten times its gravity torque, which no model predicts."""
    recording = poses(truth)
    q = recording.q.copy()
    q[3, 1] = ARM.position_lower[1]
    q[3, 2] = 0.3
    tau = truth.holding_torque(q)
    tau[3, 1] = -3.0
    validation = validate_static(truth, Recording(q=q, tau=tau))
    shoulder = validation.joints[1]
    assert shoulder.num_excluded >= 1
    assert shoulder.relative_error > GOOD_RATIO > shoulder.relative_error_included
    assert shoulder.verdict == "good"


def test_actuators_not_driving_off_joints_are_judged(truth):
    recording = poses(truth)
    tau = truth.holding_torque(recording.q)
    given = Recording(q=recording.q, tau=tau).in_actuator_coordinates(ARM)
    verdicts = validate_static(wrong_model(truth), given).verdicts
    assert [name for name, verdict in verdicts.items() if verdict == "off"] == ["outer_yaw", "wrist_roll"]
    assert verdicts["shoulder_pitch"] == verdicts["elbow_pitch"] == "good"


@pytest.fixture
def files(tmp_path, truth):
    """Returns a model, a recording that it passes, and a recording with 0.3 of its torque at joint 2."""
    model, good, bad = (str(tmp_path / name) for name in ("model.yaml", "good.csv", "bad.csv"))
    wrong_model(truth).save(model)
    recording = poses(truth)
    tau = truth.holding_torque(recording.q)
    write_recording(Recording(q=recording.q, tau=tau), good)
    tau[:, 1] *= 0.3
    write_recording(Recording(q=recording.q, tau=tau), bad)
    return model, good, bad


def test_require_sets_the_exit_code_and_names_the_joints(files, tmp_path, capsys):
    model, good, bad = files
    for required in ([], ["--require", "usable"], ["--require", "good"]):
        assert main(["validate", good, "--model", model, *required]) == 0
    capsys.readouterr()
    report = tmp_path / "errors.json"
    assert main(["validate", bad, "--model", model]) == 0
    assert capsys.readouterr().out.startswith("Verdict: do not use (shoulder_pitch). ")
    for required in ("usable", "good"):
        command = ["validate", bad, "--model", model, "--require", required]
        assert main([*command, "--json", str(report), "--overwrite"]) == 2
        output = capsys.readouterr()
        assert f"verdicts below {required} on {bad}: shoulder_pitch (do not use)" in refusal(output.err)
        assert output.out.startswith("Verdict: do not use (shoulder_pitch). ")
        found = json.loads(report.read_text())
        assert found["verdict"] == "do not use" and found["rule"] == rule_text(in_motion=False)
        assert [j["verdict"] for j in found["joints"]] == ["off", "do not use", "good", "good", "good", "good", "off"]


def test_closed_pipe_fails_and_keeps_the_verdicts(files):
    """`validate ... | head -1` with pipefail: the pipe closes before anything is written."""
    model, _, bad = files
    read, write = os.pipe()
    os.close(read)
    command = ["validate", bad, "--model", model, "--require", "usable", "--save"]
    program = [sys.executable, "-m", "dvrk_drake.cli", *command]
    done = subprocess.run(program, stdout=write, stderr=subprocess.PIPE, text=True, check=False)
    os.close(write)
    assert done.returncode != 0 and "Traceback" not in done.stderr
    assert IdentifiedModel.load(model).validation.verdicts["shoulder_pitch"] == "do not use"


def test_identification_recording_gives_no_verdict_to_rely_on(files, tmp_path, capsys):
    model, good, _ = files
    loaded = IdentifiedModel.load(model)
    provenance = dataclasses.replace(loaded.provenance, sha256=read_recording(good).sha256)
    dataclasses.replace(loaded, provenance=provenance).save(model)
    before = (tmp_path / "model.yaml").read_bytes()
    assert main(["validate", good, "--model", model]) == 0
    assert "the model was identified from this recording" in capsys.readouterr().err
    for option in (["--save"], ["--require", "usable"]):
        assert main(["validate", good, "--model", model, *option]) == 2
        text = f"the model was identified from this recording; {option[0]} requires another recording"
        assert text in capsys.readouterr().err
    assert (tmp_path / "model.yaml").read_bytes() == before


def test_run_warns_of_saved_verdicts(files, capsys):
    model, good, bad = files
    loaded = IdentifiedModel.load(model)
    assert "not validated on another recording; verdict by cross-validation: " in model_warning(model, loaded)
    assert main(["validate", bad, "--model", model, "--save"]) == 0
    saved = IdentifiedModel.load(model)
    assert dataclasses.replace(saved, validation=None) == loaded
    warning = model_warning(model, saved)
    assert f"failed validation on {bad}: shoulder_pitch (do not use);" in warning and "\n" not in warning
    capsys.readouterr()
    assert main(["validate", good, "--model", model]) == 0
    assert f"Next: dvrk-drake validate {good} --model {model} --save --overwrite\n" in capsys.readouterr().out
    assert main(["validate", good, "--model", model, "--save"]) == 2
    assert f"contains verdicts from {bad}" in capsys.readouterr().err
    assert main(["validate", good, "--model", model, "--save", "--overwrite"]) == 0
    assert model_warning(model, IdentifiedModel.load(model)) == ""


def test_largest_error_excludes_joints_without_feedforward(files, capsys):
    model, _, bad = files
    assert main(["validate", bad, "--model", model]) == 0
    assert "(shoulder_pitch, " in " ".join(capsys.readouterr().out.split()).partition("Next: ")[0]
    loaded = IdentifiedModel.load(model)
    joints = [dataclasses.replace(j, feedforward_scale=0.0) if j.name == "shoulder_pitch" else j for j in loaded.joints]
    dataclasses.replace(loaded, joints=joints).save(model)
    assert main(["validate", bad, "--model", model]) == 0
    answer = " ".join(capsys.readouterr().out.split()).partition("Next: ")[0]
    assert "Largest error: " in answer and "(shoulder_pitch, " not in answer


def test_saved_verdicts_include_all_joints(truth, tmp_path):
    with pytest.raises(ModelError, match=r"verdicts has entries for outer_yaw; it needs one entry for each joint"):
        dataclasses.replace(truth, validation=ValidationSummary("a.csv", "", {"outer_yaw": "good"})).check()
    verdicts = {joint.name: "good" for joint in truth.joints} | {"wrist_roll": "splendid"}
    with pytest.raises(ModelError, match=r'verdicts\.wrist_roll is "splendid"; allowed: off, good, usable'):
        dataclasses.replace(truth, validation=ValidationSummary("a.csv", "", verdicts)).check()


def test_run_warns_before_connecting_to_the_arm(files, monkeypatch, capsys):
    """Runs `ready_controller`, shared by run and collect, until it would open the network."""
    from dvrk_drake.cli import lcm

    def stop(_):
        raise ModelError("no network here")

    monkeypatch.setattr("dvrk_drake.processes.lcm_network.open_lcm", stop)
    model, _, bad = files
    assert main(["validate", bad, "--model", model, "--save"]) == 0
    capsys.readouterr()
    for path, warnings in ((model, 1), (None, 0)):
        with pytest.raises(ModelError, match="no network"):
            lcm.ready_controller(
                SimpleNamespace(arm="mtmr", model=path, lcm_url="", realtime=False, key=None), "gravity"
            )
        assert capsys.readouterr().err.count("shoulder_pitch (do not use)") == warnings


def test_cross_validated_verdicts_use_the_same_rule(truth):
    def statistics(j, effort, error, feedforward_scale):
        changes = {
            "rms_zero_torque_included": effort,
            "rms_cross_validation_included": error,
            "feedforward_scale": feedforward_scale,
        }
        return dataclasses.replace(j, **changes)

    pairs = [(1.0, 0.1, 1.0), (1.0, 0.9, 1.0), (1.0, 2.0, 1.0), (1.0, 2.0, 0.0), (0.0, 0.0, 1.0)]
    pairs += [(1.0, float("nan"), 1.0), (1.0, 0.1, 0.5)]
    expected = ["good", "usable", "do not use", "off", "not judged", "not judged", "good"]
    model = dataclasses.replace(
        truth, joints=[statistics(j, *numbers) for j, numbers in zip(truth.joints, pairs, strict=True)]
    )
    assert list(cross_validated_verdicts(model).values()) == expected
    of_motion = [ActuatorStatistics(n, 1.0, 0.0, e, 0.0) for n, e in zip(ARM.joint_names, [0.1, 0.9] * 4, strict=False)]
    model = dataclasses.replace(truth, dynamics=DynamicSection(actuators=of_motion))
    assert list(cross_validated_verdicts(model).values()) == (["good", "do not use"] * 4)[:7]
