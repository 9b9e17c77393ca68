"""`check`: every quirk of real recordings is found with its size where it was put, and nowhere else."""

import json
from dataclasses import replace

import numpy as np
import pytest
from rich.console import Console
from synthetic_motion import EFFORT_NOISE, PERIOD, RATE, clean_motion

from dvrk_drake.analysis.check.recording_check import check_recording
from dvrk_drake.analysis.convert.convert import read_wpi_csv, wpi_in_joint_coordinates
from dvrk_drake.analysis.signals.low_pass import low_pass
from dvrk_drake.analysis.signals.poses import find_poses
from dvrk_drake.analysis.signals.true_time import true_time
from dvrk_drake.analysis.tables import make_table
from dvrk_drake.cli import main
from dvrk_drake.errors import RecordingError
from dvrk_drake.lcmtypes import lcmt_dvrk_status as Status
from dvrk_drake.models.arm import load_arm
from dvrk_drake.models.lcm_log import LcmEvent, event_bytes
from dvrk_drake.models.lcm_messages import status_channel
from dvrk_drake.models.plant import holding_torque, make_arm_plant, set_arm_positions
from dvrk_drake.models.recording import Recording, read_recording, write_recording

pytestmark = pytest.mark.slow

ARMS = "psm", "mtmr"


def found(recording, name="psm"):
    """Findings by kind."""
    report = check_recording(recording, load_arm(name))
    kinds = {}
    for finding in report.findings:
        kinds.setdefault(finding.kind, []).append(finding)
    return kinds


def changed(recording, block, joint, change):
    values = getattr(recording, block).copy()
    values[:, joint] = change(values[:, joint])
    return replace(recording, **{block: values})


# A clean motion.


@pytest.mark.parametrize("name", ARMS)
def test_a_clean_motion_gives_only_its_period(name):
    report = check_recording(clean_motion(name), load_arm(name))
    assert [finding.kind for finding in report.findings] == ["repetition"]
    assert report.period == pytest.approx(PERIOD, abs=1e-4)
    assert report.jitter == 0.0
    assert report.repeated == 0.0
    for joint in report.joints:
        assert joint.velocity_gain == pytest.approx(1, abs=2e-3)
        assert joint.velocity_lag == pytest.approx(0, abs=1e-4)


@pytest.mark.parametrize("name", ARMS)
def test_floor_is_the_noise_that_was_put_into_the_efforts(name):
    arm = load_arm(name)
    report = check_recording(clean_motion(name), arm)
    white = np.random.default_rng(0).normal(size=(20000, 1)) * EFFORT_NOISE
    passed = float(np.std(low_pass(white, RATE, arm.effort_cut_off)))
    # In actuator coordinates noise of coupled joints adds; the first is driven by its own motor.
    assert report.joints[0].floor == pytest.approx(passed, rel=0.15)


@pytest.mark.parametrize("name", ARMS)
def test_the_same_in_actuator_coordinates(name):
    arm, recording = load_arm(name), clean_motion(name)
    ours, theirs = (check_recording(r, arm) for r in (recording, recording.in_actuator_coordinates(arm)))
    assert [f.kind for f in ours.findings] == [f.kind for f in theirs.findings]
    for a, b in zip(ours.joints, theirs.joints, strict=True):
        assert a.floor == pytest.approx(b.floor, rel=1e-6)
        assert a.range == pytest.approx(b.range, rel=1e-9)


def test_a_motion_that_does_not_repeat_has_no_floor():
    recording = clean_motion(period=97.0)
    kinds = found(recording)
    assert "no repetition" in kinds
    assert "repetition" not in kinds
    assert {f.severity for fs in kinds.values() for f in fs} <= {"note", "warning"}


# Time.


def test_repeated_rows_are_counted_and_their_times_made():
    generator = np.random.default_rng(3)
    whole = clean_motion()
    rows = np.arange(len(whole))
    repeats = generator.random(len(rows)) < 0.12
    repeats[0] = False
    last = np.maximum.accumulate(np.where(repeats, 0, rows))
    polled = replace(whole, q=whole.q[last], qd=whole.qd[last], tau=whole.tau[last])
    kinds = found(polled)
    assert kinds["repeated rows"][0].size == pytest.approx(np.mean(repeats), abs=1e-9)
    clock = true_time(polled.in_actuator_coordinates(load_arm("psm")))
    np.testing.assert_array_equal(clock.rows, rows[~repeats])


