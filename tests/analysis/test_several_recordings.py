"""Identification of one model from several motions of a simulated arm whose friction and offsets change."""

import dataclasses
import itertools

import numpy as np
import pytest
from motions import fourier_motion, friction_everywhere, recorded, true_dynamics

import dvrk_drake as dvrk
from dvrk_drake.analysis import identification
from dvrk_drake.analysis.motion_identification import thinned
from dvrk_drake.analysis.motion_validation import validate_motion
from dvrk_drake.analysis.observations.observations import Observations
from dvrk_drake.analysis.pose_identification import identify_static, with_effects_at_rest
from dvrk_drake.dynamics.actuator_effects import ActuatorEffect
from dvrk_drake.dynamics.dynamic_model import DynamicModel
from dvrk_drake.dynamics.dynamic_regressor import derive_base_parameters
from dvrk_drake.errors import RecordingError
from dvrk_drake.models.effects_schema import DriveEffect
from dvrk_drake.recordings.formats import write_recording

pytestmark = pytest.mark.numeric

ARM = dvrk.load_arm("psm")
NOISE, RATE = 0.05, 1000.0
#: Factors of the friction on each day, and offsets as shares of the RMS effort. Their means are 1 and 0.1.
FACTORS, OFFSETS = (0.7, 1.0, 1.3), (0.25, 0.1, -0.05)


def day(truth, effort, factor, offset):
    """Returns the true model on a day with other friction and offsets."""
    effects = [dataclasses.replace(e, coefficient=factor * e.coefficient) for e in truth.section.effects]
    effects += [
        DriveEffect(f"actuator.{name}", "offset", 0.0, float(offset * size))
        for name, size in zip(ARM.joint_names, effort, strict=True)
    ]
    return DynamicModel(ARM, dataclasses.replace(truth.section, effects=effects))


@pytest.fixture(scope="module")
def days():
    """Returns the true model, the RMS efforts, and one recording per day."""
    generator = np.random.default_rng(3)
    motions = [fourier_motion(ARM, generator, 10.0, 15.0, RATE) for _ in FACTORS]
    truth = true_dynamics(ARM, generator, friction_everywhere(ARM, motions[0], 0.1))
    effort = np.sqrt(np.mean(truth.effort(*motions[0][1:]) ** 2, axis=0))
    recordings = [
        dataclasses.replace(recorded(day(truth, effort, *values), motion, NOISE, generator), source=f"day{i + 1}.csv")
        for i, (motion, *values) in enumerate(zip(motions, FACTORS, OFFSETS, strict=True))
    ]
    return truth, effort, recordings


@pytest.fixture(scope="module")
def result(days):
    return dvrk.identify(days[2], ARM)


@pytest.fixture(scope="module")
def alone(days):
    """Returns the result of the first recording alone."""
    return dvrk.identify(days[2][0], ARM)


@pytest.fixture(scope="module")
def pair(days, tmp_path_factory):
    """Returns the paths of all recordings, and the result of the first two, read from their files."""
    folder = tmp_path_factory.mktemp("days")
    paths = [folder / f"day{i + 1}.csv" for i in range(3)]
    for path, recording in zip(paths, days[2], strict=True):
        write_recording(recording, path, ARM)
    return paths, dvrk.identify([dvrk.read_recording(path, ARM) for path in paths[:2]], ARM)


def test_links_are_those_of_all_days(days, result):
    """95 % intervals of base parameters that the prior alone does not determine cover the true values."""
    truth, _, _ = days
    B = derive_base_parameters(truth.regressor).combination
    values = B @ truth.parameters[: B.shape[1]]
    z = [
        (e.value - value) / e.standard_error
        for e, value in zip(result.model.dynamics.base_parameters, values, strict=True)
        if e.identifiability > 0.5
    ]
    assert len(z) > 10 and np.mean(np.abs(z) < 1.96) > 0.85


def test_model_contains_mean_offsets_and_friction(days, result):
    truth, effort, _ = days
    found = {e.coordinate: e.coefficient for e in result.model.dynamics.effects if e.kind == "offset"}
    for name, size in zip(ARM.joint_names, effort, strict=True):
        assert found[f"actuator.{name}"] / size == pytest.approx(np.mean(OFFSETS), abs=0.07)
    assert len(found) == ARM.num_joints  # the offsets of single days are not in the model
    # A day with the mean friction and offset is predicted better than the others.
    motion = fourier_motion(ARM, np.random.default_rng(8), 9.0, 15.0, RATE)
    generator = np.random.default_rng(9)
    errors = [
        validate_motion(
            result.model,
            Observations.for_model(recorded(day(truth, effort, factor, offset), motion, 0.0, generator), result.model),
        ).mean_relative_error
        for factor, offset in zip(FACTORS, OFFSETS, strict=True)
    ]
    assert errors[1] < 0.5 * min(errors[0], errors[2]) and errors[1] < NOISE


