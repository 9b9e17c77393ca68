"""Checks the clock, noise and repetition of a motion, and the consistency of its channels."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.analysis.check.findings import Finding, JointSignals, RecordingReport
from dvrk_drake.analysis.signals.effort_lag import LAG_STEP, MAX_LAG, EffortLag, effort_lag
from dvrk_drake.analysis.signals.low_pass import resample
from dvrk_drake.analysis.signals.motion_grid import GRID_RATE, MotionSignals, motion_signals
from dvrk_drake.analysis.signals.noise import cut_offs, narrow_band, spectra
from dvrk_drake.analysis.signals.repetition import find_period, repeatability_floor
from dvrk_drake.analysis.signals.true_time import (
    TrueTime,
    VelocityAgreement,
    repeated_block,
    repeated_rows,
    true_time,
    velocity_agreement,
)
from dvrk_drake.models.arm import Arm
from dvrk_drake.recordings.recording import MAX_PERIOD, REST_SPEED, Recording

#: Repeated rows below this share are attributed to chance.
MIN_REPEATED = 0.005
#: Additional share of repeated rows at which a block of channels is attributed to a slower topic.
MIN_EXTRA = 0.05
#: Smallest gap between two rows in median intervals, and in [s].
GAP, MIN_GAP = 5.0, MAX_PERIOD
#: Smallest reported jitter as a share of an interval.
MIN_JITTER = 0.05
#: An effort has a wrong sign if Coulomb friction is this many standard errors below 0. It is also wrong if the motor's
#: work is below minus the second value and the estimated Coulomb friction is negative.
MIN_GAIN, OPPOSITE = 5.0, 0.05
#: Joints are hardly identifiable separately if the correlation of their speeds exceeds this value.
MIN_CORRELATION = 0.95
#: Smallest duration of a motion for the estimation of lags, signs and noise [s].
MIN_DURATION = 10.0


def check_motion(report: RecordingReport, recording: Recording, arm: Arm) -> tuple[RecordingReport, list[Finding]]:
    """Checks a motion with increasing t whose q, qd and tau are in one coordinate system.

    Returns:
        The report with the statistics of the motion, and the findings.
    """
    interval = float(np.median(np.diff(np.asarray(recording.t))))
    gaps = _gaps(np.asarray(recording.t), interval)
    actuators = _longest_piece(recording.in_actuator_coordinates(arm), gaps)
    clock = true_time(actuators)
    t = np.asarray(actuators.t)
    duration, rate = float(t[-1] - t[0]), 1 / interval
    findings = [*_rows(actuators, clock), *_gap_findings(recording, gaps)]
    report = replace(
        report, rate=rate, duration=duration, jitter=clock.jitter, repeated=float(np.mean(repeated_rows(actuators)))
    )
    if duration < MIN_DURATION or rate < 2 / MAX_PERIOD:
        what = f"{duration:.3g} s at {rate:.3g} Hz"
        advice = f"lags, noise and repetition are judged from {MIN_DURATION:g} s at {2 / MAX_PERIOD:g} Hz on"
        return report, [*findings, Finding("warning", "short or slow", "t", what, advice, size=duration)]
    signals = motion_signals(actuators, 20.0, rate=min(rate, GRID_RATE))
    moving = np.sqrt(np.mean(signals.v**2, axis=0)) > arm.per_joint(*REST_SPEED)
    agreement = _agreement(actuators, clock, signals)
    lags = effort_lag(signals, moving)
    names = arm.joint_names
    work = _work(signals)
    findings += _velocities(agreement, names) + _lags(lags, names) + _together(signals, moving, names)
    findings += _signs(work, lags, names)
    even = t[0] + np.arange(len(t)) * (duration / (len(t) - 1))
    rows = actuators if np.ptp(np.diff(t)) < 1e-3 / rate else _resampled(actuators, even)
    period = find_period(rows.q, rate)
    report, more = _noise(report, rows, rate, period, arm)
    findings += more
    acceleration = np.sqrt(np.mean(signals.vd**2, axis=0))
    joints = tuple(
        replace(
            joint,
            speed=float(np.sqrt(np.mean(signals.v[:, j] ** 2))),
            acceleration=float(acceleration[j]),
            velocity_gain=None if agreement is None else float(agreement.gain[j]),
            velocity_lag=None if agreement is None else float(agreement.lag[j]),
            effort_lag=float(lags.lag[j]) if lags.determined[j] else None,
            work=float(work[j]),
        )
        for j, joint in enumerate(report.joints)
    )
    return replace(report, joints=joints), findings


def _rows(actuators: Recording, clock: TrueTime) -> list[Finding]:
    findings = []
    whole = float(np.mean(repeated_rows(actuators)))
    blocks = {
        name: float(np.mean(repeated_block(block)))
        for name, block in (("q", actuators.q), ("qd", actuators.qd), ("tau", actuators.tau))
        if block is not None and np.any(block)
    }
    if whole > MIN_REPEATED:
        shares = ", ".join(f"{name} alone {share:.1%}" for name, share in blocks.items())
        what = f"{whole:.1%} repeat the row before ({shares})"
        advice = "a slower topic was polled: they are left out, and true times are made; record each message once"
        findings.append(Finding("warning", "repeated rows", "rows", what, advice, size=whole))
    for name, share in blocks.items():
        # Constant channels are reported by another check.
        if whole + MIN_EXTRA < share < 1 - 2 / len(actuators):
            what = f"{share:.1%} of the rows repeat {name} but not the rest"
            advice = "it comes from a slower topic than the rest, and is up to one of its intervals late"
            findings.append(Finding("warning", "repeated channel", name, what, advice, size=share))
    if clock.reconstructed and clock.jitter > MIN_JITTER:
        what = f"q and qd say that rows are off their times: true intervals deviate by {clock.jitter:.0%} (1 sigma)"
        advice = "times are made from q and qd; record the controller's own time stamps"
        findings.append(Finding("warning", "jitter", "t", what, advice, size=clock.jitter))
    return findings


def _gaps(t: NDArray[np.float64], interval: float) -> NDArray[np.int_]:
    """Returns the indices of the rows before a gap."""
    return np.flatnonzero(np.diff(t) > max(GAP * interval, MIN_GAP))


def _longest_piece(recording: Recording, gaps: NDArray[np.int_]) -> Recording:
    edges = np.concatenate([[0], gaps + 1, [len(recording)]])
    longest = int(np.argmax(np.diff(edges)))
    rows = slice(edges[longest], edges[longest + 1])
    return replace(
        recording,
        q=recording.q[rows],
        qd=None if recording.qd is None else recording.qd[rows],
        tau=recording.measured_effort()[rows],
        t=np.asarray(recording.t)[rows],
        lines=None if recording.lines is None else recording.lines[rows],
    )


def _gap_findings(recording: Recording, gaps: NDArray[np.int_]) -> list[Finding]:
    if not len(gaps):
        return []
    intervals = np.diff(np.asarray(recording.t))
    largest = int(gaps[np.argmax(intervals[gaps])])
    what = f"{len(gaps)} gaps, the largest {intervals[largest]:.3g} s before {recording.where(largest + 1)}"
    advice = "the motion in the gap is unknown: split the recording there; signals are checked in the longest piece"
    return [Finding("warning", "gaps", "t", what, advice, size=float(intervals[largest]))]


def _agreement(actuators: Recording, clock: TrueTime, signals: MotionSignals) -> VelocityAgreement | None:
    if actuators.qd is None:
        return None
    q, qd = (resample(clock.t, x[clock.rows], signals.t) for x in (actuators.q, actuators.qd))
    return velocity_agreement(q, qd, signals.rate)


def _velocities(agreement: VelocityAgreement | None, names: tuple[str, ...]) -> list[Finding]:
    if agreement is None:
        what = "the recording has no velocities"
        return [Finding("note", "no velocities", "qd", what, "q is differentiated; its times must be good")]
    findings = []
    for j in np.flatnonzero(~agreement.agrees & np.isfinite(agreement.gain)):
        gain, lag = float(agreement.gain[j]), float(agreement.lag[j])
        what = f"qd{j + 1} is {gain:.3g} times dq/dt and {1e3 * lag:.1f} ms late (mismatch {agreement.mismatch[j]:.0%})"
        if abs(gain * np.pi / 180 - 1) < 0.1:
            what += ": degrees a second?"
        elif gain < 0:
            what += ": its sign is wrong"
        findings.append(
            Finding("warning", "velocity disagrees", names[j], what, "q is differentiated instead", (int(j),), gain)
        )
    return findings


def _lags(lags: EffortLag, names: tuple[str, ...]) -> list[Finding]:
    findings = []
    for j in np.flatnonzero(lags.determined):
        lag, error = 1e3 * float(lags.lag[j]), 1e3 * float(lags.standard_error[j])
        size = f"{abs(lag):.1f} ms (standard error {error:.1f})"
        if abs(lags.lag[j]) > MAX_LAG - LAG_STEP:
            size = f"{1e3 * MAX_LAG:.0f} ms or more"
        what = f"tau{j + 1} looks {size} {'late' if lag > 0 else 'early'}"
        advice = "a delay, or friction that builds up over some way: fit hysteresis before you shift it"
        findings.append(Finding("note", "effort lag", names[j], what, advice, (int(j),), float(lags.lag[j])))
    return findings


def _together(signals: MotionSignals, moving: NDArray[np.bool_], names: tuple[str, ...]) -> list[Finding]:
    index = np.flatnonzero(moving)
    if len(index) < 2:
        return []
    correlation = np.abs(np.corrcoef(signals.v[:, index].T))
    findings = []
    for a, b in np.argwhere(np.triu(correlation, 1) > MIN_CORRELATION):
        i, j = int(index[a]), int(index[b])
        what = f"move together (correlation of their speeds {correlation[a, b]:.3f})"
        advice = "their inertia and friction are not identifiable separately; move them independently"
        size = float(correlation[a, b])
        findings.append(Finding("warning", "move together", f"{names[i]}, {names[j]}", what, advice, (i, j), size))
    return findings


def _work(signals: MotionSignals) -> NDArray[np.float64]:
    """Returns the mean power (n,) of each actuator divided by rms(tau) rms(v), nan where either is 0."""
    size = np.sqrt(np.mean(signals.tau**2, axis=0) * np.mean(signals.v**2, axis=0))
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(np.mean(signals.tau * signals.v, axis=0) / size)


def _signs(work: NDArray[np.float64], lags: EffortLag, names: tuple[str, ...]) -> list[Finding]:
    with np.errstate(divide="ignore", invalid="ignore"):
        errors = lags.coulomb / lags.coulomb_error
    # Work alone is not sufficient: gravity and inertia may transfer it from other joints.
    wrong = (errors < -MIN_GAIN) | ((work < -OPPOSITE) & (errors < 0))
    findings = []
    for j in np.flatnonzero(wrong):
        what = (
            f"friction pushes instead of braking: Coulomb {lags.coulomb[j]:.2g} ({errors[j]:.1f} standard errors), "
            f"work {work[j]:.2f}"
        )
        advice = f"tau{j + 1} or the direction of q{j + 1} has the wrong sign: efforts are positive towards +q"
        findings.append(Finding("refusal", "effort sign", names[j], what, advice, (int(j),), float(lags.coulomb[j])))
    return findings


def _resampled(actuators: Recording, times: NDArray[np.float64]) -> Recording:
    t = np.asarray(actuators.t)
    q, tau = (resample(t, x, times) for x in (actuators.q, actuators.measured_effort()))
    qd = None if actuators.qd is None else resample(t, actuators.qd, times)
    return Recording(q, tau, qd, times, "actuator")


def _noise(
    report: RecordingReport, rows: Recording, rate: float, period: float | None, arm: Arm
) -> tuple[RecordingReport, list[Finding]]:
    tau = rows.measured_effort()
    of_tau = spectra(tau, rate, period)
    v = np.gradient(rows.q, 1 / rate, axis=0) if rows.qd is None else rows.qd
    cuts = zip(cut_offs(of_tau), cut_offs(spectra(v, rate, period)), strict=True)
    joints: list[JointSignals] = [
        replace(joint, effort_cut_off=float(a), velocity_cut_off=float(b))
        for joint, (a, b) in zip(report.joints, cuts, strict=True)
    ]
    if period is None:
        what = "the motion does not repeat, so no repeatability floor can be computed"
        advice = "let an excitation motion run twice or more: the floor tells how good a model can be"
        return replace(report, joints=tuple(joints)), [Finding("note", "no repetition", "motion", what, advice)]
    floor = repeatability_floor(tau, rate, period, arm.identification.effort_cut_off)
    joints = [replace(joint, floor=float(value)) for joint, value in zip(joints, floor, strict=True)]
    what = f"repeats every {period:.4f} s ({1 / period:.4f} Hz), {len(tau) / rate / period:.1f} times"
    advice = (
        "compare that with the frequency that was asked for; repeatability is about the least error that a model can "
        "have"
    )
    findings = [Finding("note", "repetition", "motion", what, advice, size=period)]
    for j, name in enumerate(arm.joint_names):
        if band := narrow_band(of_tau, j):
            what = (
                f"tau{j + 1} has noise between {band.lower:.0f} and {band.upper:.0f} Hz, {band.share:.0%} of its RMS, "
                "that does not repeat"
            )
            findings.append(
                Finding("note", "narrow-band noise", name, what, "filter below it before a fit", (j,), band.share)
            )
    return replace(
        report, joints=tuple(joints), period=period, floor_cut_off=arm.identification.effort_cut_off
    ), findings
