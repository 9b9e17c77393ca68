"""Checks the channels of a recording: refits it with channels exchanged, inverted, scaled or shifted."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.analysis.check.channel_fit import ChannelFit
from dvrk_drake.analysis.check.report import Finding
from dvrk_drake.analysis.static.doubts import find_doubts
from dvrk_drake.analysis.static.static_identification import LEAST_POSES, average_repeated_poses
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.recording import Recording

#: A hypothesis is accepted if it raises the log-likelihood by this much. On the public motions as recorded no exchange
#: gains anything; on damaged ones the right one gains 25 or more, in most cases hundreds.
SURE = 20.0
#: Multiples of the recorded effort that are tried.
SCALES = (0.35, 0.5, 2.0, 2.8)
#: Friction dissipates the power that the arm's file states within this factor. The public recordings of one PSM on two
#: days lie between 0.96 and 1.54.
FRICTION_FACTOR = 1.7
#: A position offset is reported from this size on [rad], [m], and from this number of standard errors on.
LEAST_OFFSET, OFFSET_ERRORS = (0.06, 0.006), 3.3
#: The zero of a joint is judged only if an offset of this size would be significant [rad], [m].
TOLERATED_OFFSET = 0.1, 0.01
#: Exchanged channels may exceed the arm's limits by this much more than the recorded ones [rad], [m].
LIMIT_MARGIN = 0.02, 0.002


def check_channels(recording: Recording, arm: Arm) -> list[Finding]:
    """Refits a recording under hypotheses about its channels and reports the ones that fit clearly better.

    The hypotheses are: the efforts of two channels are exchanged; all signals of two channels are exchanged; the effort
    of a channel is inverted; the effort of an actuator is a multiple of the true one; the position of a channel has an
    offset. Each is a maximum-a-posteriori fit of `ChannelFit`, compared by its log-likelihood. A wrong scale also shows
    in the power that friction dissipates. Of poses at rest only exchanges are tried: friction and stops hide the rest.

    Args:
        recording: a motion, or poses at rest, with efforts, in either coordinates; channels are those of its columns.
        arm: the arm that was recorded.

    Returns:
        One refusal for exchanged or inverted channels; otherwise warnings for scales and offsets, and a note that names
        the joints whose position offset the recording cannot show.

    Raises:
        RecordingError: the recording does not fit the arm, or is a motion that is too short or too coarse.
    """
    if not recording.motion(arm):
        recording = _poses_in_order(recording, arm)
        if len(recording) < LEAST_POSES:
            return []
    fit = ChannelFit(recording, arm)
    findings = [*_effort_exchanges(fit), *_full_exchanges(fit), *_inversions(fit)]
    best = max(findings, key=lambda finding: finding.size, default=None)
    if best is not None and best.size > SURE:
        # At a stop, efforts of poses look inverted.
        return [best] if fit.moves or best.kind == "exchanged channels" else []
    return [*_scales(fit), *_offsets(fit)] if fit.moves else []


def _poses_in_order(recording: Recording, arm: Arm) -> Recording:
    """The distinct poses, in joint coordinates, that do not press on a stop or exceed an effort limit."""
    poses = average_repeated_poses(recording.in_joint_coordinates(arm), arm)
    in_order = np.setdiff1d(np.arange(len(poses)), [doubt.row for doubt in find_doubts(poses, arm)])
    return replace(poses, q=poses.q[in_order], tau=poses.measured_effort()[in_order], qd=None, t=None, lines=None)


def _effort_exchanges(fit: ChannelFit) -> Iterator[Finding]:
    for i, j in combinations(map(int, fit.used), 2):
        order = _exchanged(fit.arm.num_joints, i, j)
        gain = fit.gain(fit.in_actuators(np.eye(fit.arm.num_joints)[order]))
        yield _exchange(fit.arm, (i, j), f"tau{i + 1} and tau{j + 1}", gain)


def _full_exchanges(fit: ChannelFit) -> Iterator[Finding]:
    """Exchanges of all signals of two channels that keep the arm within its limits."""
    recording, arm = fit.recording, fit.arm
    margin = np.append(arm.per_joint(*LIMIT_MARGIN), np.full(len(arm.coupled_limits), LIMIT_MARGIN[0]))
    allowed = _limit_excess(recording, arm) + margin
    for i, j in combinations(map(int, fit.used), 2):
        order = _exchanged(arm.num_joints, i, j)
        qd = None if recording.qd is None else recording.qd[:, order]
        other = replace(recording, q=recording.q[:, order], qd=qd, tau=recording.measured_effort()[:, order])
        if np.all(_limit_excess(other, arm) <= allowed):
            gain = ChannelFit(other, arm).log_likelihood - fit.log_likelihood
            yield _exchange(arm, (i, j), f"all signals of channels {i + 1} and {j + 1}", gain)


def _exchanged(n: int, i: int, j: int) -> NDArray[np.int_]:
    order = np.arange(n)
    order[[i, j]] = j, i
    return order


def _limit_excess(recording: Recording, arm: Arm) -> NDArray[np.float64]:
    """Largest excess of each limit of the joints [rad, m], 0 where there is none."""
    A, lower, upper = arm.limit_matrix()
    values = recording.in_joint_coordinates(arm).q @ A.T
    return np.asarray(np.max(np.maximum(np.maximum(lower - values, values - upper), 0.0), axis=0))


def _exchange(arm: Arm, channels: tuple[int, ...], which: str, gain: float) -> Finding:
    names = " and ".join(arm.joint_names[k] for k in channels)
    what = f"{which} are exchanged: the arm's equations fit the recording far better with them exchanged back"
    return Finding("refusal", "exchanged channels", names, what, "correct the columns of the file", channels, gain)


def _inversions(fit: ChannelFit) -> Iterator[Finding]:
    for i in map(int, fit.used):
        name = fit.arm.joint_names[i]
        signs = np.where(np.arange(fit.arm.num_joints) == i, -1.0, 1.0)
        gain = fit.gain(fit.in_actuators(np.diag(signs)))
        what = f"tau{i + 1} has the wrong sign: the arm's equations fit the recording far better with the other one"
        advice = f"efforts are positive towards +q{i + 1}"
        yield Finding("refusal", "effort sign", name, what, advice, (i,), gain)


def _scales(fit: ChannelFit) -> Iterator[Finding]:
    """Efforts of actuators at a wrong scale, by the fit or by the power that friction dissipates."""
    power = fit.dissipation()
    for i in map(int, fit.used):
        name = fit.arm.joint_names[i]
        ratio = float(power[i]) if np.isfinite(power[i]) else 1.0
        # A scale that makes friction implausible is not the cause of a better fit: the file's inertia is wrong instead.
        scales = [s for s in SCALES if 1 / FRICTION_FACTOR < ratio * s < FRICTION_FACTOR]
        n = fit.arm.num_joints
        gains = [fit.gain(np.diag(np.where(np.arange(n) == i, scale, 1.0))) for scale in scales]
        if gains and max(gains) > SURE:
            size = 1 / scales[int(np.argmax(gains))]
            what = f"effort of its actuator is about {size:.1g} times what the arm's inertia and friction need"
        elif not 1 / FRICTION_FACTOR < ratio < FRICTION_FACTOR:
            size = ratio
            what = f"friction of its actuator dissipates {size:.2g} times the power that the arm's file states"
        else:
            continue
        advice = f"check the scale of tau{i + 1} (torque constant, gear ratio, unit) and the condition of the drive"
        yield Finding("warning", "effort scale", name, what, advice, (i,), size)


def _offsets(fit: ChannelFit) -> Iterator[Finding]:
    """Position offsets of the joints whose zero the recording shows; a note names the other joints."""
    arm, hidden = fit.arm, []
    least, tolerated = arm.per_joint(*LEAST_OFFSET), arm.per_joint(*TOLERATED_OFFSET)
    for i, name in enumerate(arm.joint_names):
        offset, error = fit.position_offset(i)
        if OFFSET_ERRORS * error > tolerated[i]:
            hidden.append(name)
        elif abs(offset) > max(least[i], OFFSET_ERRORS * error):
            unit = "m" if arm.prismatic[i] else "rad"
            what = f"q{i + 1} has an offset of about {offset:+.2f} {unit} (standard error {error:.2g})"
            yield Finding("warning", "position offset", name, what, "check the zero of its encoder", (i,), offset)
    if hidden:
        what = f"an offset of {TOLERATED_OFFSET[0]} rad ({TOLERATED_OFFSET[1]} m) in their positions would not show"
        advice = "this recording cannot tell it from the links' centres of mass; check the zeros of these encoders"
        yield Finding("note", "undetectable offset", ", ".join(hidden), what, advice)
