"""Checks the channels of a recording: refits it with channels exchanged, inverted, scaled or shifted."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import chain, combinations

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.analysis.check.channel_fit import ChannelFit
from dvrk_drake.analysis.check.findings import Finding
from dvrk_drake.analysis.static.excluded_measurements import find_excluded
from dvrk_drake.analysis.static.static_identification import MIN_POSES, average_repeated_poses
from dvrk_drake.models.arm import Arm
from dvrk_drake.recordings.recording import Recording

#: Smallest gain in log-likelihood at which a hypothesis is accepted. On the unmodified public motions no exchange of
#: channels gains anything. On damaged motions the correct hypothesis gains at least 25, and in most cases hundreds.
MIN_GAIN = 20.0
#: Smallest gain at which inverted channels are accepted. An arm is almost symmetric under reflection, so inverted
#: channels gain up to 46 on the unmodified public motions.
MIN_MIRROR_GAIN = 100.0
#: Smallest gains for poses at rest, where friction disturbs the efforts. The first applies to exchanged channels, the
#: second to inverted or scaled efforts. On the unmodified public poses these gain up to 10, 31 and 19.
MIN_GAIN_AT_REST, MIN_EFFORT_GAIN_AT_REST = 30.0, 40.0
#: Hypotheses whose gain is less than this below the largest gain are reported as alternatives.
SIMILAR_GAIN = 10.0
#: Multiples of the recorded effort that are tested.
SCALES = (0.5, 2.0)
#: Largest factor between the power that friction dissipates and the power stated in the arm file. The public
#: recordings of one PSM on two days have factors between 0.96 and 1.54.
FRICTION_FACTOR = 1.7
#: Smallest reported position offset [rad], [m], and its smallest ratio to its standard error.
MIN_OFFSET, OFFSET_ERRORS = (0.06, 0.006), 3.3
#: The zero of a joint is checked only if an offset of this size would be significant [rad], [m].
MAX_UNDETECTED_OFFSET = 0.1, 0.01
#: Largest duration of a segment [s]. Longer motions are divided into equal segments, which bounds the memory of a fit.
MAX_SEGMENT_DURATION = 120.0
#: Additional excess beyond the arm's limits that exchanged channels may have [rad], [m].
LIMIT_MARGIN = 0.02, 0.002


def check_channels(recording: Recording, arm: Arm) -> list[Finding]:
    """Refits a recording under hypotheses about its channels and reports those that fit clearly better.

    The hypotheses are:

    - The efforts of two channels are exchanged.
    - All signals of two channels are exchanged.
    - The effort of a channel, or all its signals, are inverted.
    - The effort of an actuator is a multiple of the true effort.
    - The position of a channel has an offset.

    Each hypothesis is a maximum-a-posteriori fit of `ChannelFit`. The fits are compared by their log-likelihood. In a
    motion, a wrong scale is detected from the power that friction dissipates. Offsets and inverted positions are not
    detected in poses at rest. A long motion is fitted in segments, and their log-likelihoods are added. A warning
    requires at least half of the segments.

    Args:
        recording: Motion or poses at rest, with efforts, in joint or actuator coordinates. Channels are its columns.
        arm: Arm that was recorded.

    Returns:
        One refusal for exchanged or inverted channels. Otherwise, warnings for scales and offsets, and a note that
        lists the joints whose position offset is not identifiable from the recording.

    Raises:
        RecordingError: The recording does not match the arm, or is a motion that is too short or sampled too coarsely.
    """
    if not recording.motion(arm):
        poses = _poses_in_order(recording, arm)
        if len(poses) < MIN_POSES:
            return []
        fit = ChannelFit(poses, arm)
        found = _likeliest([[*_hypotheses(fit), *_scales_at_rest(fit)]], at_rest=True)
        # The spring torque of a cable may exceed the gravity torque of a light wrist. The effort then opposes gravity.
        return [replace(f, severity="warning") if f.kind == "effort sign" else f for f in found]
    hypotheses, others = [], []
    for part in _parts(recording):
        if part.motion(arm):
            fit = ChannelFit(part, arm)
            hypotheses.append(_hypotheses(fit))
            others.append([] if _likeliest(hypotheses[-1:]) else [*_scales(fit), *_offsets(fit)])
    return _likeliest(hypotheses) or _merged(others, arm)


def _parts(recording: Recording) -> list[Recording]:
    """Returns equal segments of a motion, none longer than `MAX_SEGMENT_DURATION`."""
    t, qd = recording.t, recording.qd
    if t is None or t[-1] - t[0] <= MAX_SEGMENT_DURATION:
        return [recording]
    edges = np.linspace(t[0], t[-1], int(np.ceil((t[-1] - t[0]) / MAX_SEGMENT_DURATION)) + 1)
    tau = recording.measured_effort()
    return [
        replace(
            recording, q=recording.q[rows], tau=tau[rows], qd=None if qd is None else qd[rows], t=t[rows], lines=None
        )
        for rows in np.split(np.arange(len(t)), np.searchsorted(t, edges[1:-1]))
    ]


def _hypotheses(fit: ChannelFit) -> list[Finding]:
    """Returns hypotheses of exchanged and inverted channels. The size of each is its gain in log-likelihood."""
    findings = [*_effort_exchanges(fit), *_full_exchanges(fit), *_inversions(fit)]
    return [*findings, *_full_inversions(fit)] if fit.moves else findings


def _likeliest(parts: list[list[Finding]], *, at_rest: bool = False) -> list[Finding]:
    """Returns the hypothesis with the largest total gain if it is large enough, and lists similar hypotheses in it."""
    gains: dict[tuple, list[Finding]] = {}
    for finding in chain(*parts):
        gains.setdefault((finding.kind, finding.joints, finding.what), []).append(finding)
    least = {"exchanged channels": MIN_GAIN_AT_REST if at_rest else MIN_GAIN, "inverted channel": MIN_MIRROR_GAIN}
    sure_of_effort = MIN_EFFORT_GAIN_AT_REST if at_rest else MIN_GAIN
    sums = [replace(same[0], size=sum(finding.size for finding in same)) for same in gains.values()]
    sums = sorted(sums, key=lambda finding: -finding.size)
    best = next((finding for finding in sums if finding.size > least.get(finding.kind, sure_of_effort)), None)
    if best is None:
        return []
    alike = [f.what.partition(":")[0] for f in sums if f is not best and f.size > max(best.size - SIMILAR_GAIN, 0.0)]
    return [replace(best, advice=f"{best.advice}; nearly as likely: {', '.join(alike)}") if alike else best]


def _merged(parts: list[list[Finding]], arm: Arm) -> list[Finding]:
    """Merges the warnings that occur in at least half of the segments.

    The joints whose offset is not identifiable in any segment are added as a note.
    """
    found: dict[tuple, list[Finding]] = {}
    for finding in chain(*parts):
        if finding.severity == "warning":
            found.setdefault((finding.kind, finding.joints[0]), []).append(finding)
    warnings = [same[0] for same in found.values() if 2 * len(same) >= len(parts)]
    hidden, uncertain = (
        [{i for finding in part if finding.kind == kind for i in finding.joints} for part in parts]
        for kind in ("undetectable offset", "uncertain effort scale")
    )
    in_doubt = set().union(*uncertain) - {joint for kind, joint in found if kind == "effort scale"}
    in_no_part = set.intersection(*hidden) if hidden else set()
    return [*warnings, *_uncertain_scale(arm, sorted(in_doubt)), *_undetectable(arm, sorted(in_no_part))]


def _poses_in_order(recording: Recording, arm: Arm) -> Recording:
    """Returns the distinct poses in joint coordinates, without those at a joint stop.

    Efforts beyond a limit are kept because they may belong to another joint.
    """
    poses = average_repeated_poses(recording.in_joint_coordinates(arm), arm)
    at_stop = [measurement.row for measurement in find_excluded(replace(poses, tau=np.zeros_like(poses.q)), arm)]
    in_order = np.setdiff1d(np.arange(len(poses)), at_stop)
    return replace(poses, q=poses.q[in_order], tau=poses.measured_effort()[in_order], qd=None, t=None, lines=None)


def _effort_exchanges(fit: ChannelFit) -> Iterator[Finding]:
    for i, j in combinations(sorted(map(int, [*fit.used, *fit.resting])), 2):
        if i in fit.resting and j in fit.resting:
            continue
        order = _exchanged(fit.arm.num_joints, i, j)
        gain = fit.gain(fit.in_actuators(np.eye(fit.arm.num_joints)[order]))
        yield _exchange(fit.arm, (i, j), f"tau{i + 1} and tau{j + 1}", gain)


def _full_exchanges(fit: ChannelFit) -> Iterator[Finding]:
    """Yields exchanges of all signals of two channels that keep the arm within its limits."""
    recording, arm = fit.recording, fit.arm
    allowed = _limit_excess(recording, arm) + _limit_margin(arm)
    for i, j in combinations(map(int, fit.used), 2):
        order = _exchanged(arm.num_joints, i, j)
        qd = None if recording.qd is None else recording.qd[:, order]
        other = replace(recording, q=recording.q[:, order], qd=qd, tau=recording.measured_effort()[:, order])
        gain = _gain_of(other, fit) if np.all(_limit_excess(other, arm) <= allowed) else -np.inf
        yield _exchange(arm, (i, j), f"all signals of channels {i + 1} and {j + 1}", gain)


def _exchanged(n: int, i: int, j: int) -> NDArray[np.int_]:
    order = np.arange(n)
    order[[i, j]] = j, i
    return order


def _limit_excess(recording: Recording, arm: Arm) -> NDArray[np.float64]:
    """Returns the largest excess beyond each joint limit [rad, m], 0 where there is none."""
    A, lower, upper = arm.limit_matrix()
    values = recording.in_joint_coordinates(arm).q @ A.T
    return np.asarray(np.max(np.maximum(np.maximum(lower - values, values - upper), 0.0), axis=0))


def _exchange(arm: Arm, channels: tuple[int, ...], which: str, gain: float) -> Finding:
    names = " and ".join(arm.joint_names[k] for k in channels)
    what = f"{which} are exchanged: the arm's equations fit the recording far better with them exchanged back"
    return Finding(
        "refusal", "exchanged channels", names, what, "correct the columns of the file and check again", channels, gain
    )


def _inversions(fit: ChannelFit) -> Iterator[Finding]:
    for i in map(int, fit.used):
        name = fit.arm.joint_names[i]
        signs = np.where(np.arange(fit.arm.num_joints) == i, -1.0, 1.0)
        gain = fit.gain(fit.in_actuators(np.diag(signs)))
        what = f"tau{i + 1}, or q{i + 1}, has the wrong sign: the arm's equations fit far better with the other"
        advice = f"efforts are positive towards +q{i + 1}; correct one of them and check again"
        yield Finding("refusal", "effort sign", name, what, advice, (i,), gain)


def _full_inversions(fit: ChannelFit) -> Iterator[Finding]:
    """Yields channels whose signals may all be inverted while the arm stays within its limits."""
    recording, arm = fit.recording, fit.arm
    allowed = _limit_excess(recording, arm) + _limit_margin(arm)
    for i in map(int, fit.used):
        signs = np.where(np.arange(arm.num_joints) == i, -1.0, 1.0)
        qd = None if recording.qd is None else recording.qd * signs
        other = replace(recording, q=recording.q * signs, qd=qd, tau=recording.measured_effort() * signs)
        gain = _gain_of(other, fit) if np.all(_limit_excess(other, arm) <= allowed) else -np.inf
        what = f"all signals of channel {i + 1} have the wrong sign: the arm's equations fit far better with the other"
        advice = "correct the columns of the file and check again"
        yield Finding("refusal", "inverted channel", arm.joint_names[i], what, advice, (i,), gain)


def _gain_of(other: Recording, fit: ChannelFit) -> float:
    """Returns the gain in log-likelihood of a recording with exchanged, inverted or shifted channels.

    In actuator coordinates the clock of `fit` is reused.
    """
    clock = fit.clock if fit.recording.coordinates == "actuator" else None
    return ChannelFit(other, fit.arm, clock).log_likelihood - fit.log_likelihood


def _limit_margin(arm: Arm) -> NDArray[np.float64]:
    return np.append(arm.per_joint(*LIMIT_MARGIN), np.full(len(arm.coupled_limits), LIMIT_MARGIN[0]))


def _scales(fit: ChannelFit) -> Iterator[Finding]:
    """Yields warnings for actuators whose effort has a wrong scale.

    The scale is estimated from the friction power, or from the fit if the arm file states no friction. A note lists
    the actuators whose friction is also consistent with a scale of 0.5 or 2.
    """
    power, allowed, uncertain = fit.dissipation(), _friction_factors(fit), []
    for i in map(int, fit.used):
        name, ratio = fit.arm.joint_names[i], float(power[i])
        advice = f"check the scale of tau{i + 1} (torque constant, gear ratio, unit) and the condition of the drive"
        if ratio <= 0:
            what = "the effort of its actuator does not oppose the motion as friction does"
            advice = f"check that tau{i + 1} and the positions are of the same motion"
        elif ratio > 0:
            if 1 / allowed[i] < ratio < allowed[i]:
                if not 0.5 * allowed[i] < ratio < 2.0 / allowed[i]:
                    uncertain.append(i)
                continue
            what = f"friction of its actuator dissipates {ratio:.2g} times the power that the arm's file states"
        else:
            scale, gain = _best_scale(fit, i)
            if gain < MIN_GAIN:
                continue
            ratio = 1 / scale
            what = f"effort of its actuator is about {ratio:g} times what the arm's inertia needs"
        yield Finding("warning", "effort scale", name, what, advice, (i,), ratio)
    yield from _uncertain_scale(fit.arm, uncertain)


def _scales_at_rest(fit: ChannelFit) -> Iterator[Finding]:
    """Yields wrong scales of the efforts of poses. The size of each is its gain in log-likelihood."""
    for i in map(int, fit.used):
        scale, gain = _best_scale(fit, i)
        what = f"tau{i + 1} is about {1 / scale:g} times what the arm's weight needs"
        advice = f"check the scale of tau{i + 1} (torque constant, gear ratio, unit)"
        yield Finding("warning", "effort scale", fit.arm.joint_names[i], what, advice, (i,), gain)


def _best_scale(fit: ChannelFit, channel: int) -> tuple[float, float]:
    """Returns the scale from `SCALES` with the largest gain for an effort, and that gain."""
    gains = {
        s: fit.gain(fit.in_actuators(np.diag(np.where(np.arange(fit.arm.num_joints) == channel, s, 1.0))))
        for s in SCALES
    }
    return max(gains.items(), key=lambda item: item[1])


def _uncertain_scale(arm: Arm, joints: list[int]) -> Iterator[Finding]:
    if joints:
        what = "friction is not as in the arm's file, so efforts that are half or twice the true ones would not show"
        advice = "friction of the day is the likely reason; check the torque constants if it is new"
        names = ", ".join(arm.joint_names[i] for i in joints)
        yield Finding("note", "uncertain effort scale", names, what, advice, tuple(joints))


def _friction_factors(fit: ChannelFit) -> NDArray[np.float64]:
    """Returns the allowed factors (n,) of the friction power.

    In joint coordinates the factor includes the gear ratio between an actuator and the only joint that it moves. The
    friction of the PSM's roll in the arm file was identified from a recording in which the roll may be that of the disc
    or that of the joint.
    """
    if fit.recording.coordinates == "actuator":
        return np.full(fit.arm.num_joints, FRICTION_FACTOR)
    J = fit.arm.transmission.matrix
    gear = np.where(np.count_nonzero(J, axis=1) == 1, np.abs(np.diag(J)), 1.0)
    return FRICTION_FACTOR * np.maximum(gear, 1 / gear)


def _offsets(fit: ChannelFit) -> Iterator[Finding]:
    """Yields the most likely position offset, and a note with the joints whose offset is not identifiable.

    Offsets of joints with parallel axes have similar effects, so the warning also lists the other candidates.
    """
    arm, hidden, found = fit.arm, [], {}
    least, tolerated = arm.per_joint(*MIN_OFFSET), arm.per_joint(*MAX_UNDETECTED_OFFSET)
    for i in range(arm.num_joints):
        offset, error = fit.position_offset(i)
        if OFFSET_ERRORS * error > tolerated[i]:
            hidden.append(i)
        elif abs(offset) > max(least[i], OFFSET_ERRORS * error):
            found[i] = (offset, error)
    if found:
        first, *others = sorted(found, key=lambda i: -_gain_of(_shifted_back(fit.recording, i, found[i][0]), fit))
        sizes = {i: f"{offset:+.2g} {'m' if arm.prismatic[i] else 'rad'}" for i, (offset, _) in found.items()}
        what = f"q{first + 1} has an offset of about {sizes[first]} (standard error {found[first][1]:.2g})"
        if others:
            what += f", or, less likely, {' or '.join(f'q{i + 1} one of {sizes[i]}' for i in others)}"
        advice = "check the zero of its encoder"
        yield Finding(
            "warning", "position offset", arm.joint_names[first], what, advice, (first, *others), found[first][0]
        )
    yield from _undetectable(arm, hidden)


def _undetectable(arm: Arm, joints: list[int]) -> Iterator[Finding]:
    if joints:
        angle, length = MAX_UNDETECTED_OFFSET
        what = f"an offset of {angle} rad ({length} m) in their positions would not show"
        advice = "this recording cannot tell it from the links' centres of mass; check the zeros of these encoders"
        names = ", ".join(arm.joint_names[i] for i in joints)
        yield Finding("note", "undetectable offset", names, what, advice, tuple(joints))


def _shifted_back(recording: Recording, channel: int, offset: float) -> Recording:
    return replace(recording, q=recording.q - offset * np.eye(recording.q.shape[1])[channel])
