"""Findings of `check` by kind, and recordings with one fault."""

from dataclasses import replace

from dvrk_drake.analysis.check.recording_check import check_recording
from dvrk_drake.analysis.observations.observations import Observations
from dvrk_drake.models.arm_files import load_arm

ARMS = "psm", "mtmr"


def found(recording, name="psm"):
    """Returns a mapping from a kind to the findings of `check` of this kind."""
    report = check_recording(Observations(recording, load_arm(name)))
    kinds = {}
    for finding in report.findings:
        kinds.setdefault(finding.kind, []).append(finding)
    return kinds


def changed(recording, block, joint, change):
    values = getattr(recording, block).copy()
    values[:, joint] = change(values[:, joint])
    return replace(recording, **{block: values})
