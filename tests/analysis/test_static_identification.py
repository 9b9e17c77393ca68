"""Static identification on exact data, on noisy data, and on the recording of the paper."""

import csv
import dataclasses
import shutil

import numpy as np
import pytest
from command_output import assert_refused

from dvrk_drake.analysis.estimation.robust_fit import robust_fit, weighted_fit
from dvrk_drake.analysis.observations.static_poses import find_excluded
from dvrk_drake.analysis.pose_identification import identify_static
from dvrk_drake.analysis.validation import predict_static, validate_static
from dvrk_drake.dynamics.actuator_effects import ActuatorEffect
from dvrk_drake.dynamics.holding_torque import static_model
from dvrk_drake.dynamics.identified_model import FORMAT, IdentifiedModel
from dvrk_drake.errors import IdentificationError, ModelError, RecordingError
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.models.effects_schema import DriveEffect
from dvrk_drake.models.sdf_model import MODELS_FOLDER
from dvrk_drake.recordings.formats import read_recording
from dvrk_drake.recordings.recording import Recording

pytestmark = [pytest.mark.numeric, pytest.mark.slow]


ARM = load_arm("mtmr")


def simulated(arm, poses=60, seed=0, noise=0.0, effects=(), coefficients=(), scale=1.0):
    """Returns poses within the limits with exact holding torques plus noise, a share of each joint's effort limit."""
    generator = np.random.default_rng(seed)
    model = static_model(arm, tuple(effects))
    theta = np.array([*(scale * model.gravity.base_values), *coefficients])
    q = arm.sample_poses(poses, generator, margin=0.05)
    tau = model.torque(q, theta) + noise * arm.effort_limits * generator.normal(size=q.shape)
    return Recording(q=q, tau=tau, source="simulated"), theta


def column(model, attribute):
    return np.array([getattr(joint, attribute) for joint in model.joints])


def test_least_squares_recovers_exact_parameters():
    recording, theta = simulated(ARM)
    model = identify_static(recording, ARM, "paper").model
    np.testing.assert_allclose(model.theta, theta, atol=1e-12)
    assert column(model, "rms_fit").max() < 1e-12
    assert model.provenance.rank == 12


def test_robust_method_recovers_parameters_and_effects():
    effects = tuple(ActuatorEffect(f"joint.wrist_{which}", "cable sine", 1.0) for which in ("platform", "pitch"))
    recording, _ = simulated(ARM, noise=0.005, effects=effects, coefficients=(0.05, -0.05), seed=4)
    model = identify_static(recording, ARM).model
    found = {ActuatorEffect.of(e): e.coefficient for e in model.effects}
    assert found[effects[0]] == pytest.approx(0.05, abs=0.004)
    assert found[effects[1]] == pytest.approx(-0.05, abs=0.002)
    fresh, _ = simulated(ARM, poses=200, seed=9, effects=effects, coefficients=(0.05, -0.05))
    errors = validate_static(model, fresh).joints
    for error, limit in zip(errors[1:6], ARM.effort_limits[1:6], strict=True):
        assert error.rms_error < 0.005 * limit, error
    assert all(error.rms_error <= error.rms_torque for error in errors)


def test_standard_errors_cover_the_truth_at_the_nominal_rate():
    """The 95 % intervals of 40 noisy recordings, over all parameters above the noise."""
    inside = []
    for seed in range(40):
        recording, theta = simulated(ARM, noise=0.02, seed=seed)
        usable = np.ones(recording.q.shape, dtype=bool)
        from dvrk_drake.analysis.estimation.pose_effects import StaticProblem

        fit = StaticProblem(ARM, recording.q, recording.tau, usable).fit(()).fit
        inside.append(np.abs(fit.theta - theta) < 1.96 * np.sqrt(np.diag(fit.covariance)))
    assert 0.90 < np.mean(inside) <= 0.99


