"""Computes how the efforts of a recording differ from those of another recording of the motion, or from a model."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import PchipInterpolator
from scipy.optimize import minimize_scalar

from dvrk_drake.analysis.observations.motion_grid import GRID_RATE, MotionGrid
from dvrk_drake.analysis.observations.observations import Observations
from dvrk_drake.analysis.observations.repetition import SAME_MOTION
from dvrk_drake.dynamics.dynamic_model import DynamicModel
from dvrk_drake.errors import RecordingError
from dvrk_drake.models.effects_schema import EFFECT_KINDS, half_width
from dvrk_drake.recordings.recording import Recording

#: Roles of friction effects. All effects of one role at a coordinate change together, for example with temperature or
#: lubrication.
FrictionPart = Literal["dry", "viscous"]


@dataclass(frozen=True, eq=False)
class DriveEfforts:
    """Predicted actuator efforts at the inner rows of a motion (`MotionGrid.inner`), after low-pass filtering.

    Attributes:
        other: Efforts (r, n) of the rigid bodies and of all effects except friction [N m, N].
        friction: Actuator efforts (r, n) of the dry or viscous friction at each coordinate [N m, N].
    """

    other: NDArray[np.float64]
    friction: dict[tuple[str, FrictionPart], NDArray[np.float64]]

    def total(self) -> NDArray[np.float64]:
        """Returns the sum (r, n) of friction and all other efforts."""
        return self.other + sum(self.friction.values(), np.zeros_like(self.other))

    def friction_part(self, part: FrictionPart) -> NDArray[np.float64]:
        """Returns the actuator efforts (r, n) of the dry or viscous friction, summed over all coordinates."""
        return sum((x for (_, own), x in self.friction.items() if own == part), np.zeros_like(self.other))


def drive_efforts(model: DynamicModel, grid: MotionGrid) -> DriveEfforts:
    """Returns the efforts that `model` predicts for the motion on `grid`."""
    if grid.segments:
        parts = [drive_efforts(model, own) for own in grid.segments]
        return DriveEfforts(
            np.concatenate([part.other for part in parts]),
            {key: np.concatenate([part.friction[key] for part in parts]) for key in parts[0].friction},
        )
    other = model.rigid_body_effort(grid.q, grid.v, grid.vd)
    friction: dict[tuple[str, FrictionPart], NDArray[np.float64]] = {}
    rows = model.arm.effect_coordinates
    shapes = model.effect_shapes(grid.q, grid.v, grid.vd)
    for effect, coefficient, shape in zip(model.effects, model.coefficients, shapes, strict=True):
        if not coefficient:
            continue
        effort = coefficient * shape[:, None] * rows[effect.coordinate]
        role = EFFECT_KINDS[effect.kind].role
        if role == "dry" or role == "viscous":
            key = (effect.coordinate, role)
            friction[key] = friction.get(key, 0.0) + effort
        else:
            other = other + effort
    return DriveEfforts(
        grid.filter_efforts(grid.efforts_at_rows(other)),
        {key: grid.filter_efforts(grid.efforts_at_rows(x)) for key, x in friction.items()},
    )


#: Largest correlation between measured and predicted efforts that indicates a wrong sign of the effort. It is near 0
#: for unrelated efforts, and at least 0.87 for models of public motions on other motions of the same arm.
MAX_OPPOSITE_CORRELATION = -0.3


def refuse_opposite_efforts(
    recording: Recording, names: tuple[str, ...], tau: NDArray[np.float64], expected: NDArray[np.float64]
) -> None:
    """Rejects measured efforts whose sign is opposite to the sign of the predicted efforts. Offsets are ignored.

    Args:
        recording: Recording of the efforts, for the message.
        names: Names of the n joints of the actuators.
        tau: Measured efforts (r, n) of the actuators after low-pass filtering [N m, N].
        expected: Predicted efforts (r, n) after the same filter [N m, N].

    Raises:
        RecordingError: The measured efforts of an actuator are opposite to the predicted efforts.
    """
    x, y = tau - np.mean(tau, axis=0), expected - np.mean(expected, axis=0)
    size = np.sqrt(np.sum(x**2, axis=0) * np.sum(y**2, axis=0))
    correlation = np.sum(x * y, axis=0) / np.maximum(size, np.finfo(float).tiny)
    if len(wrong := np.flatnonzero(correlation < MAX_OPPOSITE_CORRELATION)):
        which = ", ".join(f"{names[j]} (correlation {correlation[j]:.2f})" for j in wrong)
        raise RecordingError(
            f"{recording.source or 'recording'}: measured efforts are opposite to the efforts of the model: {which}. "
            "Check the signs of tau and q (efforts are positive in the direction of +q), and check the arm."
        )


@dataclass(frozen=True, eq=False)
class Whitening:
    """Whitening filter x[t] - sum_k coefficients[k - 1] x[t - k step] for each actuator.

    The step is half a period of the cut-off frequency of the low-pass filter. Samples at this interval contain the full
    bandwidth of the filtered signals.

    Attributes:
        coefficients: Coefficients (n, order) of the actuators.
        step: Number of rows between two values that the filter combines.
    """

    coefficients: NDArray[np.float64]
    step: int

    @classmethod
    def none(cls, channels: int) -> Whitening:
        """Returns a filter that does not change its input."""
        return cls(np.zeros((channels, 0)), 1)

    @classmethod
    def of(cls, residual: NDArray[np.float64], order: int, rate: float, cut_off: float) -> Whitening:
        """Creates the whitening filter from an autoregression of residuals.

        Args:
            residual: Residuals (r, n), low-pass filtered.
            order: Order of the autoregression.
            rate: Sampling rate [Hz].
            cut_off: Cut-off of the low-pass filter [Hz].
        """
        step = max(1, round(rate / (2 * cut_off)))
        coefficients = []
        for x in residual.T:
            past = np.column_stack([x[(order - k) * step : len(x) - k * step] for k in range(1, order + 1)])
            coefficients.append(np.linalg.lstsq(past, x[order * step :], rcond=None)[0])
        return cls(np.array(coefficients), step)

    @property
    def num_removed(self) -> int:
        """Number of rows at the start that the filter removes, because they have too few preceding rows."""
        return self.coefficients.shape[1] * self.step

    def __call__(self, x: NDArray[np.float64], channel: int) -> NDArray[np.float64]:
        """Returns the filtered rows (r - num_removed, ...) for the rows x (r, ...) of one actuator."""
        y = x[self.num_removed :].copy()
        for k, a in enumerate(self.coefficients[channel], start=1):
            y -= a * x[self.num_removed - k * self.step : len(x) - k * self.step]
        return y


#: Largest time shift between two motions that do not repeat [s]. A recorder that is started by hand is early or late by
#: less than this time.
MAX_SHIFT = 5.0
#: Smallest duration of the motion that both recordings must contain [s]. At the cut-off frequency `CUT_OFF`, it has 50
#: independent values of each effort.
MIN_OVERLAP = 5.0
#: Largest cut-off frequency of the low-pass filter of the difference [Hz]. Efforts of a payload have the frequencies of
#: the motion, which are below this value.
CUT_OFF = 5.0
#: Expected change of position-dependent torques as a share of an actuator's RMS effort. Between recordings of a PSM
#: without payload on two days, the RMS change over the actuators is 5.6 % (psm_one and psm_one_no_weight of
#: docs/public_recordings.md).
DRIFT = 0.06
#: Number of linear segments of a position-dependent torque over an actuator's range. Many segments are necessary,
#: because joint stops and cables have local effects.
NUM_SEGMENTS = 8
#: Correlation length of a position-dependent torque as a share of the range: two of the linear segments. Torques of
#: neighbouring knots then have a correlation of 0.88.
CORRELATION_LENGTH = 0.25
#: Number of columns of `changes` without prior: offset, dry friction and viscous friction.
_NUM_WITHOUT_PRIOR = 3
#: Step of the search for the time shift before refinement [s]. The difference of the positions has a single minimum
#: within a period of their highest frequencies, which is many times longer.
_STEP = 0.01


@dataclass(frozen=True, eq=False)
class MotionDifference:
    """Difference of the efforts of a recording from those of a reference, or from the efforts of the model.

    Attributes:
        grid: Resampled motion of the recording.
        rows: Mask (r,) of the inner rows of `grid` at times that the reference also covers. It selects k rows.
        period: Period of the motion [s], or None if the motion does not repeat.
        shift: Time shift [s]. Time t of the recording corresponds to time t + shift of the reference.
        tau: Low-pass filtered difference (k, n) of the actuator efforts [N m, N]. The effect of small differences
            between the two motions is predicted by the model and subtracted.
        changes: Columns (k, n, c) for possible changes of each drive: an offset, dry and viscous friction, and
            piecewise linear position-dependent torques (cables, springs, joint stops).
        deviation: Prior standard deviations (n, c) of the changes as RMS efforts [N m, N], inf if there is no prior.
    """

    grid: MotionGrid
    rows: NDArray[np.bool_]
    period: float | None
    shift: float
    tau: NDArray[np.float64]
    changes: NDArray[np.float64]
    deviation: NDArray[np.float64]


def motion_difference(reference: Observations | None, loaded: Observations, model: DynamicModel) -> MotionDifference:
    """Subtracts the efforts of a reference from those of a recording, after alignment in time.

    Of a recording with gaps, the longest segment between gaps is used.

    Args:
        reference: Recording of the same motion without payload, in joint or actuator coordinates. None: the efforts of
            the model are subtracted.
        other: Recording of the motion with the payload, in joint or actuator coordinates.
        model: Model of the arm without payload. With a reference, it predicts the effect of small differences between
            the two motions.

    Raises:
        RecordingError: A recording is not a motion of this arm, an effort has the wrong sign, or the recordings are not
            of the same motion.
    """
    signals = model.section.signals
    settings = replace(signals, effort_cut_off=min(CUT_OFF, signals.effort_cut_off))
    loaded = loaded.longest
    grid = replace(loaded.grid, settings=settings)
    expected = drive_efforts(model, grid)
    tau, change = _efforts(loaded, grid, expected)
    period, changes = loaded.period, _changes(model, grid, expected)
    # An error of the model, or a change of the arm since its identification, also depends on the position.
    expected_change = DRIFT * np.sqrt(np.mean(tau**2, axis=0))
    if reference is None:
        rows, shift = np.ones(len(change), bool), 0.0
        expected_change = np.hypot(expected_change, model.half_width / half_width(1.0, None))
    else:
        reference = reference.longest
        reference_grid = replace(reference.grid, settings=settings)
        shift = _shift(reference_grid, grid, period, loaded.source)
        _, reference_residual = _efforts(reference, reference_grid, drive_efforts(model, reference_grid))
        t, reference_t = grid.row_times[grid.inner] + shift, reference_grid.row_times[reference_grid.inner]
        rows = (t >= reference_t[0]) & (t <= reference_t[-1])
        change = change[rows] - _interpolate(reference_t, reference_residual, t[rows])
        changes = changes[rows]
    deviation = np.full(changes.shape[1:], np.inf)
    sizes = np.sqrt(np.mean(changes[..., _NUM_WITHOUT_PRIOR:] ** 2, axis=0))
    deviation[:, _NUM_WITHOUT_PRIOR:] = expected_change[:, None] * sizes / np.linalg.norm(sizes, axis=1, keepdims=True)
    return MotionDifference(grid, rows, period, shift, change, changes, deviation)


def _efforts(
    observations: Observations, grid: MotionGrid, expected: DriveEfforts
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Returns the measured efforts (r, n) and the residuals (r, n) of the model, after low-pass filtering."""
    tau = grid.filter_efforts(observations.tau)
    refuse_opposite_efforts(observations.recording, observations.arm.joint_names, tau, expected.total())
    return tau, tau - expected.total()


