"""What a check of a recording found: findings with their severity, and numbers of each joint."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import Any, Literal

import numpy as np

Severity = Literal["note", "warning", "refusal"]


@dataclass(frozen=True)
class Finding:
    """Something that a user must know of a recording.

    Attributes:
        severity: "note": it is handled, or only to be known; "warning": results suffer; "refusal": they would be wrong.
        kind: a short name that does not change, e.g. "repeated rows".
        where: the joints, channels or rows.
        what: the finding with its numbers.
        advice: what to do, or what is done about it.
        joints: which joints, counted from 0.
        size: the number that measures it, in SI; nan if none does.
    """

    severity: Severity
    kind: str
    where: str
    what: str
    advice: str
    joints: tuple[int, ...] = ()
    size: float = float("nan")

    def __str__(self) -> str:
        return f"{self.severity}: {self.where}: {self.what}; {self.advice}"


@dataclass(frozen=True)
class JointSignals:
    """Numbers of one joint (its actuator, where a motor or its sensor is meant); None where they do not apply.

    Attributes:
        name: of the joint.
        range: that its positions cover [rad, m].
        coverage: the same as a share of its limits' range [1].
        speed: RMS of the velocity [rad/s, m/s].
        acceleration: RMS, below the velocity's cut-off [rad/s^2, m/s^2].
        effort: RMS [N m, N].
        peak_effort: largest effort over the joint's effort limit [1].
        velocity_gain, velocity_lag: of qd against dq/dt [1], [s].
        effort_lag: of tau behind the motion [s], None if it is not determined.
        work: mean of tau v over rms(tau) rms(v) [1]; friction makes it positive.
        effort_cut_off, velocity_cut_off: above which the signal is under its noise [Hz].
        floor: repeatability floor of the effort [1].
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
    """What `check_recording` found.

    Attributes:
        source: of the recording.
        arm: name of the arm.
        kind: "poses", or "motion" where rows follow each other closely in time.
        rows: of the recording.
        joints: their numbers, in the arm's order.
        findings: refusals first, then warnings, then notes.
        rate: median rows a second of a motion [Hz].
        duration: of a motion [s].
        jitter: deviation of the true from the recorded intervals, over their mean [1].
        repeated: share of the rows that repeat the one before [1].
        period: of a motion that repeats [s].
        floor_cut_off: of the low-pass behind which `floor` is taken [Hz].
    """

    source: str
    arm: str
    kind: Literal["poses", "motion"]
    rows: int
    joints: tuple[JointSignals, ...] = ()
    findings: tuple[Finding, ...] = field(default=())
    rate: float | None = None
    duration: float | None = None
    jitter: float | None = None
    repeated: float | None = None
    period: float | None = None
    floor_cut_off: float | None = None

    @property
    def refusals(self) -> tuple[Finding, ...]:
        """The findings with which nothing should be identified."""
        return tuple(finding for finding in self.findings if finding.severity == "refusal")

    @property
    def warnings(self) -> tuple[Finding, ...]:
        """The findings that make results worse."""
        return tuple(finding for finding in self.findings if finding.severity == "warning")

    @property
    def refusal(self) -> str:
        """The first refusal in one line, with the number of all; "" without any."""
        if not self.refusals:
            return ""
        first, *others = self.refusals
        reasons = f"refused for {len(others) + 1} reasons, the first: " if others else "refused: "
        where = "" if first.where == self.source else f"{first.where}: "
        return f"{self.source}: {reasons}{where}{first.what}; {first.advice}"

    def as_dict(self) -> dict[str, Any]:
        """For JSON: what does not apply is null."""
        return _without_nan(asdict(self))


def _without_nan(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _without_nan(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_without_nan(entry) for entry in value]
    return None if isinstance(value, float) and not np.isfinite(value) else value
