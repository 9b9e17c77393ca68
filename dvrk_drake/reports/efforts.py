"""Plots of measured and predicted efforts: over time or poses, their residuals, and the error budget."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.analysis.error_shares import SHARE_LABELS, error_shares, pose_error_shares, residual_structure
from dvrk_drake.analysis.motion_identification import DynamicIdentification
from dvrk_drake.analysis.motion_validation import DynamicValidation
from dvrk_drake.analysis.observations.motion_grid import MotionGrid
from dvrk_drake.analysis.observations.static_poses import ExcludedMeasurement
from dvrk_drake.analysis.pose_identification import StaticIdentification
from dvrk_drake.analysis.results import Identification, Validation
from dvrk_drake.analysis.validation import StaticValidation
from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.models.arm import Arm
from dvrk_drake.recordings.recording import Recording
from dvrk_drake.reports.colours import COMMANDED, FITTED, HELD_OUT, MEASURED, NEUTRAL, REFERENCE, SERIES
from dvrk_drake.reports.page import Plot, Table, Text
from dvrk_drake.reports.plot import (
    Band,
    Bars,
    Curve,
    Guide,
    Mark,
    Panel,
    Style,
    axis_range,
    category_panel,
    decimated,
    effort_unit,
    joint_label,
    length_unit,
)

#: Largest number of rows in each curve over time, and of dots in a panel of residuals.
MAX_ROWS, MAX_DOTS = 3000, 600
#: Number of bins over a position or speed, smallest number of values in a bin, and its smallest share of the range.
BINS, MIN_PER_BIN, MIN_BIN_WIDTH = 25, 8, 0.01
#: Colour of each prediction, the same in all plots.
_COLOURS = {
    "fitted": FITTED,
    "held out": HELD_OUT,
    "predicted": FITTED,
    "SDF": REFERENCE,
    "previous": COMMANDED,
}
#: Colour of each cause of an error, in the order of the bars. A motion and static poses have different causes.
_BUDGET = dict(zip(SHARE_LABELS[:-1], (*SERIES[:5], *SERIES[6:]), strict=True))
_BUDGET |= {"first harmonic": SERIES[2], "second harmonic": SERIES[5], "load": SERIES[3], "other": NEUTRAL}


@dataclass(frozen=True, eq=False)
class Efforts:
    """Measured and predicted efforts of one recording, at r rows of a motion or r static poses.

    Attributes:
        model: Model of the predictions.
        recording: Recording with the measured efforts.
        x: Times since the start of the recording (r,) [s], or numbers of the poses, from 1.
        q: Positions (r, n) in the coordinates of the efforts [rad, m].
        v: Velocities (r, n) in a motion [rad/s, m/s], None for static poses.
        measured: Measured efforts (r, n) [N m, N], of a motion after low-pass filtering.
        predicted: Name of the prediction ("fitted", "held out" or "predicted") -> predicted efforts (r, n) [N m, N].
            The last one is the most independent of the measured efforts.
        baselines: Name of another model ("SDF", "previous") -> its predicted efforts (r, n) [N m, N].
        usable: Mask (r, n) of the efforts that are not excluded.
        excluded: Excluded measurements and the reasons.
        grid: Resampled motion, None for static poses.
        period: Period of the motion [s], None if it does not repeat.
    """

    model: IdentifiedModel
    recording: Recording
    x: NDArray[np.float64]
    q: NDArray[np.float64]
    v: NDArray[np.float64] | None
    measured: NDArray[np.float64]
    predicted: Mapping[str, NDArray[np.float64]]
    baselines: Mapping[str, NDArray[np.float64]]
    usable: NDArray[np.bool_]
    excluded: Sequence[ExcludedMeasurement] = ()
    grid: MotionGrid | None = None
    period: float | None = None

    @property
    def arm(self) -> Arm:
        """Arm of the model."""
        return self.model.arm

    @property
    def half_width(self) -> NDArray[np.float64]:
        """Half widths (n,) of the 95 % prediction intervals [N m, N], 0 if there are none."""
        return np.zeros(self.arm.num_joints) if self.grid is None else self.model.dynamic_model.half_width

    @property
    def judged(self) -> str:
        """Name of the prediction whose residuals are plotted."""
        return list(self.predicted)[-1]

    @property
    def residuals(self) -> NDArray[np.float64]:
        """Measured minus predicted efforts (r, n) for the prediction `judged` [N m, N]."""
        return self.measured - self.predicted[self.judged]

    def rms(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Returns the RMS (n,) of values (r,n) without excluded measurements. A joint without measurements has 0."""
        count = np.maximum(np.sum(self.usable, axis=0), 1)
        return np.asarray(np.sqrt(np.sum(np.where(self.usable, values, 0.0) ** 2, axis=0) / count))

    def rms_of_baseline(self, name: str) -> NDArray[np.float64]:
        """Returns the RMS errors (n,) of another model [N m, N]."""
        return self.rms(self.measured - self.baselines[name])


