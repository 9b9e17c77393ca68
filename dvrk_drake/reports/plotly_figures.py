"""Draws plots with Plotly, for pages in a browser."""

from __future__ import annotations

from typing import Any

import numpy as np
import plotly.graph_objects as go
from numpy.typing import NDArray
from plotly.subplots import make_subplots

from dvrk_drake.reports.colours import SERIES
from dvrk_drake.reports.page import Plot
from dvrk_drake.reports.plot import Band, Bars, Curve, Guide, Mark, Panel, Values

#: Fonts of the page and of its plots. No font is loaded.
FONT = "system-ui, -apple-system, 'Segoe UI', Roboto, 'Noto Sans', 'DejaVu Sans', sans-serif"
#: Size of the smallest text in plots: 12 px are 9 pt.
SMALLEST_TEXT = 12
#: Gap between rows of panels with and without labels of the x axis, and margin below the last row [px].
_GAP, _SMALL_GAP, _BOTTOM = 92, 34, 56
#: Margin above the first row without a legend, height of a line of the legend, and width of the narrowest legend [px],
#: which is that of a plot beside a 3D view on a page of 1280 px.
_TOP, _LEGEND_LINE, _LEGEND_WIDTH = 34, 20, 440
#: Approximate width of a character of the legend, and of the symbol of an entry [px].
_CHARACTER, _SYMBOL = 7, 48
INK, LINE, GRID = "#1b2733", "#6b7785", "#e3e7eb"

_AXIS = {
    "showgrid": True,
    "gridcolor": GRID,
    "linecolor": LINE,
    "showline": True,
    "ticks": "outside",
    "tickcolor": LINE,
    "zeroline": False,
    "exponentformat": "power",
    "automargin": True,
    "tickfont": {"size": SMALLEST_TEXT},
    "title": {"font": {"size": 13}, "standoff": 8},
}
#: Template of all plots: legend above the data, background of the page, visible axis lines.
TEMPLATE = go.layout.Template(
    layout={
        "font": {"family": FONT, "size": 13, "color": INK},
        "paper_bgcolor": "rgba(0,0,0,0)",
        "plot_bgcolor": "rgba(0,0,0,0)",
        "hovermode": "closest",
        "hoverlabel": {"font": {"size": SMALLEST_TEXT}},
        "legend": {
            "orientation": "h",
            "yref": "container",
            "y": 0.998,
            "yanchor": "top",
            "x": 0.0,
            "font": {"size": SMALLEST_TEXT},
            "traceorder": "normal",
        },
        "colorway": list(SERIES),
        "annotationdefaults": {"font": {"size": 13}},
        # Beside the plot, so that the buttons do not cover the legend.
        "modebar": {"orientation": "v", "bgcolor": "rgba(0,0,0,0)"},
        "xaxis": _AXIS,
        "yaxis": _AXIS,
    }
)
_DASHES = {"line": "solid", "broad": "solid", "step": "solid", "dashed": "dash", "dotted": "dot"}
#: Style -> symbol, size [px] and opacity.
_SYMBOLS: dict[str, tuple[str, float, float]] = {
    "dots": ("circle", 4, 0.5),
    "circles": ("circle", 9, 0.9),
    "diamonds": ("diamond-open", 9, 1.0),
    "crosses": ("x-thin-open", 8, 1.0),
}


