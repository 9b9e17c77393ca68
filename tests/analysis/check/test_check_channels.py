"""Checks of the channels of a motion: lag, sign, noise and unit of velocities and efforts."""

from dataclasses import replace

import numpy as np
import pytest
from check_findings import ARMS, changed, found
from synthetic_motion import clean_motion

from dvrk_drake.analysis.check.recording_check import check_recording
from dvrk_drake.analysis.observations.observations import Observations
from dvrk_drake.analysis.observations.static_poses import check_effort_unit
from dvrk_drake.errors import RecordingError
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.recordings.recording import Recording

pytestmark = pytest.mark.slow


@pytest.mark.parametrize(("gain", "lag"), [(1.18, 0.0), (1.0, 0.010), (1.07, 0.008), (-1.0, 0.0), (180 / np.pi, 0.0)])
def test_detects_a_wrong_velocity_gain_or_lag(gain, lag):
    whole = clean_motion("mtmr")
    late = changed(whole, "qd", 5, lambda x: gain * np.interp(whole.t - lag, whole.t, x))
    kinds = found(late, "mtmr")
    # Only the first four joints of an MTM share motors, so actuator 6 drives one joint.
    assert [f.joints for f in kinds["velocity disagrees"]] == [(5,)]
    report = check_recording(Observations(late, load_arm("mtmr")))
    assert report.joints[5].velocity_gain == pytest.approx(gain, rel=5e-3)
    assert report.joints[5].velocity_lag == pytest.approx(lag, abs=3e-4)


def test_detects_velocities_that_are_always_zero():
    whole = clean_motion()
    assert len(found(replace(whole, qd=0 * whole.qd))["velocity disagrees"]) == 7


@pytest.mark.parametrize("name", ARMS)
@pytest.mark.parametrize("joint", range(7))
def test_refuses_an_effort_with_the_wrong_sign(name, joint):
    arm = load_arm(name)
    motors = clean_motion(name).in_actuator_coordinates(arm)
    refusals = found(changed(motors, "tau", joint, lambda x: -x), name)["effort sign"]
    assert [f.joints for f in refusals] == [(joint,)]
    assert refusals[0].severity == "refusal"


def test_detects_a_saturated_effort():
    whole = clean_motion()
    limit = np.quantile(whole.tau[:, 0], 0.95)
    finding = found(changed(whole, "tau", 0, lambda x: np.minimum(x, limit)))["saturated effort"][0]
    assert finding.joints == (0,)
    assert finding.size == pytest.approx(0.05, abs=0.015)


def test_saturation_at_both_limits_is_one_finding():
    whole = clean_motion()
    limit = np.quantile(np.abs(whole.tau[:, 0]), 0.8)
    (finding,) = found(changed(whole, "tau", 0, lambda x: np.clip(x, -limit, limit)))["saturated effort"]
    assert f"at {limit:.4g} N m in" in finding.what and f"at {-limit:.4g} N m in" in finding.what


@pytest.mark.parametrize("step", [0.0, 1e-3])
def test_constant_efforts_at_rest_are_not_saturated(step):
    """The efforts are constant, or change by one step of a converter."""
    whole, arm = clean_motion(), load_arm("psm")
    tau = np.tile(0.05 * arm.effort_limits, (len(whole), 1))
    tau[::7] += step
    standing = replace(whole, q=0 * whole.q + whole.q[0], qd=0 * whole.qd, tau=tau)
    kinds = found(standing)
    assert len(kinds["never moves"]) == arm.num_joints and "saturated effort" not in kinds


def test_refuses_efforts_in_another_unit():
    assert found(changed(clean_motion(), "tau", 1, lambda x: 1000 * x))["unusable"][0].severity == "refusal"


@pytest.mark.parametrize(
    ("change", "advice"),
    [(lambda tau: 1e3 * tau, "in N mm, give --effort-scale 0.001"), (lambda tau: tau[:, ::-1], "in reverse order")],
)
def test_the_cause_of_efforts_above_the_limits_is_named(change, advice):
    arm = load_arm("mtmr")
    rows = Recording(q=np.zeros((3, 7)), tau=np.tile(0.9 * arm.effort_limits, (3, 1)))
    check_effort_unit(rows, arm)
    with pytest.raises(RecordingError, match=advice):
        check_effort_unit(replace(rows, tau=change(rows.tau)), arm)


def test_exchanged_positions_and_efforts_are_named():
    arm = load_arm("psm")
    rows = Recording(q=np.tile(0.9 * arm.effort_limits, (3, 1)), tau=np.tile(arm.position_upper, (3, 1)))
    with pytest.raises(RecordingError, match="if the positions and the efforts are exchanged"):
        rows.check_fits(arm)


def test_refuses_positions_in_degrees():
    whole = clean_motion()
    degrees = replace(whole, q=np.where(load_arm("psm").prismatic, whole.q, np.degrees(whole.q)))
    assert "degrees" in found(degrees)["unusable"][0].advice


def test_refuses_positions_in_millimetres():
    assert "millimetres" in found(changed(clean_motion(), "q", 2, lambda x: 1000 * x))["unusable"][0].advice


def test_refuses_effort_spikes_in_a_motion():
    def spike(tau):
        tau = tau.copy()
        tau[[300, 700]] = 500.0
        return tau

    finding = found(changed(clean_motion(), "tau", 1, spike))["above effort limit"][0]
    assert finding.severity == "refusal" and "2 rows" in finding.what
