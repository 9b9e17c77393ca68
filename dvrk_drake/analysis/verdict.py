"""Verdict on each joint of a model: may its torque be commanded, judged by the error on a recording.

This module holds the thresholds, the rule and its text. docs/identification.md gives the evidence for the thresholds.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal, get_args

import numpy as np

from dvrk_drake.analysis.check.findings import Finding
from dvrk_drake.dynamics.identified_model import IdentifiedModel, Verdict

Requirement = Literal["good", "usable"]

#: Largest ratio of the error to the measured effort (RMS both) of a joint that is "good".
GOOD_RATIO = 0.35
#: Largest ratio of one that is "usable", at rest: the error of commanding nothing.
USABLE_RATIO_AT_REST = 1.0
#: The same in motion, where friction is part of the model.
USABLE_RATIO_IN_MOTION = 0.5
#: An error below this share of the effort limit is "usable" at any ratio: friction holds it.
SMALL_ERROR = 0.02


def judge(effort: float, error: float, effort_limit: float, *, in_motion: bool, commanded: bool = True) -> Verdict:
    """Returns the verdict on one joint.

    Args:
        effort: RMS of the measured effort, which is the error of commanding nothing [N m; N]; 0 if none was measured.
        error: RMS of measured minus predicted effort [N m; N]; NaN if it is not known.
        effort_limit: of the joint [N m; N].
        in_motion: The recording is a motion, and the model has dynamics.
        commanded: The model predicts an effort for this joint; False where identification switched it off.
    """
    if not commanded:
        return "off"
    if not (np.isfinite(effort) and np.isfinite(error) and effort > 0):
        return "not judged"
    if error <= GOOD_RATIO * effort:
        return "good"
    usable = USABLE_RATIO_IN_MOTION if in_motion else USABLE_RATIO_AT_REST
    return "usable" if error <= max(usable * effort, SMALL_ERROR * effort_limit) else "do not use"


def rule_text(in_motion: bool) -> str:
    """The rule of `judge` in words, with its numbers."""
    good, usable, zero = (
        f"{100 * ratio:g} %" if in_motion else f"{ratio:g}"
        for ratio in (GOOD_RATIO, USABLE_RATIO_IN_MOTION if in_motion else USABLE_RATIO_AT_REST, 1.0)
    )
    return (
        f"ratio: error / measured effort; zero torque has {zero}. good: ratio up to {good}. usable: ratio up to "
        f"{usable}, or error up to {100 * SMALL_ERROR:g} % of the effort limit. do not use: all other joints. off: the "
        "model commands no torque. not judged: no effort was measured."
    )


def worst(verdicts: Mapping[str, Verdict]) -> tuple[Verdict, list[str]]:
    """The least favourable verdict and the joints that have it."""
    last = max(verdicts.values(), key=get_args(Verdict).index)
    return last, [name for name, verdict in verdicts.items() if verdict == last]


def unfit(verdicts: Mapping[str, str], required: Requirement) -> list[str]:
    """Joints that do not fulfil a requirement, each with its verdict. A joint without torque fulfils all."""
    accepted = ("good", "off") if required == "good" else ("good", "usable", "off")
    return [f"{name} ({verdict})" for name, verdict in verdicts.items() if verdict not in accepted]


def unexplained_effort(errors: Mapping[str, float | None]) -> tuple[Finding, ...]:
    """Returns a warning that names the joints in motion whose efforts the model does not explain.

    Args:
        errors: relative error of each joint [1]; None where nothing was measured.
    """
    bad = [f"{name} ({e:.0%})" for name, e in errors.items() if e is not None and e > USABLE_RATIO_IN_MOTION]
    if not bad:
        return ()
    advice = "is a sign, a unit or --coordinates wrong, or is it another arm? Do not use the model for these"
    return (Finding("warning", "unexplained effort", ", ".join(bad), "most of the effort is not explained", advice),)


def cross_validated_verdicts(model: IdentifiedModel) -> dict[str, Verdict]:
    """The verdict on each joint by the errors that identification stored: those of held-out poses or phases.

    The held-out data are of the same recording. Another recording is the stronger test.
    """
    limits = model.arm.effort_limits
    if model.dynamics is not None:
        return {
            a.name: judge(
                a.rms_effort,
                a.rms_cross_validation,
                float(limit),
                in_motion=True,
                commanded=joint.feedforward_scale > 0,
            )
            for a, joint, limit in zip(model.dynamics.actuators, model.joints, limits, strict=True)
        }
    return {
        j.name: judge(
            j.rms_zero_torque_included,
            j.rms_cross_validation_included,
            float(limit),
            in_motion=False,
            commanded=j.feedforward_scale > 0,
        )
        for j, limit in zip(model.joints, limits, strict=True)
    }
