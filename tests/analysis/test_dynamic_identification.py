"""Dynamic identification of simulated arms with known parameters, from motion to model file to prediction."""

import copy
import dataclasses

import numpy as np
import pytest
from command_output import assert_refused, refused
from motions import fourier_motion, friction_everywhere, recorded, true_dynamics
from recordings import csv_block

from dvrk_drake.analysis.motion_identification import identify_dynamic, motion_problem
from dvrk_drake.analysis.motion_validation import predict_motion, validate_motion
from dvrk_drake.analysis.observations.observations import Observations
from dvrk_drake.analysis.validation import predict
from dvrk_drake.cli import main
from dvrk_drake.dynamics.dynamic_regressor import derive_base_parameters
from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.dynamics.inertial_parameters import pseudo_inertia
from dvrk_drake.errors import ModelError, RecordingError
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.models.effects_schema import DriveEffect
from dvrk_drake.recordings.formats import write_recording
from dvrk_drake.recordings.recording import Recording

pytestmark = pytest.mark.numeric

NOISE = 0.05
RATE = 1000.0


def simulated(name, seed):
    """Returns the ground truth of an arm with friction at every actuator, its recording, and a generator."""
    arm, generator = load_arm(name), np.random.default_rng(seed)
    motion = fourier_motion(arm, generator, 10.0, 20.0, RATE)
    truth = true_dynamics(arm, np.random.default_rng(seed), friction_everywhere(arm, motion))
    return arm, truth, recorded(truth, motion, NOISE, generator)


@pytest.fixture(scope="module", params=["mtmr", pytest.param("psm", marks=pytest.mark.slow)])
def case(request):
    arm, truth, recording = simulated(request.param, 0)
    return arm, truth, recording, identify_dynamic([Observations(recording, arm)])


def test_another_motion_is_predicted_below_the_noise(case):
    arm, truth, _, result = case
    other = recorded(
        truth, fourier_motion(arm, np.random.default_rng(1), 9.0, 18.0, RATE), 0.0, np.random.default_rng(5)
    )
    validation = validate_motion(result.model, Observations.for_model(other, result.model))
    assert all(a.relative_error < NOISE for a in validation.actuators)
    assert validation.mean_relative_error < NOISE / 3


def test_cross_validated_error_is_at_least_the_noise(case):
    _, _, _, result = case
    for a in result.model.dynamics.actuators:
        # The error is slightly above the filtered white noise. The fit error is not below the repeatability floor.
        assert 0.9 * a.rms_repeatability <= a.rms_fit * np.sqrt(2) and a.rms_fit < 0.03 * a.rms_effort
        assert a.rms_fit <= a.rms_cross_validation < NOISE * a.rms_effort


def test_prediction_intervals_cover_held_out_efforts(case):
    """95 % intervals cover 93 to 97 % of the efforts that cross-validation predicts."""
    _, _, _, result = case
    (motion,) = result.motions
    inside = np.mean(np.abs(motion.measured - motion.held_out) <= result.model.dynamic_model.half_width, axis=0)
    assert np.all((inside > 0.9) & (inside < 0.99)) and 0.93 < np.mean(inside) < 0.97


def test_limits_of_the_interval_are_printed_in_joint_coordinates(case):
    arm, _, recording, result = case
    prediction = predict(result.model, recording.in_joint_coordinates(arm))
    correlation = np.array(result.model.dynamics.error_correlation)
    errors = np.random.default_rng(0).multivariate_normal(np.zeros(arm.num_joints), correlation, 20000)
    errors *= result.model.dynamic_model.half_width
    of_joints = np.std(arm.transmission.pull_back_effort(errors), axis=0)
    np.testing.assert_allclose(prediction.half_width, of_joints, rtol=0.03, atol=1e-6)
    assert predict(result.model, Recording(q=recording.q[:3])).half_width is None


def test_other_day_intervals_contain_the_change_between_days(case):
    """The change between days is independent for each actuator, and the text states its assumed size."""
    arm, _, recording, result = case
    model, prediction = result.model, predict(result.model, recording.in_joint_coordinates(arm))
    days = np.array([a.rms_between_days for a in model.dynamics.actuators])
    efforts = np.array([a.rms_effort for a in model.dynamics.actuators])
    np.testing.assert_allclose(days, efforts * arm.identification.day_deviation, rtol=1e-9, atol=0)
    added = np.sqrt(prediction.half_width_other_day**2 - prediction.half_width**2)
    of_joints = np.abs(arm.transmission.matrix.T) ** 2 @ days**2
    np.testing.assert_allclose(added, 1.96 * np.sqrt(of_joints), rtol=1e-3, atol=0)
    assert all(
        a.inside <= a.inside_other_day
        for a in validate_motion(model, Observations.for_model(recording, model)).actuators
    )
    assert f"{100 * arm.identification.day_deviation[0]:.0f}" in model.interval_scope
    for actuator in (without := copy.deepcopy(model)).dynamics.actuators:
        actuator.rms_between_days = 0.0
    assert without.interval_scope.endswith("recalibrate.")


