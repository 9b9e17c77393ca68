"""Recalibration of friction from a short recording of another day, and recordings that are rejected."""

import dataclasses

import numpy as np
import pytest
from command_output import messages, refused
from loaded_arm import friction, other_day
from motions import fourier_motion, recorded, true_dynamics

from dvrk_drake.analysis.motion_validation import validate_motion
from dvrk_drake.analysis.observations.observations import Observations
from dvrk_drake.analysis.recalibration import cross_validated_errors, refit_friction
from dvrk_drake.cli import main
from dvrk_drake.dynamics.dynamic_model import DynamicModel
from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.errors import RecordingError
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.models.effects_schema import EFFECT_KINDS
from dvrk_drake.recordings.formats import read_recording, write_recording

pytestmark = pytest.mark.slow

NOISE = 0.02


def days(name, seed=0):
    """Returns the model of the first day, the second day's ground truth (other friction and offsets), a generator."""
    arm, generator = load_arm(name), np.random.default_rng(seed)
    _, q, v, vd = fourier_motion(arm, np.random.default_rng(1000), 8.0, 8.0, 1000.0)
    bare = true_dynamics(arm, np.random.default_rng(seed), [])
    first = DynamicModel(arm, dataclasses.replace(bare.section, effects=friction(bare, q, v, vd)))
    section = other_day(first, q, v, vd, generator)
    kept = [effect for effect in section.effects if EFFECT_KINDS[effect.kind].role != "position"]
    second = DynamicModel(arm, dataclasses.replace(section, effects=kept))
    return dataclasses.replace(IdentifiedModel.from_arm(arm), dynamics=first.section), second, generator


def motion(truth, generator, seconds=10.0, seed=5):
    return recorded(
        truth, fourier_motion(truth.arm, np.random.default_rng(seed), 8.0, seconds, 1000.0), NOISE, generator
    )


def errors(model, recording):
    return np.array(
        [
            actuator.relative_error
            for actuator in validate_motion(model, Observations.for_model(recording, model)).actuators
        ]
    )


@pytest.mark.parametrize("name", ["psm", "mtmr"])
def test_friction_and_offsets_of_another_day_are_estimated(name):
    model, truth, generator = days(name)
    result = refit_friction(model, Observations.for_model(motion(truth, generator), model))
    other = motion(truth, generator, seconds=16.0, seed=6)
    before, after = errors(model, other), errors(result.model, other)
    # The friction of the second day has the same shape as that of the first, so the residual is little more than noise.
    assert np.mean(before) > 2 * np.mean(after)
    assert np.all(after < 2 * NOISE)
    assert all(a.kept for a in result.actuators)
    true = {(e.coordinate, e.kind): e.coefficient for e in truth.section.effects if e.kind == "viscous"}
    old = {(e.coordinate, e.kind): e.coefficient for e in model.dynamics.effects if e.kind == "viscous"}
    found = np.array([a.viscous for a in result.actuators])
    expected = np.array(
        [true[f"actuator.{a.name}", "viscous"] / old[f"actuator.{a.name}", "viscous"] for a in result.actuators]
    )
    np.testing.assert_allclose(found, expected, atol=0.1)
    # The statistics and intervals of the new model are those of the fit that it contains.
    for a, own in zip(result.actuators, result.model.dynamics.actuators, strict=True):
        assert own.rms_cross_validation == pytest.approx(a.after * own.rms_effort, abs=1e-12)
        assert own.rms_between_days > 0
    similar = validate_motion(
        result.model, Observations.for_model(motion(truth, generator, seconds=16.0), result.model)
    )
    assert all(a.inside > 0.9 for a in similar.actuators)
    truly = {(e.coordinate, e.kind): e.coefficient for e in truth.section.effects}
    refitted = result.model.dynamics.effects
    assert all(e.standard_error > 0 for e in refitted)
    z = np.array([(e.coefficient - truly[e.coordinate, e.kind]) / e.standard_error for e in refitted])
    assert 0.1 < np.sqrt(np.mean(z**2)) < 2


