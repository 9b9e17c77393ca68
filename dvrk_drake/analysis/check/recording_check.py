"""Checks a recording before identification and reports each problem with its location and advice."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.analysis.check.channel_check import MIN_GAIN, check_channels, segments_of
from dvrk_drake.analysis.check.channel_fit import ChannelFit
from dvrk_drake.analysis.check.measurement_check import check_motion, check_poses, repeated_row_findings
from dvrk_drake.analysis.check.mounting import find_mounting, is_assumed
from dvrk_drake.analysis.check.report import JointSignals, RecordingReport
from dvrk_drake.analysis.motion_validation import find_other_robot, validate_motion
from dvrk_drake.analysis.observations.finding import Finding, Severity
from dvrk_drake.analysis.observations.motion_faults import MIN_RETURNS, TIME_UNITS
from dvrk_drake.analysis.observations.motion_grid import MIN_DURATION
from dvrk_drake.analysis.observations.observations import Observations
from dvrk_drake.analysis.observations.static_poses import MIN_POSES, check_effort_unit, usable_poses
from dvrk_drake.analysis.observations.true_time import SAME_VALUE, distinct_rows, repeated_rows, time_factor
from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.errors import IdentificationError, RecordingError
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.arm_files import known_arms, load_arm
from dvrk_drake.progress import Progress, step_progress
from dvrk_drake.recordings.recording import (
    COORDINATES_HELP,
    LIMIT_TOLERANCE,
    MIN_RANGE,
    MIN_ROWS,
    REST_SPEED,
    Recording,
)

#: Smallest share of the range between its limits that a joint must cover for accurate estimates of its parameters. Half
#: the value removes 3 warnings on the public recordings, twice the value adds 11.
MIN_COVERAGE = 0.1
#: Smallest reported excess of a position beyond a limit [rad], [m]. Half the value adds five warnings on the public
#: recordings, twice the value removes two.
LIMIT_MARGIN = 0.005, 0.0005
#: Largest possible ratio of an effort to its limit in a motion. A larger ratio is a measurement error. Half or twice
#: the value changes no finding on the public recordings.
IMPOSSIBLE_EFFORT = 5.0
#: Smallest number of consecutive rows at the extreme effort, and smallest share of all rows, for a saturated effort.
#: Two rows give a wrong warning on the public recordings. Twice the number, and half or twice the share, change
#: nothing.
FLAT_ROWS, FLAT_SHARE = 5, 0.002
#: Smallest duration for which the effort of a moving joint is exactly 0 if its motor is off [s]. At rest or for
#: moments, a quantised effort can be 0. Half or twice the value changes no finding on the public recordings.
MIN_OFF_TIME = 1.0
#: Largest relative error of the recorded times, estimated from q and qd. A larger error indicates a wrong unit or rate.
#: Half or twice the value changes no finding on the public recordings.
TIME_TOLERANCE = 0.05
_ORDER: dict[Severity, int] = {"refusal": 0, "warning": 1, "note": 2}


def check_recording(observations: Observations) -> RecordingReport:
    """Checks poses or a motion, without the tests of `check_channels`.

    Limits are checked in joint coordinates. Sensors, motors and friction are checked in actuator coordinates. Problems
    of the recording are returned as findings. They are never raised as errors. A wrong sign that contradicts the links
    of the arm is not reported.

    Args:
        observations: Recording without preprocessing.
    """
    recording, arm, source = observations.recording, observations.arm, observations.source
    report = RecordingReport(source, arm.name, "motion" if recording.is_motion else "poses", len(recording))
    findings = [Finding("note", "reading", source, note.removesuffix("."), "") for note in recording.notes]
    if arm.locked_joints:
        what = f"the recording does not contain these joints, which are assumed at rest at {arm.locked_text} [rad, m]"
        advice = "Their friction, motors and efforts are not identifiable. The model is valid only for these positions."
        findings.append(Finding("note", "locked joints", ", ".join(arm.locked_joints), what, advice))
    try:
        joints = recording.in_joint_coordinates(arm)
        if fault := observations.source_fault or observations.jump:
            return replace(report, findings=(fault, *findings))
        recording.check_fits(arm)
        tau = joints.measured_effort()
        check_effort_unit(joints, arm)
    except RecordingError as error:
        what, advice = _what_and_advice(error, source)
        refusal = Finding("refusal", "unusable", source, what, advice)
        return replace(report, findings=(refusal, *findings))
    joint_signals = _joint_signals(joints, arm)
    findings += _positions(joints, arm, joint_signals)
    findings += _efforts(recording.in_actuator_coordinates(arm), tau, arm, report.kind)
    if report.kind == "motion":
        findings += repeated_row_findings(recording.in_actuator_coordinates(arm))
    time = _time(observations, report.kind)
    findings += time
    report = replace(report, joints=joint_signals)
    if any(finding.severity == "refusal" for finding in time):
        report = replace(report, kind="motion")
    elif report.kind == "motion":
        report, more = check_motion(report, observations)
        findings += more
    else:
        findings += check_poses(recording, arm)
    report = replace(report, findings=tuple(sorted(findings, key=lambda finding: _ORDER[finding.severity])))
    return _without_contradictions(report, observations)


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


def _positions(joints: Recording, arm: Arm, joint_signals: tuple[JointSignals, ...]) -> list[Finding]:
    findings = []
    A, lower, upper = arm.limit_matrix()
    names = [*arm.joint_names, *(limit.name for limit in arm.coupled_limits)]
    margins = np.concatenate([arm.per_joint(*LIMIT_MARGIN), np.full(len(arm.coupled_limits), LIMIT_MARGIN[0])])
    values = joints.q @ A.T
    excess = np.maximum(lower - values, values - upper)
    for i in np.flatnonzero(np.max(excess, axis=0) > margins):
        row = int(np.argmax(excess[:, i]))
        unit = "m" if i < arm.num_joints and arm.prismatic[i] else "rad"
        what = (
            f"the position is outside the limits {lower[i]:.4g}..{upper[i]:.4g} {unit} in "
            f"{100 * np.mean(excess[:, i] > margins[i]):.1f} % of the rows, with the largest excess at "
            f"{values[row, i]:.4g} {unit} ({joints.where(row)})"
        )
        advice = (
            "Efforts measured at a joint stop are not valid. Check the encoder offset and the limits of the arm file."
        )
        moved = tuple(int(j) for j in np.flatnonzero(A[i]))
        severity: Severity = "warning"
        if i >= arm.num_joints and excess[row, i] > LIMIT_TOLERANCE[0]:
            severity = "refusal"
            advice = (
                "The arm cannot reach this position. Is the choice of coordinates wrong? "
                f"Coordinates: {COORDINATES_HELP}."
            )
        findings.append(Finding(severity, "outside limits", names[i], what, advice, moved, float(excess[row, i])))
    min_range = arm.per_joint(*MIN_RANGE)
    for j, joint in enumerate(joint_signals):
        if joint.range < min_range[j]:
            what = f"the joint does not move (range {joint.range:.2g} {'m' if arm.prismatic[j] else 'rad'})"
            advice = "Its parameters are not identifiable. Record a motion of this joint."
            findings.append(Finding("warning", "never moves", joint.name, what, advice, (j,), joint.range))
        elif joint.coverage < MIN_COVERAGE:
            what = f"the joint covers only {100 * joint.coverage:.1f} % of its range"
            advice = "Its parameters will be uncertain and valid only in this range. Move the joint further."
            findings.append(Finding("warning", "little excitation", joint.name, what, advice, (j,), joint.coverage))
    return findings


def _efforts(actuators: Recording, tau: NDArray[np.float64], arm: Arm, kind: str) -> list[Finding]:
    if not np.any(tau):
        advice = "The motors were off, or the efforts were not recorded."
        return [Finding("refusal", "no effort", "efforts", "all efforts are 0 in all rows", advice)]
    findings = []
    min_range = arm.per_joint(*MIN_RANGE)
    for j, name in enumerate(arm.joint_names):
        if not np.any(tau[:, j]):
            what = f"tau{j + 1} is the same number in all rows, so it was not measured"
            advice = "The motor was off, or its effort was not recorded. The model has no friction of this actuator."
            findings.append(Finding("warning", "no effort", name, what, advice, (j,)))
            continue
        if kind == "motion" and (off := _off_rows(actuators, tau[:, j], j, arm)):
            what = (
                f"tau{j + 1} is exactly 0 in {len(off)} successive rows while the joint moves, first at "
                f"{actuators.where(off[0])}"
            )
            advice = (
                "Its motor was off. Identify from the other rows, or set tau to 0 in all rows to leave this joint out."
            )
            findings.append(Finding("refusal", "no power", name, what, advice, (j,), float(len(off))))
            continue
        exceeds = int(np.sum(np.abs(tau[:, j]) > arm.effort_limits[j]))
        if exceeds:
            most = float(np.max(np.abs(tau[:, j])) / arm.effort_limits[j])
            limit = f"{arm.effort_limits[j]:.3g} {'N' if arm.prismatic[j] else 'N m'}"
            what = (
                f"tau{j + 1} exceeds its limit of {limit} in {exceeds} row{'s' * (exceeds != 1)}, with a peak at "
                f"{100 * most:.0f} % of the limit"
            )
            advice = "Usual causes: clipped efforts, or spikes of the current measurement."
            severity: Severity = "note"
            if kind == "motion" and most > IMPOSSIBLE_EFFORT:
                # Poses with such efforts are excluded later. In a motion, a few such rows make the whole fit wrong.
                severity = "refusal"
                advice = (
                    "The motor cannot produce this effort. Remove the spikes, or correct the limit in the arm file."
                )
            findings.append(Finding(severity, "above effort limit", name, what, advice, (j,), most))
        # The effort of a joint at rest is constant, which is not saturation.
        if np.ptp(actuators.q[:, j]) < min_range[j]:
            continue
        measured = actuators.measured_effort()[:, j]
        shares = {extreme: _flat_share(measured, extreme) for extreme in (float(measured.max()), float(measured.min()))}
        flat = {extreme: share for extreme, share in shares.items() if share > FLAT_SHARE}
        if flat:
            unit = "N" if arm.prismatic[j] else "N m"
            at = " and at ".join(
                f"{extreme:.4g} {unit} in {100 * share:.1f} % of the rows" for extreme, share in flat.items()
            )
            what = f"the effort is saturated at {at}"
            advice = "A saturated effort is not the true effort. Record a slower motion."
            findings.append(Finding("warning", "saturated effort", name, what, advice, (j,), max(flat.values())))
    return findings


def _off_rows(actuators: Recording, tau: NDArray[np.float64], joint: int, arm: Arm) -> range:
    """Returns the longest run of rows in which the effort tau (m,) of a moving joint is exactly 0, or an empty range.

    The run lasts at least `MIN_OFF_TIME`.
    """
    t, q = np.asarray(actuators.t), actuators.in_joint_coordinates(arm).q[:, joint]
    edges = np.flatnonzero(np.diff(np.concatenate([[False], tau == 0, [False]]).astype(int))).reshape(-1, 2)
    runs = [
        range(first, end)
        for first, end in edges.tolist()
        if t[end - 1] - t[first] >= MIN_OFF_TIME and np.ptp(q[first:end]) > arm.per_joint(*MIN_RANGE)[joint]
    ]
    return max(runs, key=len, default=range(0))


def _flat_share(values: NDArray[np.float64], extreme: float) -> float:
    """Returns the share of rows that are in runs of at least `FLAT_ROWS` rows at the extreme value."""
    at = np.abs(values - extreme) <= SAME_VALUE * max(abs(extreme), float(np.ptp(values)))
    edges = np.flatnonzero(np.diff(np.concatenate([[False], at, [False]]).astype(int)))
    lengths = np.diff(edges.reshape(-1, 2), axis=1).ravel()
    return float(np.sum(lengths[lengths >= FLAT_ROWS]) / len(values))


def _time(observations: Observations, kind: str) -> list[Finding]:
    """Returns findings for missing times, times that do not increase, and times that disagree with q and qd."""
    recording = observations.recording
    t, qd = recording.t, recording.qd
    if t is None:
        if qd is not None and np.max(np.sqrt(np.mean(qd**2, axis=0))) > REST_SPEED[0]:
            what = "the arm moves (qd), but the rows have no times t"
            advice = "The rows are treated as poses. For a motion, add the time t [s] of each row, or give --rate."
            return [Finding("warning", "no times", "t", what, advice)]
        return []
    decreasing = np.flatnonzero(np.diff(t) <= 0)
    if len(decreasing):
        row, count = int(decreasing[0]) + 1, len(decreasing)
        what = f"times do not increase in {count} row{'s' * (count != 1)}, first at {recording.where(row)}"
        severity: Severity = "refusal" if kind == "motion" else "warning"
        advice = "Sort the rows by time, and use the times of one clock [s]."
        if np.all(repeated_rows(recording)[decreasing + 1]):
            advice = "These rows repeat the previous row and its time. Remove these rows."
        return [Finding(severity, "time goes back", "t", what, advice, size=float(count))]
    factor = None
    if recording.qd is not None and len(t) >= MIN_ROWS:
        rows, times, _ = distinct_rows(recording)
        factor = time_factor(times, recording.q[rows], recording.qd[rows])
    if factor is None or abs(factor - 1) < TIME_TOLERANCE:
        return [fault] if (fault := observations.fault) else []
    unit = next((name for name, size in TIME_UNITS.items() if abs(factor * size - 1) < TIME_TOLERANCE), "")
    cause = f"t may be in {unit}" if unit else "usual causes: a wrong rate, or qd in another unit"
    for quantity, size in (("qd may be in deg/s", 180 / np.pi), ("q may be in degrees", np.pi / 180)):
        cause = quantity if abs(factor / size - 1) < TIME_TOLERANCE else cause
    what = f"times increase {factor:.4g} times as fast as q and qd imply ({cause})"
    advice = "Use t in s, q in rad (m) and qd in rad/s (m/s)."
    return [Finding("refusal", "wrong time", "t", what, advice, size=factor)]


def _what_and_advice(error: Exception, source: str) -> tuple[str, str]:
    """Returns the first sentence of an error, without the source of the recording, and the other sentences."""
    text = str(error).removeprefix(f"{source}: ").removeprefix(f"{source}, ").removeprefix(f"{source} ")
    what, _, advice = text.partition(". ")
    return what.removesuffix("."), advice


def check(recording: Recording, arm: Arm | IdentifiedModel, *, progress: Progress | None = None) -> RecordingReport:
    """Checks a recording for faults before identification, as `dvrk-drake check` does.

    Examples of faults are wrong units or signs, exchanged channels, saturated efforts, decreasing times, late or
    repeated signals, and joints that do not move. Faults are returned as findings of the report. They are not raised as
    errors.

    Args:
        recording: Poses or motion with efforts (m, n), in joint or actuator coordinates, without preprocessing.
        arm: Arm that was recorded, or its model. With the model of a motion, `check` also finds out whether a motion is
            that of another individual arm.
        progress: Callback that receives the name of the step ("checking the recording") and the finished share of the
            step (0 to 1).

    Returns:
        Report with all `findings`. Its attributes `refusals` and `warnings` are the findings of these severities, and
        `joints` contains the statistics of each joint. `identify` rejects a recording with refusals.

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
    model = None if isinstance(arm, Arm) else arm
    arm = arm if isinstance(arm, Arm) else arm.arm
    recording, dropped = with_power(recording, arm)
    if assumed := is_assumed(arm):
        arm, mounting = find_mounting(Observations(recording, arm))
        dropped = (*dropped, *mounting)
    observations = Observations(recording, arm)
    report = check_with_channels(observations)
    if not report.refusals and not assumed:
        dropped = (*dropped, *find_mounting(observations)[1])
    if not report.refusals and model is not None and model.dynamics is not None and report.kind == "motion":
        dropped = (*dropped, *find_other_robot(validate_motion(model, Observations.for_model(recording, model))))
    report = replace(report, findings=(*report.refusals, *dropped, *report.findings[len(report.refusals) :]))
    share(1.0)
    if report.refusals:
        return report
    refusals = _refusals_of_identify(observations)
    # A refusal of identify makes the warning of too few poses redundant.
    others = [finding for finding in report.findings if not (refusals and finding.kind == "few poses")]
    return replace(report, findings=(*refusals, *others))