def test_held_out_errors_are_errors_on_another_day(days, result, alone, pair):
    _, _, recordings = days
    assert [motion.recording.source for motion in result.motions] == ["day1.csv", "day2.csv", "day3.csv"]
    expected = validate_motion(pair[1].model, Observations.for_model(recordings[2], pair[1].model))
    relative = [a.relative_error for a in expected.actuators]
    np.testing.assert_allclose(result.motions[2].held_out_errors, relative, rtol=0.25, atol=0.01)
    # The prediction intervals contain the change between days, so they cover the efforts of another such day.
    measured, held_out = (np.concatenate([getattr(m, w) for m in result.motions]) for w in ("measured", "held_out"))
    inside = np.abs(measured - held_out) <= result.model.dynamic_model.half_width
    assert 0.9 < np.mean(inside) < 0.99
    # The held-out errors of one recording alone do not contain this change.
    assert np.all(result.model.dynamic_model.half_width > 1.5 * alone.model.dynamic_model.half_width)


def test_provenance_names_all_recordings(pair):
    paths, result = pair
    model, recordings = result.model, [dvrk.read_recording(path, ARM) for path in paths]
    assert model.provenance.recording == f"{paths[0]}, {paths[1]}"
    # The prediction intervals contain the errors of these days only, and after a recalibration those of its day.
    days = "recordings of the model ({}). They are valid for similar motions on the same days."
    assert days.format(f"{paths[0]}, {paths[1]}") in model.interval_scope
    assert days.format("new.csv") in model.recalibrated(model.dynamics, "new.csv").interval_scope
    assert dvrk.validate(model, recordings[1]).of_same_recording
    assert not dvrk.validate(model, recordings[2]).of_same_recording


def still(truth, offsets, seed):
    """Returns poses with holding torques of the true model, and with offsets (n,) of the actuators at rest."""
    q = ARM.sample_poses(30, np.random.default_rng(seed))
    effort = truth.rigid_body_effort(q, 0 * q, 0 * q) + offsets
    return dvrk.Recording(q=q, tau=ARM.transmission.pull_back_effort(effort), source=f"poses{seed}.csv")


def test_effects_at_rest_are_those_of_the_poses(days, alone, tmp_path):
    """The offset of the insertion at rest differs from the offset in the motion; all other offsets are 0 at rest."""
    truth, effort, recordings = days
    offsets = np.zeros(7)
    offsets[2] = 2.0 * effort[2]
    result = dvrk.identify([still(truth, offsets, 0), recordings[0]], ARM)
    other = still(truth, offsets, 1)
    result.model.save(tmp_path / "model.yaml")
    model = dvrk.IdentifiedModel.load(tmp_path / "model.yaml")
    error = ARM.transmission.inverse.pull_back_effort(model.holding_torque(other.q) - other.tau)
    assert np.all(np.abs(error.mean(axis=0)) < 0.06 * effort)
    found = {e.coordinate: e.coefficient for e in model.effects}
    assert found["actuator.insertion"] == pytest.approx(offsets[2], abs=0.1 * effort[2])
    assert "actuator.insertion offset +" in result.note
    # The effort in motions is that of the motion.
    assert model.dynamics.effects == alone.model.dynamics.effects and not alone.model.effects


def test_friction_at_rest_is_no_offset(days, alone):
    """The sign of the remaining friction is random, so its mean is not significant."""
    truth, effort, _ = days
    friction = 0.3 * effort * np.random.default_rng(2).choice([-1.0, 1.0], (30, 7))
    level = still(truth, 0.0, 0)
    in_motion = ARM.transmission.inverse.pull_back_effort(alone.model.holding_torque(level.q) - level.tau).mean(axis=0)
    assert np.max(np.abs(in_motion) / effort) > 0.1  # with the offset of the motion
    poses = identify_static(still(truth, friction, 0), ARM)
    model = with_effects_at_rest(alone.model, poses)
    error = ARM.transmission.inverse.pull_back_effort(model.holding_torque(level.q) - level.tau).mean(axis=0)
    assert np.all(np.abs(error) < 0.2 * effort)


@pytest.mark.parametrize("count", [30, pytest.param(20, marks=pytest.mark.slow)])
def test_hysteresis_between_poses_is_no_spring(days, alone, count):
    """Friction along the path between the poses is correlated with the position, like a spring."""
    truth, effort, _ = days
    for seed in range(2):
        level = still(truth, 0.0, seed)
        x = ARM.transmission.position(level.q)
        friction = np.zeros((30, 7))
        for j in range(7):
            path = np.concatenate([np.linspace(a, b, 51)[1:] for a, b in itertools.pairwise(x[:, j])])
            effect = ActuatorEffect(f"actuator.{ARM.joint_names[j]}", "presliding", 0.5 * np.ptp(x[:, j]))
            friction[1:, j] = 0.1 * effort[j] * effect.column(path, np.gradient(path))[49::50]
            assert np.corrcoef(friction[:, j], x[:, j])[0, 1] > 0.5
        poses = still(truth, friction, seed)
        part = dataclasses.replace(poses, q=poses.q[:count], tau=poses.tau[:count])
        corrected = with_effects_at_rest(alone.model, identify_static(part, ARM))
        errors = [
            np.sqrt(
                np.mean(ARM.transmission.inverse.pull_back_effort(m.holding_torque(level.q) - level.tau) ** 2, axis=0)
            )
            for m in (alone.model, corrected)
        ]
        # Half of the friction.
        assert np.all(errors[1] < errors[0] + 0.05 * effort)