@pytest.mark.parametrize("name", ARMS)
@pytest.mark.parametrize("jitter", [0.15, 0.5])
def test_jitter_is_measured_and_taken_out(name, jitter):
    intervals = np.random.default_rng(4).gamma(1 / jitter**2, jitter**2 / RATE, 4000)
    true = np.concatenate([[0.0], np.cumsum(intervals)])
    recording = clean_motion(name, at=true)
    arm = load_arm(name)
    kinds = found(recording, name)
    assert kinds["jitter"][0].size == pytest.approx(jitter, rel=0.15)
    assert "velocity disagrees" not in kinds
    made = np.diff(true_time(recording.in_actuator_coordinates(arm)).t)
    left = made / made.mean() - intervals / intervals.mean()
    # 0.5 would be half of the jitter: what is left is the curvature of the way between two rows.
    assert np.std(left) < 0.1 * jitter


def test_a_slower_effort_topic_is_named():
    whole = clean_motion()
    every_other = np.arange(len(whole)) // 2 * 2
    kinds = found(replace(whole, tau=whole.tau[every_other]))
    assert [f.where for f in kinds["repeated channel"]] == ["tau"]
    assert kinds["repeated channel"][0].size == pytest.approx(0.5, abs=0.01)
    assert "repeated rows" not in kinds


def test_gap_in_time():
    whole = clean_motion()
    keep = np.ones(len(whole), bool)
    keep[1000:1100] = False
    cut = replace(whole, q=whole.q[keep], qd=whole.qd[keep], tau=whole.tau[keep], t=whole.t[keep])
    gap = found(cut)["gaps"][0]
    assert gap.size == pytest.approx(101 / RATE, abs=1e-9)
    assert "row 1001" in gap.what
    assert set(found(cut)) == {"gaps", "repetition"}


def test_times_that_go_back_are_refused():
    whole = clean_motion()
    t = whole.t.copy()
    t[500] = t[498]
    refusal = found(replace(whole, t=t))["time goes back"][0]
    assert refusal.severity == "refusal"
    assert "row 501" in refusal.what


@pytest.mark.parametrize(("factor", "unit"), [(1000.0, "milliseconds"), (1e9, "nanoseconds"), (7 / 6, "rate right")])
def test_times_in_another_unit_are_refused(factor, unit):
    whole = clean_motion()
    refusal = found(replace(whole, t=whole.t * factor))["wrong time"][0]
    assert refusal.severity == "refusal"
    assert refusal.size == pytest.approx(factor, rel=1e-2)
    assert unit in refusal.what


# Channels.


@pytest.mark.parametrize(("gain", "lag"), [(1.18, 0.0), (1.0, 0.010), (1.07, 0.008), (-1.0, 0.0), (180 / np.pi, 0.0)])
def test_velocities_that_disagree(gain, lag):
    whole = clean_motion("mtmr")
    late = changed(whole, "qd", 5, lambda x: gain * np.interp(whole.t - lag, whole.t, x))
    kinds = found(late, "mtmr")
    # Only the first four joints of an MTM share motors, so this joint is one channel.
    assert [f.joints for f in kinds["velocity disagrees"]] == [(5,)]
    report = check_recording(late, load_arm("mtmr"))
    assert report.joints[5].velocity_gain == pytest.approx(gain, rel=5e-3)
    assert report.joints[5].velocity_lag == pytest.approx(lag, abs=3e-4)


def test_velocities_that_are_always_zero():
    whole = clean_motion()
    assert len(found(replace(whole, qd=0 * whole.qd))["velocity disagrees"]) == 7