def test_leave_one_out_residuals_equal_a_fit_without_the_pose():
    generator = np.random.default_rng(0)
    X, tau = generator.normal(size=(12, 3, 4)), generator.normal(size=(12, 3))
    weights, prior = generator.uniform(0.5, 2, (12, 3)), np.array([0.0, 0.1, 1.0, 0.0])
    fit = weighted_fit(X, tau, weights, prior)
    for i in range(12):
        rest = np.arange(12) != i
        other = weighted_fit(X[rest], tau[rest], weights[rest], prior)
        np.testing.assert_allclose(fit.leave_one_out_residuals[i], tau[i] - X[i] @ other.theta, atol=1e-12)


def test_gross_outliers_do_not_move_the_robust_fit():
    generator = np.random.default_rng(1)
    X = generator.normal(size=(60, 2, 3))
    theta = np.array([1.0, -2.0, 0.5])
    tau = X @ theta + 0.01 * generator.normal(size=(60, 2))
    tau[5:9, 1] += 10.0
    fit = robust_fit(X, tau, np.ones((60, 2), bool), np.zeros(3), np.full(2, 1e-6))
    np.testing.assert_allclose(fit.fit.theta, theta, atol=0.01)
    assert fit.outliers.sum() == 4
    assert fit.outliers[5:9, 1].all()


def test_poses_at_a_stop_are_excluded_and_named():
    recording, _ = simulated(ARM, poses=40, noise=0.002)
    q, tau = recording.q.copy(), recording.tau.copy()
    q[3, 1:3] = [-0.15, -0.2]  # the sum is below -0.33
    tau[3, 1:3] -= 5.0
    q[7, 5] = ARM.position_upper[5]
    tau[7, 5] += 0.05
    tau[11, 3] = 2.0  # eight times what the motor can give
    dirty = dataclasses.replace(recording, q=q, tau=tau)
    reasons = {(d.row, d.joints): d.reason for d in find_excluded(dirty, ARM)}
    assert "parallelogram at -0.350 rad is at its stop" in reasons[3, (1, 2)]
    assert "wrist_yaw at 0.785 rad is at its stop" in reasons[7, (5,)]
    assert "wrist_platform effort 2 N m exceeds its limit of 0.309 N m" in reasons[11, (3,)]
    clean_rows = np.ones(40, bool)
    clean_rows[[3, 7, 11]] = False
    clean = dataclasses.replace(recording, q=q[clean_rows], tau=tau[clean_rows])
    with_dirt, without = identify_static(dirty, ARM).model, identify_static(clean, ARM).model
    np.testing.assert_allclose(with_dirt.theta[:3], without.theta[:3], rtol=0.05, atol=0)


def test_pure_friction_is_not_worse_than_zero_torque():
    """Wrist torques are unrelated to the pose. Over seeds, errors on other poses do not increase beyond chance."""
    ratios = []
    for seed in range(6):
        generator = np.random.default_rng(seed)

        def with_friction(recording, generator=generator):
            tau = recording.tau.copy()
            tau[:, 3:] = generator.uniform(-0.1, 0.1, (len(tau), 4)) * ARM.effort_limits[3:]
            return dataclasses.replace(recording, tau=tau)

        model = identify_static(with_friction(simulated(ARM, seed=seed)[0]), ARM).model
        errors = validate_static(model, with_friction(simulated(ARM, poses=200, seed=100 + seed)[0])).joints
        ratios.append([e.rms_error / e.rms_torque for e in errors[3:]])
    assert np.mean(ratios) < 1.03
    assert np.max(ratios) < 1.2


def test_actuator_coordinates_give_the_same_model():
    recording, _ = simulated(ARM, noise=0.002)
    actuator = Recording(
        q=ARM.transmission.position(recording.q),
        tau=ARM.transmission.inverse.pull_back_effort(recording.tau),
        coordinates="actuator",
        source="simulated",
    )
    model = identify_static(recording, ARM, "paper").model
    np.testing.assert_allclose(identify_static(actuator, ARM, "paper").model.theta, model.theta, atol=1e-12)
    np.testing.assert_allclose(
        ARM.transmission.pull_back_effort(predict_static(model, actuator)),
        model.holding_torque(recording.q),
        atol=1e-12,
    )


