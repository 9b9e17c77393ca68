"""Checks a recording for channels that are exchanged, inverted, scaled or shifted.

Channel i of a recording consists of its columns qi, qdi and taui.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import chain, combinations

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.analysis.check.channel_fit import OFFSET_DEVIATION, ChannelFit
from dvrk_drake.analysis.observations.finding import Finding
from dvrk_drake.analysis.observations.observations import Observations
from dvrk_drake.analysis.observations.static_poses import MIN_POSES, average_repeated_poses, find_excluded
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.arm_files import has_converted_model
from dvrk_drake.recordings.recording import Recording

#: Smallest gain in log-likelihood at which a hypothesis of `check_channels` is accepted. On the unmodified public
#: motions, no exchange of channels has a positive gain. On public motions with one added error, the correct hypothesis
#: has a gain of at least 25, and in most cases of more than 100. These motions are single segments. The gain of several
#: segments is their mean, because all segments have the same errors of the arm model.
MIN_GAIN = 20.0
#: Smallest gain at which the hypothesis of an inverted channel is accepted. An arm is almost symmetric under
#: reflection. This hypothesis therefore has gains of up to 46 on the unmodified public motions.
MIN_MIRROR_GAIN = 100.0
#: Smallest gains for poses at rest. The first number is for exchanged channels, the second number is for inverted or
#: scaled efforts. Friction disturbs the efforts at rest. On the unmodified public poses, the largest gains are 10 for
#: exchanges, 31 for inversions and 19 for scales.
MIN_GAIN_AT_REST, MIN_EFFORT_GAIN_AT_REST = 30.0, 40.0
#: Hypotheses with a gain within this distance of the largest gain are reported as alternatives. Half or twice the value
#: changes no finding on the public recordings of an MTM and of PSMs.
SIMILAR_GAIN = 10.0
#: Factors by which the recorded effort is multiplied for a test of the scale. Smaller errors may be changes of friction
#: (`FRICTION_FACTOR`). The factors are not tested for a converted model file, whose masses may be wrong by a factor of
#: 2 and which states no friction; see `find_mounting`.
SCALES = (0.5, 2.0)
#: Largest accepted ratio of the dissipated friction power to the friction power expected from the arm file. The public
#: recordings of one PSM on two days have ratios between 0.96 and 1.54.
FRICTION_FACTOR = 1.7
#: Smallest reported position offset [rad], [m], and smallest ratio of a reported offset to its standard error. Half the
#: offset gives a wrong warning for the public motion `mtm_one`. A normal error exceeds the ratio once in 1000 joints.
MIN_OFFSET, OFFSET_ERRORS = (0.06, 0.006), 3.3
#: Largest duration of a segment [s]. A longer motion is divided into equal segments, because the memory of a fit is
#: proportional to the duration: 190 MB for this duration of a PSM. Of more than `MAX_SEGMENTS` segments, evenly
#: distributed ones are checked, since each takes seconds. At least two of four segments must agree on a warning.
MAX_SEGMENT_DURATION, MAX_SEGMENTS = 120.0, 4
#: Largest accepted increase of the excess beyond a joint limit if channels are exchanged or inverted [rad], [m]. A
#: hypothesis with a larger increase is rejected. Real poses exceed the limits by up to 0.026 rad
#: (`mtm_2015_apr18_all80`).
LIMIT_MARGIN = 0.02, 0.002


def check_channels(observations: Observations) -> list[Finding]:
    """Tests hypotheses about errors in the channels of a recording, and reports the likely errors.

    Channel i of a recording consists of its columns qi, qdi and taui. The hypotheses are:

    - The efforts of two channels are exchanged.
    - All signals of two channels are exchanged.
    - The effort of a channel is inverted, or all signals of a channel are inverted.
    - The effort of an actuator has a wrong scale.
    - The position of a channel has an offset.

    Each hypothesis is tested by a maximum-a-posteriori fit (`ChannelFit`), and the fits are compared by their
    log-likelihood. In a motion, a wrong scale is detected from the dissipated friction power. Offsets and inverted
    positions are not detected in poses at rest. A long motion is fitted in at most `MAX_SEGMENTS` segments, and the
    gain of a hypothesis is the mean over these segments. It does not grow with the length of the recording. A warning
    is reported if it occurs in at least half of the segments.

    Args:
        observations: Motion or poses at rest, with efforts.

    Returns:
        One refusal for exchanged or inverted channels (for an inverted effort in poses at rest, a warning). Otherwise,
        warnings for wrong effort scales and for position offsets, and notes with the joints whose effort scale or
        position offset is not identifiable from the recording.

    Raises:
        RecordingError: The recording does not match the arm, or is a motion that is too short or sampled too coarsely.
    """
    arm = observations.arm
    if not observations.recording.motion(arm):
        poses = _usable_poses(observations.recording, arm)
        if len(poses) < MIN_POSES:
            return []
        fit = ChannelFit(Observations(poses, arm))
        found = _best_hypothesis([[*_hypotheses(fit), *_scales_at_rest(fit)]], at_rest=True)
        # The spring torque of a cable may exceed the gravity torque of a light wrist. The effort then opposes gravity.
        return [replace(f, severity="warning") if f.kind == "effort sign" else f for f in found]
    hypotheses, scales_and_offsets = [], []
    for segment in segments_of(observations.longest):
        if segment.recording.motion(arm):
            fit = ChannelFit(segment)
            hypotheses.append(list(_hypotheses(fit)))
            if not _best_hypothesis(hypotheses[-1:]):
                scales_and_offsets.append((_scales(fit), _offsets(fit)))
    return _best_hypothesis(hypotheses) or _merge_segments(scales_and_offsets, len(hypotheses), arm)


def segments_of(observations: Observations) -> list[Observations]:
    """Returns at most `MAX_SEGMENTS` equal segments of a motion, each at most `MAX_SEGMENT_DURATION` long."""
    recording = observations.recording
    t = recording.t
    if t is None or t[-1] - t[0] <= MAX_SEGMENT_DURATION:
        return [observations]
    edges = np.linspace(t[0], t[-1], int(np.ceil((t[-1] - t[0]) / MAX_SEGMENT_DURATION)) + 1)
    segments = np.split(np.arange(len(t)), np.searchsorted(t, edges[1:-1]))
    chosen = np.unique(np.linspace(0, len(segments) - 1, min(len(segments), MAX_SEGMENTS)).round().astype(int))
    return [Observations(recording.select(segments[k]), observations.arm) for k in chosen]


def _hypotheses(fit: ChannelFit) -> Iterator[Finding]:
    """Yields the hypotheses of exchanged and inverted channels.

    The `size` of each finding is its gain in log-likelihood.
    """
    arm, used = fit.arm, [int(i) for i in fit.used]
    unit = np.eye(arm.num_joints)
    for i, j in combinations(sorted([*used, *map(int, fit.resting)]), 2):
        # The efforts of two actuators at rest are constants in both orders.
        if i in used or j in used:
            yield _exchange(arm, (i, j), f"tau{i + 1} and tau{j + 1}", fit.gain(_exchanged(unit, i, j)))
    for i, j in combinations(used, 2):
        which = f"all signals (q, qd, tau) of channels {i + 1} and {j + 1}"
        yield _exchange(arm, (i, j), which, _gain_of_channels(_exchanged(unit, i, j), fit))
    if len(used) == arm.num_joints > 2:
        channels = tuple(used)
        yield _exchange(arm, channels, "the columns tau are in reverse order: they", fit.gain(unit[::-1]))
        which = "all columns (q, qd, tau) are in reverse order: they"
        yield _exchange(arm, channels, which, _gain_of_channels(unit[::-1], fit))
    what = "all efforts have the wrong sign. The arm model fits much better with opposite signs"
    advice = "Efforts must be positive in the direction of positive motion. Correct the signs and check the file again."
    yield Finding("refusal", "effort sign", arm.name, what, advice, tuple(used), fit.gain(-unit))
    for i in used:
        gain = fit.gain(unit - 2 * np.diag(unit[i]))
        what = f"tau{i + 1} or q{i + 1} has the wrong sign. The arm model fits much better with the opposite sign"
        advice = f"Efforts must be positive in the direction of +q{i + 1}. Correct the sign and check the file again."
        yield Finding("refusal", "effort sign", arm.joint_names[i], what, advice, (i,), gain)
    for i in used if fit.moves else ():
        gain = _gain_of_channels(unit - 2 * np.diag(unit[i]), fit)
        what = (
            f"all signals (q, qd, tau) of channel {i + 1} have the wrong sign. The arm model fits much better with "
            "opposite signs"
        )
        advice = "Correct the columns of the file and check it again."
        yield Finding("refusal", "inverted channel", arm.joint_names[i], what, advice, (i,), gain)


def _exchanged(unit: NDArray[np.float64], i: int, j: int) -> NDArray[np.float64]:
    """Returns the matrix (n, n) that exchanges two of n channels."""
    order = np.arange(len(unit))
    order[[i, j]] = j, i
    return unit[order]


def _exchange(arm: Arm, channels: tuple[int, ...], which: str, gain: float) -> Finding:
    names = " and ".join(arm.joint_names[k] for k in channels)
    what = f"{which} are exchanged. The arm model fits the recording much better if they are swapped"
    advice = "Correct the columns of the file and check it again."
    return Finding("refusal", "exchanged channels", names, what, advice, channels, gain)


def _gain_of_channels(transform: NDArray[np.float64], fit: ChannelFit) -> float:
    """Returns the gain in log-likelihood if a matrix (n, n) is applied to all signals of the channels.

    It is -inf if the positions are then beyond the joint limits.
    """
    recording, arm = fit.recording, fit.arm
    q, tau = recording.q @ transform.T, recording.measured_effort() @ transform.T
    other = replace(recording, q=q, qd=None if recording.qd is None else recording.qd @ transform.T, tau=tau)
    allowed = _limit_excess(recording, arm) + arm.per_limit(*LIMIT_MARGIN)
    return _gain_of(other, fit) if np.all(_limit_excess(other, arm) <= allowed) else -np.inf


def _limit_excess(recording: Recording, arm: Arm) -> NDArray[np.float64]:
    """Returns the largest excess (l,) beyond each joint limit and coupled limit [rad, m], 0 if no row exceeds it."""
    A, lower, upper = arm.limit_matrix()
    values = recording.in_joint_coordinates(arm).q @ A.T
    return np.asarray(np.max(np.maximum(np.maximum(lower - values, values - upper), 0.0), axis=0))


def _best_hypothesis(segments: list[list[Finding]], *, at_rest: bool = False) -> list[Finding]:
    """Returns the hypothesis with the largest mean gain over all segments, or an empty list if no gain is sufficient.

    The advice lists hypotheses with a similar gain.
    """
    groups: dict[tuple, list[Finding]] = {}
    for finding in chain(*segments):
        groups.setdefault((finding.kind, finding.joints, finding.what), []).append(finding)
    min_gains = {"exchanged channels": MIN_GAIN_AT_REST if at_rest else MIN_GAIN, "inverted channel": MIN_MIRROR_GAIN}
    min_effort_gain = MIN_EFFORT_GAIN_AT_REST if at_rest else MIN_GAIN
    # A hypothesis that a segment cannot test has a gain of 0 in this segment.
    means = [
        replace(group[0], size=sum(finding.size for finding in group) / len(segments)) for group in groups.values()
    ]
    means = sorted(means, key=lambda finding: -finding.size)
    best = next((finding for finding in means if finding.size > min_gains.get(finding.kind, min_effort_gain)), None)
    if best is None:
        return []
    similar = [f for f in means if f is not best and f.size > max(best.size - SIMILAR_GAIN, 0.0)]
    if not similar:
        return [best]
    alternatives = ", ".join(finding.what.partition(". ")[0] for finding in similar)
    return [replace(best, advice=f"{best.advice} Similarly likely: {alternatives}.")]


#: Findings of one segment, and indices of the joints that its note lists.
_WithNote = tuple[list[Finding], set[int]]


def _merge_segments(segments: list[tuple[_WithNote, _WithNote]], count: int, arm: Arm) -> list[Finding]:
    """Returns the warnings that occur in at least half of all segments, and notes on scales and offsets.

    The note on offsets lists the joints whose offset is not identifiable in any segment.

    Args:
        segments: Results of `_scales` and `_offsets` for each segment without exchanged or inverted channels.
        count: Number of all segments.
        arm: Arm that was recorded.
    """
    found: dict[tuple, list[Finding]] = {}
    for finding in chain(*(warnings for segment in segments for warnings, _ in segment)):
        found.setdefault((finding.kind, finding.joints[0]), []).append(finding)
    uncertain = set().union(*(joints for (_, joints), _ in segments))
    uncertain -= {joint for kind, joint in found if kind == "effort scale"}
    undetectable = set.intersection(*(joints for _, (_, joints) in segments)) if len(segments) == count > 0 else set()
    return [
        *(group[0] for group in found.values() if 2 * len(group) >= count),
        *_notes(arm, sorted(uncertain), sorted(undetectable)),
    ]


def _notes(arm: Arm, uncertain: list[int], undetectable: list[int]) -> Iterator[Finding]:
    """Yields notes on joints with an uncertain effort scale, and on joints with an undetectable position offset."""
    if uncertain:
        what = "the friction differs from the arm file, so an effort scale of 0.5 or 2 cannot be excluded"
        advice = (
            "Usual cause: friction varies from day to day. Check the torque constants if earlier recordings did not "
            "have this note."
        )
        names = ", ".join(arm.joint_names[i] for i in uncertain)
        yield Finding("note", "uncertain effort scale", names, what, advice, tuple(uncertain))
    if undetectable:
        angle, length = OFFSET_DEVIATION
        what = f"position offsets of {angle} rad ({length} m) cannot be detected in this recording"
        advice = (
            "Such offsets have the same effect as different centres of mass of the links. Check the encoder offsets."
        )
        names = ", ".join(arm.joint_names[i] for i in undetectable)
        yield Finding("note", "undetectable offset", names, what, advice, tuple(undetectable))


def _usable_poses(recording: Recording, arm: Arm) -> Recording:
    """Returns the distinct poses in joint coordinates, without poses at a joint stop.

    Efforts beyond a limit are kept because they may belong to another joint.
    """
    poses = average_repeated_poses(recording.in_joint_coordinates(arm), arm)
    at_stop = [measurement.row for measurement in find_excluded(replace(poses, tau=np.zeros_like(poses.q)), arm)]
    usable = np.setdiff1d(np.arange(len(poses)), at_stop)
    return replace(poses, q=poses.q[usable], tau=poses.measured_effort()[usable], qd=None, t=None, lines=None)


def _gain_of(other: Recording, fit: ChannelFit) -> float:
    """Returns the gain in log-likelihood of a recording with exchanged, inverted or shifted channels.

    If the recording is in actuator coordinates, the true times of the rows are those of `fit`.
    """
    is_motion_of_actuators = fit.moves and fit.recording.coordinates == "actuator"
    clocks = fit.observations.clocks if is_motion_of_actuators else None
    return ChannelFit(Observations(other, fit.arm, clocks=clocks)).log_likelihood - fit.log_likelihood


def _scales(fit: ChannelFit) -> _WithNote:
    """Returns warnings for actuators whose effort has a wrong scale.

    The scale is estimated from the dissipated friction power, or from a fit if the arm file states no friction. The
    second result contains the other actuators for which a scale of 0.5 or 2 cannot be excluded.
    """
    power, allowed = fit.dissipation(), _friction_factors(fit)
    warnings, uncertain = list[Finding](), set[int]()
    for i in map(int, fit.used):
        name, ratio = fit.arm.joint_names[i], float(power[i])
        advice = f"Check the scale of tau{i + 1} (torque constant, gear ratio, unit) and the condition of the drive."
        if ratio <= 0:
            what = "the actuator effort contains no friction that opposes the motion"
            advice = f"Check that tau{i + 1} and the positions were recorded in the same motion."
        elif ratio > 0:
            if 1 / allowed[i] < ratio < allowed[i]:
                if not SCALES[0] * allowed[i] < ratio < SCALES[1] / allowed[i]:
                    uncertain.add(i)
                continue
            what = f"the actuator friction dissipates {ratio:.2g} times the power expected from the arm file"
        else:
            scale, gain = (1.0, 0.0) if has_converted_model(fit.arm) else _best_scale(fit, i)
            if gain < MIN_GAIN:
                continue
            ratio = 1 / scale
            what = f"the actuator effort is about {ratio:g} times the effort expected from the arm model"
        warnings.append(Finding("warning", "effort scale", name, what, advice, (i,), ratio))
    return warnings, uncertain


def _scales_at_rest(fit: ChannelFit) -> Iterator[Finding]:
    """Yields the most likely wrong effort scale of each actuator, for poses at rest.

    The `size` of each finding is its gain in log-likelihood.
    """
    for i in map(int, fit.used):
        scale, gain = _best_scale(fit, i)
        what = f"tau{i + 1} is about {1 / scale:g} times the effort expected from gravity"
        advice = f"Check the scale of tau{i + 1} (torque constant, gear ratio, unit)."
        yield Finding("warning", "effort scale", fit.arm.joint_names[i], what, advice, (i,), gain)


def _best_scale(fit: ChannelFit, channel: int) -> tuple[float, float]:
    """Returns the scale from `SCALES` with the largest gain in log-likelihood for an effort, and this gain."""
    unit = np.eye(fit.arm.num_joints)
    gains = {s: fit.gain(unit + (s - 1) * np.diag(unit[channel])) for s in SCALES}
    return max(gains.items(), key=lambda item: item[1])


def _friction_factors(fit: ChannelFit) -> NDArray[np.float64]:
    """Returns the largest accepted ratio (n,) of dissipated to expected friction power for each actuator.

    The ratio is `FRICTION_FACTOR`. For a recording in joint coordinates, it is multiplied by the gear ratio of an
    actuator that moves only one joint. Reason: the friction in the PSM's arm file was identified from a recording whose
    roll position may be that of the instrument disc or that of the joint.
    """
    if fit.recording.coordinates == "actuator":
        return np.full(fit.arm.num_joints, FRICTION_FACTOR)
    J = fit.arm.transmission.matrix
    gear = np.where(np.count_nonzero(J, axis=1) == 1, np.abs(np.diag(J)), 1.0)
    return FRICTION_FACTOR * np.maximum(gear, 1 / gear)


def _offsets(fit: ChannelFit) -> _WithNote:
    """Returns a warning for the most likely position offset, and the joints whose offset is not identifiable.

    Offsets of joints with parallel axes have similar effects, so the warning also lists the other possible joints.
    """
    arm, undetectable, found = fit.arm, set[int](), {}
    min_offset, max_undetected = arm.per_joint(*MIN_OFFSET), arm.per_joint(*OFFSET_DEVIATION)
    for i in range(arm.num_joints):
        offset, error = fit.position_offset(i)
        if OFFSET_ERRORS * error > max_undetected[i]:
            undetectable.add(i)
        elif abs(offset) > max(min_offset[i], OFFSET_ERRORS * error):
            found[i] = (offset, error)
    if not found:
        return [], undetectable
    shifts = {i: offset * np.eye(arm.num_joints)[i] for i, (offset, _) in found.items()}
    gains = {i: _gain_of(replace(fit.recording, q=fit.recording.q - shift), fit) for i, shift in shifts.items()}
    first, *others = sorted(found, key=lambda i: -gains[i])
    sizes = {i: f"{offset:+.2g} {'m' if arm.prismatic[i] else 'rad'}" for i, (offset, _) in found.items()}
    unit = "m" if arm.prismatic[first] else "rad"
    what = f"q{first + 1} has an offset of about {sizes[first]} (standard error {found[first][1]:.2g} {unit})"
    if others:
        what += f". Less likely: {', '.join(f'q{i + 1} has an offset of {sizes[i]}' for i in others)}"
    joints, name = (first, *others), arm.joint_names[first]
    warning = Finding("warning", "position offset", name, what, "Check the encoder offset.", joints, found[first][0])
    return [warning], undetectable