def efforts_of(
    result: Identification | Validation, baselines: Mapping[str, NDArray[np.float64]] | None = None, number: int = 0
) -> Efforts:
    """Returns the efforts of a validation, or of one recording (index `number`) of an identification."""
    if isinstance(result, DynamicIdentification | DynamicValidation):
        if isinstance(result, DynamicIdentification):
            motion = result.motions[number]
            recording, grid, period, measured = motion.recording, motion.grid, motion.period, motion.measured
            predicted = {"fitted": motion.predicted, "held out": motion.held_out}
        else:
            recording, grid, period, measured = result.recording, result.grid, result.period, result.measured
            predicted = {"predicted": result.predicted}
        t, q, v = grid.actuator_motion()
        return Efforts(
            model=result.model,
            recording=recording,
            x=t - grid.row_times[0],
            q=q,
            v=v,
            measured=measured,
            predicted=predicted,
            baselines=baselines or {},
            usable=np.ones(measured.shape, dtype=bool),
            grid=grid,
            period=period,
        )
    assert isinstance(result, StaticIdentification | StaticValidation)
    measured = result.recording.measured_effort()
    predicted = {"predicted": measured - result.residuals}
    if isinstance(result, StaticIdentification):
        predicted = {"fitted": measured - result.residuals}
        predicted["held out"] = measured - result.cross_validation_residuals
    return Efforts(
        model=result.model,
        recording=result.recording,
        x=np.arange(1.0, len(measured) + 1),
        q=result.recording.q,
        v=None,
        measured=measured,
        predicted=predicted,
        baselines=baselines or {},
        usable=result.usable,
        excluded=result.excluded,
    )


