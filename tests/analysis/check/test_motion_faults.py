"""Faults of whole motions: units of time, rates, two sources, wrapped angles, gaps, and efforts without power."""

from dataclasses import replace

import numpy as np
import pytest
from command_output import assert_refused

from dvrk_drake.analysis.check.channel_fit import ChannelFit
from dvrk_drake.analysis.check.recording_check import check_recording, with_power
from dvrk_drake.analysis.identification import identify
from dvrk_drake.analysis.observations.motion_faults import jump_fault, source_fault, time_fault
from dvrk_drake.analysis.observations.observations import Observations
from dvrk_drake.analysis.validation import predict
from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.errors import RecordingError
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.models.plant import holding_torques
from dvrk_drake.recordings.recording import Recording

ARM, PSM = load_arm("mtmr"), load_arm("psm")


def motion_fault(recording, arm):
    return source_fault(recording, arm) or time_fault(recording, arm)


def motion(rate=100.0, seconds=12.0, arm=ARM, speed=1.0, velocities=False):
    """Returns a smooth motion with friction-like efforts and noise."""
    t = np.arange(round(seconds * rate)) / rate
    w = speed * (1 + 0.2 * np.arange(arm.num_joints))
    middle, reach = (arm.position_upper + arm.position_lower) / 2, 0.2 * (arm.position_upper - arm.position_lower)
    q, v = middle + reach * np.sin(w * t[:, None]), reach * w * np.cos(w * t[:, None])
    noise = np.random.default_rng(0).normal(size=q.shape)
    tau = arm.effort_limits * (0.1 * np.cos(q) + 0.05 * np.tanh(v / 0.05) + 0.002 * noise)
    return Recording(q=q, tau=tau, qd=v if velocities else None, t=t, source="motion.csv")


@pytest.mark.parametrize("rate", [50.0, 200.0, 1000.0])
@pytest.mark.parametrize(
    ("unit", "factor"),
    [("milliseconds", 1e3), ("microseconds", 1e6), ("nanoseconds", 1e9), ("hours", 1 / 3600), ("days", 1 / 86400)],
)
def test_names_the_unit_of_wrong_times(unit, factor, rate):
    whole = motion(rate)
    assert motion_fault(whole, ARM) is None
    # A time since 1970, as in a bag, and lost rows.
    rows = np.delete(np.arange(len(whole)), slice(300, 320))
    other = replace(whole, t=(1.7e9 + whole.t) * factor).select(rows)
    fault = motion_fault(other, ARM)
    assert fault.kind == "wrong time" and f"t may be in {unit}: {rate:g} Hz" in fault.what
    assert [f.kind for f in check_recording(Observations(other, ARM)).refusals] == ["wrong time"]
    for call in (lambda: identify(other, ARM), lambda: predict(IdentifiedModel.from_arm(ARM), other)):
        assert_refused(RecordingError, f"t may be in {unit}", call)


@pytest.mark.parametrize("names", [("tau", "qd", "q"), ("q", "tau", "qd"), ("qd", "q", "tau")])
def test_names_of_exchanged_quantities(names):
    true = motion(velocities=True)
    assert source_fault(true, ARM) is None
    fault = source_fault(replace(true, **dict(zip(names, (true.q, true.qd, true.tau), strict=True))), ARM)
    assert fault.kind == "exchanged quantities"
    assert "Positions are in {}, velocities in {}, efforts in {}".format(*names) in fault.what


@pytest.mark.parametrize("rate", [3.0, 12.0, 19.0])
def test_slow_rates_are_named(rate):
    fault = motion_fault(motion(rate, 200.0), ARM)
    assert fault.kind == "too slow" and f"the rate of {rate:.3g} Hz is too slow" in fault.what
    assert "50 Hz or more" in fault.advice