@pytest.mark.parametrize("name", ARMS)
@pytest.mark.parametrize("lag", [0.010, -0.010, 0.020])
def test_late_efforts(name, lag):
    report = check_recording(clean_motion(name, effort_lag=lag), load_arm(name))
    lags = [joint.effort_lag for joint in report.joints]
    assert sum(value is not None for value in lags) >= 5
    for value in lags:
        if value is not None:
            # Inertia that depends on the pose is not in the fit; a lag of 3 ms is what it may look like.
            assert value == pytest.approx(lag, abs=0.0035)


@pytest.mark.parametrize("name", ARMS)
@pytest.mark.parametrize("joint", range(7))
def test_wrong_sign_of_an_effort_is_refused(name, joint):
    arm = load_arm(name)
    motors = clean_motion(name).in_actuator_coordinates(arm)
    refusals = found(changed(motors, "tau", joint, lambda x: -x), name)["effort sign"]
    assert [f.joints for f in refusals] == [(joint,)]
    assert refusals[0].severity == "refusal"


def test_narrow_band_noise():
    generator = np.random.default_rng(6)
    whole = clean_motion()
    white = generator.normal(size=len(whole))
    band = low_pass(white, RATE, 15.0) - low_pass(white, RATE, 7.0)
    size = 0.15 * np.sqrt(np.mean(whole.tau[:, 2] ** 2))
    noisy = changed(whole, "tau", 2, lambda x: x + size * band / np.std(band))
    bands = found(noisy)["narrow-band noise"]
    assert [f.joints for f in bands] == [(2,)]
    assert bands[0].size == pytest.approx(0.15, rel=0.15)


def test_louder_noise_lowers_the_cut_off_to_what_moves():
    """The motion ends at its fifth harmonic, 0.83 Hz; only friction's reversals are above."""
    report = check_recording(clean_motion(), load_arm("psm"))
    louder = changed(
        clean_motion(), "tau", 0, lambda x: x + np.random.default_rng(8).normal(size=len(x)) * 0.5 * np.std(x)
    )
    noisy = check_recording(louder, load_arm("psm"))
    assert noisy.joints[0].effort_cut_off < report.joints[0].effort_cut_off
    assert 2.0 <= noisy.joints[0].effort_cut_off < 10.0


def test_saturated_effort():
    whole = clean_motion()
    limit = np.quantile(whole.tau[:, 0], 0.95)
    finding = found(changed(whole, "tau", 0, lambda x: np.minimum(x, limit)))["saturated effort"][0]
    assert finding.joints == (0,)
    assert finding.size == pytest.approx(0.05, abs=0.015)


def test_efforts_in_another_unit_are_refused():
    assert found(changed(clean_motion(), "tau", 1, lambda x: 1000 * x))["unusable"][0].severity == "refusal"


def test_positions_in_degrees_are_refused():
    whole = clean_motion()
    degrees = replace(whole, q=np.where(load_arm("psm").prismatic, whole.q, np.degrees(whole.q)))
    assert "degrees" in found(degrees)["unusable"][0].what


def test_millimetres_are_refused():
    assert "millimetres" in found(changed(clean_motion(), "q", 2, lambda x: 1000 * x))["unusable"][0].what


# What the arm did.


def test_a_joint_that_never_moves():
    still = changed(changed(clean_motion(), "q", 3, lambda x: 0 * x + 0.1), "qd", 3, lambda x: 0 * x)
    kinds = found(still)
    assert [f.joints for f in kinds["never moves"]] == [(3,)]
    assert {f.severity for fs in kinds.values() for f in fs} <= {"note", "warning"}


def test_little_excitation():
    arm = load_arm("psm")
    middle = (arm.position_lower[0] + arm.position_upper[0]) / 2
    small = changed(clean_motion(), "q", 0, lambda x: middle + 0.1 * (x - middle))
    small = changed(small, "qd", 0, lambda x: 0.1 * x)
    finding = found(small)["little excitation"][0]
    assert finding.joints == (0,)
    assert finding.size == pytest.approx(
        0.1 * np.ptp(clean_motion().q[:, 0]) / np.ptp([arm.position_lower[0], arm.position_upper[0]])
    )


