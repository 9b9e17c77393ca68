"""Plots of the drives: friction torque over speed, and torque of cables, springs and offsets over position."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import plotly.graph_objects as go
from numpy.typing import NDArray
from plotly.subplots import make_subplots

from dvrk_drake.dynamics.actuator_effects import ActuatorEffect, joint_row, position_along
from dvrk_drake.dynamics.drive_curves import depends_on_position, friction_curve, position_curve
from dvrk_drake.dynamics.dynamic_model import effect_shapes
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.effects_schema import DriveEffect
from dvrk_drake.reports.html.labels import coordinate_units
from dvrk_drake.reports.html.motion_plots import MotionEfforts
from dvrk_drake.reports.html.plot_style import COLOURS, axis_range

#: Number of points of a curve, and largest number of dots in a panel.
_POINTS, _DOTS = 201, 500
#: Height of a row of panels, and of the legend [px].
_PANEL, _AROUND = 250, 90


def friction_over_speed(efforts: MotionEfforts) -> go.Figure | None:
    """Returns a figure of the friction of each coordinate over its speed, or None if the model has no friction.

    The dots are the friction effort of the model plus the residual, which is the measured effort minus all other
    efforts of the model.
    """
    model, arm, grid = efforts.model.dynamic_model, efforts.arm, efforts.grid
    effects = [e for e in model.section.effects if not depends_on_position(e)]
    if not effects:
        return None
    names = list(dict.fromkeys(e.coordinate for e in effects))
    figure = _grid(names)
    transmitted = model.transmitted_effort(grid.q, grid.v, grid.vd)
    of_segments = [
        effect_shapes(model.regressor, [ActuatorEffect.of(e) for e in effects], g.q, g.v, transmitted[own])
        for g, own, _ in grid.each_segment()
    ]
    along: dict[str, NDArray[np.float64]] = {name: np.zeros(len(grid.t)) for name in names}
    for e, *shapes in zip(effects, *of_segments, strict=True):
        along[e.coordinate] = along[e.coordinate] + e.coefficient * np.concatenate(shapes)
    for k, name in enumerate(names):
        h = arm.effect_coordinates[name]
        speed = efforts.v @ h
        of_model = grid.filter_efforts(grid.at_rows(along[name], int(np.argmax(np.abs(h)))))
        friction = of_model + efforts.residuals @ h / (h @ h)
        largest = float(np.max(np.abs(speed), initial=0.0))
        v = largest * np.linspace(-1, 1, _POINTS) ** 3  # more points at low speeds
        x = float(np.sqrt(np.mean(position_along(arm, name, grid.q) ** 2)))
        load = float(np.mean(np.abs(transmitted @ h)) / (h @ h))
        _add_curve(figure, k, speed, friction, v, friction_curve(effects, name, v, load, x))
        effort, length = coordinate_units(arm, name)
        _label_axes(figure, k, f"speed [{length}/s]", f"friction [{effort}]")
    return figure


def torque_over_position(
    arm: Arm, effects: Sequence[DriveEffect], q: NDArray[np.float64], residuals: NDArray[np.float64] | None = None
) -> go.Figure | None:
    """Returns a figure of the torque of offset, cables and springs of each coordinate over its position.

    The result is None if the model has no such effect that depends on the position.

    Args:
        arm: Arm of the model.
        effects: Effects of the model.
        q: Positions (m, n) of the joints in the recording [rad, m]. The curve covers their range.
        residuals: Residuals (m, n) in joint coordinates at these positions, nan for excluded measurements. The dots are
            the torque of the curve plus the residual. None: no dots.
    """
    own = [e for e in effects if depends_on_position(e)]
    names = list(dict.fromkeys(e.coordinate for e in own if e.kind != "offset"))
    if not names:
        return None
    figure = _grid(names)
    for k, name in enumerate(names):
        x = position_along(arm, name, q)
        curve = np.linspace(x.min(), x.max(), _POINTS)
        dots = None
        if residuals is not None:
            row = joint_row(arm, name)
            used = row != 0
            dots = position_curve(own, name, x) + residuals[:, used] @ row[used] / (row @ row)
        _add_curve(figure, k, x, dots, curve, position_curve(own, name, curve))
        figure.update_xaxes(**axis_range(x), **_at(figure, k))
        effort, length = coordinate_units(arm, name)
        _label_axes(figure, k, f"position [{length}]", f"torque [{effort}]" if effort == "N m" else f"force [{effort}]")
    return figure


def _columns(count: int) -> int:
    return min(3, count)


def _grid(names: Sequence[str]) -> go.Figure:
    columns = _columns(len(names))
    rows = -(-len(names) // columns)
    height = _AROUND + _PANEL * rows
    figure = make_subplots(
        rows=rows, cols=columns, subplot_titles=list(names), vertical_spacing=96 / height, horizontal_spacing=0.08
    )
    figure.update_layout(height=height, meta={"columns": columns})
    figure.update_annotations(font_size=13)
    return figure


def _at(figure: go.Figure, k: int) -> dict[str, int]:
    columns = figure.layout.meta["columns"]
    return {"row": k // columns + 1, "col": k % columns + 1}


def _label_axes(figure: go.Figure, k: int, x: str, y: str) -> None:
    figure.update_xaxes(title_text=x, nticks=6, **_at(figure, k))
    figure.update_yaxes(title_text=y, nticks=6, **_at(figure, k))


def _add_curve(
    figure: go.Figure,
    k: int,
    x: NDArray[np.float64],
    dots: NDArray[np.float64] | None,
    curve_x: NDArray[np.float64],
    curve_y: NDArray[np.float64],
) -> None:
    if dots is not None:
        step = -(-len(x) // _DOTS)
        figure.add_scatter(
            x=x[::step].astype(np.float32),
            y=dots[::step].astype(np.float32),
            mode="markers",
            name="measured minus all other efforts of the model",
            legendgroup="dots",
            showlegend=k == 0,
            marker={"size": 4, "color": COLOURS["measured"], "opacity": 0.35},
            **_at(figure, k),
        )
    figure.add_scatter(
        x=curve_x,
        y=curve_y,
        mode="lines",
        name="model",
        legendgroup="model",
        showlegend=k == 0,
        line={"color": COLOURS["fitted"], "width": 2.5},
        **_at(figure, k),
    )
