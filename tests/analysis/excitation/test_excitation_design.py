"""Expected errors compared with simulated estimates, and designed motions compared with random ones."""

from copy import deepcopy
from dataclasses import replace

import numpy as np
import pytest
from command_output import refused
from motions import fourier_motion, friction_everywhere, recorded, true_dynamics
from recordings import csv_block

import dvrk_drake as dvrk
from dvrk_drake.analysis.excitation.design import contracted
from dvrk_drake.analysis.excitation.information import MotionInformation, random_motion, state_of
from dvrk_drake.analysis.excitation.motion_limits import MotionLimits, motion_violations
from dvrk_drake.analysis.excitation.periodic_motion import PeriodicMotion
from dvrk_drake.analysis.excitation.predicted_effort import PredictedEffort
from dvrk_drake.analysis.motion_identification import identify_dynamic
from dvrk_drake.analysis.observations.observations import Observations
from dvrk_drake.cli import main
from dvrk_drake.errors import ExcitationError
from dvrk_drake.models.environment import Environment
from dvrk_drake.models.plant import holding_torques, inverse_dynamics
from dvrk_drake.workers import local_executor

PERIOD = 5.0


@pytest.fixture(scope="module", params=["mtmr", pytest.param("psm", marks=pytest.mark.slow)])
def information(request):
    return MotionInformation(dvrk.load_arm(request.param), MotionLimits())


@pytest.fixture
def state(information):
    motion = random_motion(information.arm, MotionLimits(), PERIOD, 4, np.random.default_rng(2))
    return state_of(motion, 40)


def test_expected_error_is_that_of_simulated_estimates(information, state):
    """Parameters from the prior and measurements with noise give maximum-a-posteriori estimates with this error."""
    generator, effort = np.random.default_rng(0), information.rms_effort(state)
    deviation = np.linalg.cholesky(np.linalg.inv(information.criterion.prior))
    H = information.criterion.prior + information.matrix(state, PERIOD)
    weight = information.weight(PERIOD, state.shape[1])
    squares = []
    for _ in range(200):
        x = deviation @ generator.normal(size=len(deviation))
        b = np.zeros(len(x))
        for (own, X), size in zip(information.columns(state), effort, strict=True):
            tau = X @ x[own] + size / np.sqrt(weight) * generator.normal(size=len(X))
            b[own] += weight / size**2 * (X.T @ tau)
        error = np.linalg.solve(H, b) - x
        squares.append(
            [
                np.mean((X @ error[own]) ** 2) / size**2
                for (own, X), size in zip(information.columns(information.states), information.effort, strict=True)
            ]
        )
    assert np.sqrt(np.mean(squares)) == pytest.approx(information.expected_error(state, PERIOD), rel=0.1)


def test_gradient_is_the_derivative(information, state):
    value, gradient = information.log_error_gradient(state, PERIOD)
    assert np.exp(value) == pytest.approx(information.expected_error(state, PERIOD), rel=1e-9)
    generator = np.random.default_rng(1)
    for _ in range(3):
        direction = generator.normal(size=state.shape) * information.scales[:, None]
        above, below = (np.log(information.expected_error(state + step * direction, PERIOD)) for step in (1e-5, -1e-5))
        assert np.sum(gradient * direction) == pytest.approx((above - below) / 2e-5, rel=1e-3, abs=1e-4)


def test_more_information_gives_a_smaller_error(information, state):
    once, twice = (information.expected_error(state, period) for period in (PERIOD, 2 * PERIOD))
    assert twice < once
    criterion, matrices = information.criterion, [information.matrix(state, k * PERIOD) for k in (1, 1e5)]
    assert criterion.known_parameters(matrices[1]) >= criterion.known_parameters(matrices[0])
    at_rest = state.copy()
    at_rest[1:] = 0.0
    assert information.expected_error(at_rest, PERIOD) > once
    assert information.condition_number(state) < information.condition_number(at_rest)


@pytest.mark.slow
def test_design_meets_limits_and_beats_random_motions(information):
    arm = information.arm
    limits = MotionLimits(margin=0.1, traverse_time=1.5)
    design = dvrk.design_excitation(arm, duration=12.0, period=PERIOD, harmonics=8, limits=limits, starts=1)
    assert design.motion.duration == 15.0
    assert motion_violations(design.motion, arm, limits) == []
    own = MotionInformation(arm, limits)
    generator = np.random.default_rng(4)
    randoms = [own.expected_error(state_of(random_motion(arm, limits, PERIOD, 6, generator), 48), PERIOD) for _ in "ab"]
    assert design.expected_error < 0.75 * min(*randoms, design.random_error)
    assert design.expected_error == pytest.approx(own.expected_error(state_of(design.motion, 64), PERIOD), rel=0.02)


def test_random_motions_meet_nearly_all_limits(information):
    arm, limits = information.arm, MotionLimits()
    for seed in range(3):
        motion = random_motion(arm, limits, PERIOD, 5, np.random.default_rng(seed))
        # Between the times at which they are scaled, they may exceed a limit slightly.
        assert motion_violations(contracted(motion, arm, limits), arm, limits) == []


