"""Extracts static poses from a motion, and averages repeated poses."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.analysis.observations.excluded_measurements import check_effort_unit
from dvrk_drake.analysis.observations.low_pass import low_pass
from dvrk_drake.analysis.observations.true_time import CUT_OFF, ORDER
from dvrk_drake.errors import IdentificationError
from dvrk_drake.models.arm import Arm
from dvrk_drake.recordings.recording import MAX_PERIOD, REST_SPEED, SAME_POSE, Recording

#: Smallest number of distinct poses for an identification. The efforts of seven joints are then more than three times
#: as many as the 12 to 15 base parameters of an MTM or a PSM.
MIN_POSES = 8
#: Largest speed of each joint [rad/s], [m/s] and smallest duration [s] of a static segment. Half or twice these values
#: changes no finding on the public recordings.
MAX_REST_SPEED, MIN_REST = (0.02, 0.002), 0.3


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
    runs = list(stationary_runs(still, moving.q, arm.per_joint(*SAME_POSE), min_rows))
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


def usable_poses(recording: Recording, arm: Arm, averaged: bool = True) -> Recording:
    """Returns the poses of a recording in joint coordinates. Repeated poses are averaged if `averaged` is True.

    Raises:
        RecordingError: The recording does not match the arm or has no efforts.
        IdentificationError: There are too few poses, or the recording is a motion.
    """
    recording.check_fits(arm)
    recording, source = recording.in_joint_coordinates(arm), recording.source or "recording"
    if motion := recording.motion(arm):
        raise IdentificationError(
            f"{source}: the arm moves ({motion}). Static identification requires poses at rest (below "
            f"{REST_SPEED[0]} rad/s)."
        )
    if averaged:
        recording = average_repeated_poses(recording, arm)
    recording.measured_effort()
    if len(recording) < MIN_POSES:
        raise IdentificationError(
            f"{source}: {len(recording)} distinct pose{'s' * (len(recording) != 1)} found. Identification requires at "
            f"least {MIN_POSES}. Record 40 or more poses that cover the range of the arm."
        )
    check_effort_unit(recording, arm)
    return recording


def average_repeated_poses(recording: Recording, arm: Arm) -> Recording:
    """Averages the rows of each repeated pose. Rows are the same pose if all joints agree within `SAME_POSE`."""
    tolerance = arm.per_joint(*SAME_POSE)
    groups: list[list[int]] = []
    for row, q in enumerate(recording.q):
        group = next((g for g in groups if np.all(np.abs(recording.q[g[0]] - q) < tolerance)), None)
        if group is None:
            groups.append([row])
        else:
            group.append(row)
    if len(groups) == len(recording):
        return recording
    first = [group[0] for group in groups]
    return replace(
        recording,
        q=np.array([recording.q[g].mean(axis=0) for g in groups]),
        tau=np.array([recording.measured_effort()[g].mean(axis=0) for g in groups]),
        qd=None,
        t=None,
        lines=None if recording.lines is None else recording.lines[first],
    )
