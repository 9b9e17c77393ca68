"""A recorded motion as a dynamic model takes it: on an even grid of true times, and back to the recording's rows."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.analysis.signals.low_pass import central_difference, low_pass, resample
from dvrk_drake.analysis.signals.true_time import true_time
from dvrk_drake.dynamics.dynamic_section import SignalSettings
from dvrk_drake.errors import RecordingError
from dvrk_drake.models.arm import Arm
from dvrk_drake.recordings.recording import Recording

#: Rate of the grid [Hz]: fine enough for hysteresis to turn round where the joint does.
GRID_RATE = 400.0
#: Left out at each end, where filters swing in [s].
ENDS = 1.0
#: Shortest motion, and least rate of its rows, that tell anything [s, Hz].
LEAST_DURATION, LEAST_RATE = 5.0, 50.0


@dataclass(frozen=True, eq=False)
class MotionGrid:
    """A motion of an arm's joints; every quantity below is low-pass filtered as `settings` says.

    Attributes:
        arm: which moves.
        settings: of the filters and delays.
        t: (m,) even times [s] at `GRID_RATE`.
        q, v, vd: (m, n) of the joints.
        row_times: (r,) the true time of every row of the recording, on the clock of t.
        rate: mean rate of the rows [Hz].
    """

    arm: Arm
    settings: SignalSettings
    t: NDArray[np.float64]
    q: NDArray[np.float64]
    v: NDArray[np.float64]
    vd: NDArray[np.float64]
    row_times: NDArray[np.float64]
    rate: float

    @property
    def inner(self) -> slice:
        """The rows that count: without `ENDS`."""
        ends = round(ENDS * self.rate)
        return slice(ends, len(self.row_times) - ends)

    def at_rows(self, x: NDArray[np.float64], actuator: int) -> NDArray[np.float64]:
        """x (m, ...), what explains an actuator's effort, at the rows (r, ...), later by that effort's delay."""
        place = (self.row_times - self.settings.effort_delay[actuator] - self.t[0]) * GRID_RATE
        before = np.clip(np.floor(place).astype(int), 0, len(x) - 2)
        share = np.clip(place - before, 0.0, 1.0).reshape(-1, *[1] * (x.ndim - 1))
        return (1 - share) * x[before] + share * x[before + 1]

    def behind_filter(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """x (r, ...) at the rows behind the low-pass that efforts are compared behind, ends left out."""
        flat = low_pass(x.reshape(len(x), -1), self.rate, self.settings.effort_cut_off)
        return flat.reshape(x.shape)[self.inner]

    def efforts_at_rows(self, tau: NDArray[np.float64]) -> NDArray[np.float64]:
        """Efforts (m, n) of the actuators on the grid, at the rows (r, n)."""
        return np.column_stack([self.at_rows(tau[:, i], i) for i in range(tau.shape[1])])


def default_settings(arm: Arm) -> SignalSettings:
    """What the arm's files say."""
    motion = arm.motion
    return SignalSettings(
        acceleration_cut_off=list(motion.acceleration_cut_off),
        effort_cut_off=arm.effort_cut_off,
        effort_delay=list(motion.effort_delay),
    )


def motion_grid(recording: Recording, arm: Arm, settings: SignalSettings) -> MotionGrid:
    """Brings a motion in either coordinates onto the grid.

    The positions are differentiated (recorded velocities only tell the times, see `true_time`): actuator by actuator,
    since each has its own encoder and cut-off.

    Raises:
        RecordingError: it does not fit the arm, has no times, or is too short or too coarse.
    """
    recording.check_fits(arm)
    recording = recording.in_actuator_coordinates(arm)
    clock = true_time(recording)
    duration = float(clock.t[-1] - clock.t[0])
    rate = (len(recording) - 1) / duration
    if duration < LEAST_DURATION or rate < LEAST_RATE:
        raise RecordingError(
            f"{recording.source or 'recording'}: {duration:.1f} s at {rate:.0f} Hz; a dynamic model needs a motion of "
            f"at least {LEAST_DURATION:g} s at {LEAST_RATE:g} Hz"
        )
    t = clock.t[0] + np.arange(int(duration * GRID_RATE) + 1) / GRID_RATE
    raw = resample(clock.t, recording.q[clock.rows], t)
    a = low_pass(raw, GRID_RATE, settings.position_cut_off)
    slow = low_pass(raw, GRID_RATE, settings.acceleration_cut_off)
    to_joint = arm.transmission.inverse()
    last = np.searchsorted(clock.rows, np.arange(len(recording)), side="right") - 1
    return MotionGrid(
        arm=arm,
        settings=settings,
        t=t,
        q=to_joint.position(a),
        v=to_joint.velocity(central_difference(a, GRID_RATE)),
        vd=to_joint.velocity(central_difference(central_difference(slow, GRID_RATE), GRID_RATE)),
        row_times=clock.t[np.maximum(last, 0)],
        rate=rate,
    )
