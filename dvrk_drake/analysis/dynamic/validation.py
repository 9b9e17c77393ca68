"""Validates a dynamic model on a motion, and estimates the shares of the error that have different causes."""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.analysis.results import Validation
from dvrk_drake.analysis.signals.low_pass import low_pass
from dvrk_drake.analysis.signals.motion_grid import MotionGrid, motion_grid
from dvrk_drake.analysis.signals.repetition import period_of, repeatability_floor
from dvrk_drake.analysis.verdict import judge, rule_text
from dvrk_drake.dynamics.identified_model import IdentifiedModel, Verdict
from dvrk_drake.recordings.recording import Recording

#: Width of the smoothed sign function of the friction-like error, as a share of the RMS velocity.
_FRICTION_WIDTH = 0.1
#: Number of frequencies of the sine and cosine functions in the position-dependent error.
_HARMONICS = 2


@dataclass(frozen=True)
class ActuatorError:
    """RMS effort error of one actuator over a motion, after low-pass filtering.

    Attributes:
        name: Name of the joint of the actuator.
        rms_effort: RMS measured effort [N m, N if prismatic].
        rms_error: RMS of measured minus predicted effort [N m, N if prismatic].
        relative_error: rms_error / rms_effort [1], None if rms_effort is 0.
        bias: Share of rms_error^2 due to the mean error.
        friction_like: Additional share of rms_error^2 that viscous and Coulomb friction in the actuator explain.
        position_dependent: Additional share of rms_error^2 that sine and cosine functions of the position explain. The
            functions have half a period and one period over the range of the position.
        other: Remaining share of rms_error^2.
        repeatability: Relative RMS difference of the efforts between periods (see `repeatability_floor`) [1], or None
            if the motion does not repeat.
        verdict: Verdict on the actuator, see `judge`.
    """

    name: str
    rms_effort: float
    rms_error: float
    relative_error: float | None
    bias: float
    friction_like: float
    position_dependent: float
    other: float
    repeatability: float | None
    verdict: Verdict


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class DynamicValidation(Validation):
    """Errors of a model on one motion.

    Attributes:
        actuators: Errors of the actuators, in the arm's order.
        cut_off: Cut-off of the low-pass filter of the compared efforts [Hz].
        t: Times (r,) of the compared rows [s]. One second at each end is omitted because of filter transients.
        q: Positions (r, n) of the actuators [rad, m].
        v: Velocities (r, n) of the actuators [rad/s, m/s].
        measured: Measured efforts (r, n) of the actuators after low-pass filtering [N m, N].
        predicted: Predicted efforts (r, n) of the actuators after low-pass filtering [N m, N].
    """

    actuators: list[ActuatorError]
    cut_off: float
    t: NDArray[np.float64]
    q: NDArray[np.float64]
    v: NDArray[np.float64]
    measured: NDArray[np.float64]
    predicted: NDArray[np.float64]

    @property
    def mean_relative_error(self) -> float:
        """Mean relative error over the actuators whose measured effort is not 0."""
        errors = [a.relative_error for a in self.actuators if a.relative_error is not None]
        return float(np.mean(errors)) if errors else float("nan")

    @property
    def verdicts(self) -> dict[str, Verdict]:
        """Verdict on each actuator."""
        return {actuator.name: actuator.verdict for actuator in self.actuators}

    @property
    def relative_errors(self) -> dict[str, float | None]:
        """RMS error / RMS effort of each actuator after low-pass filtering [1], None if its measured effort is 0."""
        return {actuator.name: actuator.relative_error for actuator in self.actuators}

    def as_dict(self) -> dict:
        """Returns the output of `validate --json` as a dictionary."""
        return {
            "verdict": self.verdict,
            "rule": rule_text(in_motion=True),
            "coordinates": "actuator",
            "cut_off_hz": self.cut_off,
            "mean_relative_error": self.mean_relative_error,
            "actuators": [asdict(actuator) for actuator in self.actuators],
        }


