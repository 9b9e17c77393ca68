"""Tuning: gains of joints with known equations, gains files, and invalid input."""

import dataclasses
from functools import partial

import numpy as np
import pytest
from command_output import refused
from figure_rules import checked_figures
from report_pages import printed
from scipy.optimize import brentq

from dvrk_drake.errors import ControllerError
from dvrk_drake.experiments.scenario import load_scenario
from dvrk_drake.experiments.tuning import (
    CONDITIONS,
    DURATION,
    Comparison,
    settling_times,
    tune_arm,
)
from dvrk_drake.experiments.tuning_bench import Bench, JointOnBench, Response, band, step_size
from dvrk_drake.experiments.tuning_model_based import (
    GAIN_MARGIN,
    MAX_COUNT_EFFORT,
    PHASE_MARGIN,
    JointProperties,
    SampledLoop,
    Sampling,
    design_arm,
    design_joint,
    mass_matrices,
    place,
    sampling_of,
)
from dvrk_drake.experiments.tuning_procedure import (
    RELEASE_DURATION,
    evaluate_oscillation,
    find_ultimate_gain,
    tune_joint,
)
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.models.arm_schema import Gains, load_gains, save_gains
from dvrk_drake.models.effects_schema import ArmEffects, DelayEffect, DriveEffect
from dvrk_drake.reports.image_files import write_images
from dvrk_drake.reports.tuning import tuning_page
from dvrk_drake.workers import local_executor

#: The second-order approximation of the lags is valid only far below 1 / (9 ms).
FAR_BELOW = 15.0


class LinearJoint:
    """JointUnderTest with viscous friction only, computed from its equations."""

    step, count, band, effort_limit = 0.05, 1e-6, 1e-3, 2.0

    def __init__(self, M, sampling, viscous):
        self.loop, self.sampling = SampledLoop(M, sampling, viscous), sampling

    def respond(self, kp, kd, ki, duration):
        A = self.loop.closed_loop(Gains([kp], [kd], [ki]))
        x, error = self.loop.at_rest(self.step), []
        for _ in range(round(duration / self.sampling.period) + 1):
            error.append(x[0])
            x = A @ x
        return self.sampling.period * np.arange(len(error)), np.array(error)


def single(kp, kd, ki=0.0):
    return Gains([kp], [kd], [ki])


def analytic_ultimate(M, b, lag):
    """Returns the gain K and the period for which M s^2 + b s + K exp(-s lag) = 0 has the root s = j w."""
    w = brentq(lambda w: np.tan(w * lag) * M * w - b, 1e-6, 0.499 * np.pi / lag)
    return M * w**2 / np.cos(w * lag), 2 * np.pi / w


@pytest.mark.parametrize(("M", "b", "ticks"), [(0.1, 0.08, 2), (0.1, 0.3, 2), (0.02, 0.08, 3), (0.3, 0.15, 1)])
def test_ultimate_gain_and_period_match_analytic_values(M, b, ticks):
    sampling = Sampling(ticks=ticks)
    gain, period = analytic_ultimate(M, b, (ticks + 0.5) * sampling.period)
    found = find_ultimate_gain(LinearJoint(M, sampling, b))
    assert found.sustained
    assert found.gain == pytest.approx(gain, rel=0.03)
    assert found.period == pytest.approx(period, rel=0.03)
    assert found.growth == pytest.approx(1.0, abs=0.01)


def test_frictionless_joint_oscillates_with_every_gain():
    # A double integrator with delay is unstable for every proportional gain. The result is the smallest gain for which
    # the release shows the required four swings, i.e. two periods.
    M = 0.05
    assert find_ultimate_gain(LinearJoint(M, Sampling(), 0.0)).gain == pytest.approx(
        M * (2 * np.pi * 2 / RELEASE_DURATION) ** 2, rel=0.06
    )


def test_reports_joint_without_oscillation():
    found = find_ultimate_gain(LinearJoint(0.02, Sampling(), 50.0))
    assert not found.sustained
    assert found.gain == 20.0 * LinearJoint.effort_limit / LinearJoint.step