@pytest.mark.slow
def test_motion_above_a_table_is_contracted():
    arm = dvrk.load_arm("psm")
    limits = MotionLimits(positions={"insertion": (0.05, 0.2)}, environment=Environment(-0.17))
    options = {"duration": 4.0, "period": 4.0, "harmonics": 3, "limits": limits}
    with local_executor(2) as executor:
        design = dvrk.design_excitation(arm, starts=2, executor=executor, **options)
    alone = [dvrk.design_excitation(arm, starts=1, seed=seed, **options).expected_error for seed in (0, 1)]
    assert any(design.expected_error == pytest.approx(error, rel=1e-3) for error in alone)
    assert motion_violations(design.motion, arm, limits) == []
    q = design.motion.evaluate(np.linspace(0, 4, 400)).q[:, 2]
    assert q.min() >= 0.05 and q.max() <= 0.2


def test_motion_below_a_table_is_refused():
    arm = dvrk.load_arm("psm")
    with pytest.raises(
        ExcitationError, match=r"no motion meets all limits: collision of .* in the middle of the motion"
    ):
        dvrk.design_excitation(
            arm, duration=4.0, period=4.0, harmonics=2, limits=MotionLimits(environment=Environment(0.0)), starts=1
        )


@pytest.mark.parametrize(
    ("argument", "message"),
    [
        ({"harmonics": 1}, "harmonics is 1; allowed: 2 to 20"),
        ({"duration": 0.5}, "period is 0.5; allowed: 1 to 600"),
        ({"duration": 3.0, "period": 5.0}, "duration is 3; allowed: 5 to 36000"),
        ({"starts": 0}, "starts is 0"),
        ({"limits": MotionLimits(effort=0.05)}, "the dry friction exceeds 5 % of the effort limit"),
    ],
)
def test_wrong_arguments_are_rejected(argument, message):
    with pytest.raises(ExcitationError) as error:
        dvrk.design_excitation(dvrk.load_arm("mtml"), starts=argument.pop("starts", 1), **argument)
    assert message in str(error.value)