def plotly_figure(plot: Plot) -> go.Figure:
    """Returns the Plotly figure of a plot."""
    count, columns = len(plot.panels), plot.columns
    rows = -(-count // columns)
    heights = plot.row_heights
    gap = _SMALL_GAP if plot.shared_x else _GAP
    top = _TOP + _LEGEND_LINE * _legend_lines(plot)
    inside = sum(heights) + gap * (rows - 1)
    figure = make_subplots(
        rows=rows,
        cols=columns,
        row_heights=heights,
        shared_xaxes=plot.shared_x,
        vertical_spacing=gap / inside,
        horizontal_spacing=0.13 if columns > 1 else 0.0,  # 80 px on a page of 800 px, for labels and ticks
        subplot_titles=[panel.title for panel in plot.panels],
    )
    names: set[str] = set()
    for k, panel in enumerate(plot.panels):
        at = {"row": k // columns + 1, "col": k % columns + 1}
        _draw(figure, panel, at, names)
        if plot.shared_x and panel is not plot.panels[-1]:
            figure.update_xaxes(title_text="", showticklabels=False, **at)
    if columns > 1:  # a panel is half as wide, and labels such as -0.005 must not overlap
        figure.update_xaxes(nticks=5, selector=lambda axis: axis.type != "log")
    figure.update_annotations(font_size=13)
    if columns == 1:
        figure.update_annotations(xanchor="left", x=0.0)
    return figure.update_layout(
        template=TEMPLATE,
        height=inside + top + _BOTTOM,
        margin={"l": 64, "r": 44, "t": top, "b": _BOTTOM},
        barmode="stack",
        bargap=0.3,
        showlegend=bool(names),
        hovermode="x" if plot.time else "closest",
    )


def _legend_lines(plot: Plot) -> int:
    """Returns the number of lines of the legend on a narrow page."""
    names = dict.fromkeys(mark.name for panel in plot.panels for mark in panel.marks if mark.name)
    widths = [_CHARACTER * len(name) + _SYMBOL for name in names]
    if sum(widths) <= _LEGEND_WIDTH:
        return 1 if names else 0
    # Plotly makes all entries of a legend with several lines as wide as the widest one.
    return -(-len(names) // max(1, _LEGEND_WIDTH // max(widths)))


def _draw(figure: go.Figure, panel: Panel, at: dict[str, int], names: set[str]) -> None:
    for mark in panel.marks:
        entry = {"name": mark.name, "legendgroup": mark.name, "showlegend": bool(mark.name) and mark.name not in names}
        names |= {mark.name} - {""}
        if isinstance(mark, Guide):
            _draw_guide(figure, mark, at, entry)
        else:
            for trace in _traces(mark, entry):
                figure.add_trace(trace, **at)
    figure.update_xaxes(
        title_text=panel.x_label,
        type="log" if panel.log_x else None,
        range=_range(panel.x_range, panel.log_x),
        nticks=None if panel.log_x else 8,
        tickangle=0,
        **({"dtick": 1} if panel.log_x else {}),
        **at,
    )
    figure.update_yaxes(
        title_text=panel.y_label,
        type="log" if panel.log_y else None,
        range=_range(panel.y_range, panel.log_y),
        nticks=6,
        **at,
    )
    if categories := panel.categories:
        figure.update_yaxes(
            type="category",
            categoryorder="array",
            categoryarray=categories,
            range=[len(categories) - 0.5, -0.5],
            nticks=0,
            **at,
        )


def _traces(mark: Mark, entry: dict[str, Any]) -> list[go.Scatter | go.Bar]:
    if isinstance(mark, Band):
        edge = {"mode": "lines", "line": {"width": 0}, "hoverinfo": "skip", "legendgroup": entry["legendgroup"]}
        low = go.Scatter(x=_compact(mark.x), y=_compact(mark.low), showlegend=False, **edge)
        fill = {"fill": "tonexty", "fillcolor": _transparent(mark.colour, 0.25)}
        return [low, go.Scatter(x=_compact(mark.x), y=_compact(mark.high), **(edge | fill | entry))]
    if isinstance(mark, Bars):
        hover = {"hovertext": list(mark.texts), "hoverinfo": "text"} if mark.texts else {}
        style = {"color": mark.colour, "line": {"color": "white", "width": 1}}
        return [go.Bar(y=list(mark.labels), x=mark.values, orientation="h", marker=style, **hover, **entry)]
    assert isinstance(mark, Curve)
    hover = {"text": list(mark.texts), "hovertemplate": "%{text}"} if mark.texts else {}
    return [go.Scatter(x=_compact(mark.x), y=_compact(mark.y), **_look(mark.style, mark.colour), **hover, **entry)]


def _look(style: str, colour: str) -> dict[str, Any]:
    if style in _SYMBOLS:
        symbol, size, opacity = _SYMBOLS[style]
        edge = {"width": 2 if "open" in symbol else 0, "color": colour}
        return {
            "mode": "markers",
            "marker": {"symbol": symbol, "size": size, "opacity": opacity, "color": colour, "line": edge},
        }
    line: dict[str, Any] = {"color": colour, "width": 1.5, "dash": _DASHES[style]}
    if style == "broad":
        line |= {"color": _transparent(colour, 0.35), "width": 4.0}
    if style == "step":
        line["shape"] = "hv"
    return {"mode": "lines", "line": line}


def _draw_guide(figure: go.Figure, guide: Guide, at: dict[str, int], entry: dict[str, Any]) -> None:
    add_line, add_range = (
        (figure.add_vline, figure.add_vrect) if guide.axis == "x" else (figure.add_hline, figure.add_hrect)
    )
    # Plotly's default draws no guide in axes to which the curves are added later.
    place: dict[str, Any] = {**at, "exclude_empty_subplots": False}
    dash = "dash" if guide.dashed else "solid"
    if guide.high is None:
        add_line(guide.low, line={"color": guide.colour, "dash": dash, "width": 1.2}, **place)
        look: dict[str, Any] = {"mode": "lines", "line": {"color": guide.colour, "dash": dash, "width": 1.2}}
    else:
        add_range(guide.low, guide.high, fillcolor=guide.colour, opacity=0.3, line_width=0, layer="below", **place)
        marker = {"symbol": "square", "size": 12, "color": _transparent(guide.colour, 0.4)}
        look = {"mode": "markers", "marker": marker}
    if entry["showlegend"]:
        figure.add_trace(go.Scatter(x=[None], y=[None], **look, **entry), **at)


def _range(limits: tuple[float, float] | None, log: bool) -> list[float] | None:
    if limits is None:
        return None
    return [float(np.log10(x)) if log else float(x) for x in limits]


def _compact(values: Values) -> NDArray[Any]:
    """Returns the values in single precision, which halves the size of the page."""
    array = np.asarray(values)
    return array.astype(np.float32) if array.dtype == np.float64 else array


def _transparent(colour: str, opacity: float) -> str:
    red, green, blue = (int(colour[k : k + 2], 16) for k in (1, 3, 5))
    return f"rgba({red},{green},{blue},{opacity:g})"
