"""Validates a dynamic model on a motion, and estimates the shares of the error that have different causes."""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.analysis.error_shares import ErrorShares, error_shares
from dvrk_drake.analysis.estimation.robust_fit import rms
from dvrk_drake.analysis.observations.finding import Finding
from dvrk_drake.analysis.observations.motion_grid import MotionGrid
from dvrk_drake.analysis.observations.observations import Observations
from dvrk_drake.analysis.observations.repetition import motion_floor
from dvrk_drake.analysis.results import JudgedError, Validation, coverage, judge, rule_text, tolerances
from dvrk_drake.dynamics.identified_model import IdentifiedModel

#: Smallest ratio of an error to the one expected on another day that is reported. It is exceeded in 12 of 12 pairs of
#: recordings of two PSMs, and in 2 of 8 pairs of one PSM (benchmarks/three_joint_recordings.py).
OTHER_ROBOT_RATIO = 1.75


@dataclass(frozen=True, kw_only=True)
class ActuatorError(JudgedError):
    """RMS effort error of one actuator over a motion, after low-pass filtering.

    Attributes:
        rms_effort: RMS measured effort [N m, N if prismatic].
        rms_error: RMS of measured minus predicted effort [N m, N if prismatic].
        relative_error: rms_error / rms_effort [1], None if rms_effort is 0.
        shares: Shares of rms_error^2 by cause.
        repeatability: Relative RMS difference of the efforts between periods (see `repeatability_floor`) [1], or None
            if the motion does not repeat.
        inside: Share of the efforts inside the 95 % prediction interval (`DynamicModel.half_width`) [1], or None if the
            model has no interval.
        inside_other_day: The same for the interval on another day (`DynamicModel.combined_half_width`) [1].
    """

    rms_effort: float
    rms_error: float
    relative_error: float | None
    shares: ErrorShares
    repeatability: float | None
    inside: float | None = None
    inside_other_day: float | None = None

    @property
    def judged_error(self) -> float | None:
        """Relative error for the verdict."""
        return self.relative_error


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class DynamicValidation(Validation):
    """Errors of a model on one motion.

    Attributes:
        actuators: Errors of the actuators, in the arm's order.
        t: Times (r,) of the compared rows [s]. Both ends are omitted (`MotionGrid.inner`).
        q: Positions (r, n) of the actuators [rad, m].
        period: Period of the motion [s], or None if the motion does not repeat.
        measured: Measured efforts (r, n) after low-pass filtering, see `MotionGrid.channels` [N m, N].
        predicted: Predicted efforts (r, n) after low-pass filtering [N m, N].
        grid: Resampled motion.
    """

    actuators: list[ActuatorError]
    t: NDArray[np.float64]
    q: NDArray[np.float64]
    period: float | None
    measured: NDArray[np.float64]
    predicted: NDArray[np.float64]
    grid: MotionGrid

    @property
    def mean_relative_error(self) -> float:
        """Mean relative error over the actuators whose measured effort is not 0."""
        errors = [a.relative_error for a in self.actuators if a.relative_error is not None]
        return float(np.mean(errors)) if errors else float("nan")

    @property
    def errors(self) -> list[ActuatorError]:
        """Errors of the actuators after low-pass filtering."""
        return self.actuators

    def as_dict(self) -> dict:
        """Returns the output of `validate --json` as a dictionary."""
        return {
            "verdict": self.verdict,
            "rule": rule_text(),
            "coordinates": "actuator",
            "cut_off_hz": self.grid.settings.effort_cut_off,
            "mean_relative_error": self.mean_relative_error,
            "actuators": [{**asdict(actuator), "shares": actuator.shares._asdict()} for actuator in self.actuators],
        }


def predict_motion(model: IdentifiedModel, observations: Observations) -> NDArray[np.float64]:
    """Returns the predicted efforts (m, n) of the actuators at all rows of a motion, after the low-pass filter.

    Raises:
        RecordingError: The recording does not match the arm, or is not a motion.
        ModelError: The model has no dynamics.
    """
    grid = observations.grid
    return grid.low_passed(_efforts(model, grid))


