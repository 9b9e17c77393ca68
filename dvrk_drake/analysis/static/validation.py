"""Validates the holding torques of a model on a recording."""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.analysis.estimation.robust_fit import rms
from dvrk_drake.analysis.results import Validation
from dvrk_drake.analysis.static.excluded_measurements import (
    ExcludedMeasurement,
    check_effort_unit,
    find_excluded,
    usable_measurements,
)
from dvrk_drake.analysis.verdict import NEGLIGIBLE, coverage, judge, rule_text, tolerances
from dvrk_drake.dynamics.identified_model import IdentifiedModel, Verdict
from dvrk_drake.models.arm import Arm
from dvrk_drake.recordings.recording import Coordinates, Recording, file_transmission


@dataclass(frozen=True)
class JointError:
    """RMS torque error of one joint over a recording, in the coordinates of the recording.

    Attributes with the suffix `_included` omit the excluded measurements.

    Attributes:
        name: Name of the joint.
        rms_torque: RMS measured torque [N m, N if prismatic]. It is also the RMS error of zero torque.
        rms_error: RMS of measured minus predicted torque [N m, N if prismatic].
        relative_error: rms_error / rms_torque [1], None if rms_torque is 0.
        rms_torque_included: RMS measured torque of the included measurements [N m, N if prismatic].
        rms_error_included: RMS error of the included measurements [N m, N if prismatic].
        relative_error_included: rms_error_included / rms_torque_included [1], None if rms_torque_included is 0.
        num_excluded: Number of measurements that are excluded because the joint is at a stop or the effort is beyond
            its limit.
        coverage: Share of the range between the limits that the recording covers, see `verdict.coverage` [1].
        verdict: Verdict from the included measurements, see `judge`.
    """

    name: str
    rms_torque: float
    rms_error: float
    relative_error: float | None
    rms_torque_included: float
    rms_error_included: float
    relative_error_included: float | None
    num_excluded: int
    coverage: float
    verdict: Verdict


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
    def verdicts(self) -> dict[str, Verdict]:
        """Verdict on each joint."""
        return {joint.name: joint.verdict for joint in self.joints}

    @property
    def relative_errors(self) -> dict[str, float | None]:
        """Ratio of RMS error to RMS measured effort of each joint [1], None if the effort is 0.

        Excluded measurements are not used.
        """
        return {joint.name: joint.relative_error_included for joint in self.joints}

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
    model: IdentifiedModel, recording: Recording, coordinates: Coordinates | None = None
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
    if (coordinates or recording.coordinates) != "joint":
        # tau_joint = J' tau_actuator, so the inverse map transforms efforts from joints to actuators.
        tau = file_transmission(arm, coordinates or recording.coordinates).inverse.pull_back_effort(tau)
    return tau


def validate_static(model: IdentifiedModel, recording: Recording) -> StaticValidation:
    """Compares a model's holding torques with a recording.

    Args:
        model: Identified model.
        recording: Poses with efforts, in joint or actuator coordinates.

    Raises:
        RecordingError: The recording does not fit the model's arm, or has no efforts.
    """
    arm = model.arm
    if recording.coordinates == "wpi":
        recording = recording.in_joint_coordinates(arm)
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
    errors = _joint_errors(arm, recording, predicted, usable, covered)
    return StaticValidation(
        model=model,
        recording=recording,
        joints=errors,
        poses=len(recording),
        residuals=residuals,
        excluded=excluded,
        usable=usable,
    )


def _joint_errors(
    arm: Arm,
    recording: Recording,
    predicted: NDArray[np.float64],
    usable: NDArray[np.bool_],
    covered: NDArray[np.float64],
) -> list[JointError]:
    measured = recording.measured_effort()
    errors = []
    for j, (name, tolerance) in enumerate(zip(arm.joint_names, tolerances(arm, recording.coordinates), strict=True)):
        use = usable[:, j]
        torque, error = (rms(tau[:, j]) for tau in (measured, measured - predicted))
        torque_used, error_used = (rms(tau[use, j]) for tau in (measured, measured - predicted))
        is_negligible = rms(predicted[:, j]) <= NEGLIGIBLE * tolerance.friction and error_used <= tolerance.friction
        commanded = bool(np.any(predicted[:, j])) and not is_negligible
        errors.append(
            JointError(
                name,
                torque,
                error,
                error / torque if torque > 0 else None,
                torque_used,
                error_used,
                error_used / torque_used if torque_used > 0 else None,
                int(np.sum(~use)),
                float(covered[j]),
                judge(torque_used, error_used, tolerance, float(covered[j]), commanded=commanded),
            )
        )
    return errors