def test_asymmetric_friction_is_refitted():
    """The first actuator has the same friction on both days. That of the second depends on the direction."""
    model, truth, generator = days("psm")
    section = model.dynamics
    first, second = "actuator.yaw", "actuator.pitch"
    forward = [dataclasses.replace(e, kind=f"{e.kind} forward") for e in section.effects if e.coordinate == second]
    forward = [e for e in forward if e.kind == "presliding forward"]
    section = dataclasses.replace(section, effects=section.effects + forward)
    today = [e for e in section.effects if e.coordinate == first]
    today += [
        dataclasses.replace(e, coefficient=(1.4 if EFFECT_KINDS[e.kind].role == "dry" else 1.0) * e.coefficient)
        for e in section.effects
        if e.coordinate != first
    ]
    truth = DynamicModel(model.arm, dataclasses.replace(section, effects=today))
    result = refit_friction(
        dataclasses.replace(model, dynamics=section),
        Observations.for_model(motion(truth, generator), dataclasses.replace(model, dynamics=section)),
    )
    (refitted,) = [e for e in result.model.dynamics.effects if e.kind == "presliding forward"]
    assert refitted.coefficient == pytest.approx(1.4 * forward[0].coefficient, rel=0.1, abs=1e-6)
    for a in result.actuators:
        assert a.kept or a.after == a.before


def test_rigid_bodies_and_holding_torques_are_unchanged():
    model, truth, generator = days("psm")
    result = refit_friction(model, Observations.for_model(motion(truth, generator), model))
    new, arm = result.model, model.arm
    assert new.dynamics.links == model.dynamics.links and new.dynamics.rotors == model.dynamics.rotors
    assert new.base_parameters == model.base_parameters
    # An offset estimated from a motion is not a holding torque (`IdentifiedModel.holding_effects`).
    q = arm.sample_poses(3, np.random.default_rng(0))
    offsets = np.array([a.offset for a in result.actuators])
    np.testing.assert_allclose(new.holding_torque(q), model.holding_torque(q), atol=1e-12)
    q, rest = q[:1], np.zeros_like(q[:1])
    moved = new.dynamic_model.effect_effort(q, rest, rest) - model.dynamic_model.effect_effort(q, rest, rest)
    np.testing.assert_allclose(moved[0], offsets, atol=1e-12)


def test_errors_do_not_increase_on_the_same_day():
    model, _, generator = days("psm")
    same = model.dynamic_model
    result = refit_friction(model, Observations.for_model(motion(same, generator), model))
    other = motion(same, generator, seconds=16.0, seed=6)
    np.testing.assert_allclose(errors(result.model, other), errors(model, other), atol=NOISE / 10)
    assert all(a.dry == pytest.approx(1, abs=0.1) and a.viscous == pytest.approx(1, abs=0.1) for a in result.actuators)


def test_joint_at_rest_is_unchanged():
    model, truth, generator = days("psm")
    t, q, v, vd = fourier_motion(truth.arm, np.random.default_rng(5), 8.0, 10.0, 1000.0)
    q[:, 0], v[:, 0], vd[:, 0] = q[0, 0], 0.0, 0.0
    result = refit_friction(model, Observations.for_model(recorded(truth, (t, q, v, vd), NOISE, generator), model))
    yaw = result.actuators[0]
    assert (yaw.kept, yaw.reason, yaw.dry, yaw.offset) == (False, "no motion in both directions", 1.0, 0.0)
    assert all(a.kept for a in result.actuators[1:])
    before, after = ([e for e in m.dynamics.effects if e.coordinate == "actuator.yaw"] for m in (model, result.model))
    assert before == after


def test_motion_in_one_direction_is_rejected():
    model, truth, generator = days("psm")
    t = np.arange(10_000) / 1000.0
    start, v = truth.arm.sample_poses(1, generator, margin=0.4)[0], truth.arm.per_joint(0.06, 0.006)
    slow = (t, start + t[:, None] * v, np.tile(v, (len(t), 1)), np.zeros((len(t), 7)))
    with pytest.raises(RecordingError, match="no actuator moves in both directions"):
        refit_friction(model, Observations.for_model(recorded(truth, slow, 0.0, generator), model))


@pytest.mark.parametrize(("ours", "theirs"), [("psm", "mtmr"), ("mtmr", "psm")])
def test_another_arm_is_rejected(ours, theirs):
    model, *_ = days(ours)
    _, truth, generator = days(theirs)
    with pytest.raises(RecordingError, match=r"Check the arm|outside|limits"):
        refit_friction(model, Observations.for_model(motion(truth, generator), model))


