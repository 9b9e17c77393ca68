"""Plotly template of the reports, and the colours of the roles of traces."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import plotly.graph_objects as go
from numpy.typing import NDArray
from plotly.subplots import make_subplots

from dvrk_drake.reports.colours import ROLES, SERIES

#: Fonts of the page and of its plots. No font is loaded.
FONT = "system-ui, -apple-system, 'Segoe UI', Roboto, 'Noto Sans', 'DejaVu Sans', sans-serif"
#: Size of the smallest text in plots: 12 px are 9 pt.
SMALLEST_TEXT = 12
#: Height of a plot whose figure has no height [px].
DEFAULT_HEIGHT = 380
#: Smallest range of positions or speeds for which an axis shows only this range [rad, m, rad/s, m/s].
MIN_SPAN = 0.01
_INK, _LINE, _GRID = "#1b2733", "#6b7785", "#e3e7eb"
_AXIS = {
    "showgrid": True,
    "gridcolor": _GRID,
    "linecolor": _LINE,
    "showline": True,
    "ticks": "outside",
    "tickcolor": _LINE,
    "zeroline": False,
    "exponentformat": "power",
    "automargin": True,
    "tickfont": {"size": SMALLEST_TEXT},
    "title": {"font": {"size": 13}, "standoff": 8},
}
#: Template of all plots: legend above the data, white background, visible axis lines.
TEMPLATE = go.layout.Template(
    layout={
        "font": {"family": FONT, "size": 13, "color": _INK},
        "margin": {"l": 64, "r": 24, "t": 56, "b": 52},
        "paper_bgcolor": "white",
        "plot_bgcolor": "white",
        "hovermode": "closest",
        "hoverlabel": {"font": {"size": SMALLEST_TEXT}},
        "legend": {
            "orientation": "h",
            "yref": "container",
            "y": 0.995,
            "yanchor": "top",
            "x": 0.0,
            "font": {"size": SMALLEST_TEXT},
        },
        "colorway": list(SERIES),
        "annotationdefaults": {"font": {"size": 13}},
        "xaxis": _AXIS,
        "yaxis": _AXIS,
    }
)


def series_colour(i: int) -> str:
    """Returns the colour of the i-th series of a plot in which the series have no roles."""
    return SERIES[i % len(SERIES)]


def axis_range(x: NDArray[np.float64]) -> dict[str, Any]:
    """Returns the settings of an axis for positions or speeds x (m,). Its range is at least 2 `MIN_SPAN`."""
    if len(x) and np.ptp(x) < MIN_SPAN:  # The joint hardly moves. Without a range, the ticks show rounding errors.
        return {"range": [float(x.mean()) - MIN_SPAN, float(x.mean()) + MIN_SPAN]}
    return {}


def transparent(colour: str, opacity: float) -> str:
    """Returns a colour "#rrggbb" with an opacity 0..1, for filled areas."""
    red, green, blue = (int(colour[k : k + 2], 16) for k in (1, 3, 5))
    return f"rgba({red},{green},{blue},{opacity:g})"


def joint_panels(names: Sequence[str], x_title: str = "", x_titles: Sequence[str] = ()) -> go.Figure:
    """Returns a figure with one panel per joint in two columns. Panel j has row 1 + j // 2 and column 1 + j % 2.

    Args:
        names: Titles of the panels.
        x_title: Title of the x axis of the last panel in each column. All panels then have the same x axis.
        x_titles: Titles of the x axes of all panels, if the panels have different x axes.
    """
    rows = -(-len(names) // 2)
    height, gap = (240.0, 92.0) if x_titles else (200.0, 46.0)  # of a panel and between panels [px]
    figure = make_subplots(
        rows=rows,
        cols=2,
        subplot_titles=list(names),
        shared_xaxes="all" if x_title else False,
        vertical_spacing=gap / (rows * height),
        horizontal_spacing=0.14,
    )
    for j in range(len(names)):
        title = x_titles[j] if x_titles else x_title if j >= len(names) - 2 else ""
        # With an odd number of panels, the last panel of the right column is one row higher.
        figure.update_xaxes(title=title, showticklabels=bool(title) or bool(x_titles), row=1 + j // 2, col=1 + j % 2)
    return figure.update_layout(height=110 + height * rows)


#: Role of a trace -> colour, the same in all plots and figures.
COLOURS = ROLES | {"predicted": ROLES["fitted"], "residual": _LINE, "zero": _LINE}


def line(role: str) -> dict[str, str | float]:
    """Returns the line of a trace with a role of `COLOURS`.

    Measurements are drawn first, as a thick and light line that the thin lines of predictions do not hide.
    """
    if role == "measured":
        return {"color": "rgba(31, 31, 31, 0.35)", "width": 4.0}
    return {"color": COLOURS[role], "width": 1.3}
