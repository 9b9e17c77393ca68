"""`check` of simulated and real recordings: motions, poses, channels, times, and the command."""

import json
from dataclasses import replace

import numpy as np
import pytest
from command_output import assert_refused, refusal
from figure_rules import checked_figures
from synthetic_motion import PERIOD, RATE, clean_motion

from dvrk_drake.analysis.check.recording_check import check_recording
from dvrk_drake.analysis.observations.observations import Observations
from dvrk_drake.analysis.observations.static_poses import check_effort_unit
from dvrk_drake.analysis.observations.true_time import true_time
from dvrk_drake.cli import main
from dvrk_drake.errors import RecordingError
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.models.plant import holding_torques
from dvrk_drake.recordings.formats import read_recording, write_recording
from dvrk_drake.recordings.recording import MIN_ROWS, Recording

pytestmark = pytest.mark.slow

ARMS = "psm", "mtmr"


def found(recording, name="psm"):
    """Returns a mapping from a kind to the findings of `check` of this kind."""
    report = check_recording(Observations(recording, load_arm(name)))
    kinds = {}
    for finding in report.findings:
        kinds.setdefault(finding.kind, []).append(finding)
    return kinds


def changed(recording, block, joint, change):
    values = getattr(recording, block).copy()
    values[:, joint] = change(values[:, joint])
    return replace(recording, **{block: values})


@pytest.mark.parametrize("name", ARMS)
def test_clean_motion_has_only_the_period_as_finding(name):
    report = check_recording(Observations(clean_motion(name), load_arm(name)))
    assert [finding.kind for finding in report.findings] == ["repetition"]
    assert report.period == pytest.approx(PERIOD, abs=1e-4)
    assert report.jitter == 0.0
    assert report.repeated == 0.0
    for joint in report.joints:
        assert joint.velocity_gain == pytest.approx(1, abs=2e-3)
        assert joint.velocity_lag == pytest.approx(0, abs=1e-4)


@pytest.mark.parametrize("name", ARMS)
def test_actuator_coordinates_have_the_same_findings(name):
    arm, recording = load_arm(name), clean_motion(name)
    joint, actuator = (
        check_recording(Observations(r, arm)) for r in (recording, recording.in_actuator_coordinates(arm))
    )
    assert [f.kind for f in joint.findings] == [f.kind for f in actuator.findings]
    for a, b in zip(joint.joints, actuator.joints, strict=True):
        assert a.floor == pytest.approx(b.floor, rel=1e-6)
        assert a.range == pytest.approx(b.range, rel=1e-9)


def test_a_motion_that_does_not_repeat_has_no_floor():
    recording = clean_motion(period=97.0)
    kinds = found(recording)
    assert "no repetition" in kinds
    assert "repetition" not in kinds
    assert {f.severity for fs in kinds.values() for f in fs} <= {"note", "warning"}


def test_detects_a_joint_that_does_not_move():
    still = changed(changed(clean_motion(), "q", 3, lambda x: 0 * x + 0.1), "qd", 3, lambda x: 0 * x)
    kinds = found(still)
    assert [f.joints for f in kinds["never moves"]] == [(3,)]
    assert {f.severity for fs in kinds.values() for f in fs} <= {"note", "warning"}


def test_detects_little_excitation():
    arm = load_arm("psm")
    middle = (arm.position_lower[0] + arm.position_upper[0]) / 2
    small = changed(clean_motion(), "q", 0, lambda x: middle + 0.1 * (x - middle))
    small = changed(small, "qd", 0, lambda x: 0.1 * x)
    finding = found(small)["little excitation"][0]
    assert finding.joints == (0,)
    assert finding.size == pytest.approx(
        0.1 * np.ptp(clean_motion().q[:, 0]) / np.ptp([arm.position_lower[0], arm.position_upper[0]])
    )


def test_detects_joints_that_move_together():
    whole = clean_motion()
    q, qd = whole.q.copy(), whole.qd.copy()
    q[:, 1], qd[:, 1] = 0.5 * q[:, 0], 0.5 * qd[:, 0]
    assert [f.joints for f in found(replace(whole, q=q, qd=qd))["move together"]] == [(0, 1)]


