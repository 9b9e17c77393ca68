"""Measures of runs with a prescribed motion, whose values are known without simulation."""

import math

import numpy as np
import pytest
from command_output import assert_refused

from dvrk_drake.errors import StudyError
from dvrk_drake.experiments.scenario import Scenario, Target
from dvrk_drake.experiments.simulation import Simulation
from dvrk_drake.experiments.study_measures import KINDS, Measure
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.recordings.recording import Recording

MTM = load_arm("mtml")
T = np.arange(0, 20.001, 0.01)


def state(q):
    """Returns the true state. The recordings deviate from it by 10 mrad, which must not affect the measures."""
    return np.hstack([q, 0 * q])


def released(**motions):
    """Returns scenario and run of an MTM in mode "gravity" with a given motion of the named joints."""
    scenario = Scenario(arm="mtml", duration=20.0)
    scenario.controller.mode = "gravity"
    q = np.zeros((len(T), 7))
    for joint, motion in motions.items():
        q[:, MTM.joint_names.index(joint)] = motion
    tau = np.tile(0.25 * MTM.effort_limits, (len(T), 1))
    return scenario, Simulation(Recording(q=q + 0.01, qd=0 * q, tau=tau, t=T), state(q), None, None)


def stepped(motion):
    """Returns scenario and run of an elbow with a target of 0.4 rad at 2 s."""
    scenario = Scenario(arm="mtml", duration=20.0, targets=[Target(2.0, [0, 0, 0.4, 0, 0, 0, 0])])
    q = np.zeros((len(T), 7))
    q[:, 2] = motion
    desired = np.zeros_like(q)
    desired[:, 2] = 0.4 * np.clip(T / 2, 0, 1)
    return scenario, Simulation(Recording(q=q + 0.01, qd=0 * q, tau=0 * q, t=T), state(q), None, desired)


def test_uniform_drift_has_known_rate_and_distance():
    run = released(elbow_pitch=-0.002 * T)
    assert Measure("drift_rate")(*run) == pytest.approx(0.002)
    assert Measure("drift", time=3.0)(*run) == pytest.approx(0.006)
    assert Measure("steady_error", time=2.0)(*run) == pytest.approx(0.002 * 19.0)
    # The drift exceeds 15 mrad after 7.5 s, and 30 mrad after 15 s.
    assert Measure("held")(*run) is False
    assert Measure("held", time=7.4)(*run) is True
    assert Measure("held", band=0.0201)(*run) is True
    assert Measure("ran_away", band=0.041)(*run) is False
    assert Measure("ran_away", band=0.039)(*run) is True
    assert Measure("effort_share")(*run) == pytest.approx(0.25)


def test_only_named_joints_are_evaluated():
    run = released(wrist_roll=0.1 * T, wrist_yaw=0.001 * T)
    assert Measure("drift_rate")(*run) == pytest.approx(0.1)
    assert Measure("drift_rate", joints=["wrist_yaw"])(*run) == pytest.approx(0.001)
    assert Measure("drift_rate", joints=["elbow_pitch"])(*run) == pytest.approx(0.0, abs=1e-12)


def test_motion_before_release_by_hand_is_excluded():
    scenario, simulation = released(elbow_pitch=0.3 * np.minimum(T, 5.0) + 0.001 * np.maximum(T - 5.0, 0.0))
    scenario.hand.path = [Target(0.0, [0.0] * 7), Target(5.0, [0.0] * 7)]
    assert Measure("held")(scenario, simulation) is True
    assert Measure("held", time=14.9)(scenario, simulation) is True
    assert Measure("held", band=0.0099)(scenario, simulation) is False
    assert Measure("ran_away", band=0.016)(scenario, simulation) is False
    assert_refused(StudyError, r"allowed: 0.02..15 s", Measure("held", time=15.1).check, scenario)


def test_settling_and_overshoot_of_decaying_oscillation():
    after = np.maximum(T - 2.0, 0.0)
    ring = 0.1 * np.exp(-after) * np.sin(2 * np.pi * after)
    run = stepped(0.4 * np.clip(T / 2, 0, 1) + ring)
    # The first and largest peak: where the derivative of exp(-t) sin(w t) is zero, w t = atan(w).
    peak = math.atan(2 * np.pi) / (2 * np.pi)
    assert Measure("overshoot")(*run) == pytest.approx(0.1 * math.exp(-peak) * math.sin(2 * np.pi * peak), rel=1e-3)
    settled = Measure("settling_time", band=1e-3)(*run)
    assert np.all(np.abs(ring[after >= settled]) <= 1e-3)
    assert np.abs(ring[(after > settled - 0.03) & (after < settled)]).max() > 1e-3
    assert settled == pytest.approx(math.log(100), abs=0.5)
    assert Measure("steady_error")(*run) == pytest.approx(0.0, abs=1e-8)


