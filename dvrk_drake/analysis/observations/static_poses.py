"""Extracts static poses from a motion, averages repeated poses, and finds the measurements to exclude from a fit."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.analysis.observations.signals import low_pass
from dvrk_drake.analysis.observations.true_time import CUT_OFF, ORDER
from dvrk_drake.errors import IdentificationError, RecordingError
from dvrk_drake.models.arm import Arm
from dvrk_drake.recordings.recording import MAX_PERIOD, REST_SPEED, SAME_POSE, Recording


@dataclass(frozen=True)
class ExcludedMeasurement:
    """Excluded efforts of one pose.

    Attributes:
        row: Index of the row in the recording, starting at 0.
        joints: Indices of the joints whose efforts are excluded, starting at 0.
        where: File and line of the pose.
        reason: Reason for the exclusion.
    """

    row: int
    joints: tuple[int, ...]
    where: str
    reason: str


def find_excluded(recording: Recording, arm: Arm) -> list[ExcludedMeasurement]:
    """Returns the measurements to exclude before any fit: poses at a joint stop and efforts beyond their limit.

    A joint stop supports part of the load. The torques of the joints at the stop are therefore not holding torques.

    Args:
        recording: Recording in joint coordinates, with efforts.
        arm: Arm whose limits are used.
    """
    excluded = []
    A, lower, upper = arm.limit_matrix()
    names = [*arm.joint_names, *(limit.name for limit in arm.coupled_limits)]
    values = recording.q @ A.T
    # A pose that is the same as one at the limit may be at the stop.
    # A coupled limit has no margin, because its value is the position at first contact with a soft stop.
    margin = np.concatenate([arm.per_joint(*SAME_POSE), np.zeros(len(arm.coupled_limits))])
    at_stop = (values < lower + margin) | (values > upper - margin)
    for row, limit in np.argwhere(at_stop):
        joints = tuple(int(j) for j in np.flatnonzero(A[limit]))
        stop = lower[limit] if values[row, limit] < (lower[limit] + upper[limit]) / 2 else upper[limit]
        unit = "m" if limit < arm.num_joints and arm.prismatic[limit] else "rad"
        reason = f"{names[limit]} at {values[row, limit]:.3f} {unit} is at its stop ({stop:.3f} {unit})"
        excluded.append(ExcludedMeasurement(int(row), joints, recording.where(int(row)), reason))
    tau = recording.measured_effort()
    usable = usable_measurements(tau.shape, excluded)
    for row, joint in np.argwhere((np.abs(tau) > arm.effort_limits) & usable):
        unit = _effort_unit(arm, joint)
        reason = (
            f"{arm.joint_names[joint]} effort {tau[row, joint]:.3g} {unit} exceeds its limit of "
            f"{arm.effort_limits[joint]:.3g} {unit}"
        )
        excluded.append(ExcludedMeasurement(int(row), (int(joint),), recording.where(int(row)), reason))
    order = np.arange(len(recording)) if recording.lines is None else recording.lines
    return sorted(excluded, key=lambda measurement: order[measurement.row])


def check_effort_unit(recording: Recording, arm: Arm) -> None:
    """Rejects a recording whose efforts are probably in a wrong unit.

    Raises:
        RecordingError: The median absolute effort of a joint exceeds its limit.
    """
    typical = np.median(np.abs(recording.measured_effort()), axis=0)
    if np.all(typical <= arm.effort_limits):
        return
    joint = int(np.argmax(typical / arm.effort_limits))
    unit = _effort_unit(arm, joint)
    message = (
        f"{recording.source or 'recording'}: most efforts of {arm.joint_names[joint]} (tau{joint + 1}) exceed its "
        f"limit of {arm.effort_limits[joint]:.3g} {unit}. Check the unit (N m, or N if prismatic) and the joint of "
        "this column."
    )
    if np.all(typical[::-1] <= arm.effort_limits):
        message += " All joints are within their limits if the columns tau are in reverse order."
    elif np.all(1e-3 * typical <= arm.effort_limits) and np.sum(typical > arm.effort_limits) > len(typical) / 2:
        message += " If the efforts are in N mm, give --effort-scale 0.001 (effort_scale= in Python)."
    raise RecordingError(message)


def exclude_outliers(
    recording: Recording, arm: Arm, outliers: NDArray[np.bool_], residuals: NDArray[np.float64]
) -> list[ExcludedMeasurement]:
    """Returns the outliers of a robust fit as excluded measurements. `outliers` is a mask (m, n)."""
    return [
        ExcludedMeasurement(
            int(row),
            (int(joint),),
            recording.where(int(row)),
            f"{arm.joint_names[joint]} effort is an outlier (residual {residuals[row, joint]:+.2g} "
            f"{_effort_unit(arm, joint)})",
        )
        for row, joint in np.argwhere(outliers)
    ]


def _effort_unit(arm: Arm, joint: int) -> str:
    return "N" if arm.prismatic[joint] else "N m"


def usable_measurements(shape: tuple[int, int], excluded: list[ExcludedMeasurement]) -> NDArray[np.bool_]:
    """Returns a mask (m, n) that is False for excluded measurements."""
    usable = np.ones(shape, dtype=bool)
    for measurement in excluded:
        usable[measurement.row, list(measurement.joints)] = False
    return usable


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