def test_detects_positions_outside_limits():
    arm = load_arm("psm")
    beyond = arm.position_upper[4] + 0.05
    whole = clean_motion()
    finding = found(changed(whole, "q", 4, lambda x: x + beyond - x.max()))["outside limits"][0]
    assert finding.joints == (4,)
    assert finding.size == pytest.approx(0.05)


def poses(arm, count=40):
    q = arm.sample_poses(count, np.random.default_rng(1), margin=0.1)
    return Recording(q, holding_torques(arm, q))


def test_poses_have_no_signals():
    arm = load_arm("mtml")
    recording = poses(arm)
    noise = np.random.default_rng(3).normal(size=recording.tau.shape)
    recording = replace(recording, tau=recording.tau + 1e-3 * noise)
    report = check_recording(Observations(recording, arm))
    assert report.kind == "poses"
    assert report.findings == ()
    assert report.joints[1].effort > 0
    assert report.joints[1].velocity_gain is None


def test_warns_of_a_motion_without_times():
    motion = clean_motion("psm")
    rows = replace(motion, t=None, qd=None)
    assert [finding.kind for finding in check_recording(Observations(rows, load_arm("psm"))).warnings].count(
        "no times"
    ) == 1
    apart = replace(rows, q=rows.q[::30], tau=rows.measured_effort()[::30], lines=None)
    assert all(finding.kind != "no times" for finding in check_recording(Observations(apart, load_arm("psm"))).findings)


def in_degrees(whole):
    return replace(whole, q=np.where(load_arm("psm").prismatic, whole.q, np.degrees(whole.q)))


def with_rows(values, *rows, value):
    """Returns a copy of an array with other values in some rows."""
    values = values.copy()
    values[list(rows)] = value
    return values


@pytest.mark.parametrize(
    ("change", "kind", "text"),
    [
        (lambda whole: Recording(np.zeros((5, 6)), np.zeros((5, 6))), "unusable", "6"),
        (lambda whole: replace(whole, tau=None), "unusable", "effort"),
        (lambda whole: changed(whole, "tau", 1, lambda x: 1000 * x), "unusable", "unit"),
        (in_degrees, "unusable", "degrees"),
        (lambda whole: changed(whole, "q", 2, lambda x: 1000 * x), "unusable", "millimetres"),
        (
            lambda whole: changed(whole, "tau", 1, lambda x: with_rows(x, 300, 700, value=500.0)),
            "above effort limit",
            "2 rows",
        ),
        (lambda whole: replace(whole, t=with_rows(whole.t, 500, value=whole.t[498])), "time goes back", "row 501"),
        (lambda whole: replace(whole, t=1e3 * whole.t), "wrong time", "milliseconds"),
        (lambda whole: replace(whole, t=1e9 * whole.t), "wrong time", "nanoseconds"),
        (lambda whole: replace(whole, t=7 / 6 * whole.t), "wrong time", "wrong rate"),
    ],
)
def test_unusable_motion_is_refused(change, kind, text):
    finding = found(change(clean_motion()))[kind][0]
    assert finding.severity == "refusal"
    assert text in f"{finding.what} {finding.advice}"


def test_motion_without_velocities():
    kinds = found(replace(clean_motion(), qd=None))
    assert set(kinds) == {"no velocities", "repetition"}


@pytest.mark.parametrize("rows", [1, 2, 99, 100, 150, 600, 1010, 1500, 2100])
def test_only_motions_of_few_rows_are_refused(rows):
    whole = clean_motion()
    short = replace(whole, q=whole.q[:rows], qd=whole.qd[:rows], tau=whole.tau[:rows], t=whole.t[:rows])
    refusals = check_recording(Observations(short, load_arm("psm"))).refusals
    assert [finding.kind for finding in refusals] == (["too few rows"] if 1 < rows < MIN_ROWS else [])


def test_arm_at_rest_without_efforts():
    whole = clean_motion()
    still = replace(whole, q=whole.q * 0 + whole.q[0], qd=0 * whole.qd, tau=0 * whole.tau)
    assert set(found(still)) == {"never moves", "no effort", "no repetition"}


