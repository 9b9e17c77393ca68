"""Validates a dynamic model on a motion, and estimates the shares of the error that have different causes."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.analysis.estimation.motion_columns import DIRECTION_WIDTH
from dvrk_drake.analysis.estimation.robust_fit import rms
from dvrk_drake.analysis.observations.finding import Finding
from dvrk_drake.analysis.observations.motion_grid import MotionGrid
from dvrk_drake.analysis.observations.noise import MOTION_FREQUENCY
from dvrk_drake.analysis.observations.observations import Observations
from dvrk_drake.analysis.observations.repetition import motion_floor
from dvrk_drake.analysis.results import JudgedError, Validation
from dvrk_drake.analysis.verdict import coverage, judge, rule_text, tolerances
from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.recordings.recording import GAP, MIN_GAP

#: Number of frequencies of the sine and cosine functions in the position-dependent error: those of the cable effects in
#: an arm file (`CABLES`).
_HARMONICS = 2
#: Smallest ratio of an error to the one expected on another day that is reported. It is exceeded in 12 of 12 pairs of
#: recordings of two PSMs, and in 2 of 8 pairs of one PSM (benchmarks/three_joint_recordings.py).
OTHER_ROBOT_RATIO = 1.75


class ErrorShares(NamedTuple):
    """Shares of the squared effort error of one actuator, by cause. The sum of all shares is 1.

    Each share is what its cause explains in addition to the previous causes.

    Attributes:
        bias: Share due to the mean error.
        friction_like: Additional share that viscous and Coulomb friction in the actuator explain.
        position_dependent: Additional share that sine and cosine functions of the actuator's position explain. The
            functions have half a period and one period over the range of the position.
        acceleration_dependent: Additional share that is linear in the accelerations of all actuators (inertia).
        posture_dependent: Additional share that is linear in the sines and cosines of the positions of all other
            actuators (gravity, cables across joints). It may contain slow errors with other causes.
        not_repeating: Share of the rest that differs between periods of the motion: half the mean square of its
            difference between periods. No function of position, velocity and acceleration explains it. None if the
            motion does not repeat.
        fast: Share of the rest above `MOTION_FREQUENCY`, without the part that does not repeat: transients at reversals
            of the velocity, vibration, errors of the delay.
        other: Remaining share: slow and, in a periodic motion, the same in each period.
    """

    bias: float
    friction_like: float
    position_dependent: float
    acceleration_dependent: float
    posture_dependent: float
    not_repeating: float | None
    fast: float
    other: float


#: Labels of the fields of `ErrorShares` in tables and figures.
SHARE_LABELS = (
    *("bias", "friction-like", "position-dependent", "acceleration-dependent"),
    *("posture-dependent", "not repeating", "fast", "other"),
)


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
        cut_off: Cut-off of the low-pass filter of the compared efforts [Hz].
        t: Times (r,) of the compared rows [s]. Both ends are omitted (`MotionGrid.inner`).
        q: Positions (r, n) of the actuators [rad, m].
        v: Velocities (r, n) of the actuators [rad/s, m/s].
        vd: Accelerations (r, n) of the actuators [rad/s^2, m/s^2].
        period: Period of the motion [s], or None if the motion does not repeat.
        measured: Measured efforts (r, n) after low-pass filtering, see `MotionGrid.channels` [N m, N].
        predicted: Predicted efforts (r, n) after low-pass filtering [N m, N].
        grid: Resampled motion.
    """

    actuators: list[ActuatorError]
    cut_off: float
    t: NDArray[np.float64]
    q: NDArray[np.float64]
    v: NDArray[np.float64]
    vd: NDArray[np.float64]
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
            "cut_off_hz": self.cut_off,
            "mean_relative_error": self.mean_relative_error,
            "actuators": [{**asdict(actuator), "shares": actuator.shares._asdict()} for actuator in self.actuators],
        }

    def error_shares(self, predicted: NDArray[np.float64]) -> list[ErrorShares]:
        """Returns the shares of the error of each actuator for predicted efforts (r, n) [N m, N]."""
        error = self.measured - predicted
        return [
            error_shares(error[:, i], i, self.q, self.v[:, i], self.vd, self.t, self.period)
            for i in range(error.shape[1])
        ]


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
        cut_off=grid.settings.effort_cut_off,
        t=t,
        q=a,
        v=v,
        vd=vd,
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


def error_shares(
    error: NDArray[np.float64],
    actuator: int,
    q: NDArray[np.float64],
    v: NDArray[np.float64],
    vd: NDArray[np.float64],
    t: NDArray[np.float64],
    period: float | None,
) -> ErrorShares:
    """Returns the shares of the squared effort error of one actuator by cause.

    Args:
        error: Measured minus predicted efforts (r,) [N m, N].
        actuator: Index of the actuator.
        q: Positions (r, n) of all actuators [rad, m].
        v: Velocities (r,) of the actuator [rad/s, m/s].
        vd: Accelerations (r, n) of all actuators [rad/s^2, m/s^2].
        t: Times (r,) at a nearly constant rate [s].
        period: Period of the motion [s], or None if the motion does not repeat.
    """
    own, others = q[:, actuator], np.delete(q, actuator, axis=1)
    width = DIRECTION_WIDTH * float(np.sqrt(np.mean(v**2))) or 1.0
    travel = (own - own.min()) / (float(np.ptp(own)) or 1.0)
    kinds = [
        [np.ones_like(own)],
        [v, np.tanh(v / width)],
        [f(np.pi * k * travel) for k in range(1, _HARMONICS + 1) for f in (np.sin, np.cos)],
        list(vd.T),
        [*np.sin(others).T, *np.cos(others).T],
    ]
    shares = []
    columns: list[NDArray[np.float64]] = []
    unexplained = float(np.mean(error**2))
    total = unexplained or 1.0
    rest = error
    for kind in kinds:
        columns += kind
        X = np.column_stack(columns)
        rest = error - X @ np.linalg.lstsq(X, error, rcond=None)[0]
        remaining = float(np.mean(rest**2))
        shares.append((unexplained - remaining) / total)
        unexplained = remaining
    bias, friction, position, acceleration, posture = shares
    slow = _slow_part(rest, t)
    repeating, sizes = [], []
    for part in (rest - slow, slow):
        size = float(np.mean(part**2))
        sizes.append(size)
        repeating.append(max(0.0, size - _mean_square_between_periods(part, t, period)))
    fast, other = repeating
    not_repeating = None if period is None else (sum(sizes) - fast - other) / total
    return ErrorShares(bias, friction, position, acceleration, posture, not_repeating, fast / total, other / total)


def _slow_part(x: NDArray[np.float64], t: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns the part of a signal (r,) below `MOTION_FREQUENCY`. It is orthogonal to the rest of the signal."""
    frequency = np.fft.rfftfreq(len(x), float(t[-1] - t[0]) / (len(t) - 1))
    return np.fft.irfft(np.where(frequency < MOTION_FREQUENCY, np.fft.rfft(x), 0.0), len(x))


def _mean_square_between_periods(x: NDArray[np.float64], t: NDArray[np.float64], period: float | None) -> float:
    """Returns half the mean square of the difference of a signal (r,) between periods. Returns 0 without a period."""
    if period is None:
        return 0.0
    # Times in a gap have no measurement.
    after = np.clip(np.searchsorted(t, t + period), 1, len(t) - 1)
    first = (t + period <= t[-1]) & (t[after] - t[after - 1] < max(MIN_GAP, GAP * float(np.median(np.diff(t)))))
    return float(np.mean((np.interp(t[first] + period, t, x) - x[first]) ** 2)) / 2
