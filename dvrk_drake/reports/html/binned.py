"""Efforts of a recording, and their residuals over another quantity: dots, mean and standard deviation in bins."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import plotly.graph_objects as go
from numpy.typing import NDArray
from plotly.subplots import make_subplots

from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.models.arm import Arm
from dvrk_drake.recordings.recording import Recording
from dvrk_drake.reports.html.plot_style import COLOURS, axis_range

#: Largest number of dots in one panel, and number of bins.
MAX_DOTS, BINS = 600, 25
#: Smallest number of values in a bin.
MIN_PER_BIN = 8
#: Smallest width of a bin, as a share of the range.
MIN_BIN_WIDTH = 0.01
#: Height of one row of panels, and of the legend [px].
_PANEL, _AROUND = 230, 100
#: Panel: title, label of the x axis, unit of the residuals, x (r,), residuals (r,).
Panel = tuple[str, str, str, NDArray[np.float64], NDArray[np.float64]]


@dataclass(frozen=True, eq=False)
class ComparedEfforts:
    """Measured and predicted efforts in m rows.

    Attributes:
        model: Model of the predictions.
        recording: Recording with the measured efforts.
        measured: Measured efforts (m, n) [N m, N].
        predicted: Name of the prediction ("fitted", "held out" or "predicted") -> predicted efforts (m, n) [N m, N].
            The last one is the most independent of the measured efforts.
    """

    model: IdentifiedModel
    recording: Recording
    measured: NDArray[np.float64]
    predicted: Mapping[str, NDArray[np.float64]]

    @property
    def arm(self) -> Arm:
        """Arm of the model."""
        return self.model.arm

    @property
    def judged(self) -> str:
        """Name of the prediction whose residuals are plotted."""
        return list(self.predicted)[-1]

    @property
    def residuals(self) -> NDArray[np.float64]:
        """Measured minus predicted efforts (m, n) for the prediction `judged` [N m, N]."""
        return self.measured - self.predicted[self.judged]


def bin_means(
    x: NDArray[np.float64], y: NDArray[np.float64], bins: int = BINS
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Returns mean x, mean y and the standard deviation of y (b,) in bins with similar numbers of values.

    Args:
        x, y: Values (r,).
        bins: Number of bins. It is smaller if a bin would contain fewer than `MIN_PER_BIN` values, or would be narrower
            than `MIN_BIN_WIDTH`.
    """
    bins = max(1, min(bins, len(x) // MIN_PER_BIN))
    edges = np.quantile(x, np.linspace(0, 1, bins + 1))
    # Bins that are much narrower than the others would show the scatter instead of the mean.
    kept = [edges[0]]
    for edge in edges[1:]:
        if edge - kept[-1] > MIN_BIN_WIDTH * (edges[-1] - edges[0]):
            kept.append(edge)
    edges = np.array(kept)
    index = np.clip(np.searchsorted(edges, x, side="right") - 1, 0, max(len(edges) - 2, 0))
    used = np.unique(index)
    of_bin = [index == k for k in used]
    return (
        np.array([x[rows].mean() for rows in of_bin]),
        np.array([y[rows].mean() for rows in of_bin]),
        np.array([y[rows].std() for rows in of_bin]),
    )


def binned_residuals(panels: Sequence[Panel], columns: int) -> tuple[go.Figure, str]:
    """Returns a figure with one panel per entry of `panels`, and a sentence that explains dots, line and band."""
    count = -(-len(panels) // columns)
    height = _AROUND + _PANEL * count
    figure = make_subplots(
        rows=count,
        cols=columns,
        subplot_titles=[f"{name}" for name, *_ in panels],
        vertical_spacing=96 / height,
        horizontal_spacing=0.09,
    )
    every = 1
    for k, (_, axis, unit, x, residuals) in enumerate(panels):
        step = -(-len(x) // MAX_DOTS)
        every = max(every, step)
        _add_panel(figure, k // columns + 1, k % columns + 1, x, residuals, step, first=k == 0)
        figure.update_xaxes(title_text=axis, nticks=5, tickangle=0, row=k // columns + 1, col=k % columns + 1)
        figure.update_xaxes(**axis_range(x), row=k // columns + 1, col=k % columns + 1)
        figure.update_yaxes(title_text=f"[{unit}]", row=k // columns + 1, col=k % columns + 1)
    figure.update_layout(height=height)
    figure.update_annotations(font_size=13)
    dots = "one dot per measurement" if every == 1 else f"one dot per {every} rows"
    return figure, f"Dots: {dots}. Line and band: mean and one standard deviation in up to {BINS} bins."


def _add_panel(
    figure: go.Figure,
    row: int,
    column: int,
    x: NDArray[np.float64],
    residuals: NDArray[np.float64],
    step: int,
    first: bool,
) -> None:
    center, mean, deviation = bin_means(x, residuals)
    figure.add_scatter(
        x=x[::step].astype(np.float32),
        y=residuals[::step].astype(np.float32),
        mode="markers",
        name="residual",
        legendgroup="residual",
        showlegend=first,
        marker={"size": 4, "color": COLOURS["residual"], "opacity": 0.55},
        row=row,
        col=column,
    )
    figure.add_scatter(
        x=np.concatenate([center, center[::-1]]),
        y=np.concatenate([mean + deviation, (mean - deviation)[::-1]]),
        mode="lines",
        fill="toself",
        fillcolor="rgba(57, 123, 220, 0.3)",
        line={"width": 0},
        hoverinfo="skip",
        name="one standard deviation",
        legendgroup="band",
        showlegend=first,
        row=row,
        col=column,
    )
    figure.add_scatter(
        x=center,
        y=mean,
        mode="lines",
        name="mean",
        legendgroup="mean",
        showlegend=first,
        line={"color": COLOURS["fitted"], "width": 2},
        row=row,
        col=column,
    )
    figure.add_hline(y=0.0, line={"color": COLOURS["zero"], "width": 1}, row=row, col=column)