def efforts_plot(efforts: Efforts, name: str = "efforts", *, time: bool = True) -> Plot:
    """Returns two panels per joint: measured and predicted efforts, and below them measured minus predicted effort.

    Measured efforts are a thick line below the thin lines of the predictions, so that no line hides another one. The
    band is the 95 % prediction interval.
    """
    arm, panels = efforts.arm, []
    is_motion = efforts.v is not None
    step = -(-2 * len(efforts.x) // MAX_ROWS) if is_motion else 1
    x_label = "time since the start of the recording [s]" if is_motion else f"pose, 1 to {len(efforts.x)} [1]"
    styles: tuple[Style, Style, Style] = ("broad", "line", "line") if is_motion else ("circles", "crosses", "diamonds")
    for j in range(arm.num_joints):
        shown = np.flatnonzero(efforts.usable[:, j])
        rows = shown[decimated(efforts.measured[shown, j], step)] if len(shown) else shown
        x, unit = efforts.x[rows], effort_unit(arm, j)
        marks: list[Mark] = []
        if efforts.half_width[j] > 0:
            middle = efforts.predicted[efforts.judged][rows, j]
            low, high = middle - efforts.half_width[j], middle + efforts.half_width[j]
            marks.append(Band("95 % prediction interval", x, low, high, _COLOURS[efforts.judged]))
        marks.append(Curve("measured", x, efforts.measured[rows, j], MEASURED, styles[0]))
        residuals: list[Mark] = [Guide("y", 0.0, None, NEUTRAL, dashed=False)]
        for other, values in efforts.baselines.items():
            marks.append(Curve(f"{other} model", x, values[rows, j], _COLOURS[other], styles[2]))
        for prediction, values in efforts.predicted.items():
            marks.append(Curve(prediction, x, values[rows, j], _COLOURS[prediction], styles[1]))
            error = efforts.measured[rows, j] - values[rows, j]
            residuals.append(Curve("", x, error, _COLOURS[prediction], styles[1]))
        panels.append(Panel(_title(efforts, j), marks, x_label, f"effort [{unit}]", height=150))
        panels.append(Panel("", residuals, x_label, f"residual [{unit}]", height=100))
    caption = "Measured and predicted effort of each joint, and below it measured minus predicted effort"
    if efforts.grid is not None:
        cut_off = efforts.grid.settings.effort_cut_off
        caption = f"Efforts of the actuators below {cut_off:.3g} Hz, and below them measured minus predicted effort"
    return Plot(name, caption, panels, time=time, shared_x=True)


def _title(efforts: Efforts, j: int) -> str:
    label, effort = joint_label(efforts.arm, j), efforts.rms(efforts.measured)[j]
    if effort == 0:
        return f"{label}: no effort"
    errors = [f"{efforts.judged} {100 * efforts.rms(efforts.residuals)[j] / effort:.1f} %"]
    errors += [f"{name} {100 * efforts.rms_of_baseline(name)[j] / effort:.1f} %" for name in efforts.baselines]
    return f"{label}: RMS error / RMS effort: {', '.join(errors)}"


def residuals_plot(efforts: Efforts, name: str = "residuals") -> Plot:
    """Returns the residuals over position and, for a motion, over speed: dots, mean and standard deviation in bins."""
    arm, panels, step = efforts.arm, [], 1
    for j in range(arm.num_joints):
        use = efforts.usable[:, j]
        if not np.any(use):
            continue
        unit, title = length_unit(arm, j), joint_label(arm, j)
        quantities = [(efforts.q[use, j], f"position [{unit}]")]
        if efforts.v is not None:
            quantities.append((efforts.v[use, j], f"speed [{unit}/s]"))
        for x, label in quantities:
            residual = efforts.residuals[use, j]
            step = max(step, -(-len(x) // MAX_DOTS))
            centre, mean, deviation = bin_means(x, residual)
            marks: list[Mark] = [
                Curve("residual", x[::step], residual[::step], MEASURED, "dots"),
                Band("one standard deviation", centre, mean - deviation, mean + deviation, FITTED),
                Curve("mean", centre, mean, FITTED),
                Guide("y", 0.0, None, NEUTRAL, dashed=False),
            ]
            y_label = f"residual [{effort_unit(arm, j)}]"
            panels.append(Panel(title, marks, label, y_label, x_range=axis_range(x), height=170))
    dots = "one dot per measurement" if step == 1 else f"one dot per {step} rows"
    adjective = efforts.judged.replace(" ", "-")
    caption = f"Measured minus {adjective} effort: {dots}, mean and one standard deviation in up to {BINS} bins"
    return Plot(name, caption, panels, columns=2)


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
    members = [index == k for k in np.unique(index)]
    return (
        np.array([x[rows].mean() for rows in members]),
        np.array([y[rows].mean() for rows in members]),
        np.array([y[rows].std() for rows in members]),
    )


def budget_of(efforts: Efforts) -> dict[str, dict[str, float]]:
    """Returns the shares of the squared error of each joint with an effort, by cause. The shares of a joint sum to 1.

    For a motion, see `ErrorShares`; for static poses, see `pose_error_shares`.
    """
    grid, budgets = efforts.grid, {}
    vd = None
    if grid is not None:
        vd = grid.efforts_at_rows(grid.arm.transmission.velocity(grid.vd))[grid.inner]
    for j, name in enumerate(efforts.arm.joint_names):
        use = efforts.usable[:, j]
        if not np.any(efforts.measured[use, j]):
            continue
        error, q = efforts.residuals[use, j], efforts.q[use, j]
        if vd is not None and efforts.v is not None:
            shares = error_shares(error, j, efforts.q, efforts.v[:, j], vd, efforts.x, efforts.period)
            budgets[name] = {label: share or 0.0 for label, share in zip(SHARE_LABELS, shares, strict=True)}
        else:
            budgets[name] = pose_error_shares(error, q, efforts.predicted[efforts.judged][use, j])
    return budgets


def budget_plot(efforts: Efforts, name: str = "error_budget") -> Plot:
    """Returns one bar per joint: the relative RMS error, divided by shares of the squared error."""
    budgets = budget_of(efforts)
    joints = list(budgets)
    rows = [efforts.arm.joint_names.index(joint) for joint in joints]
    effort = efforts.rms(efforts.measured)[rows]
    relative = 100 * efforts.rms(efforts.residuals)[rows] / effort
    marks: list[Mark] = []
    for cause, colour in _BUDGET.items():
        shares = np.array([budgets[joint].get(cause, 0.0) for joint in joints])
        if np.any(shares > 0.005):
            texts = [f"{j}, {cause}: {100 * s:.0f} % of the squared error" for j, s in zip(joints, shares, strict=True)]
            marks.append(Bars(cause, joints, relative * shares, colour, texts))
    caption = f"Relative RMS error of the {efforts.judged.replace(' ', '-')} efforts and its causes"
    return Plot(name, caption, [category_panel("", marks, "RMS error / RMS effort [%]")])


def structure_table(efforts: Efforts) -> Table | Text:
    """Returns the structures that explain the error of joints, see `residual_structure`, or that there are none."""
    rows, is_motion = [], efforts.v is not None
    tested = "first and second harmonic of the position of the joint, load"
    if is_motion:
        tested += ", friction, hysteresis, friction that grows with the load"
    for j, name in enumerate(efforts.arm.joint_names):
        use = efforts.usable[:, j]
        if np.any(efforts.measured[use, j]):
            v = None if efforts.v is None else efforts.v[use, j]
            load = efforts.predicted[efforts.judged][use, j]
            rows += [
                (name, kind, f"{100 * share:.0f} %")
                for kind, share in residual_structure(efforts.residuals[use, j], efforts.q[use, j], load, v)[:1]
            ]
    if not rows:
        return Text(f"No tested structure explains the errors. Tested: {tested}.", show="details")
    return Table(
        ("joint", "structure in the residual", "explained"),
        rows,
        "Structure that explains most of the squared error beyond the mean error",
        f"Tested: {tested}. Joints without such a structure are not listed.",
        show="details",
    )