def other_arm(recording: Recording, arm: Arm) -> str:
    """Returns the arm of a recording that is outside the limits of `arm`, "ARM" if several arms fit, "" if none."""

    def fits(tested: Arm) -> bool:
        try:
            recording.check_fits(tested)
        except RecordingError:
            return False
        return True

    if arm.locked_joints or fits(arm):
        return ""
    fitting = [name for name in known_arms() if fits(load_arm(name))]
    return fitting[0] if len(fitting) == 1 else "ARM" if fitting else ""


def with_power(recording: Recording, arm: Arm) -> tuple[Recording, tuple[Finding, ...]]:
    """Returns the part of a recording whose efforts can be used, and findings on all other rows and channels.

    The result has no rows without power, in which all efforts are exactly 0, and no segments of a motion that are
    shorter than `MIN_DURATION` between two gaps. Efforts of a moving joint that are constant in all rows were not
    measured. They are replaced by 0, which marks a channel that was not measured (`Recording.unmeasured`). A recording
    without any efforts is not changed.
    """
    if recording.tau is None or not np.any(recording.tau) or recording.q.shape[1] != arm.num_joints:
        return recording, ()
    findings: list[Finding] = []
    count = len(recording)
    off = ~np.any(recording.tau, axis=1)
    if num_off := int(np.sum(off)):
        runs = int(np.sum(np.diff(off.astype(int), prepend=0) == 1))
        what = (
            f"all efforts are exactly 0 in {num_off} of {count} row{'s' * (count != 1)}, first at "
            f"{recording.where(int(np.argmax(off)))}. These rows are not used"
        )
        advice = "The motors were off, or the efforts were not measured."
        if runs > MIN_RETURNS * count:
            advice = "The rows alternate with rows that have efforts. Usual cause: two publishers on one topic."
        findings.append(Finding("warning", "no power", "efforts", what, advice, size=float(num_off)))
        recording = recording.select(~off)
    tau = recording.measured_effort()
    moves = np.ptp(recording.q, axis=0) > arm.per_joint(*MIN_RANGE)
    constant = moves & (np.ptp(tau, axis=0) == 0) & (tau[0] != 0) & (len(tau) >= MIN_POSES)
    if np.any(constant):
        recording = replace(recording, tau=np.where(constant, 0.0, tau))
    if recording.is_motion and recording.has_increasing_times:
        t, segments = np.asarray(recording.t), recording.segments()
        short = [rows for rows in segments if t[rows.stop - 1] - t[rows.start] < MIN_DURATION]
        if 0 < len(short) < len(segments):
            keep = np.ones(len(t), dtype=bool)
            for rows in short:
                keep[rows] = False
            what = (
                f"{np.sum(~keep)} of {len(t)} rows are in {len(short)} segment{'s' * (len(short) != 1)} shorter than "
                f"{MIN_DURATION:g} s between gaps of t, first at {recording.where(short[0].start)}. These rows are not "
                "used"
            )
            findings.append(Finding("warning", "short segments", "t", what, "Record without interruptions."))
            recording = recording.select(keep)
    return recording, tuple(findings)