def test_procedure_damps_linear_joint():
    sampling = Sampling()
    result = tune_joint(LinearJoint(0.1, sampling, 0.2))
    assert result.damped
    assert result.kp == pytest.approx(result.ultimate.gain * result.kp_ratio)
    t, error = LinearJoint(0.1, sampling, 0.2).respond(result.kp, result.kd, result.ki, 2.0)
    assert -error.min() < 0.05 * LinearJoint.step + LinearJoint.count
    assert np.abs(error[t > 1.6]).max() < LinearJoint.band
    assert result.ki == 0.0  # there is no disturbance, hence no offset


@pytest.mark.parametrize("ratio", [0.02, 0.1, -0.05])
def test_growth_and_period_of_known_oscillation(ratio):
    w = 40.0
    t = 1e-3 * np.arange(1501)
    x = 0.3 + 0.05 * np.exp(-ratio * w * t) * np.cos(w * np.sqrt(1 - ratio**2) * t)
    found = evaluate_oscillation(t, x, 1e-5)
    assert found.growth == pytest.approx(np.exp(-np.pi * ratio / np.sqrt(1 - ratio**2)), rel=1e-3)
    assert found.period == pytest.approx(2 * np.pi / w / np.sqrt(1 - ratio**2), rel=0.01)
    assert found.sustained == (ratio < 0)


def test_sticking_or_creeping_is_no_oscillation():
    t = 1e-3 * np.arange(1000)
    assert evaluate_oscillation(t, np.full(1000, 0.05), 1e-4).growth == 0.0
    assert evaluate_oscillation(t, 0.05 * np.exp(-5 * t), 1e-4).growth == 0.0
    # Encoder quantisation does not count as a swing.
    assert evaluate_oscillation(t, 3e-3 * np.round(np.sin(60 * t)), 6.1e-3).swings == 0


def poles(loop, gains, sampling):
    """Returns the closed-loop poles in s [rad/s], least damped first. Poles of a delay are at -infinity."""
    z = np.linalg.eigvals(loop.closed_loop(gains)).astype(complex)
    with np.errstate(divide="ignore", invalid="ignore"):
        s = np.log(z) / sampling.period
    return s[np.argsort(-s.real)]


@pytest.mark.parametrize("viscous", [0.0, 0.5])
@pytest.mark.parametrize("ratio", [0.5, 0.8, 1.0])
@pytest.mark.parametrize("ticks", [1, 2, 3])
def test_pole_placement_gives_desired_damping(ratio, ticks, viscous):
    sampling = Sampling(ticks=ticks)
    M = 0.2
    kp, kd = place(M, FAR_BELOW, ratio, sampling, viscous)
    slowest = poles(SampledLoop(M, sampling, viscous), single(kp, kd), sampling)
    slowest = slowest[np.abs(slowest) > 1e-6][:2]
    polynomial = np.real(np.poly(slowest))  # s^2 + 2 z w s + w^2
    w = np.sqrt(polynomial[2])
    assert w == pytest.approx(FAR_BELOW, rel=0.04)
    assert polynomial[1] / (2 * w) == pytest.approx(ratio, rel=0.04)


def test_margins_match_stability_limits():
    sampling, M = Sampling(), 0.1
    kp, kd = place(M, 40.0, 0.8, sampling)
    ki = 4.0 * kp
    margins = SampledLoop(M, sampling).margins(single(kp, kd, ki))
    for factor, stable in ((0.99 * margins.gain, True), (1.01 * margins.gain, False)):
        assert SampledLoop(M, sampling).is_stable(single(factor * kp, factor * kd, factor * ki)) == stable
    # A delay T changes the phase by w T, so the phase margin corresponds to a time.
    delay_margin = margins.phase / margins.crossover / sampling.period
    for ticks, stable in ((int(delay_margin), True), (int(delay_margin) + 1, False)):
        delayed = Sampling(sampling.period, sampling.ticks + ticks, sampling.cut_off)
        assert SampledLoop(M, delayed).is_stable(single(kp, kd, ki)) == stable