def test_static_poses_with_times_have_no_fault():
    """In small steps of one joint, they have no fault if no other unit of the times fits."""
    q = ARM.sample_poses(200, np.random.default_rng(1), 0.1)
    assert motion_fault(Recording(q=q, t=np.arange(200.0)), ARM) is None
    raster = np.tile(q[:1], (200, 1))
    raster[:, 0] = np.linspace(-0.5, 0.5, 200)
    assert motion_fault(Recording(q=raster, t=60.0 * np.arange(200)), ARM) is None
    slow = Recording(q=raster, t=10.0 * np.arange(200))
    for source, advice in (
        ("column", "remove the column t."),
        ("array", "omit the array t."),
        ("messages", "write a table with dvrk-drake convert, and remove its column t."),
        ("rate", "omit --rate (rate= in Python)."),
    ):
        fault = motion_fault(replace(slow, times_from=source), ARM)
        assert fault.advice.endswith(f"If the arm was at rest in each row, {advice}")
    fault = motion_fault(replace(slow, times_from="column", qd=np.gradient(raster, 10.0, axis=0)), ARM)
    assert fault is None or fault.advice.endswith("remove the columns t and qd.")


def test_accepts_49_9_hz_and_lost_rows():
    for recording in (motion(49.9), motion(50.0).select(np.delete(np.arange(600), [100, 400]))):
        assert Observations(recording, ARM).grid.rate == pytest.approx(49.9, abs=0.11)
    with pytest.raises(RecordingError, match=r"lasts 12.0 s at 47 Hz\. A dynamic model requires .* 50 Hz"):
        _ = Observations(motion(47.0), ARM).grid


@pytest.mark.parametrize("order", ["alternating", "random", "two of three"])
@pytest.mark.parametrize("signal", ["q", "tau", "half tau"])
def test_two_publishers_on_one_topic_are_named(signal, order):
    whole, count = motion(), 1200
    rows = np.arange(count)
    second = {
        "alternating": rows % 2 == 0,
        "random": np.random.default_rng(3).random(count) < 0.5,
        "two of three": rows % 3 > 0,
    }[order][:, None]
    other = {"q": whole.q + 0.1, "tau": -whole.tau, "half tau": 0.5 * whole.tau}[signal]
    name = "q" if signal == "q" else "tau"
    mixed = replace(whole, **{name: np.where(second, other, getattr(whole, name))})
    (refusal,) = check_recording(Observations(mixed, ARM)).refusals
    assert refusal.kind == "two sources" and refusal.where == name and "two publishers on one topic" in refusal.advice
    assert_refused(RecordingError, "two publishers", identify, mixed, ARM)


def test_noise_and_quantisation_are_not_two_publishers():
    whole = motion()
    generator = np.random.default_rng(4)
    noisy = whole.tau + 0.5 * np.std(whole.tau, axis=0) * generator.normal(size=whole.tau.shape)
    coarse = np.round(noisy / (0.5 * np.std(noisy, axis=0))) * 0.5 * np.std(noisy, axis=0)
    for tau in (noisy, coarse):
        assert motion_fault(replace(whole, tau=tau), ARM) is None
    repeated = np.arange(1200) // 2 * 2
    assert motion_fault(replace(whole.select(repeated), t=whole.t), ARM) is None


@pytest.mark.parametrize("in_motors", [False, True])
def test_a_wrapped_angle_is_named(in_motors):
    whole = motion(velocities=True)
    recording = whole.in_actuator_coordinates(ARM) if in_motors else whole
    q = recording.q.copy()
    q[:, 6] = np.where(q[:, 6] > 1.0, q[:, 6] - 2 * np.pi, q[:, 6])
    wrapped = replace(recording, q=q)
    (refusal,) = check_recording(Observations(wrapped, ARM)).refusals
    assert refusal.kind == "wrapped angle" and refusal.what.startswith("q7 jumps by a multiple of 2 pi in ")
    # Poses may differ by 2 pi, and a joint may turn by 2 pi in a gap.
    assert motion_fault(replace(wrapped, t=None, qd=None), ARM) is None