def test_base_parameters_of_the_motion_lie_in_their_intervals(case):
    """All identifiable parameters of links and rotors, by name."""
    _, truth, _, result = case
    base = derive_base_parameters(truth.regressor)
    found = result.model.dynamics.base_parameters
    assert [p.name for p in found] == list(base.base.names)
    beta = base.combination @ truth.parameters[: base.combination.shape[1]]
    z = [(p.value - b) / p.standard_error for p, b in zip(found, beta, strict=True) if p.identifiability > 0.5]
    assert len(z) > 20
    assert np.mean(np.abs(z) < 1.96) >= 0.9 and np.max(np.abs(z)) < 4
    # The variance equals that of the prior if the motion is not informative, and is smaller otherwise.
    assert all(0 <= p.identifiability <= 1 for p in found) and min(p.identifiability for p in found) < 0.2


def test_true_friction_is_found(case):
    arm, truth, _, result = case
    _, q, v, vd = fourier_motion(arm, np.random.default_rng(2), 9.0, 9.0, RATE)
    friction, found = (model.effect_effort(q, v, vd) for model in (truth, result.model.dynamic_model))
    share = np.sqrt(np.mean((found - friction) ** 2, axis=0) / np.mean(friction**2, axis=0))
    assert np.all(share < 0.2), "what a spring or weight could also be is identifiable from the other phases only"


def test_friction_that_depends_on_load_and_position_is_found():
    """The load is the effort of the identified rigid bodies and springs, not that of the SDF."""
    arm, generator = load_arm("mtmr"), np.random.default_rng(3)
    motion = fourier_motion(arm, generator, 10.0, 20.0, RATE)
    v = arm.transmission.velocity(motion[2]).std(axis=0)
    added = [
        DriveEffect("actuator.wrist_pitch", "load coulomb", float(f"{0.1 * v[4]:.3g}"), 0.3),
        DriveEffect("actuator.wrist_yaw", "load coulomb", float(f"{0.1 * v[5]:.3g}"), 0.4),
        DriveEffect("actuator.wrist_roll", "position^2 coulomb", float(f"{0.1 * v[6]:.3g}"), 5e-4),
    ]
    truth = true_dynamics(arm, generator, [*friction_everywhere(arm, motion), *added], spread=0.1)
    result = identify_dynamic([Observations(recorded(truth, motion, 0.01, generator), arm)])
    found = {(e.coordinate, e.kind): e for e in result.model.dynamics.effects}
    for effect in added:
        estimate = found[effect.coordinate, effect.kind]
        assert abs(estimate.coefficient - effect.coefficient) < 3 * estimate.standard_error + 0.1 * effect.coefficient
    # The fitted efforts are those of the model, whose loads follow from its own parameters.
    ours = predict_motion(result.model, Observations.for_model(recorded(truth, motion, 0.0, generator), result.model))
    (fitted,) = result.motions
    assert np.all(np.std(ours[fitted.grid.inner] - fitted.predicted, axis=0) < 0.01 * np.std(fitted.measured, axis=0))


def test_friction_without_information_is_not_estimated(case):
    """The prior of a drive that is at rest, or whose effort was not measured, hardly bounds its friction."""
    arm, _, recording, _ = case
    actuators = recording.in_actuator_coordinates(arm)
    at_rest, unmeasured = np.arange(arm.num_joints) == 0, np.arange(arm.num_joints) == arm.num_joints - 1
    q, tau = np.where(at_rest, 0.1, actuators.q), np.where(unmeasured, 0.0, actuators.measured_effort())
    changed = dataclasses.replace(actuators, q=q, qd=None, tau=tau)
    problem = motion_problem([Observations(changed, arm)])
    assert np.all(problem.columns.acting) and len(problem.candidates)
    kinds = {(effect.coordinate, effect.kind) for effect in problem.columns.effects}
    first, second, last = (f"actuator.{arm.joint_names[i]}" for i in (0, 1, -1))
    assert (first, "viscous") not in kinds and {(first, "offset"), (second, "viscous")} <= kinds
    assert last not in {coordinate for coordinate, _ in kinds}
    assert problem.num_mandatory + len(problem.candidates) == problem.num_effects == problem.columns.rows.shape[0]


def test_links_are_consistent_and_energy_is_positive(case):
    arm, _, _, result = case
    assert min(np.linalg.eigvalsh(pseudo_inertia(link.parameters))[0] for link in result.model.dynamics.links) > 0
    M = result.model.dynamic_model.mass_matrix(arm.sample_poses(300, np.random.default_rng(3)))
    np.testing.assert_allclose(M, np.swapaxes(M, 1, 2), atol=1e-12)
    assert np.min(np.linalg.eigvalsh(M)) > 0