def test_settling_time_is_infinite_or_includes_disturbance():
    assert Measure("settling_time")(*stepped(0.4 * np.clip(T / 2, 0, 1) + 0.002)) == math.inf
    bump = np.where(T[1500] == T, 0.01, 0.0)
    assert Measure("settling_time")(*stepped(0.4 * np.clip(T / 2, 0, 1) + bump)) == pytest.approx(13.01)


def test_early_arrival_has_no_settling_time_or_overshoot():
    run = stepped(0.4 * np.clip(T / 1.9, 0, 1))
    assert Measure("settling_time")(*run) == 0.0
    assert Measure("overshoot")(*run) == 0.0


@pytest.mark.parametrize(
    ("measure", "revolute", "prismatic"),
    [
        (Measure("held"), 0.015, 0.0015),
        (Measure("held", band=0.03), 0.03, 0.003),
        (Measure("held", band=0.03, band_prismatic=0.01), 0.03, 0.01),
        (Measure("ran_away"), 0.5, 0.05),
    ],
)
def test_bands_of_prismatic_joints_are_in_metres(measure, revolute, prismatic):
    psm = load_arm("psm")
    scenario = Scenario(arm="psm", duration=20.0)
    scenario.controller.mode = "gravity"
    assert f"{revolute:g} rad, {prismatic:g} m" in measure.title
    for joint, band in (("pitch", revolute), ("insertion", prismatic)):
        for factor in (0.99, 1.01):
            q = np.zeros((len(T), 7))
            q[1:, psm.joint_names.index(joint)] = factor * band
            run = Simulation(Recording(q=q, qd=0 * q, tau=0 * q, t=T), state(q), None, None)
            assert measure(scenario, run) is ((factor > 1) == (measure.kind == "ran_away"))


@pytest.mark.parametrize("kind", [name for name, kind in KINDS.items() if kind.unit.startswith("rad")])
def test_distances_in_rad_and_m_are_not_compared(kind):
    """The largest of them would be a number of two units."""
    scenario = Scenario(arm="psm", duration=20.0, targets=[Target(2.0, [0.1, 0, 0.1, 0, 0, 0, 0])])
    unit = KINDS[kind].unit
    for joints, expected in ((["pitch", "roll"], unit), (["insertion"], unit.replace("rad", "m"))):
        measure = Measure(kind, joints=joints)
        assert measure.unit(scenario.mounted_arm) == expected
        measure.check(scenario)
    for joints in ([], ["pitch", "insertion"]):
        with pytest.raises(StudyError, match=rf"{kind} is .* joints in rad and in m\. Give joints of .* \[insertion\]"):
            Measure(kind, joints=joints).check(scenario)


@pytest.mark.parametrize("kind", KINDS)
def test_failed_run_has_worst_value(kind):
    scenario, simulation = stepped(0.4 * np.clip(T / 2, 0, 1))
    measure = Measure(kind)
    measure.check(scenario)
    assert measure.is_boolean == isinstance(measure(scenario, simulation), bool)
    worst = measure.worst
    assert worst is {"held": False, "ran_away": True}[kind] if measure.is_boolean else worst == math.inf


@pytest.mark.parametrize(
    ("measure", "message"),
    [
        (Measure("settle"), 'kind is "settle"; allowed: settling_time, overshoot'),
        (Measure("overshoot", band=0.1), "band is not a setting of overshoot"),
        (Measure("drift", band_prismatic=0.1), "band_prismatic is not a setting of drift"),
        (Measure("ran_away", time=1.0), "time is not a setting of ran_away"),
        (Measure("held", band=-1.0), "band is -1; allowed: 1e-09..12.6 rad"),
        (Measure("held", time=math.nan), "time is nan; allowed: 1e-05..3600 s"),
        (Measure("held", time=18.5), r"time of held is 18.5 s; allowed: 0.02..18 s"),
        (Measure("drift", time=0.001), r"time of drift is 0.001 s; allowed: 0.02..18 s"),
        (Measure("drift", joints=["elbow"]), "unknown joint elbow; joints of MTML: outer_yaw, shoulder_pitch,"),
    ],
)
def test_rejects_invalid_measures(measure, message):
    assert_refused(StudyError, message, measure.check, stepped(T)[0])


def test_overshoot_requires_target():
    assert_refused(StudyError, "overshoot requires a scenario with targets", Measure("overshoot").check, released()[0])
