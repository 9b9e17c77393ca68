"""Plotly template of the reports. The colours of the roles are those of `reports.figures.style`."""

from __future__ import annotations

import plotly.graph_objects as go

#: Fonts of the page and of its plots. No font is loaded.
FONT = "system-ui, -apple-system, 'Segoe UI', Roboto, 'Noto Sans', 'DejaVu Sans', sans-serif"
#: Size of the smallest text in plots: 12 px are 9 pt.
SMALLEST_TEXT = 12
_INK, _LINE, _GRID = "#1b2733", "#6b7785", "#e3e7eb"
_AXIS = {
    "showgrid": True,
    "gridcolor": _GRID,
    "linecolor": _LINE,
    "showline": True,
    "ticks": "outside",
    "tickcolor": _LINE,
    "zeroline": False,
    "automargin": True,
    "tickfont": {"size": SMALLEST_TEXT},
    "title": {"font": {"size": 13}, "standoff": 8},
}
#: Template of all plots: legend above the data, white background, visible axis lines.
TEMPLATE = go.layout.Template(
    layout={
        "font": {"family": FONT, "size": 13, "color": _INK},
        "height": 380,
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
        "annotationdefaults": {"font": {"size": 13}},
        "xaxis": _AXIS,
        "yaxis": _AXIS,
    }
)