def joined(rate):
    """Returns two parts of a motion in one file, with continuous times. The second part begins at row 601."""
    parts = motion(rate, 1800 / rate)
    return replace(parts.select(np.r_[0:600, 900:1800]), t=np.arange(1500) / rate, lines=np.arange(1500) + 2)


@pytest.mark.parametrize("rate", [50.0, 200.0, 1000.0])
def test_jumps_between_joined_recordings_are_named(rate):
    recording = joined(rate)
    (refusal,) = check_recording(Observations(recording, ARM)).refusals
    step = np.max(np.abs(recording.q[600] - recording.q[599]))
    assert (refusal.kind, refusal.where) == (
        "jump",
        "q",
    ) and f"by {step:.2g} rad at motion.csv, line 602" in refusal.what
    assert "Write joined recordings to one file each; identify accepts several files." in refusal.advice
    for call in (lambda: identify(recording, ARM), lambda: predict(IdentifiedModel.from_arm(ARM), recording)):
        assert_refused(RecordingError, r"jumps by .* at motion\.csv, line 602\. Usual causes: recordings joined", call)
    # The motion during a gap is unknown.
    gap = replace(recording, t=recording.t + np.where(np.arange(1500) < 600, 0.0, 0.3 + 6 / rate))
    assert jump_fault(gap, ARM) is None


def test_a_wrong_row_is_a_jump():
    whole = motion()
    q = whole.q.copy()
    q[[300, 700], 4] += 0.4
    fault = jump_fault(replace(whole, q=q), ARM)
    assert fault.what.startswith("q5 jumps by 0.4")
    assert fault.what.endswith(" rad at motion.csv, row 301; positions jump at 4 rows: 301, 302, 701, 702")


@pytest.mark.parametrize("rate", [50.0, 200.0, 1000.0])
def test_real_steps_are_no_jumps(rate):
    """Lost rows up to a gap, repeated rows, quantised positions, and a motion that begins suddenly."""
    whole = motion(rate, 1800 / rate)
    lost = whole.select(np.delete(np.arange(1800), np.r_[300:304, 900:904]))
    late = whole.select(np.maximum.accumulate(np.where(np.arange(1800) % 6 == 0, np.arange(1800), 0)))
    coarse = np.where(np.arange(7) == 2, np.round(whole.q / 0.008) * 0.008, whole.q)
    starts = replace(whole, q=np.where(np.arange(1800)[:, None] < 900, whole.q[900], whole.q))
    for recording in (whole, lost, replace(lost, t=whole.t[:1792]), replace(late, t=whole.t), starts):
        assert jump_fault(recording, ARM) is None
    assert jump_fault(replace(whole, q=coarse), ARM) is None


def test_unrecorded_motions_between_poses_are_no_jumps():
    poses = ARM.sample_poses(20, np.random.default_rng(2), 0.1)
    poses[:, 6] = 0.0  # Its range exceeds 2 pi.
    tau = holding_torques(ARM, poses)
    at_rest = Recording(np.repeat(poses, 150, axis=0), np.repeat(tau, 150, axis=0), t=np.arange(3000) / 100)
    assert jump_fault(at_rest, ARM) is not None
    assert "jump" not in [finding.kind for finding in check_recording(Observations(at_rest, ARM)).findings]
    assert len(Observations(at_rest, ARM).poses().recording) == 20


def test_drops_rows_without_power():
    whole = motion()
    tau = whole.tau.copy()
    tau[1000:] = 0.0
    tau[17] = 0.0
    powered, (finding,) = with_power(replace(whole, tau=tau), ARM)
    assert len(powered) == 999 and np.all(np.any(powered.tau, axis=1))
    assert (finding.severity, finding.size) == ("warning", 201.0)
    assert "all efforts are exactly 0 in 201 of 1200 rows, first at motion.csv, row 18" in finding.what
    tau[::2] = 0.0
    _, (finding,) = with_power(replace(whole, tau=tau), ARM)
    assert "two publishers" in finding.advice
    off = replace(whole, tau=0 * tau)
    assert with_power(off, ARM) == (off, ())
    assert [f.kind for f in check_recording(Observations(off, ARM)).refusals] == ["no effort"]


