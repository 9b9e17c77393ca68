"""Extracts static poses or low-speed segments from a motion."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.analysis.observations.low_pass import low_pass
from dvrk_drake.analysis.static.static_identification import average_repeated_poses
from dvrk_drake.errors import IdentificationError
from dvrk_drake.models.arm import Arm
from dvrk_drake.recordings.recording import MAX_PERIOD, MIN_ROWS, Recording

#: Cut-off of the zero-phase low-pass filter for velocities [Hz], and its order.
CUT_OFF, ORDER = 10.0, 4
#: Limits of a static segment: largest speed of each joint [rad/s], [m/s], smallest duration [s], and largest distance
#: of each joint from the start of the segment [rad], [m].
MAX_REST_SPEED, MIN_REST, SAME_REST = (0.02, 0.002), 0.3, (0.01, 0.001)


def static_poses(recording: Recording, arm: Arm) -> Recording | None:
    """Extracts the static poses of a motion, at which the arm is at rest for at least `MIN_REST` seconds.

    Each static segment is averaged over its second half. Segments at the same pose are averaged. A gap in the times
    ends a segment, because the motion in the gap is unknown.

    Args:
        recording: Motion with efforts. If it has no qd, the positions are differentiated.
        arm: Arm that was recorded.

    Returns:
        Recording with one row per static pose, in joint coordinates and without times. This result may have no rows. It
        is None if `recording` is not a motion (`Recording.is_motion`), or its times do not increase.

    Raises:
        RecordingError: The recording has no efforts, or belongs to another arm.
    """
    moving = recording.in_joint_coordinates(arm)
    t = moving.t
    if t is None or not (moving.is_motion and moving.has_increasing_times):
        return None
    tau = moving.measured_effort()
    v = smooth_velocity(moving)
    still = np.all(np.abs(v) < arm.per_joint(*MAX_REST_SPEED), axis=1)
    still &= np.diff(t, append=t[-1]) < MAX_PERIOD
    min_rows = round(MIN_REST / float(np.median(np.diff(t))))
    runs = list(stationary_runs(still, moving.q, arm.per_joint(*SAME_REST), min_rows))
    second_halves = [run[len(run) // 2 :] for run in runs]
    poses = replace(
        moving,
        q=np.array([moving.q[rows].mean(axis=0) for rows in second_halves]).reshape(-1, arm.num_joints),
        tau=np.array([tau[rows].mean(axis=0) for rows in second_halves]).reshape(-1, arm.num_joints),
        qd=None,
        t=None,
        lines=None if moving.lines is None else moving.lines[[rows[0] for rows in second_halves]],
    )
    return average_repeated_poses(poses, arm)


def smooth_velocity(recording: Recording) -> NDArray[np.float64]:
    """Returns the velocities (m, n) of a motion after a zero-phase low-pass filter [rad/s, m/s]."""
    t = np.asarray(recording.t)
    qd = np.gradient(recording.q, t, axis=0) if recording.qd is None else recording.qd
    rate = 1 / float(np.median(np.diff(t)))
    return low_pass(qd, rate, CUT_OFF, ORDER)


def stationary_runs(
    still: NDArray[np.bool_], q: NDArray[np.float64], max_distance: NDArray[np.float64], min_rows: int
) -> Iterator[NDArray[np.int_]]:
    """Yields the row indices of each segment with low speed.

    A segment ends before the first row at which the distance of q from the start of the segment exceeds `max_distance`.
    The next segment begins at this row.

    Args:
        still: Mask (m,) of the rows with low speed.
        q: Positions (m, n) [rad, m].
        max_distance: Largest distance (n,) of q from the start of a segment [rad, m].
        min_rows: Smallest number of rows of a segment.
    """
    edges = np.flatnonzero(np.diff(np.concatenate([[False], still, [False]]).astype(int)))
    for first, end in edges.reshape(-1, 2):
        start = first
        while end - start >= min_rows:
            outside = np.any(np.abs(q[start:end] - q[start]) > max_distance, axis=1)
            stop = start + int(np.argmax(outside)) if np.any(outside) else end
            if stop - start >= min_rows:
                yield np.arange(start, stop)
            start = stop


#: Largest speed and acceleration in a low-speed segment, as shares of the joint's 99 % quantiles of speed and
#: acceleration.
SLOW_SPEED, SLOW_ACCELERATION = 0.1, 0.2
#: Largest duration of a block of averaged rows [s]. Rows are averaged only if a block contains at least two rows.
MIN_PERIOD = 0.005
#: Smallest number of rows of a low-speed segment.
MIN_SAMPLES = 3
#: Largest distance of each joint from the start of a low-speed segment [rad], [m]. Segments whose mean poses agree
#: within this distance are repetitions.
SAME_SEGMENT = 0.05, 0.005


class LowSpeedSegments(NamedTuple):
    """Low-speed segments of a motion.

    Attributes:
        recording: Mean poses and efforts of the segments, one row each, in joint coordinates and without times.
        measured: Mask (m, n) of the efforts that are holding torques: in each row, the effort of the slow joint.
    """

    recording: Recording
    measured: NDArray[np.bool_]


def low_speed_segments(recording: Recording, arm: Arm) -> LowSpeedSegments:
    """Extracts the low-speed segments of each joint as static poses, and averages repetitions.

    The efforts contain two errors: inertial efforts due to the motion of other joints, and dry friction of either sign.
    A dynamic identification or static poses of the whole arm (`static_poses`) give a more accurate model.

    Raises:
        RecordingError: The recording has no efforts, or belongs to another arm.
        IdentificationError: The recording has no times or velocities, or no low-speed segments.
    """
    moving = recording.in_joint_coordinates(arm)
    moving.measured_effort()
    where = recording.source or "recording"
    if moving.qd is None or not (moving.is_motion and moving.has_increasing_times):
        raise IdentificationError(
            f"{where}: the recording has no low-speed segments, because it is not a motion with velocities. Required: "
            f"columns qd1..qd{arm.num_joints}, times t that increase by less than {MAX_PERIOD} s, and at least "
            f"{MIN_ROWS} rows."
        )
    moving = _downsampled(moving)
    tau, t = moving.measured_effort(), np.asarray(moving.t)
    v = smooth_velocity(moving)
    vd = np.gradient(v, t, axis=0)
    # The 99 % quantile is robust to spikes, unlike the maximum.
    is_slow = np.abs(v) < SLOW_SPEED * np.quantile(np.abs(v), 0.99, axis=0)
    is_slow &= np.diff(t, append=t[-1])[:, None] < MAX_PERIOD
    is_slow &= np.abs(vd) < SLOW_ACCELERATION * np.quantile(np.abs(vd), 0.99, axis=0)
    segments = [(j, rows) for j in range(arm.num_joints) for rows in _segments_of(is_slow[:, j], j, moving, arm)]
    # In the order of time, successive segments are neighbours, as in a recording of poses.
    segments.sort(key=lambda segment: int(segment[1][0]))
    if not segments:
        raise IdentificationError(
            f"{where}: the motion has no low-speed segments (below {100 * SLOW_SPEED:.0f} % of the largest speed and "
            f"{100 * SLOW_ACCELERATION:.0f} % of the largest acceleration of a joint). Record poses at rest."
        )
    measured = np.zeros((len(segments), arm.num_joints), dtype=bool)
    measured[range(len(segments)), [joint for joint, _ in segments]] = True
    means = replace(
        moving,
        q=np.array([moving.q[rows].mean(axis=0) for _, rows in segments]),
        tau=np.array([tau[rows].mean(axis=0) for _, rows in segments]),
        qd=None,
        t=None,
        lines=None if moving.lines is None else moving.lines[[rows[0] for _, rows in segments]],
    )
    return LowSpeedSegments(means, measured)


def _downsampled(recording: Recording) -> Recording:
    """Averages blocks of rows to reduce their number. A block is much shorter than 1 / `CUT_OFF`."""
    t, qd, tau = recording.t, recording.qd, recording.measured_effort()
    if t is None or qd is None:
        return recording
    size = int(MIN_PERIOD / float(np.median(np.diff(t))) + 1e-6)
    if size < 2:
        return recording
    blocks = len(t) // size

    def mean(values: NDArray[np.float64]) -> NDArray[np.float64]:
        return values[: blocks * size].reshape(blocks, size, *values.shape[1:]).mean(axis=1)

    lines = None if recording.lines is None else recording.lines[: blocks * size : size]
    return replace(recording, q=mean(recording.q), qd=mean(qd), tau=mean(tau), t=mean(t), lines=lines)


def _longest_of_each_pass(runs: Iterable[NDArray[np.int_]]) -> Iterator[NDArray[np.int_]]:
    """Yields the longest run of rows of each series of adjacent runs.

    The friction is the same in all runs of a series. These runs are not independent, so only one of them is used.
    """
    longest: NDArray[np.int_] | None = None
    last = -2
    for run in runs:
        if longest is not None and run[0] != last + 1:
            yield longest
            longest = None
        if longest is None or len(run) > len(longest):
            longest = run
        last = int(run[-1])
    if longest is not None:
        yield longest


def _segments_of(is_slow: NDArray[np.bool_], joint: int, moving: Recording, arm: Arm) -> list[NDArray[np.int_]]:
    """Returns the rows of each low-speed segment of one joint. Repetitions of a segment are merged.

    In each segment, all joints stay within `SAME_SEGMENT` of their positions at the start.
    """
    max_distance = arm.per_joint(*SAME_SEGMENT)
    segments: list[NDArray[np.int_]] = []
    means = np.empty((0, arm.num_joints))
    for run in _longest_of_each_pass(stationary_runs(is_slow, moving.q, max_distance, MIN_SAMPLES)):
        q = moving.q[run].mean(axis=0)
        repetitions = np.flatnonzero(np.all(np.abs(means - q) < max_distance, axis=1))
        if len(repetitions):
            k = repetitions[0]
            segments[k] = np.concatenate([segments[k], run])
            means[k] = moving.q[segments[k]].mean(axis=0)
        else:
            segments.append(run)
            means = np.vstack([means, q])
    return segments
