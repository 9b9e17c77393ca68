"""Estimates the force on a point of an arm from a recording, with the efforts that the arm's model does not explain."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dvrk_drake.analysis.check.recording_check import require_usable, with_power
from dvrk_drake.analysis.motion_validation import validate_motion
from dvrk_drake.analysis.observations.finding import Finding
from dvrk_drake.analysis.observations.observations import Observations
from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.dynamics.kinematics import Axes, Contact, is_measurable
from dvrk_drake.dynamics.momentum_observer import DryFrictionBound
from dvrk_drake.errors import ModelError
from dvrk_drake.models.effects_schema import half_width
from dvrk_drake.models.files import Reportable, refuse_existing
from dvrk_drake.progress import Progress, step_progress
from dvrk_drake.recordings.recording import Recording

#: Standard deviation of an effort that was not measured [N m, N]. With it, the effort does not affect the force.
UNMEASURED = 1e4


@dataclass(frozen=True, eq=False, repr=False)
class ExternalForce(Reportable):
    """Force on a point of an arm over a recording.

    Attributes:
        model: Model of the arm.
        recording: Recording of the arm.
        contact: Point at which the force acts.
        frame: Name of the frame of the point.
        t: Times (m,) [s], or None for poses without times.
        q: Joint positions (m, n) [rad, m].
        effort: Joint efforts (m, n) that the force exerts on the arm [N m, N].
        effort_covariance: Covariances (m, n, n) of these efforts.
        force: Forces (m, k) on the arm, in the components of `contact` [N].
        covariance: Covariances (m, k, k) of the forces [N^2].
        warnings: Findings about the recording.
        note: Note on how poses were extracted from a motion, "" if no poses were extracted.
    """

    model: IdentifiedModel
    recording: Recording
    contact: Contact
    frame: str
    t: NDArray[np.float64] | None
    q: NDArray[np.float64]
    effort: NDArray[np.float64]
    effort_covariance: NDArray[np.float64]
    force: NDArray[np.float64]
    covariance: NDArray[np.float64]
    warnings: tuple[Finding, ...] = ()
    note: str = ""

    def __repr__(self) -> str:
        return f"<ExternalForce on {self.frame} of {self.model.arm.name}: {len(self.force)} rows>"

    @property
    def measurable(self) -> NDArray[np.bool_]:
        """Mask (m, k) of the components that the arm can measure at its pose, see `is_measurable`."""
        return is_measurable(self.covariance)

    @property
    def half_width(self) -> NDArray[np.float64]:
        """Half widths (m, k) of the 95 % intervals of the forces [N]."""
        return half_width(1.0, None) * np.sqrt(np.diagonal(self.covariance, axis1=1, axis2=2))

    @property
    def effort_half_width(self) -> NDArray[np.float64]:
        """Half widths (m, n) of the 95 % intervals of the efforts [N m, N]."""
        return half_width(1.0, None) * np.sqrt(np.diagonal(self.effort_covariance, axis1=1, axis2=2))

    def save(self, path: str | Path, *, overwrite: bool = False) -> None:
        """Writes the forces and the joint efforts with their intervals as a CSV. Forces are nan if not measurable.

        Args:
            path: CSV file to write.
            overwrite: True to replace an existing file.

        Raises:
            DvrkDrakeError: The file exists and `overwrite` is False, or the file cannot be written.
        """
        from dvrk_drake.recordings.csv_files import write_csv

        refuse_existing(path, overwrite)
        measured = [np.where(self.measurable, x, np.nan) for x in (self.force, self.half_width)]
        columns = {} if self.t is None else {"t": self.t}
        columns |= {
            "force": measured[0],
            "force_lower": measured[0] - measured[1],
            "force_upper": measured[0] + measured[1],
            "tau": self.effort,
            "lower": self.effort - self.effort_half_width,
            "upper": self.effort + self.effort_half_width,
        }
        stated = {"frame": self.frame, "axes": self.contact.axes, "arm": self.model.arm.name}
        write_csv(path, columns, self.model.arm, stated)


def estimate_force(
    recording: Recording,
    model: IdentifiedModel,
    *,
    frame: str = "",
    point: ArrayLike = (0.0, 0.0, 0.0),
    axes: Axes = "base",
    direction: ArrayLike | None = None,
    cannula: bool = False,
    same_day: bool = False,
    progress: Progress | None = None,
) -> ExternalForce:
    """Estimates the force on a point of an arm over a recording, as `dvrk-drake force` does.

    The external efforts are the efforts of the model minus those of the motors. In a motion, both are low-pass filtered
    without delay as in the identification, so the intervals follow from the errors on held-out motions. The force is
    the weighted least-squares solution of J' f = external efforts, see `Contact`. It assumes that nothing else touches
    the arm.

    Static poses of a recording are compared with the holding torques of the model. Their intervals contain the dry
    friction.

    Args:
        recording: Motion or static poses with efforts.
        model: Model from `identify` or `IdentifiedModel.load`. For a motion, it must have dynamics.
        frame: Frame F of the SDF. Default: `arm.frames.hand`.
        point: Position p_FP (3,) of the point [m].
        axes: Axes of the force: "base" or "frame".
        direction: Direction (3,) of the force in these axes, if it is known.
        cannula: True if a cannula at the remote centre can exert an unknown axial force.
        same_day: True if the model was identified on the day of the recording. By default, the intervals contain the
            assumed change of the efforts between days.
        progress: Callback that receives the name of the step ("checking the recording" or "estimating the force") and
            the finished share of the step (0 to 1).

    Raises:
        RecordingError: The recording does not fit the model's arm, or `check` rejects the recording.
        ModelError: The arm moves, but the model was identified from static poses. Or the model states no errors.
        ArmError: The frame does not exist, or an argument of the contact is invalid.

    Example:
        >>> import dvrk_drake as dvrk
        >>> files = {file.name: file for file in dvrk.write_samples("samples")}
        >>> arm = dvrk.load_arm("psm")
        >>> recording = dvrk.read_recording(files["psm_motion.csv"], arm)
        >>> model = dvrk.identify(recording, arm).model
        >>> force = dvrk.estimate_force(recording, model, axes="frame")
        >>> force.force.shape[1], bool((abs(force.force) < force.half_width).mean() > 0.9)
        (3, True)
    """
    arm = model.arm
    contact = Contact(arm, frame, point, axes=axes, direction=direction, cannula=cannula)
    recording, dropped = with_power(recording, arm)
    poses = Observations.for_model(recording, model).poses()
    if poses.moves and model.dynamics is None:
        raise ModelError(
            f"{recording.source or 'recording'}: the arm moves, but the model was identified from static poses, so it "
            "has no inertia and no friction; use a model that was identified from a motion"
        )
    report = require_usable(poses.observations, progress)
    share = step_progress(progress, "estimating the force")
    share(0.0)
    estimate = _efforts_in_motion if poses.moves else _efforts_at_rest
    t, q, effort, covariance = estimate(model, poses.observations, same_day)
    force, force_covariance = contact.force(q, effort, covariance)
    share(1.0)
    return ExternalForce(
        model=model,
        recording=poses.recording,
        contact=contact,
        frame=frame or arm.frames.hand,
        t=t,
        q=q,
        effort=effort,
        effort_covariance=covariance,
        force=force,
        covariance=force_covariance,
        warnings=(*dropped, *report.warnings),
        note=poses.note,
    )


_Efforts = tuple[NDArray[np.float64] | None, NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]


def _efforts_in_motion(model: IdentifiedModel, observations: Observations, same_day: bool) -> _Efforts:
    """Returns times (m,), joint positions (m, n), and external joint efforts (m, n) with covariances (m, n, n).

    The compared efforts are those of the measured channels, which may combine actuators.
    """
    dynamics, transmission = model.dynamic_model, model.arm.transmission
    compared = validate_motion(model, observations)
    grid = compared.grid
    measured = np.any(grid.channels, axis=1)
    to_joints = np.linalg.solve(grid.channels.T + np.diag((~measured).astype(float)), transmission.matrix)
    effort = (compared.predicted - compared.measured) @ to_joints
    errors = grid.channels @ dynamics.error_covariance(other_day=not same_day) @ grid.channels.T
    errors = to_joints.T @ (errors + np.diag(~measured * UNMEASURED**2)) @ to_joints
    bound = DryFrictionBound(dynamics)
    states, state = [], bound.start()
    for q, v in zip(grid.at_rows(grid.q, 0), grid.at_rows(grid.v, 0), strict=True):
        bound.update(state, q, v, 1.0 / grid.rate)
        states.append(state.copy())
    covariance = errors + bound.covariance(np.array(states)[grid.inner])
    return compared.t, transmission.inverse.position(compared.q), effort, covariance


def _efforts_at_rest(model: IdentifiedModel, observations: Observations, same_day: bool) -> _Efforts:
    """Returns the same as `_efforts_in_motion` for static poses.

    The errors of a model on held-out poses contain the dry friction. A model of motions only does not state them.
    """
    arm = model.arm
    poses = observations.recording.in_joint_coordinates(arm)
    effort = model.static_model.torque(poses.q, model.theta) - poses.measured_effort()
    deviation = np.array([joint.rms_leave_one_out for joint in model.joints])
    if np.all(deviation > 0):
        covariance = np.diag(deviation**2)
    elif model.dynamics is not None:
        dynamics, J = model.dynamic_model, arm.transmission.matrix
        bound = DryFrictionBound(dynamics)
        covariance = J.T @ dynamics.error_covariance(other_day=not same_day) @ J
        covariance = covariance + bound.covariance(bound.start())
    else:
        raise ModelError("the model states no errors, so the force has no interval; use a model from identify")
    covariance = covariance + np.diag(~poses.measured_joints(arm) * UNMEASURED**2)
    return poses.t, poses.q, effort, np.tile(covariance, (len(poses), 1, 1))