def test_a_motor_that_is_switched_off_is_refused():
    whole = motion()
    tau = whole.tau.copy()
    tau[700:, 3] = 0.0
    refusals = [f for f in check_recording(Observations(replace(whole, tau=tau), ARM)).refusals if f.kind == "no power"]
    assert [f.what for f in refusals] == [
        "tau4 is exactly 0 in 500 successive rows while the joint moves, first at motion.csv, row 701"
    ]


def test_constant_efforts_are_not_measured():
    whole = motion()
    tau = whole.tau.copy()
    tau[:, 6], tau[:, 5] = 0.01, 0.0
    powered, findings = with_power(replace(whole, tau=tau), ARM)
    assert findings == ()
    np.testing.assert_array_equal(powered.unmeasured, [False] * 5 + [True] * 2)


def test_filters_and_states_begin_anew_after_a_gap():
    """Each segment has the results of a recording of this segment alone."""
    whole = motion(seconds=20.0)
    rows = [np.arange(0, 900), np.arange(1000, 2000)]
    cut = whole.select(np.concatenate(rows))
    grid = Observations(cut, ARM).grid
    alone = [Observations(whole.select(own), ARM).grid for own in rows]
    for name in ("t", "q", "v", "vd", "row_times"):
        np.testing.assert_allclose(
            getattr(grid, name), np.concatenate([getattr(g, name) for g in alone]), rtol=0, atol=1e-9
        )
    model = IdentifiedModel.from_arm(ARM, dynamics=True).dynamic_model
    dry = [model.effort(g.q, g.v, g.vd) for g in alone]
    expected = [g.filter_efforts(g.efforts_at_rows(x)) for g, x in zip(alone, dry, strict=True)]
    found = grid.filter_efforts(grid.efforts_at_rows(np.concatenate(dry)))
    np.testing.assert_allclose(found, np.concatenate(expected), rtol=0, atol=1e-9)
    np.testing.assert_allclose(
        grid.row_times[grid.inner], np.concatenate([g.row_times[g.inner] for g in alone]), rtol=0, atol=1e-9
    )
    parts = [part.filter_rows(part.at_rows(part.t**2, 0), own) for part, own in grid.thinned(3).parts()]
    expected = [part.filter_rows(part.at_rows(part.t**2, 0), own) for g in alone for part, own in g.thinned(3).parts()]
    np.testing.assert_allclose(np.concatenate(parts), np.concatenate(expected), rtol=0, atol=1e-6)


def test_drops_short_segments_between_gaps():
    whole = motion(seconds=20.0)
    cut = whole.select(np.r_[0:900, 1000:1100, 1200:2000])
    with pytest.raises(RecordingError, match=r"row 901: only 0.99 s of motion between two gaps of t"):
        _ = Observations(cut, ARM).grid
    kept, (finding,) = with_power(cut, ARM)
    assert len(kept) == 1700 and "100 of 1800 rows are in 1 segment shorter than 2 s" in finding.what
    # A twentieth of each segment is left out at both ends.
    assert Observations(kept, ARM).grid.inner_rows.size == 0.9 * 1700


def test_gain_at_rest_does_not_grow_with_the_number_of_poses():
    """Shifted repetitions of 80 poses have the same errors of the arm model."""
    generator = np.random.default_rng(4)
    poses = ARM.sample_poses(80, generator, margin=0.1)
    gains = []
    for copies in (1, 3):
        q = np.tile(poses, (copies, 1)) + 1e-6 * generator.normal(size=(80 * copies, 7))
        tau = 1.3 * holding_torques(ARM, q) + 0.01 * ARM.effort_limits * np.sin(7 * q)
        fit = ChannelFit(Observations(Recording(q, tau), ARM))
        gains.append(fit.gain(np.diag(np.where(np.arange(7) == 2, -1.0, 1.0))))
    assert gains[1] == pytest.approx(gains[0], rel=0.02)
