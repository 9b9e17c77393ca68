"""`check` and `identify` detect channels that are exchanged, inverted, scaled or shifted."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from synthetic_motion import RATE, trajectory

from dvrk_drake.analysis.check.channel_check import check_channels
from dvrk_drake.analysis.check.recording_check import check_with_channels
from dvrk_drake.analysis.motion_identification import identify_dynamic
from dvrk_drake.analysis.observations.observations import Observations
from dvrk_drake.cli import main
from dvrk_drake.dynamics.actuator_effects import ActuatorEffect
from dvrk_drake.dynamics.dynamic_regressor import DynamicRegressor
from dvrk_drake.errors import IdentificationError
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.models.plant import holding_torques
from dvrk_drake.recordings.formats import read_recording, write_recording
from dvrk_drake.recordings.recording import Recording

pytestmark = pytest.mark.slow

#: Prefixes of the columns, in the order of the fields of a Recording.
PREFIXES = ("q", "tau", "qd")


@cache
def motion(name):
    """Returns a simulated motion. Link masses deviate by up to 10 % from the SDF, drive effects by up to 20 %."""
    arm, generator = load_arm(name), np.random.default_rng(3)
    t = np.arange(0, 24, 1 / RATE)
    q, v, vd = trajectory(arm, t, period=12.0)
    regressor = DynamicRegressor(arm)
    masses = np.repeat(generator.uniform(0.9, 1.1, len(regressor.links)), 10)
    parameters = regressor.values * np.append(masses, np.ones(len(regressor.values) - len(masses)))
    tau = arm.transmission.inverse.pull_back_effort(regressor.torque(q, v, vd, parameters))
    a, a_dot = arm.transmission.position(q), arm.transmission.velocity(v)
    for stated in [*arm.effects.friction, *arm.effects.cables, *arm.effects.springs]:
        h = arm.effect_coordinates[stated.coordinate]
        shape = ActuatorEffect(stated.coordinate, stated.kind, stated.scale).column(a @ h, a_dot @ h)
        tau += generator.uniform(0.8, 1.2) * stated.coefficient * np.outer(shape, h)
    tau += 0.02 * np.sqrt(np.mean(tau**2, axis=0)) * generator.normal(size=tau.shape)
    return Recording(a, tau, a_dot, t, "actuator", source=name)


def exchanged(recording, i, j, *blocks):
    order = np.arange(7)
    order[[i, j]] = j, i
    return replace(recording, **{block: getattr(recording, block)[:, order] for block in blocks})


@pytest.mark.parametrize("coordinates", ["actuator", "joint"])
@pytest.mark.parametrize("name", ["mtmr", "psm"])
def test_undamaged_motion_has_no_finding(name, coordinates):
    arm, recording = load_arm(name), motion(name)
    recording = recording.in_joint_coordinates(arm) if coordinates == "joint" else recording
    assert [f for f in check_channels(Observations(recording, arm)) if f.severity != "note"] == []


def test_long_motion_is_checked_in_segments():
    arm, short, count = load_arm("mtmr"), motion("mtmr"), 6
    t = np.arange(count * len(short)) / RATE
    long = Recording(*(np.tile(x, (count, 1)) for x in (short.q, short.tau, short.qd)), t, "actuator", source="long")
    findings, expected = check_channels(Observations(long, arm)), check_channels(Observations(short, arm))
    assert [str(finding) for finding in findings] == [str(finding) for finding in expected]
    (refusal,) = check_channels(Observations(exchanged(long, 1, 2, "tau"), arm))
    assert (refusal.kind, refusal.joints) == ("exchanged channels", (1, 2))
    half_scaled = long.tau * np.where(t > t[-1] / 2, 2.0, 1.0)[:, None] ** (np.arange(7) == 1)
    (scale,) = (
        f for f in check_channels(Observations(replace(long, tau=half_scaled), arm)) if f.kind == "effort scale"
    )
    assert scale.joints == (1,)


@pytest.mark.parametrize(("name", "pair"), [("mtmr", (0, 1)), ("mtmr", (5, 6)), ("psm", (4, 5)), ("psm", (1, 2))])
def test_detects_exchanged_efforts(name, pair):
    damaged = exchanged(motion(name), *pair, "tau")
    found = check_channels(Observations(damaged, load_arm(name)))
    assert [(f.severity, f.kind, f.joints) for f in found] == [("refusal", "exchanged channels", pair)]
    assert f"tau{pair[0] + 1} and tau{pair[1] + 1}" in found[0].what


@pytest.mark.parametrize(("name", "pair"), [("mtmr", (3, 4)), ("psm", (4, 5)), ("psm", (0, 1))])
def test_detects_channels_with_all_signals_exchanged(name, pair):
    damaged = exchanged(motion(name), *pair, "q", "qd", "tau")
    found = check_channels(Observations(damaged, load_arm(name)))
    assert [(f.kind, f.joints) for f in found] == [("exchanged channels", pair)]
    assert "all signals" in found[0].what


def test_detects_all_efforts_inverted_or_in_reverse_order():
    true, arm = motion("psm"), load_arm("psm")
    for tau, what in ((-true.tau, "all efforts have the wrong sign"), (true.tau[:, ::-1], "tau are in reverse order")):
        (found,) = check_channels(Observations(replace(true, tau=tau), arm))
        assert found.severity == "refusal" and what in found.what


@pytest.mark.parametrize(("name", "joint", "factor"), [("mtmr", 6, 0.5), ("psm", 3, 2.0)])
def test_detects_a_scaled_effort(name, joint, factor):
    recording = motion(name)
    scale = np.where(np.arange(7) == joint, factor, 1.0)
    found = check_channels(Observations(replace(recording, tau=recording.tau * scale), load_arm(name)))
    # There may also be findings for drives that share a joint with this drive.
    sizes = {f.joints[0]: f.size for f in found if f.kind == "effort scale"}
    assert sizes[joint] == pytest.approx(factor, rel=0.3)


@pytest.mark.parametrize("joint", [0, 5])
def test_detects_a_channel_with_all_signals_inverted(joint):
    recording, signs = motion("mtmr"), np.where(np.arange(7) == joint, -1.0, 1.0)
    damaged = replace(recording, q=recording.q * signs, qd=recording.qd * signs, tau=recording.tau * signs)
    found = check_channels(Observations(damaged, load_arm("mtmr")))
    assert [(f.kind, f.joints) for f in found] == [("inverted channel", (joint,))]


@pytest.mark.parametrize(("joint", "offset"), [(1, 0.15), (2, -0.1), (3, -0.15)])
def test_detects_a_position_offset(joint, offset):
    recording = motion("mtmr")
    found = check_channels(
        Observations(replace(recording, q=recording.q + offset * np.eye(7)[joint]), load_arm("mtmr"))
    )
    (finding,) = (f for f in found if f.kind == "position offset")
    assert finding.joints[0] == joint
    assert finding.size == pytest.approx(offset, abs=0.06)


@cache
def static_poses(still=()):
    """Returns 60 poses of an MTMR with noisy efforts. The joints `still` do not move."""
    arm, generator = load_arm("mtmr"), np.random.default_rng(2)
    q = arm.sample_poses(60, generator, margin=0.1)
    q[:, list(still)] = q[0, list(still)]
    noise = 0.02 * arm.effort_limits * generator.normal(size=q.shape)
    return Recording(q, holding_torques(arm, q) + noise)


@pytest.mark.parametrize(
    ("pair", "still"), [((0, 1), ()), ((1, 2), ()), ((3, 4), ()), ((0, 2), (0,)), ((3, 6), (0, 6))]
)
def test_detects_exchanged_efforts_of_poses(pair, still):
    arm, poses = load_arm("mtmr"), static_poses(still)
    assert check_channels(Observations(poses, arm)) == []
    found = check_channels(Observations(exchanged(poses, *pair, "tau"), arm))
    assert [(f.severity, f.kind, f.joints) for f in found] == [("refusal", "exchanged channels", pair)]


@pytest.mark.parametrize(("factor", "kind"), [(-1.0, "effort sign"), (2.0, "effort scale")])
def test_detects_a_wrong_sign_or_scale_of_poses(factor, kind):
    poses = static_poses()
    found = check_channels(
        Observations(replace(poses, tau=poses.tau * factor ** (np.arange(7) == 2)), load_arm("mtmr"))
    )
    assert [(f.severity, f.kind, f.joints) for f in found] == [("warning", kind, (2,))]


def test_notes_a_scale_that_friction_cannot_exclude():
    """With 1.5 times the friction of the arm file, half of the effort dissipates 0.75 times the expected power."""
    arm, recording = load_arm("mtmr"), motion("mtmr")
    h = arm.effect_coordinates["actuator.wrist_roll"]
    stated = [effect for effect in arm.effects.friction if effect.coordinate == "actuator.wrist_roll"]
    shapes = sum(
        e.coefficient * ActuatorEffect(e.coordinate, e.kind, e.scale).column(recording.q @ h, recording.qd @ h)
        for e in stated
    )
    halved = 0.5 * (recording.tau + 0.5 * np.outer(shapes, h)) * (h != 0) + recording.tau * (h == 0)
    found = check_channels(Observations(replace(recording, tau=halved), arm))
    assert [f.severity for f in found if 6 in f.joints and "scale" in f.kind] == ["note"]


def test_notes_joints_with_undetectable_offset():
    # Gravity is independent of the angle about a vertical axis.
    notes = [
        f for f in check_channels(Observations(motion("mtmr"), load_arm("mtmr"))) if f.kind == "undetectable offset"
    ]
    assert "outer_yaw" in notes[0].where
    assert "elbow_pitch" not in notes[0].where


def test_exchange_replaces_a_wrong_sign():
    arm = load_arm("mtmr")
    damaged = exchanged(motion("mtmr"), 4, 5, "tau")
    assert [f.kind for f in check_with_channels(Observations(damaged, arm)).refusals] == ["exchanged channels"]


def test_identify_refuses_exchanged_channels(tmp_path, capfd):
    write_recording(exchanged(motion("mtmr"), 0, 1, "tau"), tmp_path / "motion.csv")
    model = tmp_path / "model.yaml"
    command = ["identify", str(tmp_path / "motion.csv"), "--arm", "mtmr"]
    assert main([*command, "--output", str(model)]) == 2
    assert "tau1 and tau2 are exchanged" in capfd.readouterr().err
    assert not model.exists()


def test_rejects_a_model_worse_than_zero_torque():
    recording = motion("mtmr")
    noise = np.random.default_rng(1).normal(size=recording.q.shape) * np.sqrt(np.mean(recording.tau**2, axis=0))
    with pytest.raises(IdentificationError, match="cross-validated relative error exceeds 100 %"):
        identify_dynamic([Observations(replace(recording, tau=noise), load_arm("mtmr"))])


@pytest.mark.parametrize(
    ("name", "coordinates"),
    [
        *(("mtm_one", "actuator"), ("psm_one", "actuator"), ("psm_one_205g_insertion", "actuator")),
        *(("mtm_one", "joint"), ("psm_one_no_weight", "joint"), ("psm_one_105g_parallel", "joint")),
    ],
)
def test_real_motions_have_no_finding(shared_data, name, coordinates):
    path = shared_data / "trajectories" / f"{name}.csv"
    if not path.is_file():
        pytest.skip(f"needs {path}")
    arm = load_arm("mtmr" if name.startswith("mtm") else "psm")
    recording = read_recording(path, arm, "actuator")
    if coordinates == "joint":  # as in a file from `dvrk-drake convert`
        recording = read_recording(path, arm, "wpi")
    assert [f for f in check_channels(Observations(recording, arm)) if f.severity != "note"] == []


@pytest.mark.parametrize("name", ["psm1_1", "psm1_2", "psm1_3", "psm2_1", "psm2_2"])
def test_detects_errors_of_other_arms(shared_data, name):
    """Recordings of two PSMs that were not used to select the constants of the check. Only three joints move."""
    path = shared_data / "psm_three_joints" / f"{name}.csv"
    if not path.is_file():
        pytest.skip(f"needs {path}")
    arm, columns = load_arm("psm"), np.genfromtxt(path, delimiter=",", names=True)
    blocks = [[columns[f"{prefix}{i}"] if i < 4 else 0.0 * columns["t"] for i in range(1, 8)] for prefix in PREFIXES]
    recording = Recording(*(np.array(block).T for block in blocks), columns["t"], "joint", source=name)
    assert [f for f in check_channels(Observations(recording, arm)) if f.severity != "note"] == []
    for pair in ((0, 1), (0, 2), (1, 2)):
        (refusal,) = check_channels(Observations(exchanged(recording, *pair, "tau"), arm))
        assert (refusal.kind, refusal.joints) == ("exchanged channels", pair)
    for joint in range(3):
        signs = np.where(np.arange(7) == joint, -1.0, 1.0)
        (refusal,) = check_channels(Observations(replace(recording, tau=recording.tau * signs), arm))
        assert (refusal.kind, refusal.joints) == ("effort sign", (joint,))