def test_model_file_round_trip(case, tmp_path):
    _, _, recording, result = case
    result.model.save(tmp_path / "model.yaml")
    loaded = IdentifiedModel.load(tmp_path / "model.yaml")
    assert loaded.dynamics == result.model.dynamics
    ours, theirs = (predict_motion(model, Observations.for_model(recording, model)) for model in (loaded, result.model))
    np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-12 * np.abs(theirs).max())
    text = (tmp_path / "model.yaml").read_text()
    for old, new, message in (
        ("kind: viscous", "kind: sticky", 'kind is "sticky"; allowed: offset'),
        ("coordinate: actuator.", "coordinate: motor.", "allowed: actuator."),
    ):
        (tmp_path / "bad.yaml").write_text(text.replace(old, new, 1))
        assert_refused(ModelError, message, IdentifiedModel.load, tmp_path / "bad.yaml")
    heavy = result.model.dynamics.links[0].parameters
    (tmp_path / "bad.yaml").write_text(text.replace(str(heavy[4]), "-1.0", 1))
    assert_refused(ModelError, "is not physically consistent", IdentifiedModel.load, tmp_path / "bad.yaml")


def test_commands_reject_an_invalid_motion(case, tmp_path, capsys):
    """One effort of 500 N m, as in a damaged line of a file, prevents identification, validation and prediction."""
    arm, _, recording, result = case
    tau = recording.tau.copy()
    tau[500, 1] = 500.0
    paths = {name: str(tmp_path / name) for name in ("good.csv", "bad.csv", "model.yaml", "out.csv")}
    write_recording(recording, paths["good.csv"])
    write_recording(dataclasses.replace(recording, tau=tau), paths["bad.csv"])
    result.model.save(paths["model.yaml"])
    for command in (
        ["identify", paths["bad.csv"], "--arm", arm.source, "--output", str(tmp_path / "new.yaml")],
        ["validate", paths["bad.csv"], "--model", paths["model.yaml"]],
        ["predict", paths["bad.csv"], "--model", paths["model.yaml"], "--output", paths["out.csv"]],
    ):
        assert "refused: " in refused(capsys, *command)
    assert not (tmp_path / "new.yaml").exists() and not (tmp_path / "out.csv").exists()
    assert main(["validate", paths["good.csv"], "--model", paths["model.yaml"]]) == 0


def test_motion_without_efforts_is_predicted_not_validated(case, tmp_path, capsys):
    """The prediction depends on positions only, so it is the same with and without measured efforts."""
    _, _, recording, result = case
    paths = {name: str(tmp_path / name) for name in ("with.csv", "without.csv", "model.yaml")}
    write_recording(recording, paths["with.csv"])
    write_recording(dataclasses.replace(recording, tau=None), paths["without.csv"])
    result.model.save(paths["model.yaml"])
    predicted = []
    for name in ("with.csv", "without.csv"):
        output = str(tmp_path / f"of_{name}")
        assert main(["predict", paths[name], "--model", paths["model.yaml"], "--output", output]) == 0
        predicted.append(csv_block(output, "tau", "lower", "upper", "lower_other_day", "upper_other_day"))
        printed = capsys.readouterr().out
        assert "always 0" not in printed and result.model.interval_scope in printed
    np.testing.assert_allclose(*predicted, rtol=0, atol=1e-12 * np.abs(predicted).max())
    arm, powers = result.model.arm, []
    for coordinates in ("joint", "actuator"):
        prediction = predict(result.model, recording, coordinates=coordinates)
        v = recording.in_joint_coordinates(arm) if coordinates == "joint" else recording.in_actuator_coordinates(arm)
        powers.append(np.sum(prediction.tau * v.qd, axis=1))
        assert np.all(prediction.half_width > 0)
    np.testing.assert_allclose(powers[1], powers[0], rtol=0, atol=1e-9 * np.abs(powers[0]).max())
    assert main(["validate", paths["without.csv"], "--model", paths["model.yaml"]]) == 2
    assert "has no efforts; needs columns tau1..tau7" in capsys.readouterr().err


def test_recordings_that_are_not_motions_are_rejected():
    arm = load_arm("mtmr")
    q = np.tile(arm.sample_poses(1, np.random.default_rng(0)), (400, 1))
    with pytest.raises(RecordingError, match="the recording has no times"):
        identify_dynamic([Observations(Recording(q=q, tau=0 * q), arm)])
    with pytest.raises(RecordingError, match=r"2\.0 s at 200 Hz. A dynamic model requires"):
        identify_dynamic(
            [Observations(Recording(q=q + np.arange(400)[:, None] * 1e-6, tau=0 * q, t=np.arange(400) / 200), arm)]
        )


def test_held_out_efforts_have_the_cross_validated_error(case):
    _, _, _, result = case
    (motion,) = result.motions
    error = np.sqrt(np.mean((motion.measured - motion.held_out) ** 2, axis=0))
    stated = [a.rms_cross_validation for a in result.model.dynamics.actuators]
    np.testing.assert_allclose(error, stated, rtol=1e-9, atol=1e-12)
    # Each row is predicted without its fold, so the held-out efforts are not those of the fit.
    assert np.all(np.max(np.abs(motion.held_out - motion.predicted), axis=0) > 0)
