"""Difference between the efforts of two recordings of the same motion, after alignment in time."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import PchipInterpolator
from scipy.optimize import minimize_scalar

from dvrk_drake.analysis.signals.drive_efforts import DriveEfforts, drive_efforts, refuse_opposite_efforts
from dvrk_drake.analysis.signals.motion_grid import GRID_RATE, MotionGrid, motion_grid
from dvrk_drake.analysis.signals.repetition import SAME_MOTION, period_of
from dvrk_drake.dynamics.dynamic_model import DynamicModel
from dvrk_drake.errors import RecordingError
from dvrk_drake.recordings.recording import Recording


@dataclass(frozen=True, eq=False)
class Whitening:
    """Whitening filter x[t] - sum_k coefficients[k - 1] x[t - k step] for each channel.

    The step is half a period of the cut-off frequency of the low-pass filter of the rows. Sampling at this spacing
    contains their full bandwidth and nothing above it.

    Attributes:
        coefficients: Coefficients (n, order) of each channel. Zeros leave the channel unchanged.
        step: Number of rows between the values that are combined.
    """

    coefficients: NDArray[np.float64]
    step: int

    @classmethod
    def none(cls, channels: int) -> Whitening:
        """Returns the whitening filter that leaves white rows unchanged."""
        return cls(np.zeros((channels, 0)), 1)

    @classmethod
    def of(cls, residual: NDArray[np.float64], order: int, rate: float, cut_off: float) -> Whitening:
        """Fits the autoregression of residuals (r, n), filtered at `cut_off` [Hz] and sampled at `rate` [Hz]."""
        step = max(1, round(rate / (2 * cut_off)))
        coefficients = []
        for x in residual.T:
            past = np.column_stack([x[(order - k) * step : len(x) - k * step] for k in range(1, order + 1)])
            coefficients.append(np.linalg.lstsq(past, x[order * step :], rcond=None)[0])
        return cls(np.array(coefficients), step)

    @property
    def lost(self) -> int:
        """Number of rows at the start that are removed because they have no preceding rows."""
        return self.coefficients.shape[1] * self.step

    def __call__(self, x: NDArray[np.float64], channel: int) -> NDArray[np.float64]:
        """Returns the filtered rows (r - lost, ...) for the rows x (r, ...) of one channel."""
        y = x[self.lost :].copy()
        for k, a in enumerate(self.coefficients[channel], start=1):
            y -= a * x[self.lost - k * self.step : len(x) - k * self.step]
        return y


#: Largest time shift between two motions that do not repeat [s].
MAX_SHIFT = 5.0
#: Smallest duration of the motion that both recordings must contain [s].
MIN_OVERLAP = 5.0
#: Cut-off frequency of the low-pass filter of the difference [Hz]. The effort of a payload is as slow as the motion,
#: and the rest is noise.
CUT_OFF = 5.0
#: Expected change of position-dependent torques as a share of an actuator's RMS effort. Between two days of a PSM
#: without payload it is 0.4 to 9 % for the actuators, with an RMS of 5.6 % (psm_one, psm_one_no_weight of
#: docs/public_recordings.md).
DRIFT = 0.06
#: Number of linear segments of a position-dependent torque over an actuator's range. Joint stops and folds of cables
#: have local effects.
PIECES = 8
#: Correlation length of a position-dependent torque as a share of the range.
CORRELATED = 0.25
#: Number of columns of `changes` without prior: offset, Coulomb friction and viscous friction.
_SIMPLE = 3
#: Step of the search before refinement [s].
_STEP = 0.01


@dataclass(frozen=True, eq=False)
class MotionDifference:
    """Difference from a reference to another recording of the same motion.

    Attributes:
        grid: Grid of the other motion.
        rows: Indices or mask (r,) of its inner rows that have a counterpart in the reference.
        period: Period of a repeating motion [s], or None.
        shift: Time shift [s]. The other motion at t corresponds to the reference at t + shift.
        tau: Filtered difference of the efforts of the actuators (k, n) [N m, N], other minus reference. The difference
            predicted by the model for the small differences of the two motions is subtracted.
        changes: Columns (k, n, c) for possible changes of each drive: an offset, Coulomb and viscous friction, and
            position-dependent torques (cables, springs, a joint stop), which are piecewise linear.
        deviation: Prior standard deviations (n, c) of the changes as RMS efforts [N m, N], inf where there is no prior.
    """

    grid: MotionGrid
    rows: NDArray[np.bool_]
    period: float | None
    shift: float
    tau: NDArray[np.float64]
    changes: NDArray[np.float64]
    deviation: NDArray[np.float64]


def motion_difference(reference: Recording, other: Recording, model: DynamicModel) -> MotionDifference:
    """Aligns two recordings of one motion and subtracts the reference.

    Args:
        reference: Recording of the motion before the change, in joint or actuator coordinates.
        other: Recording of the same motion after the change, in joint or actuator coordinates.
        model: Model of the arm before the change. It is only used for the small differences of the motions.

    Raises:
        RecordingError: A recording is not a motion of this arm, an effort has the wrong sign, or the recordings are not
            of the same motion.
    """
    signals = model.section.signals
    settings = replace(signals, effort_cut_off=min(CUT_OFF, signals.effort_cut_off))
    before, grid = (motion_grid(recording, model.arm, settings) for recording in (reference, other))
    period = period_of(grid)
    shift = _shift(before, grid, period, other)
    expected = drive_efforts(model, grid)
    (tau, left), (_, left_before) = (
        _efforts(reference_or_other, own, efforts, model)
        for reference_or_other, own, efforts in (
            (other, grid, expected),
            (reference, before, drive_efforts(model, before)),
        )
    )
    t, t_before = grid.row_times[grid.inner] + shift, before.row_times[before.inner]
    rows = (t >= t_before[0]) & (t <= t_before[-1])
    changes = _changes(model, grid, expected)[rows]
    size = np.sqrt(np.mean(tau**2, axis=0))
    deviation = np.full(changes.shape[1:], np.inf)
    parts = np.sqrt(np.mean(changes[..., _SIMPLE:] ** 2, axis=0))
    deviation[:, _SIMPLE:] = DRIFT * size[:, None] * parts / np.linalg.norm(parts, axis=1, keepdims=True)
    change = left[rows] - _at(t_before, left_before, t[rows])
    return MotionDifference(grid, rows, period, shift, change, changes, deviation)


def _efforts(
    recording: Recording, grid: MotionGrid, expected: DriveEfforts, model: DynamicModel
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Returns the filtered efforts of the actuators (r, n), measured and minus those predicted by the model."""
    tau = grid.filter_efforts(recording.in_actuator_coordinates(model.arm).measured_effort())
    refuse_opposite_efforts(recording, model.arm.joint_names, tau, expected.total())
    return tau, tau - expected.total()


