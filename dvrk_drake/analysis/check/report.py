"""Result of a check of a recording: its findings, and statistics of each joint."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import Any, Literal

import numpy as np

from dvrk_drake.analysis.observations.finding import Finding


@dataclass(frozen=True)
class JointSignals:
    """Statistics of the signals of one joint and of the actuator with the same name.

    The attributes `range`, `coverage`, `effort` and `peak_effort` are those of the joint. All other statistics are
    those of the actuator. An attribute is None if it does not apply.

    Attributes:
        name: Name of the joint.
        range: Range of the positions [rad, m].
        coverage: Range of the positions as a share of the range between the limits [1].
        speed: RMS velocity [rad/s, m/s].
        acceleration: RMS acceleration, low-pass filtered at 20 Hz [rad/s^2, m/s^2].
        effort: RMS effort [N m, N].
        peak_effort: Largest effort divided by the joint's effort limit [1].
        velocity_gain: Gain of qd relative to dq/dt [1].
        velocity_lag: Lag of qd relative to dq/dt [s].
        effort_lag: Lag of tau relative to the motion [s], None if the lag is not significant.
        work: Mean of tau v divided by rms(tau) rms(v) [1]. Friction increases this value.
        effort_cut_off: Frequency above which noise exceeds the effort signal [Hz].
        velocity_cut_off: Frequency above which noise exceeds the velocity signal [Hz].
        floor: Repeatability of the effort: relative RMS difference between periods [1].
    """

    name: str
    range: float
    coverage: float
    effort: float | None = None
    peak_effort: float | None = None
    speed: float | None = None
    acceleration: float | None = None
    velocity_gain: float | None = None
    velocity_lag: float | None = None
    effort_lag: float | None = None
    work: float | None = None
    effort_cut_off: float | None = None
    velocity_cut_off: float | None = None
    floor: float | None = None


@dataclass(frozen=True)
class RecordingReport:
    """Result of `check` and `check_recording`.

    The attributes from `longest` to `floor_cut_off` are None if they do not apply, for example to poses.

    Attributes:
        source: Source of the recording.
        arm: Name of the arm.
        kind: "motion" if the rows have times with short intervals, otherwise "poses".
        rows: Number of rows of the recording.
        joints: Statistics of the joints, in the arm's order.
        findings: Refusals first, then warnings, then notes.
        longest: Number of rows of the longest segment of a motion without gaps of its times. The statistics of the
            motion are those of this segment.
        rate: Median sampling rate of a motion [Hz].
        duration: Duration of the longest segment [s].
        jitter: Standard deviation of the differences between true and recorded intervals, divided by the mean interval
            [1].
        repeated: Share of rows that repeat the previous row [1].
        period: Period of a motion that repeats [s].
        floor_cut_off: Cut-off frequency of the low-pass filter for `floor` [Hz].
    """

    source: str
    arm: str
    kind: Literal["poses", "motion"]
    rows: int
    joints: tuple[JointSignals, ...] = ()
    findings: tuple[Finding, ...] = field(default=())
    longest: int | None = None
    rate: float | None = None
    duration: float | None = None
    jitter: float | None = None
    repeated: float | None = None
    period: float | None = None
    floor_cut_off: float | None = None

    @property
    def refusals(self) -> tuple[Finding, ...]:
        """Findings that exclude the recording from identification."""
        return tuple(finding for finding in self.findings if finding.severity == "refusal")

    @property
    def warnings(self) -> tuple[Finding, ...]:
        """Findings that make results less accurate."""
        return tuple(finding for finding in self.findings if finding.severity == "warning")

    @property
    def refusal(self) -> str:
        """First refusal in one line, with the number of refusals, or "" if there is none."""
        if not self.refusals:
            return ""
        first, *others = self.refusals
        count = f"refused (first of {len(others) + 1} reasons): " if others else "refused: "
        where = "" if first.where == self.source else f"{first.where}: "
        return f"{self.source}: {count}{where}{first.what}. {first.advice}".rstrip()

    def as_dict(self) -> dict[str, Any]:
        """Returns the report as a dictionary for JSON. Values that do not apply are None."""
        return _without_nan(asdict(self))


def _without_nan(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _without_nan(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_without_nan(entry) for entry in value]
    return None if isinstance(value, float) and not np.isfinite(value) else value