def test_command_prints_findings_and_writes_json(tmp_path, capsys, monkeypatch):
    path, output = tmp_path / "motion.csv", tmp_path / "check.json"
    write_recording(changed(clean_motion(), "qd", 4, lambda x: 1.1 * x), path)
    with checked_figures(monkeypatch):
        assert main(["check", str(path), "--arm", "psm", "--json", str(output), "--plots", str(tmp_path / "p")]) == 0
    assert (tmp_path / "p" / "spectra.png").stat().st_size > 10_000
    text = " ".join(capsys.readouterr().out.split())
    assert "warning: wrist_pitch: qd5 is 1.1 times dq/dt" in text
    report = json.loads(output.read_text())
    assert report["period"] == pytest.approx(PERIOD, abs=1e-4)
    assert {f["kind"] for f in report["findings"]} >= {"velocity disagrees", "repetition"}


def test_command_plots_no_spectra_of_poses(tmp_path, capsys):
    write_recording(poses(load_arm("mtml")), tmp_path / "poses.csv")
    arguments = ["check", str(tmp_path / "poses.csv"), "--arm", "mtml", "--plots", str(tmp_path / "plots")]
    assert main(arguments) == 0
    assert "spectra require a motion with efforts" in capsys.readouterr().err


def test_command_refuses_with_exit_code_2(tmp_path, capsys):
    path = tmp_path / "motion.csv"
    whole = clean_motion()
    write_recording(replace(whole, t=1000 * whole.t), path)
    assert main(["check", str(path), "--arm", "psm"]) == 2
    captured = capsys.readouterr()
    assert "milliseconds" in refusal(captured.err) and "milliseconds" not in captured.out
    assert captured.out.startswith("Verdict: unusable (wrong time)")


# Checks of the channels of a motion: lag, sign, noise and unit of velocities and efforts.


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


@pytest.mark.parametrize("name", ARMS)
@pytest.mark.parametrize("joint", range(7))
def test_refuses_an_effort_with_the_wrong_sign(name, joint):
    arm = load_arm(name)
    motors = clean_motion(name).in_actuator_coordinates(arm)
    refusals = found(changed(motors, "tau", joint, lambda x: -x), name)["effort sign"]
    assert [f.joints for f in refusals] == [(joint,)]
    assert refusals[0].severity == "refusal"


def test_detects_a_saturated_effort():
    """A saturation at both limits is one finding."""
    whole = clean_motion()
    limit = np.quantile(np.abs(whole.tau[:, 0]), 0.8)
    (finding,) = found(changed(whole, "tau", 0, lambda x: np.clip(x, -limit, limit)))["saturated effort"]
    assert finding.joints == (0,)
    shares = [np.mean(sign * whole.tau[:, 0] >= limit) for sign in (1, -1)]
    assert finding.size == pytest.approx(max(shares), abs=0.015)
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


@pytest.mark.parametrize(
    ("change", "advice"),
    [(lambda tau: 1e3 * tau, "in N mm, give --effort-scale 0.001"), (lambda tau: tau[:, ::-1], "in reverse order")],
)
def test_the_cause_of_efforts_above_the_limits_is_named(change, advice):
    arm = load_arm("mtmr")
    rows = Recording(q=np.zeros((3, 7)), tau=np.tile(0.9 * arm.effort_limits, (3, 1)))
    check_effort_unit(rows, arm)
    assert_refused(RecordingError, advice, check_effort_unit, replace(rows, tau=change(rows.tau)), arm)


def test_exchanged_positions_and_efforts_are_named():
    arm = load_arm("psm")
    rows = Recording(q=np.tile(0.9 * arm.effort_limits, (3, 1)), tau=np.tile(arm.position_upper, (3, 1)))
    assert_refused(RecordingError, "if the positions and the efforts are exchanged", rows.check_fits, arm)


# Checks of the times of a motion: repeated rows, jitter, gaps and wrong units.