def test_only_dominant_joint_is_slowed_down():
    arm = load_arm("mtml")
    sampling, design = sampling_of(arm), design_arm(arm)
    alone = [design_joint(joint, sampling) for joint in design.properties]
    is_slower = [joint.limited_by == "other joints" for joint in design.joints]
    assert any(is_slower) and not all(is_slower)
    assert [a == b for a, b in zip(alone, design.joints, strict=True)] == [not slower for slower in is_slower]
    # Separate designs are unstable together. The common design is stable, also at other poses.
    more_delay = Sampling(sampling.period, sampling.ticks + 1, sampling.cut_off)
    loops = [
        SampledLoop(0.8 * M, more_delay) for M in mass_matrices(arm, arm.sample_poses(20, np.random.default_rng(9)))
    ]
    together = Gains(*([getattr(joint, name) for joint in alone] for name in ("kp", "kd", "ki")))
    assert not all(loop.is_stable(together) for loop in loops)
    assert all(loop.is_stable(design.gains) for loop in loops)


def test_least_damped_mode_identifies_joint():
    sampling = Sampling()
    loop = SampledLoop(np.diag([0.1, 0.01]), sampling)
    for kd, joint in (([0.0, 0.2], 0), ([2.0, 0.0], 1)):
        growth, shares = loop.least_damped_mode(Gains([10.0, 1.0], kd, [0.0, 0.0]))
        assert growth > 1.0  # a double integrator with delay and no damping
        np.testing.assert_allclose(shares, np.eye(2)[joint], atol=1e-9)


def test_design_keeps_margins_and_reports_limitation():
    sampling = Sampling()
    joint = JointProperties(
        (0.05, 0.2), dry_friction=0.1, viscous=0.0, gravity=0.5, count=3e-5, band=1e-3, effort_limit=2.0
    )
    design = design_joint(joint, sampling)
    assert design.limited_by == "phase margin"
    assert min(margins.phase for margins in design.margins) == pytest.approx(PHASE_MARGIN, abs=0.02)
    assert min(margins.gain for margins in design.margins) > GAIN_MARGIN
    # The integral term moves a sticking joint within 0.25 s, unless Ki is at its upper bound.
    assert design.ki <= (0.1 + 0.2 * 0.5) / (1e-3 * 0.25) + 1e-9
    coarse_encoder = dataclasses.replace(joint, count=1e-3, dry_friction=0.0)
    design = design_joint(coarse_encoder, sampling)
    assert design.limited_by == "encoder count"
    assert (
        coarse_encoder.count * (design.kp + design.kd * (1 - sampling.decay) / sampling.period)
        <= MAX_COUNT_EFFORT * coarse_encoder.effort_limit
    )
    with pytest.raises(ControllerError, match=r"limited by encoder count"):
        design_joint(dataclasses.replace(coarse_encoder, count=1.0), sampling)
    delayed = design_joint(joint, Sampling(ticks=4))
    assert delayed.frequency < 0.8 * design_joint(joint, sampling).frequency


def test_settling_times_of_known_steps():
    arm = load_arm("psm")
    n, t = arm.num_joints, 1e-3 * np.arange(round(1e3 * DURATION) + 1)
    goal, w = step_size(arm), 10.0
    q = goal * (1 - np.exp(-w * t))[:, None]
    q[:, 1] = 0.5 * goal[1]
    q[:, 2] = goal[2] * (1 + 0.1 * np.sin(50 * t)) - goal[2] * (t == 0)
    settling = settling_times(arm, Response(t, q, q, np.zeros((len(t), n)), goal))
    assert settling[0] == pytest.approx(np.log(goal[0] / band(arm)[0]) / w, abs=2e-3)
    assert np.all(np.isinf(settling[1:3]))  # the first never enters the band, the second does not stay