def require_usable(
    observations: Observations,
    progress: Progress | None = None,
    *,
    channels: bool = False,
    ignored_kind: str = "",
) -> RecordingReport:
    """Checks a recording and raises an error if it is not usable.

    Args:
        observations: Recording, see `check_recording`.
        progress: Callback that receives the name of the step ("checking the recording") and the finished share of the
            step (0 to 1).
        channels: True to check the channels too, see `check_with_channels`.
        ignored_kind: Kind of the findings that are ignored, or "".

    Returns:
        Report without refusals.

    Raises:
        RecordingError: The recording has a refusal. The message is the first refusal. The attribute `findings`
            of the error contains all refusals and warnings.
    """
    report_share = step_progress(progress, "checking the recording")
    report_share(0.0)
    report = check_with_channels(observations) if channels else check_recording(observations)
    report_share(1.0)
    kept = tuple(finding for finding in report.findings if finding.kind != ignored_kind)
    report = replace(report, findings=kept)
    if report.refusals:
        error = RecordingError(report.refusal)
        error.findings = (*report.refusals, *report.warnings)
        raise error
    return report


def check_with_channels(observations: Observations) -> RecordingReport:
    """Checks a recording with `check_recording`, then its channels with `check_channels`.

    The channels are not checked if `check_recording` reports a refusal, unless all refusals are efforts with a wrong
    sign. Exchanged channels have a similar effect to efforts with a wrong sign. A refusal for exchanged channels
    therefore replaces the refusals for wrong signs.
    """
    report = check_recording(observations)
    others = [finding for finding in report.refusals if finding.kind != "effort sign"]
    if others or (report.kind == "motion" and not observations.recording.motion(observations.arm)):
        return report
    try:
        found = check_channels(observations)
    except RecordingError:
        return report  # The motion is too short, or its rate too low, for a fit. identify rejects it for that reason.
    if any(finding.severity == "refusal" for finding in found):
        kept = [finding for finding in report.findings if finding.severity != "refusal"]
        return replace(report, findings=(*found, *kept))
    if report.refusals:
        return report
    return replace(report, findings=tuple(sorted((*report.findings, *found), key=lambda f: _ORDER[f.severity])))


