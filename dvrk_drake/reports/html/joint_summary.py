"""Verdict, errors and coverage of each joint for all kinds of identification and validation results."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import plotly.graph_objects as go
from numpy.typing import NDArray

from dvrk_drake.analysis.dynamic.dynamic_identification import DynamicIdentification
from dvrk_drake.analysis.dynamic.validation import DynamicValidation
from dvrk_drake.analysis.results import Identification, Validation
from dvrk_drake.analysis.static.static_identification import FOLDS, StaticIdentification
from dvrk_drake.analysis.static.validation import StaticValidation
from dvrk_drake.analysis.verdict import cross_validated_verdicts, identified_coverage, reason, rule_text, tolerances
from dvrk_drake.dynamics.identified_model import Verdict
from dvrk_drake.models.arm import Arm
from dvrk_drake.reports.html.labels import effort_unit, length_unit
from dvrk_drake.reports.html.page import Cell, Table
from dvrk_drake.reports.html.page import Verdict as Label
from dvrk_drake.reports.html.plot_style import COLOURS

#: Verdict -> level of its label.
LEVELS: dict[Verdict, str] = {
    "good": "good",
    "usable": "warning",
    "do not use": "bad",
    "off": "neutral",
    "not judged": "neutral",
}
Result = Identification | Validation


@dataclass(frozen=True)
class JointSummary:
    """Effort, errors and verdict of one joint.

    Attributes:
        name: Name of the joint.
        effort: RMS measured effort [N m, N], without excluded measurements.
        error: RMS error on which the verdict is based [N m, N].
        verdict: Verdict on the joint.
        errors: Name of an error -> RMS error [N m, N], None if unknown. The order is that of the table.
    """

    name: str
    effort: float
    error: float
    verdict: Verdict
    errors: dict[str, float | None]


def in_motion(result: Result) -> bool:
    """Returns whether the errors are those of a motion."""
    return isinstance(result, DynamicIdentification | DynamicValidation)


def joint_summaries(result: Result) -> list[JointSummary]:
    """Returns the summary of each joint of a result."""
    if isinstance(result, StaticIdentification):
        verdicts = cross_validated_verdicts(result.model)
        return [
            JointSummary(
                j.name,
                j.rms_zero_torque_included,
                j.rms_cross_validation_included,
                verdicts[j.name],
                {
                    "fit": j.rms_fit_included,
                    "leave-one-out": j.rms_leave_one_out_included,
                    f"{FOLDS}-fold cross-validation": j.rms_cross_validation_included,
                },
            )
            for j in result.model.joints
        ]
    if isinstance(result, StaticValidation):
        of_model = {j.name: j.rms_cross_validation_included or None for j in result.model.joints}
        return [
            JointSummary(
                j.name,
                j.rms_torque_included,
                j.rms_error_included,
                j.verdict,
                {"this recording": j.rms_error_included, "cross-validation of the model": of_model[j.name]},
            )
            for j in result.joints
        ]
    cross_validated = {a.name: a for a in result.model.dynamic_model.section.actuators}
    if isinstance(result, DynamicIdentification):
        verdicts = cross_validated_verdicts(result.model)
        return [
            JointSummary(
                a.name,
                a.rms_effort,
                a.rms_cross_validation,
                verdicts[a.name],
                {
                    "fit": a.rms_fit,
                    "cross-validation": a.rms_cross_validation,
                    "repeatability": a.rms_repeatability or None,
                },
            )
            for a in cross_validated.values()
        ]
    assert isinstance(result, DynamicValidation)
    return [
        JointSummary(
            a.name,
            a.rms_effort,
            a.rms_error,
            a.verdict,
            {
                "this recording": a.rms_error,
                "cross-validation of the model": (
                    cross_validated[a.name].rms_cross_validation or None if a.name in cross_validated else None
                ),
                "repeatability": None if a.repeatability is None else a.repeatability * a.rms_effort,
            },
        )
        for a in result.actuators
    ]


def verdict_table(result: Result) -> Table:
    """Returns the table of the verdicts with their reasons."""
    arm = result.model.arm
    if isinstance(result, StaticValidation | DynamicValidation):
        errors = result.joints if isinstance(result, StaticValidation) else result.actuators
        covered = [joint.coverage for joint in errors]
    else:
        covered = identified_coverage(result.model).tolist()
    coordinates = result.recording.coordinates if isinstance(result, StaticValidation) else "joint"
    limits_of_error = tolerances(arm, "actuator" if in_motion(result) else coordinates)
    which = "error on this recording" if isinstance(result, Validation) else "cross-validation error"
    rows: list[tuple[Cell, ...]] = []
    for k, (joint, own) in enumerate(zip(joint_summaries(result), result.model.joints, strict=True)):
        limit = float(arm.effort_limits[k])
        judged = joint.effort, joint.error, limits_of_error[k], covered[k]
        why = reason(joint.verdict, *judged, prismatic=bool(arm.prismatic[k]))
        ratio = f"{100 * joint.error / joint.effort:.1f} %" if joint.effort > 0 else ""
        scale = f"{own.feedforward_scale:.2f}"
        error = f"{joint.error:.3g}" if np.isfinite(joint.error) else ""
        label = Label(joint.verdict, LEVELS[joint.verdict], why)
        limits = (f"{limit:.3g}", f"{100 * joint.error / limit:.1f} %" if error else "")
        rows.append((joint.name, f"{joint.effort:.3g}", error, effort_unit(arm, k), ratio, *limits, scale, label))
    columns = ("RMS effort", f"RMS {which}", "unit", "ratio", "effort limit", "error / limit", "feedforward scale")
    return Table(
        ("joint", *columns, "verdict"),
        rows,
        caption=f"Verdict on each joint from the {which}",
        note=_capitalized(rule_text()),
    )


def error_table(result: Result) -> Table:
    """Returns the table of fit, cross-validation and repeatability of each joint."""
    arm, summaries = result.model.arm, joint_summaries(result)
    names = [name for name in summaries[0].errors if any(s.errors[name] is not None for s in summaries)]
    rows = [
        (s.name, effort_unit(arm, k), f"{s.effort:.3g}", *(_with_share(s.errors[name], s.effort) for name in names))
        for k, s in enumerate(summaries)
    ]
    return Table(("joint", "unit", "RMS effort", *names), rows, caption="RMS effort and RMS errors of each joint")


def error_dots(result: Result) -> go.Figure:
    """Returns a figure of the relative errors of each joint, as dots on a logarithmic axis."""
    summaries = [s for s in joint_summaries(result) if s.effort > 0]
    roles = {"fit": "fitted", "repeatability": "measured", "leave-one-out": "commanded"}
    symbols = {"fit": "circle-open", "repeatability": "line-ns-open", "leave-one-out": "diamond-open"}
    figure = go.Figure()
    for name in summaries[0].errors if summaries else ():
        points = [(s.name, 100 * error / s.effort) for s in summaries if (error := s.errors[name])]
        if points:
            figure.add_scatter(
                y=[joint for joint, _ in points],
                x=[share for _, share in points],
                mode="markers",
                name=name,
                marker={
                    "size": 12,
                    "symbol": symbols.get(name, "circle" if name != "cross-validation of the model" else "square-open"),
                    "color": COLOURS[roles.get(name, "held out")],
                    "line": {"width": 2.5},
                },
                hovertemplate="%{y}: %{x:.2g} %",
            )
    ticks = [10.0**power * digit for power in range(-3, 4) for digit in (1, 2, 5)]
    figure.update_xaxes(
        type="log", title_text="RMS error / RMS effort [%]", tickvals=ticks, ticktext=[f"{tick:g}" for tick in ticks]
    )
    figure.update_yaxes(autorange="reversed")
    figure.update_layout(height=130 + 34 * len(summaries))
    return figure


def coverage_table(result: Result, q: NDArray[np.float64], v: NDArray[np.float64] | None) -> Table:
    """Returns the table of the positions and speeds of each joint in the recording.

    Args:
        result: Result of the recording.
        q: Positions (m, n) of the joints [rad, m].
        v: Velocities (m, n) of the joints, None for static poses.
    """
    arm = result.model.arm
    rows = []
    for j, name in enumerate(arm.joint_names):
        lower, upper = float(q[:, j].min()), float(q[:, j].max())
        limits = f"{arm.position_lower[j]:.3g} .. {arm.position_upper[j]:.3g}"
        share = (upper - lower) / (arm.position_upper[j] - arm.position_lower[j])
        cells = [name, length_unit(arm, j), limits, f"{lower:.3g} .. {upper:.3g}", f"{100 * share:.0f} %"]
        if v is not None:
            cells += [f"{np.sqrt(np.mean(v[:, j] ** 2)):.3g}", f"{np.abs(v[:, j]).max():.3g}"]
        rows.append(tuple(cells))
    header = ("joint", "unit", "position limits", "recorded", "covered")
    if v is None:
        return Table(header, rows, caption="Positions of the joints in the recording")
    units = "; ".join(sorted({f"{length_unit(arm, j)}/s" for j in range(arm.num_joints)}, reverse=True))
    return Table(
        (*header, f"RMS speed [{units}]", f"peak speed [{units}]"),
        rows,
        caption="Positions and speeds of the joints in the recording",
        note="The arm file states no speed limits, so the table lists no relative speeds.",
    )


def coverage_bars(arm: Arm, q: NDArray[np.float64]) -> go.Figure:
    """Returns a figure of the recorded range of each joint between its limits, with the recorded positions (m, n)."""
    lower, width = arm.position_lower, arm.position_upper - arm.position_lower
    low, high = (100 * (ends - lower) / width for ends in (q.min(axis=0), q.max(axis=0)))
    names = list(arm.joint_names)
    figure = go.Figure()
    figure.add_bar(
        y=names,
        x=high - low,
        base=low,
        orientation="h",
        name="recorded range",
        marker={"color": COLOURS["fitted"]},
        hovertemplate="%{y}: %{base:.0f} .. %{x:.0f} % of the range",
    )
    middle = 100 * (np.quantile(q, [0.25, 0.75], axis=0) - lower) / width
    figure.add_bar(
        y=names,
        x=middle[1] - middle[0],
        base=middle[0],
        orientation="h",
        name="half of the rows",
        marker={"color": COLOURS["held out"]},
        width=0.3,
        hovertemplate="%{y}: half of the rows are in %{base:.0f} .. %{x:.0f} %",
    )
    for limit in (0, 100):
        figure.add_vline(x=limit, line={"color": COLOURS["limit"], "width": 2})
    figure.update_layout(barmode="overlay", height=130 + 34 * len(names), bargap=0.3)
    ends = [min(-3.0, float(low.min()) - 2), max(103.0, float(high.max()) + 2)]
    figure.update_xaxes(title_text="position between the limits [%]", range=ends)
    figure.update_yaxes(autorange="reversed")
    return figure


def _with_share(error: float | None, effort: float) -> str:
    if error is None:
        return ""
    return f"{error:.3g} ({100 * error / effort:.1f} %)" if effort > 0 else f"{error:.3g}"


def _capitalized(text: str) -> str:
    return text[:1].upper() + text[1:]


def worst_level(verdicts: Sequence[Verdict]) -> str:
    """Returns the level of the answer for the least favourable of the verdicts."""
    levels = {LEVELS[verdict] for verdict in verdicts}
    return next((level for level in ("bad", "warning", "good") if level in levels), "plain")
