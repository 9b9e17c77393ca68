"""Validates the holding torques of a model on a recording."""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.analysis.estimation.robust_fit import rms
from dvrk_drake.analysis.observations.excluded_measurements import (
    ExcludedMeasurement,
    check_effort_unit,
    find_excluded,
    usable_measurements,
)
from dvrk_drake.analysis.results import JudgedError, Validation
from dvrk_drake.analysis.verdict import NEGLIGIBLE, coverage, judge, rule_text, tolerances
from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.recordings.recording import FileCoordinates, Recording, file_transmission


@dataclass(frozen=True, kw_only=True)
class JointError(JudgedError):
    """RMS torque error of one joint over a recording, in the coordinates of the recording.

    Attributes with the suffix `_included` omit the excluded measurements.

    Attributes:
        rms_torque: RMS measured torque [N m, N if prismatic]. It is also the RMS error of zero torque.
        rms_error: RMS of measured minus predicted torque [N m, N if prismatic].
        relative_error: rms_error / rms_torque [1], None if rms_torque is 0.
        rms_torque_included: RMS measured torque of the included measurements [N m, N if prismatic].
        rms_error_included: RMS error of the included measurements [N m, N if prismatic].
        relative_error_included: rms_error_included / rms_torque_included [1], None if rms_torque_included is 0.
        num_excluded: Number of measurements that are excluded because the joint is at a stop or the effort is beyond
            its limit.
    """

    rms_torque: float
    rms_error: float
    relative_error: float | None
    rms_torque_included: float
    rms_error_included: float
    relative_error_included: float | None
    num_excluded: int

    @property
    def judged_error(self) -> float | None:
        """Relative error for the verdict, without the excluded measurements."""
        return self.relative_error_included


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class StaticValidation(Validation):
    """Errors of the holding torques of a model at the poses of a recording.

    Attributes:
        joints: Errors of the joints, in the arm's order.
        poses: Number of poses.
        residuals: Measured minus predicted efforts (m, n), in the coordinates of the recording [N m, N].
        excluded: Measurements that the verdicts do not use, and the reasons for the exclusion.
        usable: Mask (m, n) of the efforts that are not excluded, in the coordinates of the recording.
    """

    joints: list[JointError]
    poses: int
    residuals: NDArray[np.float64]
    excluded: list[ExcludedMeasurement]
    usable: NDArray[np.bool_]

    @property
    def errors(self) -> list[JointError]:
        """Errors of the joints."""
        return self.joints

    def as_dict(self) -> dict:
        """Returns the output of `validate --json` as a dictionary."""
        return {
            "verdict": self.verdict,
            "rule": rule_text(),
            "joints": [asdict(joint) for joint in self.joints],
            "poses": self.poses,
            "excluded": [{"where": measurement.where, "reason": measurement.reason} for measurement in self.excluded],
        }


def predict_static(
    model: IdentifiedModel, recording: Recording, coordinates: FileCoordinates | None = None
) -> NDArray[np.float64]:
    """Returns the predicted holding torques (m, n) at the poses of a recording [N m, N].

    Args:
        model: Identified model.
        recording: Poses.
        coordinates: Coordinates of the torques. Default: those of the recording.

    Raises:
        RecordingError: The recording does not fit the model's arm.
    """
    arm = model.arm
    recording.check_fits(arm)
    tau = model.holding_torque(recording.in_joint_coordinates(arm).q)
    # tau_joint = J' tau_file, so the inverse map transforms efforts from joints to the coordinates of the file.
    return file_transmission(arm, coordinates or recording.coordinates).inverse.pull_back_effort(tau)


def validate_static(model: IdentifiedModel, recording: Recording) -> StaticValidation:
    """Compares a model's holding torques with a recording.

    Args:
        model: Identified model.
        recording: Poses with efforts, in joint or actuator coordinates.

    Raises:
        RecordingError: The recording does not fit the model's arm, or has no efforts.
    """
    arm = model.arm
    measured = recording.measured_effort()
    predicted = predict_static(model, recording)
    residuals = measured - predicted
    in_joints = recording.in_joint_coordinates(arm)
    check_effort_unit(in_joints, arm)
    excluded = find_excluded(in_joints, arm)
    usable = usable_measurements(measured.shape, excluded)
    if recording.coordinates == "actuator":
        # An excluded measurement of a joint excludes the measurements of all actuators that drive the joint.
        usable = ~((~usable) @ (arm.transmission.matrix.T != 0))
    usable = usable & ~recording.unmeasured
    covered = coverage(arm, np.ptp(in_joints.q, axis=0), recording.coordinates)
    joints = []
    for j, (name, tolerance) in enumerate(zip(arm.joint_names, tolerances(arm, recording.coordinates), strict=True)):
        use = usable[:, j]
        torque, error = rms(measured[:, j]), rms(residuals[:, j])
        torque_used, error_used = rms(measured[use, j]), rms(residuals[use, j])
        is_negligible = rms(predicted[:, j]) <= NEGLIGIBLE * tolerance.friction and error_used <= tolerance.friction
        commanded = bool(np.any(predicted[:, j])) and not is_negligible
        joints.append(
            JointError(
                name=name,
                rms_torque=torque,
                rms_error=error,
                relative_error=error / torque if torque > 0 else None,
                rms_torque_included=torque_used,
                rms_error_included=error_used,
                relative_error_included=error_used / torque_used if torque_used > 0 else None,
                num_excluded=int(np.sum(~use)),
                coverage=float(covered[j]),
                verdict=judge(torque_used, error_used, tolerance, float(covered[j]), commanded=commanded),
            )
        )
    return StaticValidation(
        model=model,
        recording=recording,
        joints=joints,
        poses=len(recording),
        residuals=residuals,
        excluded=excluded,
        usable=usable,
    )
