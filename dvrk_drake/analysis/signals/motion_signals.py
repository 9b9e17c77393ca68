"""Signals of a recorded motion on an even time grid: filtered without delay, with velocities and accelerations."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dvrk_drake.analysis.signals.low_pass import central_difference, low_pass, resample
from dvrk_drake.analysis.signals.true_time import true_time
from dvrk_drake.analysis.signals.velocity_agreement import velocity_agreement
from dvrk_drake.recordings.recording import Recording


@dataclass(frozen=True, eq=False)
class MotionSignals:
    """A motion at a constant rate, in the coordinates of its recording. SI and radians.

    Attributes:
        t: (m,) times, evenly spaced [s].
        q, v, vd: (m, n) positions, velocities and accelerations, low-pass filtered.
        tau: (m, n) efforts, not filtered: filter them and what is to explain them alike, see `low_pass`.
        rows: (k,) rows of the recording that are used; the others repeat the row before them.
        row_times: (k,) the time of each of them, on the same clock as `t`.
        differentiated: (n,) True where v is dq/dt because the recorded qd disagrees with it, or there is none.
    """

    t: NDArray[np.float64]
    q: NDArray[np.float64]
    v: NDArray[np.float64]
    vd: NDArray[np.float64]
    tau: NDArray[np.float64]
    rows: NDArray[np.int_]
    row_times: NDArray[np.float64]
    differentiated: NDArray[np.bool_]

    @property
    def rate(self) -> float:
        """Samples a second [Hz]."""
        return float((len(self.t) - 1) / (self.t[-1] - self.t[0]))


def motion_signals(
    recording: Recording, acceleration_cut_off: ArrayLike, *, cut_off: float = 50.0, rate: float = 400.0
) -> MotionSignals:
    """Brings a motion onto an even grid of its true times and differentiates it.

    Rows that repeat the row before are left out and the times of the others made good (`true_time`); then everything is
    interpolated at `rate`, q and v are filtered at `cut_off`, and vd is the central difference of v filtered at
    `acceleration_cut_off`.

    Args:
        recording: with t and tau, in the coordinates that the signals shall have.
        acceleration_cut_off: of the zero-phase low-pass for vd [Hz]; one, or (n,) one a joint.
        cut_off: of the one for q and v [Hz].
        rate: of the grid [Hz].

    Raises:
        RecordingError: no efforts, or no motion: no times that increase.
    """
    clock = true_time(recording)
    tau = recording.measured_effort()[clock.rows]
    t = clock.t[0] + np.arange(int((clock.t[-1] - clock.t[0]) * rate) + 1) / rate
    q = low_pass(resample(clock.t, recording.q[clock.rows], t), rate, cut_off)
    v = central_difference(q, rate)
    agrees = np.zeros(q.shape[1], dtype=bool)
    if recording.qd is not None:
        qd = low_pass(resample(clock.t, recording.qd[clock.rows], t), rate, cut_off)
        agrees = velocity_agreement(q, qd, rate).agrees
        v = np.where(agrees, qd, v)
    vd = low_pass(central_difference(v, rate), rate, acceleration_cut_off)
    return MotionSignals(t, q, v, vd, resample(clock.t, tau, t), clock.rows, clock.t, ~agrees)