def _changes(model: DynamicModel, grid: MotionGrid, expected: DriveEfforts) -> NDArray[np.float64]:
    """Returns the columns (r, n, 3 + PIECES + 1) for changes of the drives at the inner rows."""
    transmission = model.arm.transmission
    speed = grid.filter_efforts(grid.efforts_at_rows(transmission.velocity(grid.v)))
    a = transmission.position(grid.q)
    shapes = np.stack([_shapes(x) for x in a.T], axis=1)
    flat = grid.filter_efforts(np.stack([grid.at_rows(shapes[:, i], i) for i in range(a.shape[1])], axis=1))
    simple = np.stack([np.ones_like(speed), expected.friction_part("dry"), speed], axis=2)
    return np.concatenate([simple, flat], axis=2)


def _shapes(x: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns basis functions (m, PIECES + 1) at positions (m,).

    With independent weights their sum is linear between knots, and adjacent knots are correlated. It is a Gaussian
    process over the range with a squared-exponential kernel.
    """
    place = (x - np.min(x)) / max(float(np.ptp(x)), np.finfo(float).tiny)
    knots = np.linspace(0.0, 1.0, PIECES + 1)
    hats = np.maximum(1 - PIECES * np.abs(place[:, None] - knots), 0.0)
    kernel = np.exp(-0.5 * ((knots[:, None] - knots) / CORRELATED) ** 2)
    values, vectors = np.linalg.eigh(kernel)
    return np.asarray(hats @ (vectors * np.sqrt(np.maximum(values, 0.0))))


def _at(t: NDArray[np.float64], x: NDArray[np.float64], times: NDArray[np.float64]) -> NDArray[np.float64]:
    different = np.concatenate([[True], np.diff(t) > 0])
    return np.asarray(PchipInterpolator(t[different], x[different], axis=0)(times), dtype=float)


def _shift(reference: MotionGrid, other: MotionGrid, period: float | None, recording: Recording) -> float:
    """Returns the shift at which the positions, in units of their standard deviations, agree best."""
    deviation = np.std(other.q, axis=0)
    moving = deviation > 1e-3
    x, y = (grid.q[:, moving] / deviation[moving] for grid in (reference, other))
    step = round(_STEP * GRID_RATE)
    start = other.t[0] - reference.t[0]

    def distance(shift: int) -> float:
        """Returns half the mean squared difference between x[i + shift] and y[i]."""
        first, last = max(0, -shift), min(len(y), len(x) - shift)
        if last - first < MIN_OVERLAP * GRID_RATE:
            return np.inf
        return float(np.mean((x[first + shift : last + shift : step] - y[first:last:step]) ** 2)) / 2

    max_shift = round((MAX_SHIFT if period is None else period / 2) * GRID_RATE)
    coarse = min(range(-max_shift, max_shift + 1, step), key=distance)
    best = min(range(coarse - step, coarse + step + 1), key=distance)
    if not distance(best) < SAME_MOTION**2:
        raise RecordingError(
            f"{recording.source or 'recording'}: the motion differs from the reference. After alignment in time, the "
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