def _without_contradictions(report: RecordingReport, observations: Observations) -> RecordingReport:
    """Returns the report without findings on the sign of an effort that contradict the links of the arm.

    The sign of `check_motion` is that of the friction, which is uncertain for a drive with little friction.
    """
    wrong = [finding for finding in report.refusals if finding.kind == "effort sign"]
    if not wrong or report.kind != "motion":
        return report
    try:
        fit = ChannelFit(segments_of(observations.longest)[0])
    except RecordingError:
        return report
    signs = np.ones(fit.arm.num_joints)
    signs[[joint for finding in wrong for joint in finding.joints]] = -1.0
    if fit.gain(np.diag(signs)) > -MIN_GAIN:
        return report
    return replace(report, findings=tuple(finding for finding in report.findings if finding not in wrong))


def _refusals_of_identify(observations: Observations) -> tuple[Finding, ...]:
    recording, arm = observations.recording, observations.arm
    try:
        found = observations.poses()
        if found.moves:
            _ = observations.grid
            return ()
        usable_poses(found.recording, arm)
    except (RecordingError, IdentificationError) as error:
        what, advice = _what_and_advice(error, observations.source)
        return (Finding("refusal", "identify refuses", "identify", f"rejects the recording: {what}", advice),)
    # If static poses were extracted from a motion, only these poses are used for identification.
    return () if found.recording is recording else check_recording(found.observations).refusals