def test_best_gains_settle_most_often_then_fastest():
    arm = load_arm("psm")
    never = np.full(7, np.inf)
    settling = {
        "fails": np.r_[np.inf, np.full(6, 0.1)],
        "slow": np.full(7, 0.9),
        "fast": np.full(7, 0.8),
        "never": never,
    }
    arrays = {name: times[None, None] for name, times in settling.items()}
    comparison = Comparison(arm, {}, CONDITIONS[:1], np.zeros((1, 7)), arrays, {})
    assert comparison.best(settling) == "fast"
    assert comparison.best(["never", "fails", "slow"]) == "slow"
    assert comparison.best(["never", "fails"]) == "fails"


def test_scenario_reads_gains_file(tmp_path):
    arm = load_arm("mtml")
    gains = Gains([round(1.1 * k, 4) for k in arm.gains.kp], arm.gains.kd, arm.gains.ki)
    path = tmp_path / "gains.yaml"
    save_gains(gains, path, "a remark")
    assert load_gains(path) == gains
    assert load_scenario("mtml", [f"controller.gains={path}"]).controller.gains == gains
    scenario = tmp_path / "scenario.yaml"
    scenario.write_text(f"arm: mtml\ncontroller: {{gains: {path}}}\n")
    assert load_scenario(str(scenario)).controller.gains == gains


def test_commands_reject_invalid_options(tmp_path, capsys):
    assert 'unknown arm "mtm"' in refused(capsys, "simulate", "tune", "--arm", "mtm")
    assert 'Invalid value "guess" for --method' in refused(
        capsys, "simulate", "tune", "--arm", "psm", "--method", "guess"
    )
    assert "its folder does not exist" in refused(
        capsys, "simulate", "tune", "--arm", "psm", "--output", str(tmp_path / "no" / "g")
    )
    assert "no such file" in refused(capsys, "simulate", "--arm", "mtml", "--set", "controller.gains=none.yaml")
    few = tmp_path / "few.yaml"
    save_gains(Gains([1.0], [1.0], [1.0]), few, "of one joint")
    assert "gains.kp has 1 number; allowed: 7" in refused(
        capsys, "simulate", "--arm", "mtml", "--set", f"controller.gains={few}"
    )
    assert "mode gravity does not use gains" in refused(capsys, "control", "--arm", "mtml", "--gains", str(few))


@pytest.mark.slow
def test_psm_insertion_ultimate_gain_matches_analytic():
    """Simulates viscous friction and delay only. Drake's time stepping adds no delay."""
    b, arm = 2.0, load_arm("psm")
    effects = ArmEffects(
        friction=[DriveEffect("actuator.insertion", "viscous", coefficient=b)], delay=DelayEffect(measurement=1)
    )
    arm = dataclasses.replace(arm, effects=effects)
    assert sampling_of(arm).ticks == 2
    found = find_ultimate_gain(JointOnBench(Bench(arm), 2))
    M = mass_matrices(arm, arm.sample_poses(1, np.random.default_rng(0)))[0, 2, 2]
    gain, period = analytic_ultimate(M, b, 2e-3)
    assert found.gain == pytest.approx(gain, rel=0.05)
    assert found.period == pytest.approx(period, rel=0.05)


@pytest.mark.slow
def test_designed_gains_settle_all_psm_joints(tmp_path, monkeypatch):
    monkeypatch.setattr("dvrk_drake.experiments.tuning.local_executor", partial(local_executor, 1))
    tuning = tune_arm("psm", ["model"], conditions=CONDITIONS[:1], poses=1)
    settling = tuning.comparison.settling["model"]
    assert np.all(np.isfinite(settling))
    assert tuning.found == {"model": tuning.design.gains}
    text = printed(tuning_page(tuning), verbose=True)
    assert all(name in text for name in (*tuning.arm.joint_names, "the arm's own", "[s]", "[kg m^2; kg]"))
    with checked_figures(monkeypatch):
        write_images(tuning_page(tuning), tmp_path)
    assert (tmp_path / "steps.png").stat().st_size > 10_000