def test_joints_that_move_together():
    whole = clean_motion()
    q, qd = whole.q.copy(), whole.qd.copy()
    q[:, 1], qd[:, 1] = 0.5 * q[:, 0], 0.5 * qd[:, 0]
    assert [f.joints for f in found(replace(whole, q=q, qd=qd))["move together"]] == [(0, 1)]


def test_outside_limits():
    arm = load_arm("psm")
    beyond = arm.position_upper[4] + 0.05
    whole = clean_motion()
    finding = found(changed(whole, "q", 4, lambda x: x + beyond - x.max()))["outside limits"][0]
    assert finding.joints == (4,)
    assert finding.size == pytest.approx(0.05)


# Poses, logs and what is no recording of the arm.


def poses(arm, count=40):
    q = arm.sample_poses(count, np.random.default_rng(1), margin=0.1)
    plant = make_arm_plant(arm)
    context = plant.CreateDefaultContext()
    tau = []
    for pose in q:
        set_arm_positions(plant, context, arm, pose)
        tau.append(holding_torque(plant, context, arm))
    return Recording(q, np.array(tau))


def test_poses_have_no_signals():
    arm = load_arm("mtml")
    recording = poses(arm)
    noise = np.random.default_rng(3).normal(size=recording.tau.shape)
    recording = replace(recording, tau=recording.tau + 1e-3 * noise)
    report = check_recording(recording, arm)
    assert report.kind == "poses"
    assert report.findings == ()
    assert report.joints[1].effort > 0
    assert report.joints[1].velocity_gain is None


def test_poses_whose_efforts_are_reactions():
    arm = load_arm("mtml")
    recording = poses(arm)
    kinds = found(replace(recording, tau=-recording.tau), "mtml")
    assert {1, 2} <= {f.joints[0] for f in kinds["effort sign"]}


def test_few_poses():
    assert found(replace(poses(load_arm("mtml"), 5)), "mtml")["few poses"][0].size == 5


def test_another_number_of_joints():
    assert found(Recording(np.zeros((5, 6)), np.zeros((5, 6))))["unusable"][0].severity == "refusal"


def test_no_efforts():
    assert found(replace(clean_motion(), tau=None))["unusable"][0].severity == "refusal"


def test_a_motion_without_velocities():
    kinds = found(replace(clean_motion(), qd=None))
    assert set(kinds) == {"no velocities", "repetition"}


@pytest.mark.parametrize("rows", [1, 2, 99, 100, 150, 600, 1010, 1500, 2100])
def test_short_recordings_are_not_refused(rows):
    whole = clean_motion()
    short = replace(whole, q=whole.q[:rows], qd=whole.qd[:rows], tau=whole.tau[:rows], t=whole.t[:rows])
    assert check_recording(short, load_arm("psm")).refusals == ()


def test_nothing_moves_and_nothing_pulls():
    whole = clean_motion()
    still = replace(whole, q=whole.q * 0 + whole.q[0], qd=0 * whole.qd, tau=0 * whole.tau)
    assert set(found(still)) == {"never moves", "no effort", "no repetition"}


def test_lcm_log(tmp_path):
    arm, whole = load_arm("psm"), clean_motion()
    events = []
    for row in range(len(whole)):
        status = Status()
        status.utime, status.sequence, status.session_id = 1 + round(1e6 * whole.t[row]), row, 1
        status.arm_name, status.num_joints, status.guard_state = arm.name, arm.num_joints, Status.STATE_HOLD
        status.position, status.velocity = whole.q[row].tolist(), whole.qd[row].tolist()
        status.effort_measured, status.joint_flags = whole.tau[row].tolist(), [0] * arm.num_joints
        status.position_commanded, status.effort_commanded = status.position, status.effort_measured
        events.append(event_bytes(LcmEvent(row, status.utime, status_channel(arm), status.encode())))
    (tmp_path / "arm.log").write_bytes(b"".join(events))
    report = check_recording(read_recording(tmp_path / "arm.log", arm), arm)
    assert report.kind == "motion"
    assert [finding.kind for finding in report.findings] == ["repetition"]
    assert report.period == pytest.approx(PERIOD, abs=1e-3)
    (tmp_path / "cut.log").write_bytes(b"".join(events)[:-10])
    report = check_recording(read_recording(tmp_path / "cut.log", arm), arm)
    assert {finding.kind for finding in report.findings} == {"reading", "repetition"}


