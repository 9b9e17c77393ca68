"""Whether `identify` will take a recording: what is wrong with it, and what an identification needs beside that."""

from __future__ import annotations

from dataclasses import replace

from dvrk_drake.analysis.check.channel_check import check_channels
from dvrk_drake.analysis.check.findings import Finding, RecordingReport
from dvrk_drake.analysis.check.recording_check import check_recording
from dvrk_drake.analysis.signals.motion_grid import default_settings, motion_grid
from dvrk_drake.analysis.signals.poses import find_poses
from dvrk_drake.analysis.static.static_identification import usable_poses
from dvrk_drake.errors import IdentificationError, RecordingError
from dvrk_drake.models.arm import Arm
from dvrk_drake.recordings.recording import Recording


def check_for_identification(recording: Recording, arm: Arm) -> RecordingReport:
    """As `check_recording`, with a refusal where `identify` refuses what may still be compared with a model.

    Args:
        recording: as read.
        arm: which was recorded.
    """
    report = check_with_channels(recording, arm)
    if report.refusals:
        return report
    refusals = _refusals_of_identify(recording, arm)
    # What a refusal says again, and with what is needed.
    others = [finding for finding in report.findings if not (refusals and finding.kind == "few poses")]
    return replace(report, findings=(*refusals, *others))


def check_with_channels(recording: Recording, arm: Arm) -> RecordingReport:
    """As `check_recording`, with the findings of `check_channels` for a recording that has no other refusals.

    Exchanged channels look like efforts of a wrong sign: that refusal is replaced by the one that names the cause.
    """
    report = check_recording(recording, arm)
    others = [finding for finding in report.refusals if finding.kind != "effort sign"]
    if others or (report.kind == "motion" and not recording.motion(arm)):
        return report
    try:
        found = check_channels(recording, arm)
    except RecordingError:
        return report  # too short or too coarse to be fitted: identify refuses it with that reason
    if any(finding.severity == "refusal" for finding in found):
        kept = [finding for finding in report.findings if finding.severity != "refusal"]
        return replace(report, findings=(*found, *kept))
    if report.refusals:
        return report
    order = {"warning": 0, "note": 1}
    return replace(report, findings=tuple(sorted((*report.findings, *found), key=lambda f: order[f.severity])))


def _refusals_of_identify(recording: Recording, arm: Arm) -> tuple[Finding, ...]:
    try:
        found = find_poses(recording, arm)
        if found.moves:
            motion_grid(recording, arm, default_settings(arm))
            return ()
        usable_poses(found.recording, arm)
    except (RecordingError, IdentificationError) as error:
        what, _, advice = str(error).removeprefix(f"{recording.source or 'recording'}: ").partition("; ")
        return (Finding("refusal", "identify refuses", "identify", f"will refuse it: {what}", advice),)
    # Of a motion with rests, they alone are identified from.
    return () if found.recording is recording else check_recording(found.recording, arm).refusals