def test_detects_a_slower_effort_topic():
    whole = clean_motion()
    every_other = np.arange(len(whole)) // 2 * 2
    kinds = found(replace(whole, tau=whole.tau[every_other]))
    assert [f.where for f in kinds["repeated channel"]] == ["tau"]
    assert kinds["repeated channel"][0].size == pytest.approx(0.5, abs=0.01)
    assert "repeated rows" not in kinds


def test_detects_a_gap_in_the_times():
    whole = clean_motion()
    keep = np.ones(len(whole), bool)
    keep[1000:1100] = False
    cut = replace(whole, q=whole.q[keep], qd=whole.qd[keep], tau=whole.tau[keep], t=whole.t[keep])
    gap = found(cut)["gaps"][0]
    assert gap.size == pytest.approx(101 / RATE, abs=1e-9)
    assert "row 1001" in gap.what
    assert set(found(cut)) == {"gaps", "repetition"}


@pytest.mark.parametrize("name", ARMS)
def test_finds_time_that_stalls_at_repeated_rows(name):
    """The rows are repeated while the recorded times continue, so the motion takes longer than in the arm."""
    whole, arm = clean_motion(name), load_arm(name)
    repeats = np.random.default_rng(6).random(len(whole)) < 0.12
    index = np.repeat(np.arange(len(whole)), 1 + repeats)
    t = np.arange(len(index)) / RATE
    stalled = replace(whole, q=whole.q[index], qd=whole.qd[index], tau=whole.tau[index], t=t)
    kinds = found(stalled, name)
    (finding,) = kinds["repeated rows"]
    assert finding.severity == "warning" and "removed from the times" in finding.advice
    assert finding.size == pytest.approx(1 - len(whole) / len(index), abs=0.005)
    assert "wrong time" not in kinds and "jitter" not in kinds
    clock = true_time(stalled.in_actuator_coordinates(arm))
    assert clock.t[-1] - clock.t[0] == pytest.approx(whole.t[-1] - whole.t[0], rel=0.005)
    # The recorded times of a topic that is polled too fast are correct.
    last = np.maximum.accumulate(np.where(repeats, 0, np.arange(len(whole))))
    polled = replace(whole, q=whole.q[last], qd=whole.qd[last], tau=whole.tau[last])
    (finding,) = found(polled, name)["repeated rows"]
    assert "removed from the times" not in finding.advice and "line" not in finding.what


@pytest.mark.parametrize("with_velocities", [True, False])
def test_quantised_measurements_at_rest_are_not_repeated_rows(with_velocities):
    """Half of the recording is at rest: positions and efforts are equal, with occasional changes by one count."""
    whole = clean_motion()
    count, half = 1e-4, len(whole) // 2
    q, qd, tau = (np.array(x) for x in (whole.q, whole.qd, whole.tau))
    flicker = np.random.default_rng(7).random(len(q) - half) < 0.05
    q[half:], qd[half:], tau[half:] = q[half], 0.0, tau[half]
    q = np.round(q / count) * count
    q[half:, 0] += count * flicker
    quiet = replace(whole, q=q, qd=qd if with_velocities else None, tau=np.round(tau, 3))
    assert "repeated rows" not in found(quiet)
    rows = np.arange(len(q))
    rows[[100, 101, 300]] = 99, 99, 299
    repeated = replace(quiet, q=q[rows], tau=quiet.tau[rows], qd=quiet.qd[rows] if with_velocities else None)
    (finding,) = found(repeated)["repeated rows"]
    assert finding.severity == "note" and finding.what.startswith("3 rows (")
    assert f"first at {repeated.where(100)}" in finding.what


# Checks of recordings of real arms: the findings agree with the README of the recordings.


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


@pytest.mark.parametrize("name", ["psm_one", "psm_one_no_weight", "psm_one_105g_parallel", "psm_one_205g_insertion"])
def test_real_insertion_has_noise_and_effort_lag(real, name):
    kinds = kinds_of(real(name))
    assert (2,) in [f.joints for f in kinds["narrow-band noise"]]
    # An analysis of these recordings found a lag of 0.75 samples at 200 Hz.
    lag = next(f for f in kinds["effort lag"] if f.joints == (2,))
    assert lag.size == pytest.approx(0.75 / 200, abs=0.002)