def predict_motion(model: IdentifiedModel, recording: Recording) -> NDArray[np.float64]:
    """Returns the predicted efforts (m, n) of the actuators at all rows of a motion, after the low-pass filter.

    Raises:
        RecordingError: The recording does not match the arm, or is not a motion.
        ModelError: The model has no dynamics.
    """
    dynamics = model.dynamic_model
    grid = motion_grid(recording, model.arm, dynamics.section.signals)
    return low_pass(_efforts(model, grid), grid.rate, grid.settings.effort_cut_off)


def validate_motion(model: IdentifiedModel, recording: Recording) -> DynamicValidation:
    """Compares predicted and measured efforts of a motion, in actuator coordinates.

    The relative error of an actuator is |tau_f - tau_hat| / |tau_f|, with the measured effort tau_f and the predicted
    effort tau_hat. Both efforts are filtered with the zero-phase low-pass filter, and one second at each end is
    omitted. Wang et al. (RA-L 2019) use the same metric.

    Raises:
        RecordingError: The recording does not match the arm, has no efforts, or is not a motion.
        ModelError: The model has no dynamics.
    """
    dynamics = model.dynamic_model
    arm = model.arm
    tau = recording.in_actuator_coordinates(arm).measured_effort()
    grid = motion_grid(recording, arm, dynamics.section.signals)
    measured, predicted = grid.filter_efforts(tau), grid.filter_efforts(_efforts(model, grid))
    t, a, v = grid.actuator_motion()
    period = period_of(grid)
    floor: list[float | None] = [None] * arm.num_joints
    if period is not None:
        floors = repeatability_floor(tau, grid.rate, period, grid.settings.effort_cut_off)
        floor = [float(x) if np.isfinite(x) else None for x in floors]
    actuators = [
        _actuator_error(name, measured[:, i], predicted[:, i], a[:, i], v[:, i], floor[i], float(arm.effort_limits[i]))
        for i, name in enumerate(arm.joint_names)
    ]
    return DynamicValidation(
        model=model,
        recording=recording,
        actuators=actuators,
        cut_off=grid.settings.effort_cut_off,
        t=t,
        q=a,
        v=v,
        measured=measured,
        predicted=predicted,
    )


def _efforts(model: IdentifiedModel, grid: MotionGrid) -> NDArray[np.float64]:
    return grid.efforts_at_rows(model.dynamic_model.effort(grid.q, grid.v, grid.vd))


def _actuator_error(
    name: str,
    measured: NDArray[np.float64],
    predicted: NDArray[np.float64],
    q: NDArray[np.float64],
    v: NDArray[np.float64],
    repeatability: float | None,
    effort_limit: float,
) -> ActuatorError:
    error = measured - predicted
    effort, size = float(np.sqrt(np.mean(measured**2))), float(np.sqrt(np.mean(error**2)))
    relative = size / effort if effort > 0 else None
    verdict = judge(effort, size, effort_limit, in_motion=True)
    return ActuatorError(name, effort, size, relative, *error_shares(error, q, v), repeatability, verdict)


def error_shares(
    error: NDArray[np.float64], q: NDArray[np.float64], v: NDArray[np.float64]
) -> tuple[float, float, float, float]:
    """Returns the shares of the squared effort error of one actuator: bias, friction-like, position-dependent, other.

    `ActuatorError` defines the shares. Their sum is 1.

    Args:
        error: Measured minus predicted efforts (r,) [N m, N].
        q, v: Positions [rad, m] and velocities (r,) of the actuator.
    """
    width = _FRICTION_WIDTH * float(np.sqrt(np.mean(v**2))) or 1.0
    travel = (q - q.min()) / (float(np.ptp(q)) or 1.0)
    kinds = [
        [np.ones_like(q)],
        [v, np.tanh(v / width)],
        [f(np.pi * k * travel) for k in range(1, _HARMONICS + 1) for f in (np.sin, np.cos)],
    ]
    shares = []
    columns: list[NDArray[np.float64]] = []
    total = unexplained = float(np.sum(error**2)) or 1.0
    for kind in kinds:
        columns += kind
        X = np.column_stack(columns)
        remaining = float(np.sum((error - X @ np.linalg.lstsq(X, error, rcond=None)[0]) ** 2))
        shares.append((unexplained - remaining) / total)
        unexplained = remaining
    bias, friction, position = shares
    return bias, friction, position, unexplained / total
