"""Error budget: the error of each joint, divided by its causes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import plotly.graph_objects as go
from numpy.typing import NDArray

from dvrk_drake.analysis.dynamic.validation import error_shares
from dvrk_drake.reports.figures.colours import NEUTRAL, SERIES

#: Cause -> colour.
CAUSES = {
    "constant": SERIES[1],
    "friction-like": SERIES[2],
    "position-dependent": SERIES[0],
    "differs between periods": NEUTRAL,
    "other, repeats": SERIES[5],
    "other": SERIES[5],
}


@dataclass(frozen=True, eq=False)
class JointErrors:
    """Errors of one joint or actuator.

    Attributes:
        name: Name of the joint.
        effort: RMS measured effort [N m, N].
        residuals: Measured minus predicted efforts (r,) [N m, N].
        q, v: Positions [rad, m] and velocities (r,).
        repeatability: RMS difference of the efforts between periods of a motion [N m, N], None if unknown.
    """

    name: str
    effort: float
    residuals: NDArray[np.float64]
    q: NDArray[np.float64]
    v: NDArray[np.float64]
    repeatability: float | None = None

    def shares(self) -> dict[str, float]:
        """Returns cause -> share of the squared error. The shares add up to 1.

        The part of the error that no other cause explains is divided, if the repeatability is known. One part is as
        large as the difference between periods of the motion, which no model can predict. The other part repeats.
        """
        constant, friction, position, other = error_shares(self.residuals, self.q, self.v)
        shares = {"constant": constant, "friction-like": friction, "position-dependent": position}
        if self.repeatability is None:
            return shares | {"other": other}
        square = float(np.mean(self.residuals**2))
        random = min(other, self.repeatability**2 / square) if square > 0 else 0.0
        return shares | {"differs between periods": random, "other, repeats": other - random}


def error_budget(joints: Sequence[JointErrors]) -> go.Figure:
    """Returns a figure with one bar per joint: the relative RMS error, divided by shares of the squared error."""
    shares = [joint.shares() for joint in joints]
    relative = [
        100 * float(np.sqrt(np.mean(joint.residuals**2))) / joint.effort if joint.effort > 0 else 0.0
        for joint in joints
    ]
    figure = go.Figure()
    for cause, colour in CAUSES.items():
        parts = np.array([s.get(cause, 0.0) for s in shares])
        if np.any(parts > 0.005):
            figure.add_bar(
                y=[joint.name for joint in joints],
                x=relative * parts,
                name=cause,
                orientation="h",
                marker={"color": colour, "line": {"color": "white", "width": 1}},
                customdata=100 * parts,
                hovertemplate=f"%{{y}}, {cause}: %{{customdata:.0f}} % of the squared error",
            )
    figure.update_layout(barmode="stack", legend={"traceorder": "normal"}, height=130 + 36 * len(joints), bargap=0.3)
    figure.update_xaxes(title_text="RMS error / RMS effort [%]")
    figure.update_yaxes(autorange="reversed")
    return figure
