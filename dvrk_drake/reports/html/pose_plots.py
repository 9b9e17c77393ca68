"""Plots of static poses: measured and predicted effort of each pose, and residuals over position."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import plotly.graph_objects as go
from numpy.typing import NDArray
from plotly.subplots import make_subplots

from dvrk_drake.analysis.static.excluded_measurements import ExcludedMeasurement
from dvrk_drake.analysis.static.static_identification import StaticIdentification
from dvrk_drake.analysis.static.validation import StaticValidation
from dvrk_drake.reports.html.binned import ComparedEfforts, binned_residuals
from dvrk_drake.reports.html.labels import effort_unit, joint_label, length_unit
from dvrk_drake.reports.html.plot_style import COLOURS

_MARKERS = {
    "measured": ("circle", 9),
    "fitted": ("line-ew-open", 9),
    "held out": ("x-thin-open", 7),
    "predicted": ("x-thin-open", 7),
}
#: Height of one panel, and of the legend and the labels [px].
_PANEL, _AROUND, _SQUARE = 150, 130, 290


@dataclass(frozen=True, eq=False)
class PoseEfforts(ComparedEfforts):
    """Holding efforts at m poses, in the coordinates of the recording.

    Attributes:
        usable: Mask (m, n) of the efforts that are not excluded.
        excluded: Excluded measurements and the reasons.
    """

    usable: NDArray[np.bool_]
    excluded: Sequence[ExcludedMeasurement]

    @classmethod
    def of(cls, result: StaticIdentification | StaticValidation) -> PoseEfforts:
        """Returns the efforts of an identification or a validation."""
        measured = result.recording.measured_effort()
        predicted = {"predicted": measured - result.residuals}
        if isinstance(result, StaticIdentification):
            predicted = {
                "fitted": measured - result.residuals,
                "held out": measured - result.cross_validation_residuals,
            }
        return cls(result.model, result.recording, measured, predicted, result.usable, result.excluded)


def efforts_of_poses(efforts: PoseEfforts) -> go.Figure:
    """Returns a figure with one panel per joint and the number of the pose, starting at 0, as x axis."""
    arm, n = efforts.arm, efforts.arm.num_joints
    height = _AROUND + _PANEL * n
    figure = make_subplots(
        rows=n,
        cols=1,
        shared_xaxes=True,
        vertical_spacing=34 / height,
        subplot_titles=[joint_label(arm, j) for j in range(n)],
    )
    figure.update_annotations(font_size=13, xanchor="left", x=0.0)
    poses = np.arange(len(efforts.measured))
    for j in range(n):
        for name, values in {"measured": efforts.measured, **efforts.predicted}.items():
            use = efforts.usable[:, j]
            figure.add_trace(_dots(name, poses[use], values[use, j], first=j == 0), row=j + 1, col=1)
        left_out = ~efforts.usable[:, j]
        lower, upper = _range(efforts, j)
        values = efforts.measured[left_out, j]
        excluded = _dots("excluded", poses[left_out], np.clip(values, lower, upper), first=j == 0)
        reasons = [_reason(efforts.excluded, int(row), j) for row in poses[left_out]]
        excluded.text = [
            f"{value:.4g} at pose {row}: {why}"
            for value, row, why in zip(values, poses[left_out], reasons, strict=True)
        ]
        excluded.hovertemplate = "%{text}"
        figure.add_trace(excluded, row=j + 1, col=1)
        figure.update_yaxes(range=[lower, upper], row=j + 1, col=1)
        figure.update_yaxes(title_text=f"[{effort_unit(arm, j)}]", row=j + 1, col=1)
    figure.update_xaxes(title_text="pose", row=n, col=1)
    figure.update_layout(height=height)
    return figure


def predicted_over_measured(efforts: PoseEfforts) -> go.Figure:
    """Returns a figure with one panel per joint that compares predicted and measured efforts of all poses."""
    arm = efforts.arm
    columns = min(2, arm.num_joints)
    rows = -(-arm.num_joints // columns)
    figure = make_subplots(
        rows=rows,
        cols=columns,
        subplot_titles=[joint_label(arm, j) for j in range(arm.num_joints)],
        vertical_spacing=90 / (_SQUARE * rows),
        horizontal_spacing=0.16,
    )
    for j in range(arm.num_joints):
        use = efforts.usable[:, j]
        at = {"row": j // columns + 1, "col": j % columns + 1}
        measured = efforts.measured[use, j]
        for name, values in efforts.predicted.items():
            figure.add_trace(_dots(name, measured, values[use, j], first=j == 0), **at)
        every = np.concatenate([measured, *(values[use, j] for values in efforts.predicted.values())])
        ends = [every.min(), every.max()] if len(every) else [0.0, 0.0]
        figure.add_scatter(
            x=ends,
            y=ends,
            mode="lines",
            name="predicted = measured",
            legendgroup="equal",
            showlegend=j == 0,
            line={"color": COLOURS["zero"], "width": 1},
            **at,
        )
        figure.update_xaxes(title_text=f"measured [{effort_unit(arm, j)}]", nticks=4, tickangle=0, **at)
        figure.update_yaxes(title_text=f"predicted [{effort_unit(arm, j)}]", nticks=5, **at)
    figure.update_layout(height=60 + _SQUARE * rows)
    figure.update_annotations(font_size=13)
    return figure


def residuals_over_position(efforts: PoseEfforts) -> tuple[go.Figure, str]:
    """Returns a figure with one panel per joint, and a sentence about dots, line and band."""
    arm, panels = efforts.arm, []
    for j in range(arm.num_joints):
        use = efforts.usable[:, j]
        axis = f"position [{length_unit(arm, j)}]"
        if np.any(use):
            residuals = efforts.residuals[use, j]
            panels.append((joint_label(arm, j), axis, effort_unit(arm, j), efforts.recording.q[use, j], residuals))
    return binned_residuals(panels, columns=min(3, arm.num_joints))


def _range(efforts: PoseEfforts, joint: int) -> tuple[float, float]:
    """Returns the range of the axis of a joint. It contains all efforts except excluded ones."""
    use = efforts.usable[:, joint]
    shown = [efforts.measured[use, joint], *(values[use, joint] for values in efforts.predicted.values())]
    values = np.concatenate(shown) if np.any(use) else np.zeros(1)
    margin = 0.08 * (float(np.ptp(values)) or 1e-3)
    return float(values.min()) - margin, float(values.max()) + margin


def _dots(name: str, x: NDArray, y: NDArray[np.float64], first: bool) -> go.Scatter:
    symbol, size = _MARKERS.get(name, ("diamond-open", 8))
    colour = COLOURS["limit" if name == "excluded" else name]
    return go.Scatter(
        x=x,
        y=y.astype(np.float32),
        mode="markers",
        name=name,
        legendgroup=name,
        showlegend=first,
        marker={
            "symbol": symbol,
            "size": size,
            "color": colour,
            "opacity": 0.45 if name == "measured" else 1.0,
            "line": {"width": 0 if name == "measured" else 1.6, "color": colour},
        },
        hovertemplate="%{y:.4g} at %{x}",
    )


def _reason(excluded: Sequence[ExcludedMeasurement], row: int, joint: int) -> str:
    return next((m.reason for m in excluded if m.row == row and joint in m.joints), "")
