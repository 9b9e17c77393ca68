"""Finds the measurements to exclude: poses at a joint stop, efforts beyond their limit, and outliers."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.errors import RecordingError
from dvrk_drake.models.arm import Arm
from dvrk_drake.recordings.recording import SAME_POSE, Recording


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
