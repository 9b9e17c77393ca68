"""Style of all Matplotlib figures: sizes, grids of panels, titles and legends outside the data, saving.

A figure is shown at 100 % or larger: a figure of `WIDTH` has `DPI` * `WIDTH` = 1210 pixels, the width of a page at
1280 pixels. The smallest text has 9 pt at this size. `tests/support/figure_rules.py` checks the rules.
"""

from __future__ import annotations

import math
import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import matplotlib
import matplotlib.pyplot as plt
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from dvrk_drake.models.arm import Arm
from dvrk_drake.models.files import atomic_write
from dvrk_drake.reports.colours import SERIES

#: Width of all figures [inch].
WIDTH = 11.0
#: Resolution of all figures [pixels per inch].
DPI = 110
#: Size of the smallest text [pt].
SMALLEST_TEXT = 9.0

_TITLE_LENGTH = 125  # characters of a figure title in one line
_LEGEND_LENGTH = 150  # characters of a legend in one line

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


def panel_grid(
    count: int,
    *,
    columns: int | None = None,
    height: float = 2.6,
    sharex: bool | Literal["none", "all", "row", "col"] = False,
    sharey: bool | Literal["none", "all", "row", "col"] = False,
) -> tuple[Figure, list[Axes]]:
    """Returns a figure of `WIDTH`, and its panels in reading order. Unused panels are removed.

    Args:
        count: Number of panels, for example one per joint.
        columns: Number of columns. None: at most four, with as few unused panels as possible.
        height: Height of a panel [inch].
        sharex, sharey: See `matplotlib.pyplot.subplots`.
    """
    if columns is None:
        columns = math.ceil(count / math.ceil(count / 4))
    rows = math.ceil(count / columns)
    size = (WIDTH, height * rows + 0.9)
    figure, axes = plt.subplots(rows, columns, figsize=size, sharex=sharex, sharey=sharey, squeeze=False)
    figure.set_layout_engine("constrained")
    for unused in axes.flat[count:]:
        unused.remove()
    for ax in axes.flat[:count]:
        ax.tick_params(labelbottom=True, labelleft=True)
    return figure, list(axes.flat[:count])


def joint_title(arm: Arm, j: int) -> str:
    """Returns the number and the name of joint j (from 0), for the title of a panel."""
    return f"J{j + 1} {arm.joint_names[j]}"


def position_unit(arm: Arm, j: int) -> str:
    """Returns the unit of the position of joint j (from 0)."""
    return "m" if arm.prismatic[j] else "rad"


def effort_unit(arm: Arm, j: int) -> str:
    """Returns the unit of the effort of joint j (from 0)."""
    return "N" if arm.prismatic[j] else "N m"


def set_title(figure: Figure, title: str) -> None:
    """Sets the title of a figure. The title says what the figure shows. Long titles are wrapped."""
    lines = (textwrap.fill(line, _TITLE_LENGTH) for line in title.splitlines())
    figure.suptitle("\n".join(lines))


def add_legend(figure: Figure, axes: Sequence[Axes] | None = None) -> None:
    """Adds one legend below all panels, with each label once.

    Args:
        figure: Figure with a constrained layout.
        axes: Panels with the labelled artists. None: all panels.
    """
    entries: dict[str, Artist] = {}
    for ax in figure.axes if axes is None else axes:
        for handle, label in zip(*ax.get_legend_handles_labels(), strict=True):
            entries.setdefault(label, handle)
    if entries:
        longest = max(len(label) for label in entries) + 6
        columns = max(1, min(len(entries), _LEGEND_LENGTH // longest))
        figure.legend(list(entries.values()), list(entries), loc="outside lower center", ncols=columns)


def save_figure(figure: Figure, path: Path) -> None:
    """Writes a PNG file atomically and closes the figure."""
    with atomic_write(path, "wb") as stream:
        figure.savefig(stream, dpi=DPI, format="png")
    plt.close(figure)