def test_command_writes_the_motion(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    # The motion need not be optimal. Slow tests design optimal motions.
    monkeypatch.setattr("dvrk_drake.analysis.excitation.design.MAX_ITERATIONS", 5)
    short = ["--period", "4", "--duration", "8", "--harmonics", "3", "--starts", "1"]
    assert main(["excite", "--arm", "mtmr", "--output", "m.yaml", "--csv", "m.csv", "--rate", "100", *short]) == 0
    out = capsys.readouterr().out
    assert "motion of 8 s. Expected error of predicted efforts:" in " ".join(out.split())
    motion = PeriodicMotion.load("m.yaml", dvrk.load_arm("mtmr"))
    rows = csv_block("m.csv", "t", "q", "qd")
    assert rows.shape == (801, 15)
    np.testing.assert_allclose(rows[:, 1:8], motion.evaluate(rows[:, 0]).q, atol=1e-12)
    np.testing.assert_allclose(rows[:, 8:], motion.evaluate(rows[:, 0]).v, atol=1e-12)
    for options, message in (
        (["--output", "m.yaml"], "m.yaml already exists"),
        (["--output", "n.yaml", "--position", "elbow_pitch=0"], "--position elbow_pitch=0: allowed: JOINT=LOWER:UPPER"),
        (["--output", "n.yaml", "--csv", "n.yaml"], "n.yaml"),
        (["--output", "n.yaml"], "--rate requires --csv"),
        (["--output", "n.yaml", "--position", "outer_yaw=0:1", "outer_yaw=0:0.5"], "outer_yaw is given twice"),
    ):
        rate = ["--rate", "100"] if "--rate requires" in message else []
        assert message in refused(capsys, "excite", "--arm", "mtmr", *options, *rate, *short)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["m.csv", "m.yaml"]


# Efforts that a model predicts, and designs of motions after an earlier model.


@pytest.fixture(scope="module", params=["mtmr", pytest.param("psm", marks=pytest.mark.slow)])
def arm(request):
    return dvrk.load_arm(request.param)


@pytest.fixture(scope="module")
def motion(arm):
    return fourier_motion(arm, np.random.default_rng(1), PERIOD, PERIOD, 1000.0)


def heavier(arm, factor):
    model = dvrk.IdentifiedModel.from_arm(arm, dynamics=True)
    for link in model.dynamics.links:
        link.parameters = [factor * x for x in link.parameters]
    return model


def test_efforts_are_those_of_the_model_within_its_dry_friction(arm, motion):
    _, q, v, vd = motion
    truth = true_dynamics(arm, np.random.default_rng(2), friction_everywhere(arm, motion))
    model = replace(dvrk.IdentifiedModel.from_arm(arm, dynamics=True), dynamics=truth.section)
    predicted = PredictedEffort(arm, model)
    without = predicted.without_dry_friction(q, v, vd)
    np.testing.assert_allclose(predicted.by_drake(q, v, vd), without, atol=1e-11)
    friction = np.abs(arm.transmission.pull_back_effort(truth.effort(q, v, vd)) - without).max(axis=0)
    assert np.all(friction <= predicted.dry_friction * (1 + 1e-9))
    assert np.all(friction > 0.5 * predicted.dry_friction)


def test_static_model_replaces_the_holding_efforts(arm, motion):
    q, v, vd = (x[::50] for x in motion[1:])
    nominal = dvrk.IdentifiedModel.from_arm(arm)
    of_sdf = PredictedEffort(arm, nominal).by_drake(q, v, vd)
    np.testing.assert_allclose(of_sdf, inverse_dynamics(arm, q, v, vd), atol=1e-11)
    scaled = PredictedEffort(arm, nominal.with_scaled_parameters(np.full(len(nominal.theta), 1.5)))
    np.testing.assert_allclose(scaled.by_drake(q, v, vd), of_sdf + 0.5 * holding_torques(arm, q), atol=1e-11)
    np.testing.assert_array_equal(scaled.dry_friction, arm.dry_friction())


def test_without_model_the_springs_of_the_arm_file_are_included(arm, motion):
    q = motion[1][::50]
    rest = np.zeros_like(q)
    springs = dvrk.IdentifiedModel.from_arm(arm, arm.effects.cables + arm.effects.springs)
    of_files = PredictedEffort(arm)
    np.testing.assert_allclose(of_files.by_drake(q, rest, rest), springs.holding_torque(q), atol=1e-11)
    np.testing.assert_allclose(of_files.holding(q), springs.holding_torque(q), atol=1e-11)
    dynamic = PredictedEffort(arm, dvrk.IdentifiedModel.from_arm(arm, dynamics=True))
    np.testing.assert_allclose(dynamic.holding(q), dynamic.by_drake(q, rest, rest), atol=1e-11)


def test_heavier_links_leave_less_effort_for_the_motion(arm):
    limits = MotionLimits()
    moves = random_motion(arm, limits, PERIOD, 4, np.random.default_rng(0))
    same, heavy = (heavier(arm, factor) for factor in (1.0, 30.0))
    efforts = [
        line for line in motion_violations(moves, arm, replace(limits, effort=1.0), heavy) if line.startswith("effort")
    ]
    assert efforts
    assert motion_violations(moves, arm, replace(limits, effort=1.0), same) == []
    with pytest.raises(ExcitationError, match=r"no motion meets all limits: the effort of .* exceeds 80 %"):
        random_motion(arm, limits, PERIOD, 4, np.random.default_rng(0), heavy)


@pytest.mark.slow
def test_second_motion_adds_more_information():
    arm = dvrk.load_arm("psm")
    limits, rng = MotionLimits(effort=0.8), np.random.default_rng(3)
    options = {"limits": limits, "duration": PERIOD, "period": PERIOD, "harmonics": 3, "starts": 1}
    first = dvrk.design_excitation(arm, **options)
    t = np.arange(3000) / 1000
    moves = random_motion(arm, limits, PERIOD, 4, rng).evaluate(t)[:3]
    truth = true_dynamics(arm, rng, friction_everywhere(arm, (t, *moves), 0.15))
    t = np.arange(15_000) / 1000
    repeated = replace(first.motion, repetitions=3).evaluate(t)[:3]
    model = identify_dynamic([Observations(recorded(truth, (t, *repeated), 0.05, rng), arm)]).model
    second = dvrk.design_excitation(arm, model=model, **options)
    information = MotionInformation(arm.with_gravity(model.arm.gravity), limits, model)
    again = state_of(first.motion, 24)
    assert second.expected_error < information.expected_error(again, PERIOD)
    unknown = deepcopy(model)
    for parameter in unknown.dynamics.base_parameters:
        parameter.standard_error = 1e6
    without = MotionInformation(information.arm, limits, unknown).expected_error(again, PERIOD)
    assert information.expected_error(again, PERIOD) < without
    assert second.known_parameters > first.known_parameters


def test_models_of_other_arms_are_rejected(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    psm = dvrk.IdentifiedModel.from_arm(dvrk.load_arm("psm"))
    with pytest.raises(ExcitationError, match="the model is for PSM"):
        dvrk.design_excitation(dvrk.load_arm("mtml"), model=psm)
    psm.save("psm.yaml")
    for options, message in (
        (["--arm", "mtml", "--model", "psm.yaml"], "the model is for PSM, not for MTML"),
        (["--arm", "psm", "--model", "none.yaml"], "none.yaml"),
        (["--arm", "psm", "--model", "psm.yaml", "--gravity", "0", "0", "-9.81"], "--gravity cannot be used with"),
    ):
        assert message in refused(capsys, "excite", *options, "--output", "motion.yaml")
    assert [path.name for path in tmp_path.iterdir()] == ["psm.yaml"]