def validate_motion(model: IdentifiedModel, observations: Observations) -> DynamicValidation:
    """Compares predicted and measured efforts of a motion, in actuator coordinates.

    The relative error of an actuator is |tau_f - tau_hat| / |tau_f|, with the measured effort tau_f and the predicted
    effort tau_hat. Both efforts are filtered with the zero-phase low-pass filter, and both ends are omitted
    (`MotionGrid.inner`). Wang et al. (RA-L 2019) use the same metric.

    Raises:
        RecordingError: The recording does not match the arm, has no efforts, or is not a motion.
        ModelError: The model has no dynamics.
    """
    dynamics = model.dynamic_model
    arm = model.arm
    tau, grid, period = observations.tau, observations.grid, observations.period
    measured, predicted = grid.filter_efforts(tau @ grid.channels.T), filtered_efforts(model, grid)
    t, a, v = grid.actuator_motion()
    floor: list[float | None] = [None] * arm.num_joints
    if period is not None:
        floor = [float(x) if np.isfinite(x) else None for x in motion_floor(tau, grid, period)]
    vd = grid.efforts_at_rows(arm.transmission.velocity(grid.vd))[grid.inner]
    covered = coverage(arm, np.ptp(grid.q, axis=0), "actuator")
    widths = np.array([dynamics.combined_half_width(grid.channels, other_day=day) for day in (False, True)])
    errors, actuators = measured - predicted, []
    for i, (name, tolerance) in enumerate(zip(arm.joint_names, tolerances(arm, "actuator"), strict=True)):
        error, coverage_of_range = errors[:, i], float(covered[i])
        effort, size = rms(measured[:, i]), rms(error)
        commanded = model.joints[i].feedforward_scale > 0
        inside: list[float | None] = [None, None]
        if effort > 0 and np.all(widths[:, i]):
            inside = np.mean(np.abs(error)[:, None] <= widths[:, i], axis=0).tolist()
        actuators.append(
            ActuatorError(
                name=name,
                rms_effort=effort,
                rms_error=size,
                relative_error=size / effort if effort > 0 else None,
                shares=error_shares(error, i, a, v[:, i], vd, t, period),
                repeatability=floor[i],
                verdict=judge(effort, size, tolerance, coverage_of_range, commanded=commanded),
                coverage=coverage_of_range,
                inside=inside[0],
                inside_other_day=inside[1],
            )
        )
    return DynamicValidation(
        model=model,
        recording=observations.recording,
        actuators=actuators,
        t=t,
        q=a,
        period=period,
        measured=measured,
        predicted=predicted,
        grid=grid,
    )


def find_other_robot(validation: DynamicValidation) -> tuple[Finding, ...]:
    """Returns a warning with the actuators whose errors exceed those expected on another day (`OTHER_ROBOT_RATIO`)."""
    assert validation.model.dynamics is not None
    # A nominal model states no errors.
    stated = {a.name: np.hypot(a.rms_cross_validation, a.rms_between_days) for a in validation.model.dynamics.actuators}
    bad = []
    for error in validation.actuators:
        expected = stated.get(error.name, 0.0)
        if error.rms_effort > 0 and error.rms_error > OTHER_ROBOT_RATIO * expected > 0:
            shares = 100 * error.rms_error / error.rms_effort, 100 * expected / error.rms_effort
            bad.append(f"{error.name} ({shares[0]:.0f} %, expected {shares[1]:.0f} %)")
    if not bad:
        return ()
    what = "the errors of the model are much larger than expected for another day of the same arm"
    advice = "Usual causes: another individual arm or instrument, a payload, or a changed drive. Identify it again."
    return (Finding("warning", "other robot", ", ".join(bad), what, advice),)


def filtered_efforts(model: IdentifiedModel, grid: MotionGrid) -> NDArray[np.float64]:
    """Returns the predicted efforts (r, n) of the channels of a motion without both ends, after low-pass filtering."""
    return grid.filter_efforts(_efforts(model, grid) @ grid.channels.T)


def _efforts(model: IdentifiedModel, grid: MotionGrid) -> NDArray[np.float64]:
    dynamics = model.dynamic_model
    return grid.efforts_at_rows(np.concatenate([dynamics.effort(g.q, g.v, g.vd) for g, _, _ in grid.each_segment()]))