def test_too_few_poses_and_too_low_rank_are_rejected():
    recording, _ = simulated(ARM, poses=4)
    assert_refused(IdentificationError, "4 distinct poses found", identify_static, recording, ARM)
    same, _ = simulated(ARM, poses=10)
    same = dataclasses.replace(same, q=np.tile(same.q[:1], (10, 1)), tau=np.tile(same.tau[:1], (10, 1)))
    assert_refused(IdentificationError, r"determine only \d of 12 base parameters", identify_static, same, ARM, "paper")
    assert_refused(IdentificationError, "1 distinct pose found", identify_static, same, ARM)


def test_repeated_samples_are_averaged_before_validation():
    """Ten samples of each of 12 poses with friction per pose give the same result as their 12 averages."""
    recording, _ = simulated(ARM, poses=12)
    generator = np.random.default_rng(5)
    friction = 0.1 * ARM.effort_limits * generator.uniform(-1, 1, recording.q.shape)
    noise = 1e-4 * ARM.effort_limits * generator.normal(size=(10, *recording.q.shape))
    samples = Recording(
        q=np.repeat(recording.q, 10, axis=0),
        tau=(recording.tau + friction + noise).transpose(1, 0, 2).reshape(-1, 7),
        source="samples",
    )
    averages = Recording(q=recording.q, tau=recording.tau + friction + noise.mean(axis=0), source="averages")
    ours, reference = identify_static(samples, ARM), identify_static(averages, ARM)
    assert len(ours.recording) == 12
    np.testing.assert_allclose(ours.model.theta, reference.model.theta, atol=1e-9)


def test_joint_that_did_not_move_has_no_feedforward():
    recording, _ = simulated(ARM, poses=40)
    generator = np.random.default_rng(0)
    q = recording.q.copy()
    q[:, 3:] = [0.5, 0.7, 0.2, 0.1]
    model = static_model(ARM)
    tau = model.torque(q, model.gravity.base_values) + 0.05 * ARM.effort_limits * generator.uniform(-1, 1, q.shape)
    result = identify_static(Recording(q=q, tau=tau, source="fixed wrist"), ARM).model
    assert np.all(result.feedforward_scale[3:] == 0.0)
    fresh, _ = simulated(ARM, poses=100, seed=3)
    for error in validate_static(result, fresh).joints:
        assert error.rms_error <= error.rms_torque, error


def test_torques_in_the_wrong_unit_are_rejected():
    recording, _ = simulated(ARM)
    with pytest.raises(RecordingError, match="Check the unit"):
        identify_static(dataclasses.replace(recording, tau=1000 * recording.tau), ARM)


def test_moving_recording_is_rejected():
    recording, _ = simulated(ARM)
    t = 0.005 * np.arange(len(recording))
    for moving in (
        dataclasses.replace(recording, qd=np.full_like(recording.q, 0.2)),
        dataclasses.replace(recording, t=t),
    ):
        assert_refused(IdentificationError, "the arm moves", identify_static, moving, ARM)
    # Poses with time stamps: the arm moves between them and rests at each.
    assert identify_static(dataclasses.replace(recording, t=8.0 * np.arange(len(recording))), ARM, "paper")


def test_model_file_round_trip_and_rejections(tmp_path):
    spring = ActuatorEffect("joint.wrist_pitch", "cable sine", 1.0)
    recording, _ = simulated(ARM, noise=0.002, effects=(spring,), coefficients=(-0.05,))
    model = identify_static(recording, ARM).model
    model.save(tmp_path / "m.yaml")
    again = IdentifiedModel.load(tmp_path / "m.yaml")
    assert again == model
    np.testing.assert_allclose(again.holding_torque(recording.q), model.holding_torque(recording.q), atol=1e-12)
    text, url = (tmp_path / "m.yaml").read_text(), "package://dvrk_drake/arms/mtmr.yaml"
    for bad, message in (
        (text.replace(url, "psm9"), 'unknown arm "psm9"'),
        (text.replace("kind: cable sine", "kind: viscous"), 'kind is "viscous"; allowed: offset, spring, cable sine,'),
        (
            text.replace(FORMAT, "dvrk_drake identified model 0").replace("\neffects:", "\njoint_effects:"),
            f'model 0"; allowed: "{FORMAT}"$',
        ),
    ):
        assert bad != text
        (tmp_path / "bad.yaml").write_text(bad)
        assert_refused(ModelError, message, IdentifiedModel.load, tmp_path / "bad.yaml")


