"""Efforts that a model predicts, and designs of motions after an earlier model."""

from copy import deepcopy
from dataclasses import replace

import numpy as np
import pytest
from command_output import refusal
from motions import fourier_motion, friction_everywhere, recorded, true_dynamics

import dvrk_drake as dvrk
from dvrk_drake.analysis.excitation.information import MotionInformation
from dvrk_drake.analysis.excitation.motion_limits import MotionLimits, motion_violations
from dvrk_drake.analysis.excitation.predicted_effort import PredictedEffort
from dvrk_drake.analysis.excitation.random_motion import random_motion, state_of
from dvrk_drake.analysis.motion_identification import identify_dynamic
from dvrk_drake.analysis.observations.observations import Observations
from dvrk_drake.cli import main
from dvrk_drake.errors import ExcitationError
from dvrk_drake.models.plant import holding_torques, inverse_dynamics

PERIOD = 5.0


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
        assert main(["excite", *options, "--output", "motion.yaml"]) == 2
        assert message in refusal(capsys.readouterr().err)
    assert [path.name for path in tmp_path.iterdir()] == ["psm.yaml"]