# The command.


def test_command_prints_findings_and_writes_json(tmp_path, capsys):
    path, output = tmp_path / "motion.csv", tmp_path / "check.json"
    write_recording(changed(clean_motion(), "qd", 4, lambda x: 1.1 * x), path)
    assert main(["check", str(path), "--arm", "psm", "--json", str(output), "--plots", str(tmp_path / "p")]) == 0
    assert (tmp_path / "p" / "spectra.png").stat().st_size > 10_000
    text = capsys.readouterr().out
    assert "warning: wrist_pitch: qd5 is 1.1 times dq/dt" in text
    report = json.loads(output.read_text())
    assert report["period"] == pytest.approx(PERIOD, abs=1e-4)
    assert {f["kind"] for f in report["findings"]} >= {"velocity disagrees", "repetition"}


def test_command_refuses_with_exit_code_2(tmp_path, capsys):
    path = tmp_path / "motion.csv"
    whole = clean_motion()
    write_recording(replace(whole, t=1000 * whole.t), path)
    assert main(["check", str(path), "--arm", "psm"]) == 2
    captured = capsys.readouterr()
    assert "milliseconds" in captured.out
    assert captured.err.count("\n") == 1


# Recordings of real arms.


@pytest.fixture(scope="module")
def real_motion(shared_data):
    def motion(name):
        path = shared_data / "trajectories" / f"{name}.csv"
        if not path.is_file():
            pytest.skip(f"needs {path}")
        return wpi_in_joint_coordinates(read_wpi_csv(path), real_arm(name))

    return motion


@pytest.fixture(scope="module")
def real(real_motion):
    return lambda name: check_recording(real_motion(name), real_arm(name))


def real_arm(name):
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
    floors = [round(100 * joint.floor, 1) for joint in report.joints]
    assert floors == [4.5, 15.2, 6.7, 4.3, 16.3, 10.3, 19.2]


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
def test_real_insertion_has_noise_between_5_and_17_hz_and_a_late_effort(real, name):
    kinds = kinds_of(real(name))
    assert (2,) in [f.joints for f in kinds["narrow-band noise"]]
    # A study of these recordings found three quarters of a sample at 200 Hz.
    lag = next(f for f in kinds["effort lag"] if f.joints == (2,))
    assert lag.size == pytest.approx(0.75 / 200, abs=0.002)


@pytest.mark.parametrize("name", ["mtm_one", "psm_one"])
@pytest.mark.parametrize("joint", [0, 2, 4, 6])
def test_real_motor_with_the_wrong_sign_is_refused(real_motion, name, joint):
    arm = real_arm(name)
    motors = changed(real_motion(name).in_actuator_coordinates(arm), "tau", joint, lambda x: -x)
    refusals = check_recording(motors, arm).refusals
    assert [(f.kind, f.joints) for f in refusals] == [("effort sign", (joint,))]


def test_spikes_of_an_effort_are_refused_in_a_motion():
    def spike(tau):
        tau = tau.copy()
        tau[[300, 700]] = 500.0
        return tau

    finding = found(changed(clean_motion(), "tau", 1, spike))["above effort limit"][0]
    assert finding.severity == "refusal" and "2 rows" in finding.what


@pytest.mark.parametrize("rows", [np.random.default_rng(0).permutation(1000), np.r_[0:500, 499:999]])
def test_a_motion_whose_times_go_back_is_not_taken_for_poses(rows):
    motion = clean_motion()
    shuffled = Recording(q=motion.q[rows], tau=motion.tau[rows], qd=motion.qd[rows], t=motion.t[rows])
    with pytest.raises(RecordingError, match="t does not increase"):
        find_poses(shuffled, load_arm("psm"))


def test_units_in_the_headings_of_tables_are_printed():
    console = Console(record=True, width=120)
    console.print(make_table("title [kg]", "", "mass [kg]"))
    assert "mass [kg]" in console.export_text()
