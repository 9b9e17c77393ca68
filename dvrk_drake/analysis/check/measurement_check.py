"""Checks poses and motions: times, noise, repetition, and consistency of positions, velocities and efforts."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.analysis.check.effort_lag import CUT_OFF, MAX_LAG, EffortLag, effort_lag
from dvrk_drake.analysis.check.report import RecordingReport
from dvrk_drake.analysis.estimation.motion_effects import MIN_ERRORS
from dvrk_drake.analysis.estimation.motion_estimates import STRONG_CORRELATION
from dvrk_drake.analysis.observations.finding import Finding, Severity
from dvrk_drake.analysis.observations.motion_grid import GRID_RATE, MotionSignals, motion_signals
from dvrk_drake.analysis.observations.observations import Observations
from dvrk_drake.analysis.observations.repetition import find_period, repeatability_floor
from dvrk_drake.analysis.observations.signals import cut_offs, narrow_band, resample, spectra
from dvrk_drake.analysis.observations.static_poses import (
    MIN_POSES,
    average_repeated_poses,
    find_excluded,
    usable_measurements,
)
from dvrk_drake.analysis.observations.true_time import (
    GAIN_TOLERANCE,
    TrueTime,
    VelocityAgreement,
    distinct_rows,
    repeated_block,
    repeated_rows,
    velocity_agreement,
)
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.plant import holding_torques
from dvrk_drake.recordings.recording import MAX_LOST, MAX_MOTION_STEP, MIN_RATE, REST_SPEED, Recording

#: Largest share of repeated rows that is reported as a note, because it hardly changes a model. Above it: warning.
#: Twice the value makes one warning on the public recordings a note, half the value changes none.
MIN_REPEATED = 0.005
#: Smallest difference of two shares of rows for a warning that a signal (q, qd or tau) comes from a slower topic: the
#: share of rows that repeat this signal, and the share of rows that repeat all signals. Half or twice the value changes
#: no finding on the public recordings.
MIN_EXTRA = 0.05
#: Smallest reported jitter as a share of the mean interval. Half or twice the value changes no finding on the public
#: recordings.
MIN_JITTER = 0.05
#: An effort has the wrong sign in two cases: its Coulomb friction is more than `MIN_ERRORS` standard errors below 0, or
#: it is more than the first number of standard errors below 0 and the relative work of the motor is below minus the
#: second number. Within two standard errors of 0, the sign of the friction is uncertain. Half or twice the second
#: number changes no finding on the public recordings.
MIN_SIGN_ERRORS_WITH_WORK, MIN_NEGATIVE_WORK = 2.0, 0.05
#: Smallest duration of a motion for the estimation of lags, signs and noise [s]. Half the value checks one more public
#: motion (TX40), without a new warning.
MIN_DURATION = 10.0


def check_motion(report: RecordingReport, observations: Observations) -> tuple[RecordingReport, list[Finding]]:
    """Checks a motion.

    Args:
        report: Report to which the statistics of the motion are added.
        observations: Motion with increasing t.

    Returns:
        Report with the statistics of the motion, and the findings.
    """
    recording, arm = observations.recording, observations.arm
    interval = float(np.median(np.diff(np.asarray(recording.t))))
    # The channels that were measured are those of the whole motion.
    actuators = recording.measured_actuators(arm).select(observations.longest_rows)
    (clock,) = observations.longest.clocks
    t = np.asarray(actuators.t)
    duration, rate = float(t[-1] - t[0]), 1 / interval
    findings = [*_times(clock), *_gap_findings(recording)]
    repeated = float(np.mean(repeated_rows(actuators)))
    report = replace(report, longest=len(t), rate=rate, duration=duration, jitter=clock.jitter, repeated=repeated)
    if duration < MIN_DURATION or rate < (1 - MAX_LOST) * MIN_RATE:
        what = (
            f"the motion lasts {duration:.3g} s at {rate:.3g} Hz, so lags, signs, noise and repetition are not checked"
        )
        advice = f"Record at least {MIN_DURATION:g} s at {MIN_RATE:g} Hz or more."
        return report, [*findings, Finding("warning", "short or slow", "t", what, advice, size=duration)]
    signals = motion_signals(actuators, clock, CUT_OFF, rate=min(rate, GRID_RATE))
    moving = np.sqrt(np.mean(signals.v**2, axis=0)) > arm.per_joint(*REST_SPEED)
    agreement = None
    if actuators.qd is not None:
        q, qd = (resample(clock.t, x[clock.rows], signals.t) for x in (actuators.q, actuators.qd))
        agreement = velocity_agreement(q, qd, signals.rate)
    lags = effort_lag(signals, moving)
    names, work = arm.joint_names, _work(signals)
    findings += _velocities(agreement, names) + _lags(lags, names) + _correlated_joints(signals, moving, names)
    findings += _wrong_signs(work, lags, arm)
    rows = actuators
    if distinct_rows(actuators).stalled:
        rows = _resampled(_true_rows(actuators, clock), rate)
    elif np.ptp(np.diff(t)) >= 1e-3 / rate:
        rows = _resampled(actuators, rate)
    period = find_period(rows.q, rate)
    statistics, more = _noise(rows, rate, period, arm)
    speed, acceleration = (np.sqrt(np.mean(x**2, axis=0)) for x in (signals.v, signals.vd))
    statistics |= {"speed": speed, "acceleration": acceleration, "work": work}
    if agreement is not None:
        statistics |= {"velocity_gain": agreement.gain, "velocity_lag": agreement.lag}
    joints = list(report.joints)
    for j, joint in enumerate(joints):
        own: dict[str, Any] = {name: float(values[j]) for name, values in statistics.items()}
        joints[j] = replace(joint, **own)
    for late in np.flatnonzero(lags.determined):
        joints[late] = replace(joints[late], effort_lag=float(lags.lag[late]))
    cut_off = None if period is None else arm.identification.effort_cut_off
    return replace(report, joints=tuple(joints), period=period, floor_cut_off=cut_off), findings + more


def repeated_row_findings(actuators: Recording) -> list[Finding]:
    """Returns findings for rows that repeat the previous row, in all signals or only in some of them.

    Args:
        actuators: Motion in actuator coordinates. Its times need not increase.
    """
    findings = []
    repeats = repeated_rows(actuators)
    all_signals, count = float(np.mean(repeats)), int(np.sum(repeats))
    blocks = {
        name: float(np.mean(repeated_block(block)))
        for name, block in (("q", actuators.q), ("qd", actuators.qd), ("tau", actuators.tau))
        if block is not None and np.any(block)
    }
    if count:
        share = f"{100 * all_signals:.2g} %" if all_signals < 0.01 else f"{100 * all_signals:.1f} %"
        what = (
            f"{count} row{'s' * (count != 1)} ({share}) repeat{'s' * (count == 1)} all signals of the previous row "
            f"while the arm moves, first at {actuators.where(int(np.argmax(repeats)))}"
        )
        advice = "Usual causes: the recorder read faster than the arm published, or messages were lost."
        if actuators.has_increasing_times and distinct_rows(actuators).stalled:
            advice = "Positions and velocities agree only if the intervals of these rows are removed from the times."
        advice += " Repeated rows are not used. Record each message once, with its time stamp."
        severity: Severity = "warning" if all_signals > MIN_REPEATED else "note"
        findings.append(Finding(severity, "repeated rows", "rows", what, advice, size=all_signals))
    for name, share_of_signal in blocks.items():
        # Constant channels are reported by another check.
        if all_signals + MIN_EXTRA < share_of_signal < 1 - 2 / len(actuators):
            what = f"{100 * share_of_signal:.1f} % of the rows repeat {name} but not the other signals"
            advice = f"{name} comes from a slower topic and is late by up to one interval of that topic."
            findings.append(Finding("warning", "repeated channel", name, what, advice, size=share_of_signal))
    return findings


def _times(clock: TrueTime) -> list[Finding]:
    if not (clock.reconstructed and clock.jitter > MIN_JITTER):
        return []
    what = (
        "time stamps disagree with the positions and velocities (intervals deviate by "
        f"{100 * clock.jitter:.0f} %, 1 sigma)"
    )
    advice = "Intervals are reconstructed from q and qd. Record the controller's time stamps to avoid this."
    return [Finding("warning", "jitter", "t", what, advice, size=clock.jitter)]


def _gap_findings(recording: Recording) -> list[Finding]:
    segments = recording.segments()
    if len(segments) == 1:
        return []
    t = np.asarray(recording.t)
    gaps = {rows.start: float(t[rows.start] - t[rows.start - 1]) for rows in segments[1:]}
    row = max(gaps, key=lambda start: gaps[start])
    gap = f"{gaps[row]:.3g} s before {recording.where(row)}"
    what = f"the times have a gap of {gap}" if len(gaps) == 1 else f"the times have {len(gaps)} gaps, the largest {gap}"
    advice = (
        "The motion in a gap is unknown, so the segments between gaps are filtered and simulated separately. Lags, "
        "signs, noise and channels are checked only in the longest segment."
    )
    return [Finding("warning", "gaps", "t", what, advice, size=gaps[row])]


def _velocities(agreement: VelocityAgreement | None, names: tuple[str, ...]) -> list[Finding]:
    if agreement is None:
        what = "the recording has no velocities"
        advice = "Velocities are computed from q and t, so the times must be accurate."
        return [Finding("note", "no velocities", "qd", what, advice)]
    findings = []
    for j in np.flatnonzero(~agreement.agrees & np.isfinite(agreement.gain)):
        gain, lag = float(agreement.gain[j]), float(agreement.lag[j])
        mismatch = f"mismatch {100 * agreement.mismatch[j]:.0f} %"
        what = f"qd{j + 1} is {gain:.3g} times dq/dt and {1e3 * lag:.1f} ms late ({mismatch})"
        advice = "Velocities are computed from q instead."
        if abs(gain * np.pi / 180 - 1) < GAIN_TOLERANCE:
            advice += f" The unit of qd{j + 1} may be deg/s; use rad/s."
        elif gain < 0:
            advice += f" The sign of qd{j + 1} is wrong."
        findings.append(Finding("warning", "velocity disagrees", names[j], what, advice, (int(j),), gain))
    return findings


def _lags(lags: EffortLag, names: tuple[str, ...]) -> list[Finding]:
    findings = []
    for j in np.flatnonzero(lags.determined):
        lag, error = 1e3 * float(lags.lag[j]), 1e3 * float(lags.standard_error[j])
        size = f"{abs(lag):.1f} ms (standard error {error:.1f} ms)"
        if abs(lags.lag[j]) > MAX_LAG - 1 / GRID_RATE:
            size = f"{1e3 * MAX_LAG:.0f} ms or more"
        what = f"tau{j + 1} {'lags' if lag > 0 else 'leads'} the motion by {size}"
        advice = "Presliding friction causes a similar lag. Fit presliding friction before you correct a delay."
        if lag < 0:
            advice = "The positions may be late, e.g. low-pass filtered. Record unfiltered positions and efforts."
        findings.append(Finding("note", "effort lag", names[j], what, advice, (int(j),), float(lags.lag[j])))
    return findings


def _correlated_joints(signals: MotionSignals, moving: NDArray[np.bool_], names: tuple[str, ...]) -> list[Finding]:
    index = np.flatnonzero(moving)
    if len(index) < 2:
        return []
    correlation = np.abs(np.corrcoef(signals.v[:, index].T))
    findings = []
    for a, b in np.argwhere(np.triu(correlation, 1) > STRONG_CORRELATION):
        i, j = int(index[a]), int(index[b])
        what = f"these joints move together (correlation of their velocities {correlation[a, b]:.3f})"
        advice = "Their inertia and friction are not identifiable separately. Move the joints independently."
        size = float(correlation[a, b])
        findings.append(Finding("warning", "move together", f"{names[i]}, {names[j]}", what, advice, (i, j), size))
    return findings


def _work(signals: MotionSignals) -> NDArray[np.float64]:
    """Returns the mean power (n,) of each actuator divided by rms(tau) rms(v), nan if tau or v is always 0."""
    size = np.sqrt(np.mean(signals.tau**2, axis=0) * np.mean(signals.v**2, axis=0))
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(np.mean(signals.tau * signals.v, axis=0) / size)


def _wrong_signs(work: NDArray[np.float64], lags: EffortLag, arm: Arm) -> list[Finding]:
    with np.errstate(divide="ignore", invalid="ignore"):
        errors = lags.coulomb / lags.coulomb_error
    # Negative work alone is not sufficient, because gravity and inertia may transfer power from other joints.
    wrong = (errors < -MIN_ERRORS) | ((work < -MIN_NEGATIVE_WORK) & (errors < -MIN_SIGN_ERRORS_WITH_WORK))
    findings = []
    for j in np.flatnonzero(wrong):
        friction, unit = float(lags.coulomb[j]), "N" if arm.prismatic[j] else "N m"
        what = (
            f"tau{j + 1} or q{j + 1} has the wrong sign, because the estimated Coulomb friction is negative "
            f"({friction:.2g} {unit}, {errors[j]:.1f} standard errors; relative work {work[j]:.2f})"
        )
        advice = f"Efforts must be positive in the direction of +q{j + 1}. Correct the sign."
        findings.append(Finding("refusal", "effort sign", arm.joint_names[j], what, advice, (int(j),), friction))
    return findings


def _true_rows(actuators: Recording, clock: TrueTime) -> Recording:
    """Returns the rows that do not repeat the previous row, at their true times."""
    qd = None if actuators.qd is None else actuators.qd[clock.rows]
    return Recording(actuators.q[clock.rows], actuators.measured_effort()[clock.rows], qd, clock.t, "actuator")


def _resampled(actuators: Recording, rate: float) -> Recording:
    t = np.asarray(actuators.t)
    times = np.arange(t[0], t[-1], 1 / rate)
    q, tau = (resample(t, x, times) for x in (actuators.q, actuators.measured_effort()))
    qd = None if actuators.qd is None else resample(t, actuators.qd, times)
    return Recording(q, tau, qd, times, "actuator")


def _noise(
    rows: Recording, rate: float, period: float | None, arm: Arm
) -> tuple[dict[str, NDArray[np.float64]], list[Finding]]:
    """Returns the cut-off frequencies and the repeatability (n,) of the actuators, and findings on noise."""
    tau = rows.measured_effort()
    tau_spectra = spectra(tau, rate, period)
    v = np.gradient(rows.q, 1 / rate, axis=0) if rows.qd is None else rows.qd
    cuts = {"effort_cut_off": cut_offs(tau_spectra), "velocity_cut_off": cut_offs(spectra(v, rate, period))}
    if period is None:
        what = "the motion does not repeat, so the repeatability of the efforts cannot be computed"
        advice = (
            "Run an excitation motion at least twice. Repeatability approximates the smallest possible model error."
        )
        return cuts, [Finding("note", "no repetition", "motion", what, advice)]
    what = f"the period is {period:.4f} s ({1 / period:.4f} Hz), and the recording has {len(tau) / rate / period:.1f}"
    what += " periods"
    advice = (
        "Compare the period with the commanded period. Repeatability approximates the smallest possible model error."
    )
    findings = [Finding("note", "repetition", "motion", what, advice, size=period)]
    for j, name in enumerate(arm.joint_names):
        if band := narrow_band(tau_spectra, j):
            what = (
                f"tau{j + 1} has noise between {band.lower:.0f} and {band.upper:.0f} Hz "
                f"({100 * band.share:.0f} % of its RMS)"
            )
            advice = "Before a fit, low-pass filter the effort with a cut-off below this band."
            findings.append(Finding("note", "narrow-band noise", name, what, advice, (j,), band.share))
    return {**cuts, "floor": repeatability_floor(tau, rate, period, arm.identification.effort_cut_off)}, findings


#: Largest number of poses at which efforts are compared with the gravity of the SDF model. It limits the time to 30 ms.
MAX_COMPARED = 500
#: Smallest RMS gravity effort of the SDF model for a check of the sign, as a share of the measured RMS effort. With a
#: smaller share, effects of the drive are the larger part of the effort.
GRAVITY_SHARE = 0.5
#: Gravity must also exceed the effects of the drive, because the torque of a cable can exceed a smaller gravity effort.
#: The share of the effort limit is for effects that the arm file does not state. In joints of an MTM and a PSM, a
#: gravity effort above the other shares of the largest effort limit (revolute, prismatic joints) exceeds all effects.
EFFECTS_SHARE, SUFFICIENT_SHARE = 0.02, (0.03, 0.1)
#: An effort has the wrong sign if its regression coefficient on gravity is more than `MIN_ERRORS` standard errors below
#: 0, and if the correlation of effort and gravity is below minus this number. Half or twice the value changes no
#: finding on the public recordings.
MIN_OPPOSITE_CORRELATION = 0.7


def check_poses(recording: Recording, arm: Arm) -> list[Finding]:
    """Checks poses in joint or actuator coordinates, with efforts."""
    findings = []
    joints = recording.in_joint_coordinates(arm)
    distinct = len(average_repeated_poses(joints, arm))
    if distinct < MIN_POSES:
        what = f"the recording has {distinct} distinct pose{'s' * (distinct != 1)}, but identify requires {MIN_POSES}"
        advice = "Record 40 or more poses that cover the range of the arm."
        findings.append(Finding("warning", "few poses", "rows", what, advice, size=float(distinct)))
    if recording.t is None and recording.qd is None and joints.is_path(arm):
        what = f"{len(joints)} rows without times follow in steps below {100 * MAX_MOTION_STEP:g} % of the joint ranges"
        advice = "The rows seem to be a motion. State its times, or its sampling rate with --rate HZ."
        findings.append(Finding("warning", "no times", "t", what, advice))
    excluded = find_excluded(joints, arm)
    if excluded:
        rows = len({measurement.row for measurement in excluded})
        what = (
            f"{rows} pose{'s' * (rows != 1)} at a joint stop or beyond an effort limit, first "
            f"{excluded[0].where}: {excluded[0].reason}"
        )
        advice = "identify excludes these efforts and lists them."
        findings.append(Finding("note", "excluded poses", "rows", what, advice, size=float(rows)))
    return findings + _wrong_sign(recording, joints, usable_measurements(joints.q.shape, excluded), arm)


def _wrong_sign(recording: Recording, joints: Recording, usable: NDArray[np.bool_], arm: Arm) -> list[Finding]:
    """Returns a refusal for each effort with the wrong sign.

    Efforts are compared in the coordinates of the recording, because a wrong sign affects only one channel in these
    coordinates. `usable` (m, n) is False for measurements at a joint stop or beyond an effort limit.
    """
    rows = np.linspace(0, len(joints) - 1, min(len(joints), MAX_COMPARED)).astype(int)
    gravity, tau = holding_torques(arm, joints.q[rows]), recording.measured_effort()[rows]
    if recording.coordinates == "actuator":
        gravity = arm.transmission.inverse.pull_back_effort(gravity)
    findings = []
    for j, least in enumerate(_least_gravity(arm)):
        use = usable[rows, j]
        if np.sum(use) >= MIN_POSES and np.sqrt(np.mean(gravity[use, j] ** 2)) >= least:
            correlation = _significant_correlation(gravity[use, j], tau[use, j])
            if correlation < -MIN_OPPOSITE_CORRELATION:
                what = f"tau{j + 1} is opposite to the gravity effort of the arm model (correlation {correlation:.2f})"
                advice = (
                    f"Efforts must be positive in the direction of +q{j + 1}. Check the sign, and check that --gravity "
                    "matches the mounting."
                )
                findings.append(Finding("refusal", "effort sign", arm.joint_names[j], what, advice, (j,), correlation))
    return findings


def _least_gravity(arm: Arm) -> NDArray[np.float64]:
    """Returns the RMS gravity efforts (n,) from which the sign of an effort is checked [N m, N]."""
    effects = arm.dry_friction() + EFFECTS_SHARE * arm.effort_limits
    for effect in arm.effects.position_dependent:
        # The coefficient of a spring is its stiffness, and its scale is the largest deflection.
        largest = effect.coefficient * (effect.scale if effect.kind == "spring" else 1.0)
        effects += np.abs(largest * (arm.effect_coordinates[effect.coordinate] @ arm.transmission.matrix))
    strongest = [np.max(arm.effort_limits, initial=0.0, where=arm.prismatic == slides) for slides in (False, True)]
    return np.minimum(effects, arm.per_joint(*strongest) * arm.per_joint(*SUFFICIENT_SHARE))


def _significant_correlation(gravity: NDArray[np.float64], tau: NDArray[np.float64]) -> float:
    """Returns the correlation of efforts (m,) with gravity efforts (m,), or 0 if it is not significant.

    The correlation is not significant if gravity is a small share of the efforts, or if an offset can explain it.
    """
    sizes = float(np.linalg.norm(gravity)), float(np.linalg.norm(tau))
    if sizes[0] < GRAVITY_SHARE * sizes[1] or sizes[1] == 0:
        return 0.0
    slope = float(gravity @ tau) / sizes[0] ** 2
    error = float(np.linalg.norm(tau - slope * gravity)) / sizes[0] / np.sqrt(len(tau) - 1)
    covariance = float((gravity - np.mean(gravity)) @ (tau - np.mean(tau)))
    significant = abs(slope) > MIN_ERRORS * error and slope * covariance > 0
    return float(gravity @ tau) / (sizes[0] * sizes[1]) if significant else 0.0
