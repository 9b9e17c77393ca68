"""Writes each plot of a page as a PNG file.

An image is shown at 100 % or larger: an image of `WIDTH` has `DPI` * `WIDTH` = 1210 pixels, the width of a page at
1280 pixels. The smallest text has 9 pt at this size. `tests/support/figure_rules.py` checks the rules.
"""

from __future__ import annotations

import textwrap
from pathlib import Path
from typing import Any

import matplotlib
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from dvrk_drake.models.files import atomic_write
from dvrk_drake.reports.colours import SERIES
from dvrk_drake.reports.page import Page, Plot
from dvrk_drake.reports.plot import Band, Bars, Curve, Guide, Mark, Panel

#: Width of all images [inch].
WIDTH = 11.0
#: Resolution of all images [pixels per inch].
DPI = 110
#: Size of the smallest text [pt].
SMALLEST_TEXT = 9.0

_TITLE_LENGTH = 125  # characters of a title in one line
_LEGEND_LENGTH = 150  # characters of a legend in one line
_LINES = {"line": "-", "broad": "-", "step": "-", "dashed": "--", "dotted": ":"}
#: Style -> marker and size [pt].
_MARKERS = {"dots": (".", 2.5), "circles": ("o", 5.0), "diamonds": ("D", 4.5), "crosses": ("x", 5.0)}

matplotlib.use("Agg")
matplotlib.rcParams.update(
    {
        "font.size": 10,
        "axes.titlesize": 10,
        "axes.labelsize": 9.5,
        "xtick.labelsize": SMALLEST_TEXT,
        "ytick.labelsize": SMALLEST_TEXT,
        "legend.fontsize": 9.5,
        "figure.titlesize": 12,
        "figure.dpi": DPI,
        "axes.grid": True,
        "grid.alpha": 0.3,
        "axes.axisbelow": True,
        "axes.spines.top": False,
        "axes.spines.right": False,
        "axes.prop_cycle": plt.cycler(color=SERIES),
        "lines.linewidth": 1.3,
        "legend.frameon": False,
    }
)


def write_images(page: Page, folder: Path) -> list[Path]:
    """Writes the plots of a page into an existing folder, and returns the paths of the files."""
    paths = []
    for plot in page.blocks:
        if isinstance(plot, Plot):
            paths.append(folder / f"{plot.name}.png")
            _save(draw_plot(plot, page.title), paths[-1])
    return paths


def draw_plot(plot: Plot, title: str) -> Figure:
    """Returns the Matplotlib figure of a plot. Its title consists of `title` and the caption of the plot."""
    count, columns = len(plot.panels), plot.columns
    rows = -(-count // columns)
    heights = plot.row_heights
    # Titles and labels of a panel need about 0.75 inch, and without labels of the x axis 0.35 inch.
    around = 0.35 if plot.shared_x else 0.75
    height = sum(heights) / DPI * 0.9 + around * rows + 1.0
    figure, axes = plt.subplots(
        rows, columns, figsize=(WIDTH, height), height_ratios=heights, squeeze=False, layout="constrained"
    )
    for unused in axes.flat[count:]:
        unused.remove()
    for panel, ax in zip(plot.panels, axes.flat, strict=False):
        _draw(ax, panel, loc="left" if columns == 1 else "center", width=110 // columns)
        if plot.shared_x and panel is not plot.panels[-1]:
            ax.set_xlabel("")
            ax.tick_params(labelbottom=False)
    figure.align_ylabels(list(axes.flat[:count]))
    figure.suptitle(textwrap.fill(f"{title}: {plot.caption}", _TITLE_LENGTH))
    _add_legend(figure)
    return figure


def _draw(ax: Axes, panel: Panel, loc: Any, width: int) -> None:
    categories = panel.categories
    left = np.zeros(len(categories))
    for mark in panel.marks:
        if isinstance(mark, Bars):
            rows = [categories.index(label) for label in mark.labels]
            bar: dict[str, Any] = {"color": mark.colour, "edgecolor": "white", "linewidth": 0.6}
            ax.barh(rows, mark.values, 0.65, left=left[rows], label=mark.name, **bar)
            left[rows] += np.asarray(mark.values)
        else:
            _draw_mark(ax, mark)
    if categories:
        ax.set_yticks(range(len(categories)), categories)
        ax.set_ylim(len(categories) - 0.5, -0.5)
        ax.grid(visible=False, axis="y")
    if panel.title:
        ax.set_title(textwrap.fill(panel.title, width), loc=loc)
    ax.set(xlabel=panel.x_label, ylabel=panel.y_label, xlim=panel.x_range)
    if panel.y_range is not None:
        ax.set_ylim(panel.y_range)
    if panel.log_x:
        ax.set_xscale("log")
    if panel.log_y:
        ax.set_yscale("log")
    if not categories and not panel.log_y:
        ax.ticklabel_format(axis="y", useOffset=False)


def _draw_mark(ax: Axes, mark: Mark) -> None:
    label = mark.name or None
    if isinstance(mark, Band):
        x, low, high = (np.asarray(values, dtype=float) for values in (mark.x, mark.low, mark.high))
        ax.fill_between(x, low, high, color=mark.colour, alpha=0.3, linewidth=0, label=label)
    elif isinstance(mark, Guide):
        line, span = (ax.axvline, ax.axvspan) if mark.axis == "x" else (ax.axhline, ax.axhspan)
        if mark.high is None:
            line(mark.low, color=mark.colour, linestyle="--" if mark.dashed else "-", linewidth=1.0, label=label)
        else:
            span(mark.low, mark.high, color=mark.colour, alpha=0.3, linewidth=0, label=label)
    elif isinstance(mark, Curve):
        if mark.style in _MARKERS:
            marker, size = _MARKERS[mark.style]
            alpha = 0.5 if mark.style == "dots" else 1.0
            ax.plot(
                mark.x, mark.y, marker, color=mark.colour, markersize=size, alpha=alpha, label=label,
                markerfacecolor="none" if mark.style == "diamonds" else None,
            )  # fmt: skip
        else:
            look: dict[str, Any] = {"broad": {"alpha": 0.35, "linewidth": 3.5}, "step": {"drawstyle": "steps-post"}}
            ax.plot(mark.x, mark.y, _LINES[mark.style], color=mark.colour, label=label, **look.get(mark.style, {}))


def _add_legend(figure: Figure) -> None:
    """Adds one legend below all panels, with each label once."""
    entries: dict[str, Artist] = {}
    for ax in figure.axes:
        for handle, label in zip(*ax.get_legend_handles_labels(), strict=True):
            entries.setdefault(label, handle)
    if entries:
        longest = max(len(label) for label in entries) + 6
        columns = max(1, min(len(entries), _LEGEND_LENGTH // longest))
        figure.legend(list(entries.values()), list(entries), loc="outside lower center", ncols=columns)


def _save(figure: Figure, path: Path) -> None:
    with atomic_write(path, "wb") as stream:
        figure.savefig(stream, dpi=DPI, format="png")
    plt.close(figure)