def test_unrelated_efforts_are_rejected():
    model, truth, generator = days("psm")
    recording = motion(truth, generator)
    noise = generator.normal(size=recording.tau.shape) * np.std(recording.tau, axis=0)
    other = dataclasses.replace(recording, tau=noise, source="noise.csv")
    with pytest.raises(
        RecordingError, match=r"noise.csv: the mean relative error .* Check the arm and the coordinates"
    ):
        refit_friction(model, Observations.for_model(other, model))


@pytest.mark.parametrize(("name", "seconds"), [("psm", 6.0), ("mtmr", 8.0)])
def test_wrong_sign_is_rejected_in_short_recordings(name, seconds):
    model, truth, generator = days(name)
    recording = motion(truth, generator, seconds).in_actuator_coordinates(truth.arm)
    for j, joint in enumerate(truth.arm.joint_names):
        tau = recording.tau.copy()
        tau[:, j] *= -1
        with pytest.raises(RecordingError, match=rf"opposite to the efforts of the model: {joint} \(correlation -"):
            refit_friction(model, Observations.for_model(dataclasses.replace(recording, tau=tau), model))
    assert refit_friction(model, Observations.for_model(recording, model)).seconds > 0


def test_error_after_is_from_held_out_parts():
    """Irregular friction in one part of the motion can be fitted there, but not predicted from the other parts."""
    model, truth, generator = days("psm")
    recording = motion(truth, generator).in_actuator_coordinates(truth.arm)
    tau = recording.tau.copy()
    first = recording.t < 2.5
    tau[first, 3] += 2 * np.std(tau[:, 3]) * np.sign(recording.qd[first, 3])
    result = refit_friction(model, Observations.for_model(dataclasses.replace(recording, tau=tau), model))
    other = motion(truth, generator, seconds=16.0, seed=6)
    before, after = errors(model, other), errors(result.model, other)
    assert np.all(after[[0, 1, 2, 4, 5, 6]] < before[[0, 1, 2, 4, 5, 6]] + NOISE / 10)
    assert result.actuators[3].after > 0.3


def test_refit_is_validated_on_held_out_phases():
    """Friction that differs in one half of the phases does not improve the prediction of the other half."""
    model, truth, generator = days("psm")
    recording = motion(truth, generator, seconds=16.0)
    before, after = cross_validated_errors(model, Observations.for_model(recording, model), 2)
    np.testing.assert_allclose(before, errors(model, recording), atol=1e-9)
    assert np.mean(after) < 0.5 * np.mean(before)
    half = (np.asarray(recording.t) - 1.0) % 8.0 < 4.0  # phases are counted from where the filters end
    old = motion(model.dynamic_model, np.random.default_rng(0), seconds=16.0)
    mixed = dataclasses.replace(old, tau=np.where(half[:, None], recording.tau, old.tau))
    before, after = cross_validated_errors(model, Observations.for_model(mixed, model), 2)
    # Each refit estimates friction that the other half does not have.
    assert np.mean(after) > np.mean(before)


def test_recalibrate_command(tmp_path, capsys):
    model, truth, generator = days("psm")
    paths = {name: str(tmp_path / name) for name in ("model.yaml", "short.csv", "new.yaml", "static.yaml")}
    model.save(paths["model.yaml"])
    IdentifiedModel.from_arm(load_arm("psm")).save(paths["static.yaml"])
    write_recording(motion(truth, generator), paths["short.csv"])
    command = ["identify", "recalibrate", paths["short.csv"], "--model", paths["model.yaml"]]
    assert main([*command, "--output", paths["new.yaml"]]) == 0
    assert IdentifiedModel.load(paths["new.yaml"]).provenance.method.endswith(f"recalibrated on {paths['short.csv']}")
    table = capsys.readouterr().out
    assert all(name in table for name in ("before", "after the refit", "wrist_yaw", "valid for similar motions"))
    again = ["--output", paths["new.yaml"], "--overwrite"]
    assert main(["identify", "recalibrate", paths["short.csv"], "--model", paths["static.yaml"], *again]) == 2
    assert main([*command, "--output", paths["model.yaml"]]) == 2
    lines = messages(capsys.readouterr().err)
    assert len(lines) == 2 and "has no dynamics" in lines[0] and "is an input" in lines[1]
    spiked = read_recording(paths["short.csv"], load_arm("psm"))
    spiked.tau[500, 1] = 500.0
    write_recording(spiked, paths["short.csv"])
    assert "exceeds its limit" in refused(capsys, *command, *again)
