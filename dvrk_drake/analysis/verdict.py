"""Judges whether the model torque of a joint may be commanded, from the error of the model on a recording.

docs/benchmarks.md contains the evidence for the thresholds.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal, get_args

import numpy as np

from dvrk_drake.analysis.check.findings import Finding
from dvrk_drake.dynamics.identified_model import IdentifiedModel, Verdict

Requirement = Literal["good", "usable"]

#: Largest ratio of the RMS error to the RMS measured effort for the verdict "good".
GOOD_RATIO = 0.35
#: Largest ratio for the verdict "usable" at rest. The ratio of zero torque is 1.
USABLE_RATIO_AT_REST = 1.0
#: Largest ratio for the verdict "usable" in motion, where the model includes friction.
USABLE_RATIO_IN_MOTION = 0.5
#: Largest RMS error, as a share of the effort limit, for the verdict "usable" at any ratio. Friction holds the joint at
#: rest despite such an error.
SMALL_ERROR = 0.02


def judge(effort: float, error: float, effort_limit: float, *, in_motion: bool, commanded: bool = True) -> Verdict:
    """Returns the verdict on one joint.

    Args:
        effort: RMS measured effort [N m, N], which is also the RMS error of zero torque. 0 if no effort was measured.
        error: RMS of measured minus predicted effort [N m, N], NaN if unknown.
        effort_limit: Effort limit of the joint [N m, N].
        in_motion: True if the recording is a motion and the model has dynamics.
        commanded: False if identification disabled the feedforward of this joint.
    """
    if not commanded:
        return "off"
    if not (np.isfinite(effort) and np.isfinite(error) and effort > 0):
        return "not judged"
    if error <= GOOD_RATIO * effort:
        return "good"
    usable = USABLE_RATIO_IN_MOTION if in_motion else USABLE_RATIO_AT_REST
    return "usable" if error <= max(usable * effort, SMALL_ERROR * effort_limit) else "do not use"


def reason(
    verdict: Verdict, effort: float, error: float, effort_limit: float, *, in_motion: bool, prismatic: bool = False
) -> str:
    """Returns the reason for a verdict of `judge` in one sentence.

    Args:
        verdict: Verdict on the joint.
        effort, error, effort_limit, in_motion: See `judge`.
        prismatic: True for a prismatic joint, whose error is in N.
    """
    if verdict == "off":
        if effort == 0:
            return "The model commands no torque, because no effort was measured."
        return "The model commands no torque, because the recording does not separate gravity from friction."
    if verdict == "not judged":
        return "No effort was measured, or no error is known."
    ratio, limit = error / effort, USABLE_RATIO_IN_MOTION if in_motion else USABLE_RATIO_AT_REST
    share = f"The error is {100 * ratio:.0f} % of the measured effort"
    if verdict == "good":
        return f"{share} (good: up to {100 * GOOD_RATIO:g} %)."
    if verdict == "usable" and ratio > limit:
        unit = "N" if prismatic else "N m"
        absolute = f"{error:.2g} {unit} or {100 * error / effort_limit:.1f} % of the effort limit"
        return f"{share}, but it is small: {absolute} (usable: up to {100 * SMALL_ERROR:g} %)."
    more = "" if verdict == "usable" else f", and {100 * error / effort_limit:.0f} % of the effort limit"
    return f"{share}{more} (usable: up to {100 * limit:g} %)."


def rule_text(in_motion: bool) -> str:
    """Returns the rule of `judge` as text, with the thresholds."""
    good, usable, zero = (
        f"{100 * ratio:g} %" if in_motion else f"{ratio:g}"
        for ratio in (GOOD_RATIO, USABLE_RATIO_IN_MOTION if in_motion else USABLE_RATIO_AT_REST, 1.0)
    )
    return (
        f"ratio: RMS error / RMS measured effort ({zero} for zero torque). good: ratio up to {good}. usable: ratio up "
        f"to {usable}, or error up to {100 * SMALL_ERROR:g} % of the effort limit. do not use: all other joints. off: "
        "the model commands no torque. not judged: no effort was measured."
    )


def worst(verdicts: Mapping[str, Verdict]) -> tuple[Verdict, list[str]]:
    """Returns the least favourable verdict and the joints that have it."""
    result = max(verdicts.values(), key=get_args(Verdict).index)
    return result, [name for name, verdict in verdicts.items() if verdict == result]


def unfit(verdicts: Mapping[str, str], required: Requirement) -> list[str]:
    """Returns the joints that do not meet a requirement, each as "name (verdict)".

    The verdict "off" meets every requirement, because the model commands no torque.
    """
    accepted = ("good", "off") if required == "good" else ("good", "usable", "off")
    return [f"{name} ({verdict})" for name, verdict in verdicts.items() if verdict not in accepted]


def unexplained_effort(errors: Mapping[str, float | None]) -> tuple[Finding, ...]:
    """Returns a warning for the joints whose relative error in motion exceeds `USABLE_RATIO_IN_MOTION`.

    Args:
        errors: Relative error of each joint [1], None if the measured effort is 0.
    """
    bad = [f"{name} ({100 * e:.0f} %)" for name, e in errors.items() if e is not None and e > USABLE_RATIO_IN_MOTION]
    if not bad:
        return ()
    what = "the RMS error of the model exceeds half of the RMS effort"
    advice = (
        "Do not use the model for these joints. Check the arm, the signs and units of the columns, and --coordinates."
    )
    return (Finding("warning", "unexplained effort", ", ".join(bad), what, advice),)


def cross_validated_verdicts(model: IdentifiedModel) -> dict[str, Verdict]:
    """Returns the verdict on each joint from the cross-validated errors of the identification.

    Validation with another recording is a stronger test.
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
