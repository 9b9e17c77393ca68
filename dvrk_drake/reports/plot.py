"""Marks and panels of a plot, independent of the library that draws them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.models.arm import Arm
from dvrk_drake.reports.colours import SERIES

Values = NDArray[Any] | Sequence[float]
#: How a curve is drawn. "broad" is a thick, light line for measurements below the thin lines of predictions. "step" is
#: a line that jumps at each point. The last four draw points without a line.
Style = Literal["line", "broad", "dashed", "dotted", "step", "dots", "circles", "diamonds", "crosses"]
#: Smallest range of positions or speeds for which an axis shows only this range [rad, m, rad/s, m/s].
MIN_SPAN = 0.01
_LINES: tuple[Style, ...] = ("line", "dashed", "dotted")


@dataclass(frozen=True, eq=False)
class Curve:
    """Points (x, y), drawn as a line or as symbols.

    Attributes:
        name: Name in the legend. Curves with one name in several panels have one entry. "": no entry.
        x, y: Coordinates (m,).
        colour: Colour as "#rrggbb", see `colours`.
        style: How the curve is drawn.
        texts: Texts (m,) that are shown when the pointer is over a point. Empty: the coordinates.
    """

    name: str
    x: Values
    y: Values
    colour: str
    style: Style = "line"
    texts: Sequence[str] = ()


@dataclass(frozen=True, eq=False)
class Band:
    """Area between two curves over the same x.

    Attributes:
        name: Name in the legend. "": no entry.
        x, low, high: Coordinates (m,).
        colour: Colour as "#rrggbb". The area is transparent.
    """

    name: str
    x: Values
    low: Values
    high: Values
    colour: str


@dataclass(frozen=True, eq=False)
class Bars:
    """Horizontal bars of categories. The bars of all marks of a panel are stacked.

    Attributes:
        name: Name in the legend.
        labels: Categories (m,).
        values: Lengths (m,).
        colour: Colour as "#rrggbb".
        texts: Texts (m,) that are shown when the pointer is over a bar.
    """

    name: str
    labels: Sequence[str]
    values: Values
    colour: str
    texts: Sequence[str] = ()


@dataclass(frozen=True)
class Guide:
    """Line or range across a whole panel, for example a limit.

    Attributes:
        axis: Axis on which the guide has a value.
        low: Value of the line, or lower end of the range.
        high: Upper end of the range. None: a line at `low`.
        colour: Colour as "#rrggbb". A range is transparent.
        name: Name in the legend. "": no entry.
        dashed: Whether a line is dashed.
    """

    axis: Literal["x", "y"]
    low: float
    high: float | None
    colour: str
    name: str = ""
    dashed: bool = True


Mark = Curve | Band | Bars | Guide


@dataclass(frozen=True, eq=False)
class Panel:
    """Axes with marks.

    Attributes:
        title: Title, e.g. the joint.
        marks: Marks, the last one on top.
        x_label, y_label: Labels of the axes with units. "": no label.
        x_range, y_range: Ranges of the axes. None: the range of the marks.
        log_x, log_y: Whether an axis is logarithmic.
        height: Height of the axes on a page [px]. Panels of one row have one height.
    """

    title: str
    marks: Sequence[Mark]
    x_label: str = ""
    y_label: str = ""
    x_range: tuple[float, float] | None = None
    y_range: tuple[float, float] | None = None
    log_x: bool = False
    log_y: bool = False
    height: int = 190

    @property
    def categories(self) -> list[str]:
        """Categories of the bars, the first one at the top."""
        return list(dict.fromkeys(label for m in self.marks if isinstance(m, Bars) for label in m.labels))


def series(i: int) -> dict[str, Any]:
    """Returns colour and style of the i-th curve of a plot in which the curves have no roles."""
    return {"colour": SERIES[i % len(SERIES)], "style": _LINES[i % len(_LINES)]}


def category_panel(title: str, marks: Sequence[Mark], x_label: str, **options: Any) -> Panel:
    """Returns a panel with categories. Its height depends on their number."""
    count = len(Panel(title, marks).categories)
    return Panel(title, marks, x_label, height=30 + 32 * count, **options)


def joint_label(arm: Arm, joint: int) -> str:
    """Returns the number and the name of a joint, e.g. "J1 outer_yaw"."""
    return f"J{joint + 1} {arm.joint_names[joint]}"


def effort_unit(arm: Arm, joint: int) -> str:
    """Returns "N" for a prismatic joint, otherwise "N m"."""
    return "N" if arm.prismatic[joint] else "N m"


def length_unit(arm: Arm, joint: int) -> str:
    """Returns "m" for a prismatic joint, otherwise "rad"."""
    return "m" if arm.prismatic[joint] else "rad"


def axis_range(x: NDArray[np.float64]) -> tuple[float, float] | None:
    """Returns the range of an axis for positions or speeds x (m,), at least 2 `MIN_SPAN`. None: the range of x."""
    if len(x) and np.ptp(x) < MIN_SPAN:  # The joint hardly moves. Without a range, the ticks show rounding errors.
        return float(x.mean()) - MIN_SPAN, float(x.mean()) + MIN_SPAN
    return None


def decimated(values: NDArray[np.float64], step: int) -> NDArray[np.int_]:
    """Returns the indices of the smallest and the largest of each `step` values (r,). Steps of 1 or 2: all indices."""
    if step <= 2:
        return np.arange(len(values))
    starts = np.arange(0, len(values), step)
    both = [
        (start + np.argmin(values[start : start + step]), start + np.argmax(values[start : start + step]))
        for start in starts
    ]
    return np.unique(both)
