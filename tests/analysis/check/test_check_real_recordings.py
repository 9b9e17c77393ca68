"""Checks of recordings of real arms: the findings agree with the README of the recordings."""

import numpy as np
import pytest
from check_findings import changed

from dvrk_drake.analysis.check.recording_check import check_recording, check_with_channels
from dvrk_drake.analysis.observations.observations import Observations
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.recordings.reading import read_recording

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def real_motion(shared_data):
    def motion(name):
        path = shared_data / "trajectories" / f"{name}.csv"
        if not path.is_file():
            pytest.skip(f"needs {path}")
        return read_recording(path, arm_of(name), "wpi")

    return motion


@pytest.fixture(scope="module")
def real(real_motion):
    return lambda name: check_recording(Observations(real_motion(name), arm_of(name)))


def arm_of(name):
    return load_arm(name.split("_")[0].replace("mtm", "mtmr"))


def kinds_of(report):
    kinds = {}
    for finding in report.findings:
        kinds.setdefault(finding.kind, []).append(finding)
    return kinds


def test_real_mtm(real):
    report = real("mtm_one")
    kinds = kinds_of(report)
    assert report.refusals == ()
    assert 0.11 <= kinds["repeated rows"][0].size <= 0.135
    assert "jitter" in kinds
    assert [f.joints[0] for f in kinds["velocity disagrees"]] == [4, 5, 6]
    assert all(1.04 <= f.size <= 1.185 for f in kinds["velocity disagrees"])
    assert max(joint.velocity_lag for joint in report.joints) <= 2.2 / 200
    assert all(abs(joint.velocity_gain - 1) < 0.014 for joint in report.joints[:4])
    assert round(report.period * 200) == 2333
    assert 1 / report.period == pytest.approx(0.1 * 6 / 7, rel=2e-3)
    np.testing.assert_allclose(
        [100 * joint.floor for joint in report.joints], [4.5, 15.2, 6.7, 4.3, 16.3, 10.3, 19.2], atol=0.055
    )


def test_real_psm(real):
    report = real("psm_one")
    kinds = kinds_of(report)
    assert report.refusals == ()
    assert "repeated rows" not in kinds
    assert "velocity disagrees" not in kinds
    assert all(abs(joint.velocity_gain - 1) < 0.014 for joint in report.joints)
    assert round(report.period * 200) == 1296
    assert 1 / report.period == pytest.approx(0.18 * 6 / 7, rel=2e-3)
    np.testing.assert_allclose(
        [100 * joint.floor for joint in report.joints], [1.4, 2.0, 15.3, 3.1, 1.4, 1.9, 2.2], atol=0.055
    )


@pytest.mark.parametrize("name", ["psm_one", "psm_one_no_weight", "psm_one_105g_parallel", "psm_one_205g_insertion"])
def test_real_insertion_has_noise_and_effort_lag(real, name):
    kinds = kinds_of(real(name))
    assert (2,) in [f.joints for f in kinds["narrow-band noise"]]
    # An analysis of these recordings found a lag of 0.75 samples at 200 Hz.
    lag = next(f for f in kinds["effort lag"] if f.joints == (2,))
    assert lag.size == pytest.approx(0.75 / 200, abs=0.002)


@pytest.mark.parametrize("name", ["mtm_one", "psm_one"])
@pytest.mark.parametrize("joint", [0, 2, 4, 6])
def test_refuses_a_wrong_sign_in_a_real_motion(real_motion, name, joint):
    arm = arm_of(name)
    motors = changed(real_motion(name).in_actuator_coordinates(arm), "tau", joint, lambda x: -x)
    refusals = check_with_channels(Observations(motors, arm)).refusals
    assert [(f.kind, f.joints) for f in refusals] == [("effort sign", (joint,))]
