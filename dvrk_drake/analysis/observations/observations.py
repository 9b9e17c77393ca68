"""Prepares a recording once, for all checks, fits, validations and reports that use it."""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.analysis.observations.finding import Finding
from dvrk_drake.analysis.observations.motion_faults import jump_fault, source_fault, time_fault
from dvrk_drake.analysis.observations.motion_grid import GRID_RATE, MIN_DURATION, MotionGrid, even_times
from dvrk_drake.analysis.observations.repetition import find_period
from dvrk_drake.analysis.observations.signals import central_difference, low_pass, resample
from dvrk_drake.analysis.observations.static_poses import MIN_POSES, static_poses
from dvrk_drake.analysis.observations.true_time import TrueTime, increasing_times, true_time
from dvrk_drake.dynamics.dynamic_section import SignalSettings
from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.errors import RecordingError
from dvrk_drake.models.arm import Arm
from dvrk_drake.recordings.recording import MAX_LOST, MIN_RATE, MIN_ROWS, Recording


class Observations:
    """Recording of an arm with the quantities that are derived from it. Each is computed once, when it is first used.

    Attributes:
        recording: Poses or a motion, in joint or actuator coordinates.
        arm: Arm that was recorded.
        settings: Cut-offs of the filters and delays of the efforts.
    """

    def __init__(
        self,
        recording: Recording,
        arm: Arm,
        settings: SignalSettings | None = None,
        clocks: tuple[TrueTime, ...] | None = None,
    ) -> None:
        """Stores the arguments.

        Args:
            recording: Poses or a motion, in joint or actuator coordinates.
            arm: Arm that was recorded.
            settings: Cut-offs of the filters and delays of the efforts. None: those of the arm file.
            clocks: True times of the segments between gaps, if they are known, see `true_time`.
        """
        self.recording, self.arm = recording, arm
        self.settings = settings or SignalSettings.of(arm.identification)
        self._known_clocks = clocks

    @classmethod
    def for_model(cls, recording: Recording, model: IdentifiedModel) -> Observations:
        """Returns the observations of a recording with the signal settings of a model's identification."""
        return cls(recording, model.arm, None if model.dynamics is None else model.dynamics.signals)

    @property
    def source(self) -> str:
        """Name of the recording for messages."""
        return self.recording.source or "recording"

    @cached_property
    def tau(self) -> NDArray[np.float64]:
        """Measured efforts (m, n) of the actuators at all rows [N m, N].

        Raises:
            RecordingError: The recording has no efforts.
        """
        return self.recording.in_actuator_coordinates(self.arm).measured_effort()

    @cached_property
    def fault(self) -> Finding | None:
        """Fault of the sources or the times of the rows, see `source_fault` and `time_fault`.

        Raises:
            RecordingError: The recording does not match the arm, or is a motion with decreasing times.
        """
        if (fault := self.source_fault) is not None:
            return fault
        recording = self.recording
        recording.check_fits(self.arm)
        # With decreasing times, a motion would be treated as poses.
        has_times = recording.t is not None and len(recording) >= MIN_ROWS
        if has_times and (recording.is_motion or recording.motion(self.arm)):
            increasing_times(recording)
        return time_fault(recording, self.arm)

    @cached_property
    def source_fault(self) -> Finding | None:
        """Fault of the sources of the rows, see `motion_faults.source_fault`."""
        return source_fault(self.recording, self.arm)

    @cached_property
    def jump(self) -> Finding | None:
        """Jump of the positions. None if there is no jump or if static poses are used: between them, the arm may move.

        Raises:
            RecordingError: The recording has no efforts, or belongs to another arm.
        """
        fault = jump_fault(self.recording, self.arm)
        return None if fault is None or self._has_static_poses else fault

    @cached_property
    def static_poses(self) -> Recording | None:
        """Static poses of a motion, see `static_poses`. None if the recording is not a motion."""
        return static_poses(self.recording, self.arm)

    @property
    def _has_static_poses(self) -> bool:
        return self.static_poses is not None and len(self.static_poses) >= MIN_POSES

    def poses(self) -> Poses:
        """Returns the static poses of a motion, or these observations if there are fewer than `MIN_POSES` of them.

        Raises:
            RecordingError: The recording does not match the arm, has no efforts, or is a motion with decreasing times
                or with a fault (`fault`, `jump`).
        """
        if (fault := self.fault or self.jump) is not None:
            raise RecordingError(f"{self.source}: refused: {fault.where}: {fault.what}. {fault.advice}")
        poses = self.static_poses
        if poses is not None and len(poses) >= MIN_POSES:
            note = f"Static poses found in the motion: {len(poses)}, in {len(self.recording)} rows."
            return Poses(Observations(poses, self.arm, self.settings), note)
        return Poses(self, "", moves=poses is not None and bool(self.recording.motion(self.arm)))

    @cached_property
    def segments(self) -> list[slice]:
        """Rows of each segment of a motion between gaps of its times."""
        return self.recording.segments()

    @cached_property
    def clocks(self) -> tuple[TrueTime, ...]:
        """True times of the rows of each segment, see `true_time`.

        Raises:
            RecordingError: The recording has no times, or they do not increase.
        """
        if self._known_clocks is not None:
            return self._known_clocks
        actuators = self.recording.in_actuator_coordinates(self.arm)
        if len(self.segments) == 1:
            return (true_time(actuators),)
        return tuple(true_time(actuators.select(rows)) for rows in self.segments)

    @property
    def longest_rows(self) -> slice:
        """Rows of the longest segment between gaps."""
        return max(self.segments, key=lambda rows: rows.stop - rows.start)

    @cached_property
    def longest(self) -> Observations:
        """Longest segment between gaps, or these observations if the motion has no gap."""
        if len(self.segments) == 1:
            return self
        rows = self.longest_rows
        clock = self.clocks[self.segments.index(rows)]
        return Observations(self.recording.select(rows), self.arm, self.settings, (clock,))

    @cached_property
    def period(self) -> float | None:
        """Period of the motion [s] in its longest segment, or None if the motion does not repeat."""
        return find_period(self.arm.transmission.position(self.grid.longest_segment.q), GRID_RATE)

    @cached_property
    def grid(self) -> MotionGrid:
        """Motion, resampled at `GRID_RATE` and filtered.

        Positions are filtered and differentiated in actuator coordinates, because each actuator has its own encoder and
        cut-off. Recorded velocities are used only to estimate the true times of the rows. The segments between gaps are
        resampled and filtered separately.

        Raises:
            RecordingError: The recording does not match the arm, has no times, is too short, or its rate is too low.
        """
        self.recording.check_fits(self.arm)
        increasing_times(self.recording)
        self._check_duration()
        actuators = self.recording.in_actuator_coordinates(self.arm)
        if len(self.segments) == 1:
            return self._segment_grid(actuators, self.clocks[0])
        grids = [
            self._segment_grid(actuators.select(rows), clock)
            for rows, clock in zip(self.segments, self.clocks, strict=True)
        ]
        clock = TrueTime(
            np.concatenate([own.start + times.rows for own, times in zip(self.segments, self.clocks, strict=True)]),
            np.concatenate([times.t for times in self.clocks]),
            max(times.jitter for times in self.clocks),
            any(times.reconstructed for times in self.clocks),
        )
        # The rates of the segments of one recording differ only by lost rows.
        rate = sum(len(g.row_times) - 1 for g in grids) / sum((len(g.row_times) - 1) / g.rate for g in grids)
        names = ("t", "q", "v", "vd", "row_times")
        t, q, v, vd, row_times = (np.concatenate([getattr(g, name) for g in grids]) for name in names)
        segments = tuple(replace(g, rate=rate) for g in grids)
        return replace(grids[0], t=t, q=q, v=v, vd=vd, row_times=row_times, rate=rate, clock=clock, segments=segments)

    def _check_duration(self) -> None:
        """Raises RecordingError if a motion or one of its segments between gaps is too short, or the rate is low."""
        recording, rows = self.recording, self.segments
        durations = [float(times.t[-1] - times.t[0]) for times in self.clocks]
        total = sum(durations)
        rate = (len(recording) - len(rows)) / total if total > 0 else 0.0
        if total < MIN_DURATION or rate < (1 - MAX_LOST) * MIN_RATE:
            gaps = f", in {len(rows)} segments between gaps of t" if len(rows) > 1 else ""
            raise RecordingError(
                f"{self.source}: the motion lasts {total:.1f} s at {rate:.3g} Hz{gaps}. A dynamic model requires at "
                f"least {MIN_DURATION:g} s at {MIN_RATE:g} Hz or more."
            )
        if min(durations) < MIN_DURATION:
            k = int(np.argmin(durations))
            raise RecordingError(
                f"{recording.where(rows[k].start)}: only {durations[k]:.3g} s of motion between two gaps of t; "
                f"required: {MIN_DURATION:g} s. Remove these {rows[k].stop - rows[k].start} rows."
            )

    def _segment_grid(self, actuators: Recording, clock: TrueTime) -> MotionGrid:
        """Resamples a motion without gaps, in actuator coordinates."""
        t = even_times(clock, GRID_RATE)
        raw = resample(clock.t, actuators.q[clock.rows], t)
        a = low_pass(raw, GRID_RATE, self.settings.position_cut_off)
        slow = low_pass(raw, GRID_RATE, self.settings.acceleration_cut_off)
        to_joint = self.arm.transmission.inverse
        last = np.searchsorted(clock.rows, np.arange(len(actuators)), side="right") - 1
        has_efforts = self.recording.tau is not None
        return MotionGrid(
            arm=self.arm,
            settings=self.settings,
            t=t,
            q=to_joint.position(a),
            v=to_joint.velocity(central_difference(a, GRID_RATE)),
            vd=to_joint.velocity(central_difference(central_difference(slow, GRID_RATE), GRID_RATE)),
            row_times=clock.t[np.maximum(last, 0)],
            rate=(len(actuators) - 1) / float(clock.t[-1] - clock.t[0]),
            clock=clock,
            channels=self.recording.measured_channels(self.arm) if has_efforts else np.eye(self.arm.num_joints),
        )


class Poses(NamedTuple):
    """Result of `Observations.poses`.

    Attributes:
        observations: Recording with one row per extracted pose, or the unchanged recording.
        note: Note on how poses were extracted from a motion, "" if no poses were extracted.
        moves: True if the recording is a motion with too few static poses, which is suitable for dynamic identification
            only.
    """

    observations: Observations
    note: str
    moves: bool = False

    @property
    def recording(self) -> Recording:
        """Recording of `observations`."""
        return self.observations.recording
