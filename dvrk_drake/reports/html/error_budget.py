"""Error budget: the error of each joint, divided by its causes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import plotly.graph_objects as go
from numpy.typing import NDArray

from dvrk_drake.analysis.dynamic.validation import SHARE_LABELS, error_shares
from dvrk_drake.reports.colours import NEUTRAL, SERIES
from dvrk_drake.reports.html.motion_plots import MotionEfforts
from dvrk_drake.reports.html.plot_style import COLOURS
from dvrk_drake.reports.html.pose_plots import PoseEfforts

#: Cause -> colour.
_COLOURS = dict(zip(SHARE_LABELS, (*SERIES[:5], *SERIES[6:], NEUTRAL), strict=True))


@dataclass(frozen=True)
class JointBudget:
    """Error of one joint.

    Attributes:
        name: Name of the joint.
        relative_error: RMS error / RMS effort [1].
        shares: Cause, a label of `SHARE_LABELS` -> share of the squared error. The shares add up to 1.
        repeatability: RMS difference of the effort between periods / RMS effort [1], None if unknown.
    """

    name: str
    relative_error: float
    shares: dict[str, float]
    repeatability: float | None = None


def motion_budget(efforts: MotionEfforts) -> list[JointBudget]:
    """Returns the error of each actuator of a motion by its causes, see `ErrorShares`."""
    grid, period = efforts.grid, efforts.period
    vd = grid.efforts_at_rows(grid.arm.transmission.velocity(grid.vd))[grid.inner]
    budgets = []
    for i, name in enumerate(efforts.arm.joint_names):
        effort = _rms(efforts.measured[:, i])
        if effort > 0:
            error = efforts.residuals[:, i]
            shares = error_shares(error, i, efforts.q, efforts.v[:, i], vd, efforts.t, period)
            by_cause = {label: share or 0.0 for label, share in zip(SHARE_LABELS, shares, strict=True)}
            floor = efforts.repeatability[i]
            budgets.append(JointBudget(name, _rms(error) / effort, by_cause, floor / effort if floor > 0 else None))
    return budgets


def pose_budget(efforts: PoseEfforts) -> list[JointBudget]:
    """Returns the error of each joint at static poses: bias, position-dependent and other.

    The position-dependent share is what a sine and a cosine of the joint's position explain.
    """
    budgets = []
    for j, name in enumerate(efforts.arm.joint_names):
        use = efforts.usable[:, j]
        error, q = efforts.residuals[use, j], efforts.recording.q[use, j]
        if np.any(use) and (effort := _rms(efforts.measured[use, j])) > 0:
            shares = _pose_shares(error, q)
            budgets.append(JointBudget(name, _rms(error) / effort, shares))
    return budgets


def _pose_shares(error: NDArray[np.float64], q: NDArray[np.float64]) -> dict[str, float]:
    total = float(np.mean(error**2)) or 1.0
    bias = float(np.mean(error)) ** 2 / total
    X = np.column_stack([np.ones_like(q), np.sin(q), np.cos(q)])
    rest = float(np.mean((error - X @ np.linalg.lstsq(X, error, rcond=None)[0]) ** 2)) / total
    return {"bias": bias, "position-dependent": 1 - bias - rest, "other": rest}


def error_budget(budgets: Sequence[JointBudget]) -> go.Figure:
    """Returns a figure with one bar per joint: the relative RMS error, divided by shares of the squared error."""
    names = [budget.name for budget in budgets]
    relative = np.array([100 * budget.relative_error for budget in budgets])
    figure = go.Figure()
    for cause, colour in _COLOURS.items():
        shares = np.array([budget.shares.get(cause, 0.0) for budget in budgets])
        if np.any(shares > 0.005):
            figure.add_bar(
                y=names,
                x=relative * shares,
                name=cause,
                orientation="h",
                marker={"color": colour, "line": {"color": "white", "width": 1}},
                customdata=100 * shares,
                hovertemplate=f"%{{y}}, {cause}: %{{customdata:.0f}} % of the squared error",
            )
    known = [budget for budget in budgets if budget.repeatability is not None]
    if known:
        figure.add_scatter(
            y=[budget.name for budget in known],
            x=[100 * (budget.repeatability or 0.0) for budget in known],
            mode="markers",
            name="repeatability",
            # A white edge separates the marker from dark bars.
            marker={
                "symbol": "diamond-tall",
                "size": 17,
                "color": COLOURS["measured"],
                "line": {"width": 1.5, "color": "white"},
            },
            hovertemplate="%{y}: repeatability %{x:.2g} %",
        )
    figure.update_layout(
        barmode="stack", height=150 + 36 * len(names), bargap=0.3, margin={"t": 76}, legend={"traceorder": "normal"}
    )
    figure.update_xaxes(title_text="RMS error / RMS effort [%]", rangemode="tozero")
    figure.update_yaxes(autorange="reversed")
    return figure


def _rms(values: NDArray[np.float64]) -> float:
    return float(np.sqrt(np.mean(values**2)))
