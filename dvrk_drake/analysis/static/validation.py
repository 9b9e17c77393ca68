"""How well a model predicts the torques of a recording."""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.analysis.results import Validation
from dvrk_drake.analysis.static.excluded_measurements import (
    ExcludedMeasurement,
    check_effort_unit,
    find_excluded,
    usable_measurements,
)
from dvrk_drake.analysis.static.linear_fit import rms
from dvrk_drake.analysis.verdict import judge, rule_text
from dvrk_drake.dynamics.identified_model import IdentifiedModel, Verdict
from dvrk_drake.models.arm import Arm
from dvrk_drake.recordings.recording import Recording


@dataclass(frozen=True)
class JointError:
    """One joint's error over a recording: RMS in N m (N if prismatic) in the coordinates that the recording is in.

    `rms_torque` is what commanding zero torque would err by; `relative_error` = rms_error / rms_torque, None where
    nothing was measured. `_included`
    leaves out `num_excluded` measurements of poses that rest on a stop or exceed the effort limit. `verdict` judges what
    is left, see `judge`.
    """

    name: str
    rms_torque: float
    rms_error: float
    relative_error: float | None
    rms_torque_included: float
    rms_error_included: float
    relative_error_included: float | None
    num_excluded: int
    verdict: Verdict


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class StaticValidation(Validation):
    """Errors of a model on poses.

    Attributes:
        joints: in the arm's order.
        poses: their number.
        residuals: (m, n) measured minus predicted efforts, in the recording's coordinates [N m; N].
        excluded: measurements that the verdicts leave out, and why.
        measured: (m, n) False where an effort is no holding torque.
    """

    joints: list[JointError]
    poses: int
    residuals: NDArray[np.float64]
    excluded: list[ExcludedMeasurement]
    measured: NDArray[np.bool_]

    @property
    def verdicts(self) -> dict[str, Verdict]:
        """Verdict on each joint."""
        return {joint.name: joint.verdict for joint in self.joints}

    @property
    def relative_errors(self) -> dict[str, float | None]:
        """RMS error / RMS effort of each joint, without outliers [1]; None where nothing was measured."""
        return {joint.name: joint.relative_error_included for joint in self.joints}

    def as_dict(self) -> dict:
        """Returns what `validate --json` writes."""
        return {
            "verdict": self.verdict,
            "rule": rule_text(in_motion=False),
            "joints": [asdict(joint) for joint in self.joints],
            "poses": self.poses,
            "excluded": [{"where": measurement.where, "reason": measurement.reason} for measurement in self.excluded],
        }


def predict_static(model: IdentifiedModel, recording: Recording) -> NDArray[np.float64]:
    """Holding torques (m, n) at the recording's poses, in the recording's own coordinates.

    Raises:
        RecordingError: the recording does not fit the model's arm.
    """
    arm = model.arm
    recording.check_fits(arm)
    tau = model.holding_torque(recording.in_joint_coordinates(arm).q)
    if recording.coordinates == "actuator":
        # tau_joint = J' tau_actuator, so the inverse map pulls back from joints to actuators.
        tau = arm.transmission.inverse.pull_back_effort(tau)
    return tau


def validate_static(
    model: IdentifiedModel, recording: Recording, measured_joints: NDArray[np.bool_] | None = None
) -> StaticValidation:
    """Compares a model with a recording.

    Args:
        model: the model.
        recording: in either coordinates.
        measured_joints: (m, n) False where an effort is no holding torque, as `low_speed_segments` gives it; default: all are.

    Raises:
        RecordingError: the recording does not fit the model's arm, or has no efforts.
    """
    arm = model.arm
    measured = recording.measured_effort()
    predicted = predict_static(model, recording)
    residuals = measured - predicted
    in_joints = recording.in_joint_coordinates(arm)
    if measured_joints is None:
        measured_joints = np.ones(measured.shape, dtype=bool)
    check_effort_unit(in_joints, arm)
    excluded = find_excluded(in_joints, arm, measured_joints)
    usable = usable_measurements(measured.shape, excluded) & measured_joints
    if recording.coordinates == "actuator":
        # A doubt about a joint touches every actuator that drives it.
        usable = ~((~usable) @ (arm.transmission.matrix.T != 0))
    commanded = np.any(predicted != 0, axis=0)
    errors = _joint_errors(arm, measured, residuals, measured_joints, usable, commanded)
    return StaticValidation(
        model=model,
        recording=recording,
        joints=errors,
        poses=len(recording),
        residuals=residuals,
        excluded=excluded,
        measured=measured_joints,
    )


def _joint_errors(
    arm: Arm,
    measured: NDArray[np.float64],
    residuals: NDArray[np.float64],
    measured_joints: NDArray[np.bool_],
    usable: NDArray[np.bool_],
    commanded: NDArray[np.bool_],
) -> list[JointError]:
    errors = []
    for j, name in enumerate(arm.joint_names):
        every, use = measured_joints[:, j], usable[:, j]
        torque, error = rms(measured[every, j]), rms(residuals[every, j])
        torque_used, error_used = rms(measured[use, j]), rms(residuals[use, j])
        limit = float(arm.effort_limits[j])
        errors.append(
            JointError(
                name,
                torque,
                error,
                error / torque if torque > 0 else None,
                torque_used,
                error_used,
                error_used / torque_used if torque_used > 0 else None,
                int(np.sum(every & ~use)),
                judge(torque_used, error_used, limit, in_motion=False, commanded=bool(commanded[j])),
            )
        )
    return errors