def _changes(model: DynamicModel, grid: MotionGrid, expected: DriveEfforts) -> NDArray[np.float64]:
    """Returns the columns (r, n, c) for changes of the drives at the inner rows, see `MotionDifference.changes`."""
    transmission = model.arm.transmission
    velocity = grid.filter_efforts(grid.efforts_at_rows(transmission.velocity(grid.v)))
    a = transmission.position(grid.q)
    shapes = np.stack([_shapes(x) for x in a.T], axis=1)
    position_dependent = grid.filter_efforts(
        np.stack([grid.at_rows(shapes[:, i], i) for i in range(a.shape[1])], axis=1)
    )
    without_prior = np.stack([np.ones_like(velocity), expected.friction_part("dry"), velocity], axis=2)
    return np.concatenate([without_prior, position_dependent], axis=2)


def _shapes(x: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns basis functions (m, NUM_SEGMENTS + 1) at positions (m,).

    With independent standard normal coefficients, the sum of the functions is a Gaussian process over the range. Its
    kernel is squared-exponential at the knots, with linear interpolation between the knots.
    """
    scaled = (x - np.min(x)) / max(float(np.ptp(x)), np.finfo(float).tiny)
    knots = np.linspace(0.0, 1.0, NUM_SEGMENTS + 1)
    hats = np.maximum(1 - NUM_SEGMENTS * np.abs(scaled[:, None] - knots), 0.0)
    kernel = np.exp(-0.5 * ((knots[:, None] - knots) / CORRELATION_LENGTH) ** 2)
    values, vectors = np.linalg.eigh(kernel)
    return np.asarray(hats @ (vectors * np.sqrt(np.maximum(values, 0.0))))


def _interpolate(t: NDArray[np.float64], x: NDArray[np.float64], times: NDArray[np.float64]) -> NDArray[np.float64]:
    different = np.concatenate([[True], np.diff(t) > 0])
    return np.asarray(PchipInterpolator(t[different], x[different], axis=0)(times), dtype=float)


def _shift(reference: MotionGrid, other: MotionGrid, period: float | None, source: str) -> float:
    """Returns the time shift [s] that minimises the mean squared difference of the positions.

    The positions of each joint are divided by their standard deviation.
    """
    deviation = np.std(other.q, axis=0)
    moving = deviation > 1e-3
    x, y = (grid.q[:, moving] / deviation[moving] for grid in (reference, other))
    step = round(_STEP * GRID_RATE)
    start = other.t[0] - reference.t[0]

    def distance(shift: int) -> float:
        """Returns half the mean squared difference between x[i + shift] and y[i], inf if the overlap is too short."""
        first, last = max(0, -shift), min(len(y), len(x) - shift)
        if last - first < MIN_OVERLAP * GRID_RATE:
            return np.inf
        return float(np.mean((x[first + shift : last + shift : step] - y[first:last:step]) ** 2)) / 2

    max_shift = round((MAX_SHIFT if period is None else period / 2) * GRID_RATE)
    coarse = min(range(-max_shift, max_shift + 1, step), key=distance)
    best = min(range(coarse - step, coarse + step + 1), key=distance)
    if not distance(best) < SAME_MOTION**2:
        raise RecordingError(
            f"{source}: the motion differs from the reference. After alignment in time, the "
            f"positions differ by {100 * np.sqrt(distance(best)):.0f} % of their standard deviation; at most "
            f"{100 * SAME_MOTION:.0f} % is allowed."
        )
    inner = y[max(0, -best) + 1 : min(len(y), len(x) - best) - 1]
    at = np.arange(max(0, -best) + 1, max(0, -best) + 1 + len(inner)) + best
    curve = PchipInterpolator(np.arange(len(x)), x)
    fine = minimize_scalar(
        lambda d: float(np.mean((curve(np.clip(at + d, 0, len(x) - 1)) - inner) ** 2)),
        bounds=(-1.0, 1.0),
        method="bounded",
    )
    return float((best + fine.x) / GRID_RATE - start)