def test_poses_of_a_correct_model_change_nothing(days):
    """Within a small range, there are no candidates for springs and hysteresis, and no offset is significant."""
    truth = dvrk.IdentifiedModel.from_arm(ARM, dynamics=True)
    q = ARM.sample_poses(30, np.random.default_rng(0)).mean(axis=0) + 1e-2 * np.random.default_rng(1).normal(
        size=(30, 7)
    )
    noise = 1e-3 * ARM.effort_limits * np.random.default_rng(2).normal(size=(30, 7))
    poses = identify_static(dvrk.Recording(q=q, tau=truth.holding_torque(q) + noise, source="poses.csv"), ARM)
    assert with_effects_at_rest(truth, poses).effects == []


def test_few_poses_change_nothing(days, alone, monkeypatch):
    truth, effort, recordings = days
    monkeypatch.setattr(identification, "identify_dynamic", lambda *arguments, **options: alone)
    poses = still(truth, 0.5 * effort, 0)
    few = dataclasses.replace(poses, q=poses.q[:19], tau=poses.tau[:19])
    result = dvrk.identify([recordings[0], few], ARM)
    assert result.model.effects == [] and "none (20 poses are required)" in result.note


def test_rejected_lists(days):
    poses = [still(days[0], 0.0, seed) for seed in (0, 1)]
    for recordings in ([days[2][0], *poses], poses):
        with pytest.raises(
            RecordingError,
            match=r"poses1\.csv: contains static poses, or is sampled too slowly .*and so does poses0\.csv",
        ):
            dvrk.identify(recordings, ARM)
    first = days[2][0]
    part = dataclasses.replace(
        first, t=first.t[500:2000], q=first.q[500:2000] + 1e-6, qd=None, tau=first.tau[500:2000], source="part.csv"
    )
    with pytest.raises(RecordingError, match=r"part\.csv: contains the same efforts as day1\.csv"):
        dvrk.identify([first, part], ARM)
    with pytest.raises(RecordingError, match=r'method "paper": requires one recording, but 3 were given'):
        dvrk.identify(days[2], ARM, method="paper")
    with pytest.raises(RecordingError, match="no recordings were given"):
        dvrk.identify([], ARM)


def test_recordings_are_thinned_to_similar_rates(days):
    truth, generator = days[0], np.random.default_rng(0)
    motion = fourier_motion(ARM, generator, 10.0, 15.0, RATE)
    slow, fast = (recorded(truth, motion, 0.0, generator, rate) for rate in (100.0, 500.0))
    grids = thinned([Observations(recording, ARM).grid for recording in (slow, fast)])
    assert [grid.step for grid in grids] == [1, 5]
    assert abs(len(grids[0].inner_rows) - len(grids[1].inner_rows)) < 5


def test_identifies_joints_beside_an_unmeasured_one(days):
    """The jaw and the wrist yaw of a PSM share motors, so the yaw is identified from its joint effort. With a gap."""
    _, _, recordings = days
    whole = recordings[1]
    tau = np.where(np.arange(7) == 6, 0.0, whole.tau)
    cut = dataclasses.replace(whole, tau=tau).select(np.r_[0:1300, 1340 : len(whole)])
    result = dvrk.identify(cut, ARM)
    (motion,) = result.motions
    assert len(motion.grid.segments) == 2 and len(motion.measured) == 0.9 * len(cut)
    errors = motion.held_out_errors
    assert np.all(errors[:6] < 0.15) and np.isnan(errors[6])
    assert [joint.name for joint in result.model.joints if joint.feedforward_scale == 0] == ["jaw"]
    assert {"gaps", "no effort"} <= {finding.kind for finding in result.warnings}
    # The efforts of the wrist yaw's and of the jaw's motor are not known, but neither exceeds what both can produce.
    tau = result.model.dynamic_model.effort(*(getattr(motion.grid, name) for name in ("q", "v", "vd")))
    assert np.all(np.abs(tau) < 2 * ARM.effort_limits)
    validation = dvrk.validate(result.model, whole)
    assert validation.verdicts["jaw"] == "off" and validation.relative_errors["wrist_pitch"] < 0.15
    np.testing.assert_allclose(dvrk.validate(result.model, cut).predicted, motion.predicted, rtol=0, atol=1e-3)
