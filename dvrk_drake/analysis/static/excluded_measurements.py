"""Finds measurements that are not holding torques: poses at a joint stop, and torques beyond the effort limit."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.errors import RecordingError
from dvrk_drake.models.arm import Arm
from dvrk_drake.recordings.recording import Recording

#: Distance from a limit within which a joint may be at its stop [rad], [m].
STOP_MARGIN = 0.01, 0.002


@dataclass(frozen=True)
class ExcludedMeasurement:
    """Measurement that is not used, with the name of the pose in `where` and a readable `reason`."""

    row: int
    joints: tuple[int, ...]
    where: str
    reason: str


def find_excluded(
    recording: Recording, arm: Arm, measured: NDArray[np.bool_] | None = None
) -> list[ExcludedMeasurement]:
    """Returns the measurements to exclude before any fit.

    A stop carries load, so the torques of its joints are not holding torques.

    Args:
        recording: Recording in joint coordinates, with efforts.
        arm: Arm with the limits.
        measured: (m, n) False where an effort is not a holding torque and need not be excluded. By default all are.
    """
    excluded = []
    A, lower, upper = arm.limit_matrix()
    names = [*arm.joint_names, *(limit.name for limit in arm.coupled_limits)]
    values = recording.q @ A.T
    # A coupled limit is the position at first contact, and its stop is soft. It has no margin.
    margin = np.concatenate([arm.per_joint(*STOP_MARGIN), np.zeros(len(arm.coupled_limits))])
    at_stop = (values < lower + margin) | (values > upper - margin)
    for row, limit in np.argwhere(at_stop):
        joints = tuple(int(j) for j in np.flatnonzero(A[limit]))
        stop = lower[limit] if values[row, limit] < (lower[limit] + upper[limit]) / 2 else upper[limit]
        reason = f"{names[limit]} at {values[row, limit]:.3f} rests on its stop ({stop:.3f})"
        excluded.append(ExcludedMeasurement(int(row), joints, recording.where(int(row)), reason))
    tau = recording.measured_effort()
    usable = usable_measurements(tau.shape, excluded)
    for row, joint in np.argwhere((np.abs(tau) > arm.effort_limits) & usable):
        reason = (
            f"{arm.joint_names[joint]} effort {tau[row, joint]:.3g} exceeds its limit {arm.effort_limits[joint]:.3g}"
        )
        excluded.append(ExcludedMeasurement(int(row), (int(joint),), recording.where(int(row)), reason))
    if measured is not None:
        excluded = [
            measurement for measurement in excluded if np.any(measured[measurement.row, list(measurement.joints)])
        ]
    order = np.arange(len(recording)) if recording.lines is None else recording.lines
    return sorted(excluded, key=lambda measurement: order[measurement.row])


def check_effort_unit(recording: Recording, arm: Arm) -> None:
    """Rejects efforts beyond the capability of the motors, which indicate another unit.

    Raises:
        RecordingError: Most efforts of a joint exceed its limit.
    """
    typical = np.median(np.abs(recording.measured_effort()), axis=0)
    if np.any(typical > arm.effort_limits):
        joint = int(np.argmax(typical / arm.effort_limits))
        unit = "N" if arm.prismatic[joint] else "N m"
        raise RecordingError(
            f"{recording.source}: most efforts of {arm.joint_names[joint]} (tau{joint + 1}) exceed its limit of "
            f"{arm.effort_limits[joint]:.3g} {unit}; are they in N m (N on a prismatic joint), and of this joint?"
        )


def exclude_outliers(
    recording: Recording, arm: Arm, outliers: NDArray[np.bool_], residuals: NDArray[np.float64]
) -> list[ExcludedMeasurement]:
    """Returns the measurements that a robust fit rejected, for masks and residuals (m, n)."""
    return [
        ExcludedMeasurement(
            int(row),
            (int(joint),),
            recording.where(int(row)),
            f"{arm.joint_names[joint]} effort is {residuals[row, joint]:+.2g} away from what all other poses say",
        )
        for row, joint in np.argwhere(outliers)
    ]


def usable_measurements(shape: tuple[int, int], excluded: list[ExcludedMeasurement]) -> NDArray[np.bool_]:
    """Returns a mask (m, n) that is False for excluded measurements."""
    usable = np.ones(shape, dtype=bool)
    for measurement in excluded:
        usable[measurement.row, list(measurement.joints)] = False
    return usable
