"""Checks a recording before identification and reports each problem with its place and advice."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.analysis.check.channel_check import check_channels
from dvrk_drake.analysis.check.findings import Finding, JointSignals, RecordingReport, Severity
from dvrk_drake.analysis.check.motion_check import check_motion
from dvrk_drake.analysis.check.pose_check import check_poses
from dvrk_drake.analysis.signals.motion_grid import default_settings, motion_grid
from dvrk_drake.analysis.signals.static_segments import find_poses
from dvrk_drake.analysis.static.excluded_measurements import check_effort_unit
from dvrk_drake.analysis.static.static_identification import usable_poses
from dvrk_drake.errors import IdentificationError, RecordingError
from dvrk_drake.models.arm import Arm
from dvrk_drake.progress import Progress, step_progress
from dvrk_drake.recordings.recording import MIN_ROWS, REST_SPEED, Recording

#: A joint with a smaller range has not moved [rad], [m].
MIN_RANGE = 0.02, 0.002
#: Smallest share of the range between the limits for a joint's parameters to be well identifiable.
MIN_COVERAGE = 0.1
#: Smallest reported excess of a pose beyond a limit [rad], [m].
LIMIT_MARGIN = 0.005, 0.0005
#: Ratio of a motion's effort to its limit above which the effort is a measurement error, even if the limit is inexact.
IMPOSSIBLE_EFFORT = 5.0
#: Excess beyond the joint stops above which a position is a measurement error [rad].
IMPOSSIBLE_EXCESS = 0.3
#: Smallest number of consecutive rows at the extreme effort, and smallest share of all rows, for a clipped effort.
FLAT_ROWS, FLAT_SHARE = 5, 0.002
#: Largest relative deviation of the times from those implied by q and qd. A larger one indicates a wrong unit or rate.
TIME_TOLERANCE = 0.05
#: Number of rows between two compared positions.
BLOCK = 20
_ORDER: dict[Severity, int] = {"refusal": 0, "warning": 1, "note": 2}


def check_recording(recording: Recording, arm: Arm) -> RecordingReport:
    """Checks poses or a motion from a CSV file or an LCM log, in joint or actuator coordinates.

    Limits are checked in joint coordinates. Sensors, motors and friction are checked in actuator coordinates. Problems
    of the recording are returned as findings and never raised.

    Args:
        recording: Recording without preprocessing.
        arm: Arm that was recorded.
    """
    source = recording.source or "recording"
    report = RecordingReport(source, arm.name, "motion" if recording.is_motion else "poses", len(recording))
    findings = [Finding("note", "reading", source, note, "read the rest with that in mind") for note in recording.notes]
    try:
        joints = recording.in_joint_coordinates(arm)
        recording.check_fits(arm)
        tau = joints.measured_effort()
        check_effort_unit(joints, arm)
    except RecordingError as error:
        refusal = Finding("refusal", "unusable", source, _without_source(str(error), source), "nothing else is checked")
        return replace(report, findings=(refusal, *findings))
    numbers = _joint_signals(joints, arm)
    findings += _positions(joints, arm, numbers)
    findings += _efforts(recording.in_actuator_coordinates(arm), tau, arm, report.kind)
    time = _time(recording, report.kind)
    findings += time
    report = replace(report, joints=numbers)
    if any(finding.severity == "refusal" for finding in time):
        pass
    elif report.kind == "motion":
        report, more = check_motion(report, recording, arm)
        findings += more
    else:
        findings += check_poses(recording, arm)
    return replace(report, findings=tuple(sorted(findings, key=lambda finding: _ORDER[finding.severity])))


def _joint_signals(joints: Recording, arm: Arm) -> tuple[JointSignals, ...]:
    tau = joints.measured_effort()
    covered = np.ptp(joints.q, axis=0)
    limits = arm.position_upper - arm.position_lower
    effort = np.sqrt(np.mean(tau**2, axis=0))
    peak = np.max(np.abs(tau), axis=0) / arm.effort_limits
    return tuple(
        JointSignals(name, float(covered[j]), float(covered[j] / limits[j]), float(effort[j]), float(peak[j]))
        for j, name in enumerate(arm.joint_names)
    )


def _positions(joints: Recording, arm: Arm, numbers: tuple[JointSignals, ...]) -> list[Finding]:
    findings = []
    A, lower, upper = arm.limit_matrix()
    names = [*arm.joint_names, *(limit.name for limit in arm.coupled_limits)]
    margins = np.concatenate([arm.per_joint(*LIMIT_MARGIN), np.full(len(arm.coupled_limits), LIMIT_MARGIN[0])])
    values = joints.q @ A.T
    excess = np.maximum(lower - values, values - upper)
    for i in np.flatnonzero(np.max(excess, axis=0) > margins):
        row = int(np.argmax(excess[:, i]))
        what = (
            f"outside {lower[i]:.4g}..{upper[i]:.4g} in {np.mean(excess[:, i] > margins[i]):.1%} of the rows, "
            f"furthest {values[row, i]:.4g} at {joints.where(row)}"
        )
        advice = "there it may press on a stop, and its effort is not the arm's own; check its zero and its limits"
        moved = tuple(int(j) for j in np.flatnonzero(A[i]))
        severity: Severity = "warning"
        if i >= arm.num_joints and excess[row, i] > IMPOSSIBLE_EXCESS:
            severity = "refusal"
            advice = (
                "no arm goes there, its links would cross: are these positions of actuators (--coordinates actuator)?"
            )
        findings.append(Finding(severity, "outside limits", names[i], what, advice, moved, float(excess[row, i])))
    still = [j for j, least in enumerate(arm.per_joint(*MIN_RANGE)) if numbers[j].range < least]
    for j, joint in enumerate(numbers):
        if j in still:
            what = f"never moves: its positions cover {joint.range:.2g} {'m' if arm.prismatic[j] else 'rad'}"
            advice = "nothing of it can be identified, and what it carries only together; record it moving"
            findings.append(Finding("warning", "never moves", joint.name, what, advice, (j,), joint.range))
        elif joint.coverage < MIN_COVERAGE:
            what = f"covers {joint.coverage:.1%} of its range"
            advice = "its parameters will be uncertain and valid there only; let it move further"
            findings.append(Finding("warning", "little excitation", joint.name, what, advice, (j,), joint.coverage))
    return findings


def _efforts(actuators: Recording, tau: NDArray[np.float64], arm: Arm, kind: str) -> list[Finding]:
    if not np.any(tau):
        advice = "the motors were off or are not recorded"
        return [Finding("refusal", "no effort", "efforts", "all of them are always 0", advice)]
    findings = []
    least_range = arm.per_joint(*MIN_RANGE)
    for j, name in enumerate(arm.joint_names):
        if not np.any(tau[:, j]):
            advice = "its motor was off or is not recorded; nothing of it can be identified"
            findings.append(Finding("warning", "no effort", name, f"tau{j + 1} is always 0", advice, (j,)))
            continue
        exceeds = int(np.sum(np.abs(tau[:, j]) > arm.effort_limits[j]))
        if exceeds:
            most = float(np.max(np.abs(tau[:, j])) / arm.effort_limits[j])
            what = f"effort above its limit of {arm.effort_limits[j]:.3g} in {exceeds} rows, up to {most:.0%}"
            advice = "such peaks may be clipped or spikes of the current's measurement"
            severity: Severity = "note"
            if kind == "motion" and most > IMPOSSIBLE_EFFORT:
                # A pose may be at a joint stop and is excluded later. In a motion a few such rows spoil the whole fit.
                severity = "refusal"
                advice = (
                    "no motor of this arm does that; mend or remove the spikes, or correct the limit in the arm's file"
                )
            findings.append(Finding(severity, "above effort limit", name, what, advice, (j,), most))
        # A joint at rest needs a constant effort, which is not saturation.
        if np.ptp(actuators.q[:, j]) < least_range[j]:
            continue
        measured = actuators.measured_effort()[:, j]
        shares = {extreme: _flat_share(measured, extreme) for extreme in (float(measured.max()), float(measured.min()))}
        flat = {extreme: share for extreme, share in shares.items() if share > FLAT_SHARE}
        if flat:
            at = " and at ".join(f"{extreme:.4g} in {share:.1%} of the rows" for extreme, share in flat.items())
            what = f"effort stays at its extreme: at {at}"
            advice = "it was saturated: what the joint did there is not what tau says; record a gentler motion"
            findings.append(Finding("warning", "saturated effort", name, what, advice, (j,), max(flat.values())))
    return findings


def _flat_share(values: NDArray[np.float64], extreme: float) -> float:
    """Returns the share of the rows in runs of at least `FLAT_ROWS` rows at an extreme."""
    at = np.abs(values - extreme) <= 1e-6 * max(abs(extreme), float(np.ptp(values)))
    edges = np.flatnonzero(np.diff(np.concatenate([[False], at, [False]]).astype(int)))
    lengths = np.diff(edges.reshape(-1, 2), axis=1).ravel()
    return float(np.sum(lengths[lengths >= FLAT_ROWS]) / len(values))


def _time(recording: Recording, kind: str) -> list[Finding]:
    """Reports times that decrease, and times whose unit disagrees with q and qd."""
    t, qd = recording.t, recording.qd
    if t is None:
        if qd is not None and np.max(np.sqrt(np.mean(qd**2, axis=0))) > REST_SPEED[0]:
            what = "the arm moves (qd), but rows have no time t"
            return [Finding("warning", "no times", "t", what, "taken for poses; write t [s] to use it as a motion")]
        return []
    back = np.flatnonzero(np.diff(t) <= 0)
    if len(back):
        row = int(back[0]) + 1
        what = f"does not increase in {len(back)} rows, first at {recording.where(row)}"
        severity: Severity = "refusal" if kind == "motion" else "warning"
        advice = "rows must follow in time: sort them, and write one clock's times [s]"
        return [Finding(severity, "time goes back", "t", what, advice, size=float(len(back)))]
    factor = _time_factor(recording)
    if factor is None or abs(factor - 1) < TIME_TOLERANCE:
        return []
    units = {1e3: "milliseconds", 1e6: "microseconds", 1e9: "nanoseconds", 1 / 60: "minutes"}
    unit = next((name for size, name in units.items() if abs(factor / size - 1) < 0.1), "")
    guess = f"is t in {unit}?" if unit else "is the rate right, and are all of qd in rad/s (m/s)?"
    what = f"runs {factor:.4g} times as fast as q and qd say; {guess}"
    return [
        Finding("refusal", "wrong time", "t", what, "write t in s, q in rad (m) and qd in rad/s (m/s)", size=factor)
    ]


def _time_factor(recording: Recording) -> float | None:
    """Returns the ratio of recorded to true time.

    Most joints that move must agree on it within 10 %. Otherwise the result is None.
    """
    t, q, qd = recording.t, recording.q, recording.qd
    if t is None or qd is None or len(t) < MIN_ROWS:
        return None
    # Differences over several rows cancel jitter and repeated rows.
    way = np.diff(
        np.vstack([q[:1] * 0, np.cumsum((qd[1:] + qd[:-1]) / 2 * np.diff(t)[:, None], axis=0)])[::BLOCK], axis=0
    )
    dq = np.diff(q[::BLOCK], axis=0)
    moving = np.sqrt(np.mean(qd**2, axis=0)) > REST_SPEED[1]
    squares = np.sum(dq**2, axis=0) * np.sum(way**2, axis=0)
    related = np.sum(dq * way, axis=0) > 0.6 * np.sqrt(squares)
    chosen = moving & related & (squares > 0)
    if np.sum(chosen) < 2:
        return None
    factors = np.sqrt(np.sum(way[:, chosen] ** 2, axis=0) / np.sum(dq[:, chosen] ** 2, axis=0))
    factor = float(np.median(factors))
    return factor if np.mean(np.abs(factors / factor - 1) < 0.1) > 0.5 else None


def _without_source(message: str, source: str) -> str:
    return message.removeprefix(source).lstrip(": ")


def check(recording: Recording, arm: Arm, *, progress: Progress | None = None) -> RecordingReport:
    """Checks a recording for faults before identification, like `dvrk-drake check`.

    Faults are, for example, wrong units or signs, exchanged channels, efforts at their limit, decreasing times, late or
    repeated signals, and joints that do not move. Faults are not raised but returned as findings of the report.

    Args:
        recording: Poses or motion with efforts (m, n), in joint or actuator coordinates, without preprocessing.
        arm: Arm that was recorded.
        progress: Function that is called with the step, "checking the recording", and its completed share 0..1.

    Returns:
        Report with `findings`, each with severity, place, advice and size. Its `refusals` and `warnings` are subsets of
        them, `joints` has statistics of each joint, and `as_dict` returns the report for JSON. `identify` rejects a
        recording that has refusals.

    Example:
        >>> import dvrk_drake as dvrk, numpy as np
        >>> arm = dvrk.load_arm("mtml")
        >>> q = arm.sample_poses(20, np.random.default_rng(0))
        >>> efforts_in_n_mm = 1e3 * dvrk.IdentifiedModel.from_arm(arm).holding_torque(q)
        >>> report = dvrk.check(dvrk.Recording(q=q, tau=efforts_in_n_mm), arm)
        >>> [finding.kind for finding in report.refusals]
        ['unusable']
    """
    share = step_progress(progress, "checking the recording")
    share(0.0)
    report = check_with_channels(recording, arm)
    share(1.0)
    if report.refusals:
        return report
    refusals = _refusals_of_identify(recording, arm)
    # Findings repeated by a refusal, together with the required action.
    others = [finding for finding in report.findings if not (refusals and finding.kind == "few poses")]
    return replace(report, findings=(*refusals, *others))


def require_usable(
    recording: Recording,
    arm: Arm,
    progress: Progress | None = None,
    *,
    channels: bool = False,
    apart_from: str = "",
) -> RecordingReport:
    """Checks a recording and raises an error if it is not usable.

    Args:
        recording: Recording, see `check_recording`.
        arm: Arm that was recorded.
        progress: Function that is called with the step, "checking the recording", and its completed share 0..1.
        channels: Also checks the channels, see `check_with_channels`.
        apart_from: Kind of findings that are ignored.

    Returns:
        The report, without refusals.

    Raises:
        RecordingError: The recording has a refusal. The message is the first one, and the refusals and warnings are
            the `findings` of the error.
    """
    report_share = step_progress(progress, "checking the recording")
    report_share(0.0)
    report = (check_with_channels if channels else check_recording)(recording, arm)
    report_share(1.0)
    kept = tuple(finding for finding in report.findings if finding.kind != apart_from)
    report = replace(report, findings=kept)
    if report.refusals:
        error = RecordingError(report.refusal)
        error.findings = (*report.refusals, *report.warnings)
        raise error
    return report


def check_with_channels(recording: Recording, arm: Arm) -> RecordingReport:
    """Checks a recording like `check_recording`, and its channels with `check_channels` if there are no other refusals.

    Exchanged channels resemble efforts of a wrong sign. A refusal for wrong signs is therefore replaced by the refusal
    that names the exchanged channels.
    """
    report = check_recording(recording, arm)
    others = [finding for finding in report.refusals if finding.kind != "effort sign"]
    if others or (report.kind == "motion" and not recording.motion(arm)):
        return report
    try:
        found = check_channels(recording, arm)
    except RecordingError:
        return report  # The motion is too short or too coarse for a fit. identify rejects it for that reason.
    if any(finding.severity == "refusal" for finding in found):
        kept = [finding for finding in report.findings if finding.severity != "refusal"]
        return replace(report, findings=(*found, *kept))
    if report.refusals:
        return report
    order = {"warning": 0, "note": 1}
    return replace(report, findings=tuple(sorted((*report.findings, *found), key=lambda f: order[f.severity])))


def _refusals_of_identify(recording: Recording, arm: Arm) -> tuple[Finding, ...]:
    try:
        found = find_poses(recording, arm)
        if found.moves:
            motion_grid(recording, arm, default_settings(arm))
            return ()
        usable_poses(found.recording, arm)
    except (RecordingError, IdentificationError) as error:
        what, _, advice = str(error).removeprefix(f"{recording.source or 'recording'}: ").partition("; ")
        return (Finding("refusal", "identify refuses", "identify", f"will refuse it: {what}", advice),)
    # For a motion with static segments, only those are used for identification.
    return () if found.recording is recording else check_recording(found.recording, arm).refusals
