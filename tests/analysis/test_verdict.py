"""Verdict on each joint of a model: the rule, its evidence, and its use in `validate` and `control`."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest
from command_output import refusal, refused
from robot_file import write_robot

from dvrk_drake.analysis.results import (
    MIN_STIFFNESS,
    Tolerance,
    coverage,
    cross_validated_verdicts,
    judge,
    rule_text,
    tolerances,
    unfit,
    worst,
)
from dvrk_drake.analysis.validation import validate_static
from dvrk_drake.cli import main
from dvrk_drake.dynamics.dynamic_section import ActuatorStatistics, DynamicSection
from dvrk_drake.dynamics.identified_model import IdentifiedModel, ValidationSummary
from dvrk_drake.errors import ModelError
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.models.effects_schema import ArmEffects, DriveEffect
from dvrk_drake.processes.connection import model_warning
from dvrk_drake.recordings.formats import read_recording, write_recording
from dvrk_drake.recordings.recording import Recording

ARM = load_arm("mtmr")
LIMITS = Tolerance(friction=0.4, stiffness=0.6)


@pytest.mark.parametrize(
    ("effort", "error", "covered", "expected"),
    [
        (1.0, 0.19, 1.0, "good"),
        (1.0, 0.21, 1.0, "usable"),  # twice this error exceeds the dry friction
        (1.0, 0.19, 0.49, "usable"),  # half of the range would be extrapolated
        (1.0, 0.19, 0.0, "not judged"),  # the joint did not move
        (2.0, 0.59, 1.0, "usable"),  # held by the controller, within 15 mrad
        (2.0, 0.61, 1.0, "do not use"),  # held by neither
        (1.0, 0.51, 1.0, "do not use"),  # not held by friction, and the model explains too little
        (0.5, 0.37, 1.0, "usable"),  # held by friction
        (0.5, 0.38, 1.0, "do not use"),
        (0.1, 0.10, 1.0, "do not use"),  # a ratio near 1 is never usable, however small the error
        (0.1, 0.12, 1.0, "do not use"),
        (0.0, 0.1, 1.0, "not judged"),
        (1.0, float("nan"), 1.0, "not judged"),
    ],
)
def test_rule_of_the_verdict(effort, error, covered, expected):
    assert judge(effort, error, LIMITS, covered) == expected
    assert judge(effort, error, LIMITS, covered, commanded=False) == "off"


@pytest.mark.parametrize("name", ["mtmr", "psm"])
def test_tolerances_are_dry_friction_and_effort_at_15_mrad(name):
    arm = load_arm(name)
    of_joints, of_actuators = tolerances(arm, "joint"), tolerances(arm, "actuator")
    np.testing.assert_allclose([t.friction for t in of_joints], arm.dry_friction(), atol=1e-12)
    per_tolerance = np.diag([t.stiffness for t in of_joints]) / arm.gains.kp
    np.testing.assert_allclose(np.abs(per_tolerance).max(axis=1), arm.per_joint(0.015, 0.0015), atol=1e-12)
    deflections = np.array([t.stiffness for t in of_actuators])[:, None] * arm.transmission.matrix / arm.gains.kp
    shares = np.abs(deflections) / arm.per_joint(0.015, 0.0015)
    np.testing.assert_allclose(shares.max(axis=1), 1.0, atol=1e-12)
    bare = dataclasses.replace(arm, effects=ArmEffects())
    assert all(t.friction == t.stiffness for t in tolerances(bare, "joint"))


def test_range_of_a_joint_is_at_most_half_a_revolution():
    travel = np.array([0.0, 0.5, 0.019, 1.0, 1.0, 1.0, np.pi / 2])
    covered = coverage(ARM, travel, "joint")
    width = np.minimum(ARM.position_upper - ARM.position_lower, np.pi)
    np.testing.assert_allclose(covered, [0, 0.5 / width[1], 0, *(1 / width[3:6]), 0.5], atol=1e-12)
    # The actuator of the elbow also moves if only the shoulder moves.
    assert coverage(ARM, np.eye(7)[1], "actuator")[2] > 0 == coverage(ARM, np.eye(7)[1], "joint")[2]
    assert np.all(coverage(ARM, np.full(7, 20.0), "joint") == 1.0)


def test_the_worst_verdict_and_the_joints_that_fail():
    verdicts = {"a": "off", "b": "good", "c": "usable", "d": "good"}
    assert worst(verdicts) == ("usable", ["c"])
    assert worst({"a": "off", "b": "good"}) == ("good", ["b"])
    assert worst({**verdicts, "e": "not judged"}) == ("not judged", ["e"])
    assert worst({**verdicts, "e": "not judged", "f": "do not use"}) == ("do not use", ["f"])
    assert unfit(verdicts, "usable") == []
    assert unfit(verdicts, "good") == ["c (usable)"]
    assert unfit({"a": "do not use", "b": "not judged"}, "usable") == ["a (do not use)", "b (not judged)"]


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
    assert shoulder.relative_error > 0.3 > shoulder.relative_error_included
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
        assert found["verdict"] == "do not use" and found["rule"] == rule_text()
        assert [j["verdict"] for j in found["joints"]] == ["off", "do not use", "good", "good", "good", "good", "off"]


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
    assert "not validated on another recording; run: " in model_warning(model, loaded)
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


def test_saved_verdicts_include_all_joints(truth, tmp_path):
    with pytest.raises(ModelError, match=r"verdicts has entries for outer_yaw; it needs one entry for each joint"):
        dataclasses.replace(truth, validation=ValidationSummary("a.csv", "", {"outer_yaw": "good"})).check()
    verdicts = {joint.name: "good" for joint in truth.joints} | {"wrist_roll": "splendid"}
    with pytest.raises(ModelError, match=r'verdicts\.wrist_roll is "splendid"; allowed: off, good, usable'):
        dataclasses.replace(truth, validation=ValidationSummary("a.csv", "", verdicts)).check()


def test_commands_warn_before_connecting_to_the_arm(files, capsys):
    """`connect_arm` is shared by control and collect. It does not open the network."""
    from dvrk_drake.cli.control import connect_arm
    from dvrk_drake.cli.options import ControlledArm

    model, _, bad = files
    assert main(["validate", bad, "--model", model, "--save"]) == 0
    capsys.readouterr()
    for path, warnings in ((model, 1), (None, 0)):
        with connect_arm(ControlledArm(arm="mtmr", model=path)) as connection:
            assert connection.arm.name == "MTMR"
        assert capsys.readouterr().out.count("shoulder_pitch (do not use)") == warnings


def test_cross_validated_verdicts_use_the_same_rule(truth):
    """The errors are multiples of the smaller tolerance of each joint. The recording covers the whole range."""
    pairs = [(1.0, 0.4, 1.0), (1.2, 0.6, 1.0), (1.0, 0.8, 1.0), (1.0, 2.0, 0.0), (0.0, 0.0, 1.0)]
    pairs += [(1.0, float("nan"), 1.0), (1.0, 0.4, 0.5)]
    expected = ["good", "usable", "do not use", "off", "not judged", "not judged", "good"]
    joints = []
    for j, (joint, limits, (effort, error, scale)) in enumerate(
        zip(truth.joints, tolerances(ARM, "joint"), pairs, strict=True)
    ):
        changes = {
            "rms_zero_torque_included": effort * min(limits),
            "rms_cross_validation_included": error * min(limits),
            "feedforward_scale": scale,
            "position_lower": float(ARM.position_lower[j]),
            "position_upper": float(ARM.position_upper[j]),
        }
        joints.append(dataclasses.replace(joint, **changes))
    model = dataclasses.replace(truth, joints=joints)
    assert list(cross_validated_verdicts(model).values()) == expected
    of_motion = [
        ActuatorStatistics(joint.name, min(limits), 0.0, error * min(limits), 0.0)
        for joint, limits, error in zip(truth.joints, tolerances(ARM, "actuator"), [0.1, 0.9] * 4, strict=False)
    ]
    joints = [dataclasses.replace(joint, feedforward_scale=1.0) for joint in joints]
    model = dataclasses.replace(truth, joints=joints, dynamics=DynamicSection(actuators=of_motion))
    assert list(cross_validated_verdicts(model).values()) == (["good", "do not use"] * 4)[:7]


def test_negligible_model_torque_is_off(truth):
    """The outer yaw of an upright MTM has no gravity torque, and an identified torque of it is due to noise."""
    recording, friction = poses(truth), ARM.dry_friction()[0]
    model = dataclasses.replace(truth, effects=[DriveEffect("joint.outer_yaw", "offset", 0.0, 0.1 * friction)])
    tau = truth.holding_torque(recording.q)
    tau[:, 0] = 0.2 * friction * np.cos(np.arange(len(tau)))
    validation = validate_static(model, dataclasses.replace(recording, tau=tau))
    assert validation.verdicts["outer_yaw"] == "off"
    tau[:, 0] *= 10  # an effort that the model does not explain
    assert validate_static(model, dataclasses.replace(recording, tau=tau)).verdicts["outer_yaw"] == "do not use"


def test_static_model_is_not_validated_on_a_motion(files, tmp_path, capsys):
    """The gate before the first power-on: holding torques say nothing about a motion."""
    model, good, _ = files
    recording = read_recording(good)
    t = 0.01 * np.arange(300)[:, None]
    q = recording.q[0] + 0.1 * np.sin(5 * t)
    moving = str(tmp_path / "motion.csv")
    qd, tau = 0.5 * np.cos(5 * t) + 0 * q, recording.tau[0] + 0.01 * np.sin(7 * t)
    write_recording(Recording(q=q, qd=qd, tau=tau, t=t[:, 0]), moving)
    before = (tmp_path / "model.yaml").read_bytes()
    message = refused(capsys, "validate", moving, "--model", model, "--require", "usable", "--save")
    assert "the arm moves" in message and "the model is static" in message and "static poses" in message
    assert (tmp_path / "model.yaml").read_bytes() == before
    write_recording(Recording(q=q, qd=qd, tau=tau), moving)
    assert "the arm moves" in refused(capsys, "validate", moving, "--model", model)


def test_derived_gains_do_not_make_the_tolerance_small(tmp_path):
    """The gains of a model file follow from its links, which may be light compared with the drive."""
    arm = load_arm(write_robot(tmp_path, ('effort="20"', 'effort="2000"')))
    assert arm.gains.kp[2] * 0.015 < 0.5 * MIN_STIFFNESS * 2000
    assert tolerances(arm, "joint")[2].stiffness == pytest.approx(MIN_STIFFNESS * 2000)