def test_moved_model_files_are_loaded(tmp_path):
    (tmp_path / "arms").mkdir()
    shutil.copy(MODELS_FOLDER / "arms" / "mtmr.yaml", tmp_path / "arms" / "own.yaml")
    IdentifiedModel.from_arm(load_arm(str(tmp_path / "arms" / "own.yaml"))).save(tmp_path / "model.yaml")
    text = (tmp_path / "model.yaml").read_text()
    assert "\narm: arms/own.yaml\n" in text
    (tmp_path / "elsewhere").mkdir()
    moved = shutil.move(tmp_path / "arms", tmp_path / "elsewhere")
    shutil.move(tmp_path / "model.yaml", tmp_path / "elsewhere")
    arm = IdentifiedModel.load(tmp_path / "elsewhere" / "model.yaml").arm
    assert arm is load_arm(f"{moved}/own.yaml")
    effects = [DriveEffect("joint.wrist_pitch", "cable sine", 1.0, 0.05, standard_error=0.01)]
    model = IdentifiedModel.from_arm(load_arm("mtmr"), effects)
    model.save(tmp_path / "new.yaml")
    new = (tmp_path / "new.yaml").read_text()
    for name in ("mtmr", f"{moved}/own.yaml"):
        (tmp_path / "own.yaml").write_text(new.replace("package://dvrk_drake/arms/mtmr.yaml", name))
        read = IdentifiedModel.load(tmp_path / "own.yaml")
        assert (read.arm, read.effects) == (load_arm(name), effects)
    with pytest.raises(ModelError, match=r"new\.yaml: the model is for MTMR, not for PSM"):
        IdentifiedModel.load(tmp_path / "new.yaml", load_arm("psm"))


# Recording of the paper.


def test_paper_method_reproduces_figure_4(shared_data):
    recording = read_recording(shared_data / "mtm_static/mtm_2015_good72.csv")
    result = identify_static(recording, ARM, "paper")
    with open(shared_data / "mtm_static/paper_fig4_squared_errors.csv") as stream:
        rows = list(csv.reader(stream))[1:]
    published = np.array(rows, dtype=float)[:, 1:]
    np.testing.assert_allclose(result.residuals[:, 1:] ** 2, published, atol=1e-8)
    model = result.model
    np.testing.assert_allclose(
        column(model, "rms_fit"), [0.0472, 0.0902, 0.0892, 0.0443, 0.0215, 0.0063, 0.0044], atol=6e-5
    )
    np.testing.assert_allclose(
        column(model, "rms_leave_one_out"), [0.0472, 0.0977, 0.0956, 0.0444, 0.0217, 0.0069, 0.0044], atol=6e-5
    )
    np.testing.assert_allclose(
        column(model, "rms_zero_torque"), [0.0472, 0.5317, 0.3258, 0.0396, 0.0083, 0.0063, 0.0019], atol=6e-5
    )
    assert model.provenance.condition_number == pytest.approx(13.5, abs=0.05)


@pytest.mark.parametrize(
    "name", ["mtm_2015_good72", "mtm_2015_apr18_all80", "mtmr_2017_sweep40", "mtmr_2017_coupled12_may10"]
)
def test_default_method_beats_zero_torque_on_held_out_poses(shared_data, name):
    model = identify_static(read_recording(shared_data / f"mtm_static/{name}.csv"), ARM).model
    for joint in model.joints:
        assert joint.rms_leave_one_out_included <= joint.rms_zero_torque_included, joint
        assert joint.rms_cross_validation_included <= 1.02 * joint.rms_zero_torque_included, joint


def test_poses_at_a_stop_are_named_in_a_real_recording(shared_data):
    result = identify_static(read_recording(shared_data / "mtm_static/mtm_2015_apr18_all80.csv"), ARM)
    # Line numbers of the file. Line 72 repeats the pose of line 62.
    line = {d: int(d.where.rpartition(" ")[2]) for d in result.excluded}
    assert {62, 64, 68, 74, 78} <= {line[d] for d in result.excluded if "parallelogram" in d.reason}
    assert 47 in line.values()
