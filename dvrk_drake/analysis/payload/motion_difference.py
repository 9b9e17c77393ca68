"""Two recordings of one motion: brought onto the same time, and by how much their efforts differ."""

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
    """x[t] - sum_k coefficients[k - 1] x[t - k step], channel by channel.

    The step is half a period of the low-pass that the rows are behind: at that spacing their whole band is there, and
    nothing else is.

    Attributes:
        coefficients: (n, order) of each channel; zeros leave it as it is.
        step: rows between the values that are combined.
    """

    coefficients: NDArray[np.float64]
    step: int

    @classmethod
    def none(cls, channels: int) -> Whitening:
        """That of white rows."""
        return cls(np.zeros((channels, 0)), 1)

    @classmethod
    def of(cls, residual: NDArray[np.float64], order: int, rate: float, cut_off: float) -> Whitening:
        """The autoregression of residuals (r, n) that lie behind a low-pass at `cut_off` [Hz], rows at `rate` [Hz]."""
        step = max(1, round(rate / (2 * cut_off)))
        coefficients = []
        for x in residual.T:
            past = np.column_stack([x[(order - k) * step : len(x) - k * step] for k in range(1, order + 1)])
            coefficients.append(np.linalg.lstsq(past, x[order * step :], rcond=None)[0])
        return cls(np.array(coefficients), step)

    @property
    def lost(self) -> int:
        """Rows at the start that have no past."""
        return self.coefficients.shape[1] * self.step

    def __call__(self, x: NDArray[np.float64], channel: int) -> NDArray[np.float64]:
        """Rows (r - lost, ...) of one channel's rows x (r, ...)."""
        y = x[self.lost :].copy()
        for k, a in enumerate(self.coefficients[channel], start=1):
            y -= a * x[self.lost - k * self.step : len(x) - k * self.step]
        return y


#: A motion that does not repeat may have begun so much sooner or later than the other [s].
MAX_SHIFT = 5.0
#: Both recordings must have so much of the motion [s].
MIN_OVERLAP = 5.0
#: Of the low-pass that the difference is behind [Hz]: what a payload adds is as slow as the motion, the rest is noise.
CUT_OFF = 5.0
#: By how much of an actuator's RMS effort torques that depend on its position may change: 0.4 to 9 % (RMS 5.6 %),
#: actuator by actuator, between two days of a PSM without payload (psm_one, psm_one_no_weight of
#: docs/public_recordings.md).
DRIFT = 0.06
#: Pieces of an actuator's travel, in each of which such a torque is linear: a stop or a cable's fold is local.
PIECES = 8
#: Share of the travel over which such a torque at one place goes with that at another.
CORRELATED = 0.25
#: Columns of `changes` of which nothing is known beforehand: offset, dry and viscous friction.
_SIMPLE = 3
#: Step of the search before it is refined [s].
_STEP = 0.01


@dataclass(frozen=True, eq=False)
class MotionDifference:
    """What changed from a reference to another recording of the same motion.

    Attributes:
        grid: the other motion.
        rows: (r,) which of its inner rows have a counterpart in the reference.
        period: after which the motion repeats [s], or None.
        shift: the other motion at t is the reference at t + shift [s].
        tau: (k, n) efforts of the actuators [N m, N], other less reference, behind the filter, less what the model
            expects since the two motions differ a little.
        changes: (k, n, c) by which the drives may have changed since, actuator by actuator: an offset, dry and viscous
            friction, and torques that depend on the position (cables, springs, a stop), piecewise linear in it.
        deviation: (n, c) RMS effort [N m, N] by which each may well have changed; inf where nothing is known.
    """

    grid: MotionGrid
    rows: NDArray[np.bool_]
    period: float | None
    shift: float
    tau: NDArray[np.float64]
    changes: NDArray[np.float64]
    deviation: NDArray[np.float64]


def motion_difference(reference: Recording, other: Recording, model: DynamicModel) -> MotionDifference:
    """Subtracts the reference.

    Args:
        reference, other: recordings of the same motion, in either coordinates.
        model: of the arm without what was added to it; only small differences of the motions go through it.

    Raises:
        RecordingError: one is no motion of this arm, an effort has the wrong sign, or they are not of the same motion.
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
    """(r, n) measured efforts of the actuators behind the filter, and what the model leaves of them."""
    tau = grid.behind_filter(recording.in_actuator_coordinates(model.arm).measured_effort())
    refuse_opposite_efforts(recording, model.arm.joint_names, tau, expected.total())
    return tau, tau - expected.total()


def _changes(model: DynamicModel, grid: MotionGrid, expected: DriveEfforts) -> NDArray[np.float64]:
    """(r, n, 3 + PIECES + 1) at the inner rows."""
    transmission = model.arm.transmission
    speed = grid.behind_filter(grid.efforts_at_rows(transmission.velocity(grid.v)))
    a = transmission.position(grid.q)
    shapes = np.stack([_shapes(x) for x in a.T], axis=1)
    flat = grid.behind_filter(np.stack([grid.at_rows(shapes[:, i], i) for i in range(a.shape[1])], axis=1))
    simple = np.stack([np.ones_like(speed), expected.friction_part("dry"), speed], axis=2)
    return np.concatenate([simple, flat], axis=2)


def _shapes(x: NDArray[np.float64]) -> NDArray[np.float64]:
    """(m, PIECES + 1) of positions (m,): with independent weights their sum is piecewise linear between knots, and
    neighbouring knots are alike (a Gaussian process over the travel, with a squared-exponential kernel)."""
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
    """The shift at which the positions agree best, in units of their standard deviations."""
    deviation = np.std(other.q, axis=0)
    moving = deviation > 1e-3
    x, y = (grid.q[:, moving] / deviation[moving] for grid in (reference, other))
    step = round(_STEP * GRID_RATE)
    start = other.t[0] - reference.t[0]

    def apart(shift: int) -> float:
        """Half the mean squared difference, x[i + shift] against y[i]."""
        first, last = max(0, -shift), min(len(y), len(x) - shift)
        if last - first < MIN_OVERLAP * GRID_RATE:
            return np.inf
        return float(np.mean((x[first + shift : last + shift : step] - y[first:last:step]) ** 2)) / 2

    reach = round((MAX_SHIFT if period is None else period / 2) * GRID_RATE)
    coarse = min(range(-reach, reach + 1, step), key=apart)
    best = min(range(coarse - step, coarse + step + 1), key=apart)
    if not apart(best) < SAME_MOTION**2:
        raise RecordingError(
            f"{recording.source or 'recording'}: is not the motion of the reference: at the best alignment positions "
            f"differ by {np.sqrt(apart(best)):.0%} of their standard deviation; at most {SAME_MOTION:.0%} is allowed"
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
