"""Plots of a motion: efforts over time, and residuals over position and speed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import plotly.graph_objects as go
from numpy.typing import NDArray
from plotly.subplots import make_subplots

from dvrk_drake.analysis.dynamic.dynamic_identification import DynamicIdentification, FittedMotion
from dvrk_drake.analysis.dynamic.validation import DynamicValidation
from dvrk_drake.analysis.observations.motion_grid import MotionGrid
from dvrk_drake.reports.html.binned import ComparedEfforts, binned_residuals
from dvrk_drake.reports.html.labels import effort_unit, joint_label, length_unit
from dvrk_drake.reports.html.plot_style import COLOURS, line, transparent

#: Largest number of rows in each trace of a plot over time.
MAX_ROWS = 3000
#: Height of one panel of a plot over time, and of the legend and the labels [px].
_PANEL, _AROUND = 150, 130


@dataclass(frozen=True, eq=False)
class MotionEfforts(ComparedEfforts):
    """Efforts of the actuators during a motion, after low-pass filtering.

    Attributes:
        grid: Resampled motion.
        t: Times (r,) since the start of the recording [s].
        q, v: Positions [rad, m] and velocities (r, n) of the actuators.
        period: Period of the motion [s], or None if the motion does not repeat.
        repeatability: RMS differences (n,) of the efforts between periods [N m, N], 0 if the motion does not repeat.
        half_width: Half widths (n,) of the 95 % prediction intervals, see `DynamicModel.half_width`.
    """

    grid: MotionGrid
    t: NDArray[np.float64]
    q: NDArray[np.float64]
    v: NDArray[np.float64]
    period: float | None
    repeatability: NDArray[np.float64]
    half_width: NDArray[np.float64]

    @classmethod
    def of(cls, result: DynamicIdentification | DynamicValidation, number: int = 0) -> MotionEfforts:
        """Returns the efforts of a validation, or of one recording (index `number`) of an identification."""
        motion: FittedMotion | DynamicValidation
        if isinstance(result, DynamicIdentification):
            motion = result.motions[number]
            predicted = {"fitted": motion.predicted, "held out": motion.held_out}
            repeatability = [a.rms_repeatability for a in result.model.dynamic_model.section.actuators]
        else:
            motion, predicted = result, {"predicted": result.predicted}
            repeatability = [(a.repeatability or 0.0) * a.rms_effort for a in result.actuators]
        t, q, v = motion.grid.actuator_motion()
        return cls(
            model=result.model,
            recording=motion.recording,
            grid=motion.grid,
            t=t - motion.grid.row_times[0],
            q=q,
            v=v,
            measured=motion.measured,
            predicted=predicted,
            period=motion.period,
            repeatability=np.array(repeatability),
            half_width=result.model.dynamic_model.half_width,
        )


def efforts_over_time(efforts: MotionEfforts) -> tuple[go.Figure, str]:
    """Returns a figure with one panel per actuator, and a sentence about the omitted rows.

    Measured efforts are a thick line below the thin lines of the predictions, so that no line hides another one. The
    band is the 95 % prediction interval.
    """
    arm, n = efforts.arm, efforts.arm.num_joints
    figure = _panels([_effort_title(efforts, i) for i in range(n)])
    step = -(-2 * len(efforts.t) // MAX_ROWS)
    for i in range(n):
        rows = extremes(efforts.measured[:, i], step)
        traces = {"measured": efforts.measured, **efforts.predicted}
        traces[f"measured − {efforts.judged}"] = efforts.residuals
        band = efforts.predicted[efforts.judged][rows, i]
        for sign in (-1.0, 1.0) if efforts.half_width[i] > 0 else ():
            figure.add_trace(
                go.Scatter(
                    x=_compact(efforts.t[rows]),
                    y=_compact(band + sign * efforts.half_width[i]),
                    name="95 % prediction interval",
                    legendgroup="interval",
                    showlegend=i == 0 and sign > 0,
                    mode="lines",
                    line={"width": 0},
                    fill="tonexty" if sign > 0 else "none",
                    fillcolor=transparent(COLOURS[efforts.judged], 0.2),
                    hoverinfo="skip",
                ),
                row=i + 1,
                col=1,
            )
        for name, values in traces.items():
            figure.add_trace(
                go.Scatter(
                    x=_compact(efforts.t[rows]),
                    y=_compact(values[rows, i]),
                    name=name,
                    legendgroup=name,
                    showlegend=i == 0,
                    visible="legendonly" if "−" in name else True,
                    line=line("residual" if "−" in name else name),
                    hovertemplate=f"%{{y:.4g}} {effort_unit(arm, i)} at %{{x:.2f}} s",
                ),
                row=i + 1,
                col=1,
            )
        figure.update_yaxes(title_text=f"[{effort_unit(arm, i)}]", row=i + 1, col=1)
    figure.update_xaxes(title_text="time since the start of the recording [s]", row=n, col=1)
    if step <= 2:
        return figure, "All rows are drawn."
    return figure, f"Of each {step} rows, the rows with the smallest and the largest measured effort are drawn."


def residuals_over_position_and_speed(efforts: MotionEfforts) -> tuple[go.Figure, str]:
    """Returns a figure with two panels per actuator, and a sentence about dots, line and band."""
    panels = []
    for i in range(efforts.arm.num_joints):
        unit = length_unit(efforts.arm, i)
        for x, axis in ((efforts.q, f"position [{unit}]"), (efforts.v, f"speed [{unit}/s]")):
            panels.append(
                (joint_label(efforts.arm, i), axis, effort_unit(efforts.arm, i), x[:, i], efforts.residuals[:, i])
            )
    return binned_residuals(panels, columns=2)


def extremes(values: NDArray[np.float64], step: int) -> NDArray[np.int_]:
    """Returns the indices of the smallest and the largest of each `step` values (r,). Steps of 1 or 2: all indices."""
    if step <= 2:
        return np.arange(len(values))
    starts = np.arange(0, len(values), step)
    both = [
        (start + np.argmin(values[start : start + step]), start + np.argmax(values[start : start + step]))
        for start in starts
    ]
    return np.unique(both)


def _effort_title(efforts: MotionEfforts, i: int) -> str:
    effort = np.sqrt(np.mean(efforts.measured[:, i] ** 2))
    if effort == 0:
        return f"{joint_label(efforts.arm, i)}: no effort"
    error = np.sqrt(np.mean(efforts.residuals[:, i] ** 2)) / effort
    return f"{joint_label(efforts.arm, i)}: RMS error {100 * error:.1f} % of the effort ({efforts.judged})"


def _panels(titles: list[str]) -> go.Figure:
    count = len(titles)
    height = _AROUND + _PANEL * count
    figure = make_subplots(rows=count, cols=1, shared_xaxes=True, vertical_spacing=34 / height, subplot_titles=titles)
    figure.update_layout(height=height, hovermode="x")
    figure.update_annotations(font_size=13, xanchor="left", x=0.0)
    return figure


def _compact(values: NDArray[np.float64]) -> NDArray[np.float32]:
    """Returns the values in single precision, which halves the size of the page."""
    return values.astype(np.float32)
