"""Resamples a recorded motion at a constant rate and applies zero-phase low-pass filters."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dvrk_drake.analysis.observations.signals import central_difference, low_pass, resample
from dvrk_drake.analysis.observations.true_time import TrueTime, velocity_agreement
from dvrk_drake.dynamics.dynamic_section import SignalSettings
from dvrk_drake.models.arm import Arm
from dvrk_drake.recordings.recording import Recording

#: Rate of the time grid [Hz], high enough to resolve hysteresis when a joint reverses its direction. Half or twice the
#: rate changes the mean errors of the public motions `mtm_one` and `psm_one`, cross-validated and on another day, by
#: less than 0.2 percentage points.
GRID_RATE = 400.0
#: Duration that is omitted at each end because of filter transients [s], as for the published errors of a real MTM and
#: PSM (Wang et al., RA-L 2019: 200 rows at 200 Hz), and its largest share of a motion. Motions of less than 20 s would
#: otherwise lose more than a tenth of their rows.
ENDS, ENDS_SHARE = 1.0, 0.05
#: Smallest accepted duration of a motion, and of each of its segments between gaps [s]. At the cut-off frequency of
#: 10 Hz that is the default for efforts, it has 40 independent values of each effort.
MIN_DURATION = 2.0
#: Number of rows in one part of `MotionGrid.parts`. It limits the memory of a long motion. Half or twice the number
#: changes no result of the public motions `mtm_one` and `psm_one`.
PART_ROWS = 10_000
#: Additional rows at both ends of a part, in periods of the effort filter's cut-off. A filter transient decays by a
#: factor of 1e13 in this time.
PART_OVERLAP = 20.0


def ends_of(duration: float) -> float:
    """Returns the duration [s] that is omitted at each end of a motion of some duration [s]."""
    return min(ENDS, ENDS_SHARE * duration)


@dataclass(frozen=True, eq=False)
class MotionSignals:
    """Signals of a motion at a constant rate, in the coordinates of the recording.

    Attributes:
        t: Times (m,) at a constant rate [s].
        q: Positions (m, n), low-pass filtered [rad, m].
        v: Velocities (m, n), low-pass filtered [rad/s, m/s].
        vd: Accelerations (m, n), low-pass filtered [rad/s^2, m/s^2].
        tau: Efforts (m, n), not filtered [N m, N]. Use the same filter for efforts and regressors, see `low_pass`.
    """

    t: NDArray[np.float64]
    q: NDArray[np.float64]
    v: NDArray[np.float64]
    vd: NDArray[np.float64]
    tau: NDArray[np.float64]

    @property
    def rate(self) -> float:
        """Sampling rate [Hz]."""
        return float((len(self.t) - 1) / (self.t[-1] - self.t[0]))


def motion_signals(
    recording: Recording,
    clock: TrueTime,
    acceleration_cut_off: ArrayLike,
    *,
    rate: float = GRID_RATE,
) -> MotionSignals:
    """Resamples a motion at a constant rate and computes velocities and accelerations.

    Rows that repeat the previous row are omitted. The signals are interpolated at `rate`, and q and v are filtered at
    `SignalSettings.position_cut_off`. The acceleration vd is the central difference of v, filtered at
    `acceleration_cut_off`.

    Args:
        recording: Motion with t and tau, in the coordinates of the result.
        clock: True times of the rows of the recording.
        acceleration_cut_off: Cut-off of the zero-phase low-pass filter for vd [Hz], a scalar or one value (n,) per
            joint.
        rate: Rate of the grid [Hz].

    Raises:
        RecordingError: The recording has no efforts.
    """
    tau = recording.measured_effort()[clock.rows]
    t, cut_off = even_times(clock, rate), SignalSettings().position_cut_off
    q = low_pass(resample(clock.t, recording.q[clock.rows], t), rate, cut_off)
    v = central_difference(q, rate)
    agrees = np.zeros(q.shape[1], dtype=bool)
    if recording.qd is not None:
        qd = low_pass(resample(clock.t, recording.qd[clock.rows], t), rate, cut_off)
        agrees = velocity_agreement(q, qd, rate).agrees
        v = np.where(agrees, qd, v)
    vd = low_pass(central_difference(v, rate), rate, acceleration_cut_off)
    return MotionSignals(t, q, v, vd, resample(clock.t, tau, t))


def even_times(clock: TrueTime, rate: float) -> NDArray[np.float64]:
    """Returns times at a constant rate [Hz], from the first to the last true time [s]."""
    return clock.t[0] + np.arange(int((clock.t[-1] - clock.t[0]) * rate) + 1) / rate


@dataclass(frozen=True, eq=False)
class MotionGrid:
    """Motion of an arm, resampled and low-pass filtered according to `settings`.

    Attributes:
        arm: Arm that was recorded.
        settings: Cut-offs of the filters and delays of the efforts.
        t: Times (m,) at the constant rate `GRID_RATE` [s].
        q: Positions (m, n) of the joints [rad, m].
        v: Velocities (m, n) of the joints [rad/s, m/s].
        vd: Accelerations (m, n) of the joints [rad/s^2, m/s^2].
        row_times: True times (r,) of all rows of the recording, see `true_time` [s].
        rate: Mean rate of the rows without gaps [Hz].
        clock: True times of the rows that do not repeat the previous row.
        channels: Matrix (n, n) that maps efforts of the actuators to measured efforts, see
            `Recording.measured_channels`.
        step: Filtered efforts and regressor columns are computed for every `step`-th row.
        segments: Motion in each segment between gaps, or () for a motion without gaps. The arrays of the whole motion
            are those of its segments, one after the other.
    """

    arm: Arm
    settings: SignalSettings
    t: NDArray[np.float64]
    q: NDArray[np.float64]
    v: NDArray[np.float64]
    vd: NDArray[np.float64]
    row_times: NDArray[np.float64]
    rate: float
    clock: TrueTime
    channels: NDArray[np.float64]
    step: int = 1
    segments: tuple[MotionGrid, ...] = ()

    def thinned(self, step: int) -> MotionGrid:
        """Returns the motion with another `step`."""
        return replace(self, step=step, segments=tuple(replace(own, step=step) for own in self.segments))

    def at_rest(self) -> MotionGrid:
        """Returns the positions without velocities and accelerations."""
        zero = np.zeros_like(self.v)
        return replace(self, v=zero, vd=zero, segments=tuple(own.at_rest() for own in self.segments))

    def each_segment(self) -> Iterator[tuple[MotionGrid, slice, slice]]:
        """Yields each segment between gaps, its slice of the grid and its slice of the rows.

        Filters and effects with a state begin anew in each segment.
        """
        first, first_row = 0, 0
        for own in self.segments or (self,):
            end, end_row = first + len(own.t), first_row + len(own.row_times)
            yield own, slice(first, end), slice(first_row, end_row)
            first, first_row = end, end_row

    @property
    def longest_segment(self) -> MotionGrid:
        """Longest segment between gaps."""
        return max(self.segments or (self,), key=lambda own: len(own.t))

    @property
    def inner(self) -> slice | NDArray[np.int_]:
        """Index of every `step`-th row, without both ends of each segment (`ends_of`)."""
        if self.segments:
            return np.concatenate([rows.start + own.inner_rows for own, _, rows in self.each_segment()])
        ends = round(ends_of(len(self.row_times) / self.rate) * self.rate)
        return slice(ends, len(self.row_times) - ends, self.step)

    @property
    def inner_rows(self) -> NDArray[np.int_]:
        """Indices (k,) of the rows in `inner`."""
        return np.arange(len(self.row_times))[self.inner]

    def parts(self) -> Iterator[tuple[MotionGrid, NDArray[np.int_]]]:
        """Yields short parts of the motion, and the indices of the inner rows that each part provides.

        The indices count from the first row of the part. The parts overlap, so that filter transients at their ends do
        not affect the provided rows. Regressors of a long motion are computed part by part, because they do not fit
        into the memory.
        """
        if self.segments:
            for own in self.segments:
                yield from own.parts()
            return
        inner, count = self.inner_rows, len(self.row_times)
        overlap = round(PART_OVERLAP / self.settings.effort_cut_off * self.rate)
        delays = self.settings.effort_delay
        for rows in np.array_split(inner, max(1, round(count / PART_ROWS))):
            start, end = max(rows[0] - overlap, 0), min(rows[-1] + overlap + 1, count)
            times = self.row_times[start:end]
            first, last = np.searchsorted(self.t, [times[0] - max(delays), times[-1] - min(delays)])
            on_grid = slice(max(first - 2, 0), last + 2)
            t, q, v, vd = (x[on_grid] for x in (self.t, self.q, self.v, self.vd))
            yield replace(self, t=t, q=q, v=v, vd=vd, row_times=times), rows - start

    def at_rows(self, x: NDArray[np.float64], actuator: int) -> NDArray[np.float64]:
        """Interpolates x (m, ...) from the grid to the rows (r, ...), with the delay of the actuator's effort."""
        if self.segments:
            return np.concatenate([own.at_rows(x[of_grid], actuator) for own, of_grid, _ in self.each_segment()])
        index = (self.row_times - self.settings.effort_delay[actuator] - self.t[0]) * GRID_RATE
        before = np.clip(np.floor(index).astype(int), 0, len(x) - 2)
        share = np.clip(index - before, 0.0, 1.0).reshape(-1, *[1] * (x.ndim - 1))
        return (1 - share) * x[before] + share * x[before + 1]

    def filter_efforts(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """Applies the low-pass filter of the efforts to x (r, ...) and removes both ends, see `ends_of`."""
        return self.filter_rows(x, self.inner)

    def filter_rows(self, x: NDArray[np.float64], rows: slice | NDArray[np.int_]) -> NDArray[np.float64]:
        """Applies the low-pass filter of the efforts to x (r, ...) and returns some of the rows."""
        return self.low_passed(x)[rows]

    def low_passed(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """Applies the low-pass filter of the efforts to x (r, ...)."""
        if self.segments:
            return np.concatenate([own.low_passed(x[of_rows]) for own, _, of_rows in self.each_segment()])
        flat = low_pass(x.reshape(len(x), -1), self.rate, self.settings.effort_cut_off)
        return flat.reshape(x.shape)

    def efforts_at_rows(self, tau: NDArray[np.float64]) -> NDArray[np.float64]:
        """Interpolates efforts (m, n) of the actuators from the grid to the rows (r, n), with the effort delays."""
        return np.column_stack([self.at_rows(tau[:, i], i) for i in range(tau.shape[1])])

    def actuator_motion(self) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Returns times (k,) [s], and positions and velocities (k, n) of the actuators, at the rows in `inner`."""
        positions = self.efforts_at_rows(self.arm.transmission.position(self.q))
        velocities = self.efforts_at_rows(self.arm.transmission.velocity(self.v))
        return self.row_times[self.inner], positions[self.inner], velocities[self.inner]
