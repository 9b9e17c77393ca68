"""Plots of the drives: friction over speed, and torque of cables, springs and offsets over position."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.dynamics.actuator_effects import (
    ActuatorEffect,
    is_prismatic,
    joint_row,
    position_along,
    sliding_effort,
)
from dvrk_drake.dynamics.dynamic_model import effect_shapes
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.effects_schema import POSITION_KINDS, DriveEffect
from dvrk_drake.reports.colours import FITTED, MEASURED
from dvrk_drake.reports.efforts import Efforts
from dvrk_drake.reports.page import Plot
from dvrk_drake.reports.plot import Curve, Mark, Panel, axis_range

#: Number of points of a curve, and largest number of dots in a panel.
_POINTS, _DOTS = 201, 500


def drive_plots(efforts: Efforts) -> list[Plot]:
    """Returns the plots of friction over speed and of torque over position, without those that would be empty.

    The dots are the effort of the plotted effects plus the residual, which is the measured effort minus all other
    efforts of the model.
    """
    arm, model = efforts.arm, efforts.model
    if efforts.grid is not None:
        effects = model.dynamic_model.section.effects
        q = arm.transmission.inverse.position(efforts.q)
        residuals = arm.transmission.pull_back_effort(efforts.residuals)
        plots = [_friction(efforts)]
    else:
        effects = model.holding_effects
        poses = efforts.recording.in_joint_coordinates(arm)
        # The residuals of the unscaled model, because the curves do not contain the feedforward scale.
        q = poses.q
        residuals = poses.measured_effort() - model.static_model.torque(q, model.theta)
        residuals[~efforts.usable] = np.nan
        plots = []
    return [plot for plot in (*plots, _torque(arm, effects, q, residuals)) if plot is not None]


def _friction(efforts: Efforts) -> Plot | None:
    model, arm, grid = efforts.model.dynamic_model, efforts.arm, efforts.grid
    effects = [e for e in model.section.effects if e.kind not in POSITION_KINDS]
    if not effects or grid is None or efforts.v is None:
        return None
    transmitted = model.transmitted_effort(grid.q, grid.v, grid.vd)
    of_segments = [
        effect_shapes(model.regressor, [ActuatorEffect.of(e) for e in effects], g.q, g.v, transmitted[own])
        for g, own, _ in grid.each_segment()
    ]
    along: dict[str, NDArray[np.float64]] = {e.coordinate: np.zeros(len(grid.t)) for e in effects}
    for e, *shapes in zip(effects, *of_segments, strict=True):
        along[e.coordinate] = along[e.coordinate] + e.coefficient * np.concatenate(shapes)
    panels = []
    for name, of_effects in along.items():
        h = arm.effect_coordinates[name]
        speed = efforts.v @ h
        of_model = grid.filter_efforts(grid.at_rows(of_effects, int(np.argmax(np.abs(h)))))
        dots = of_model + efforts.residuals @ h / (h @ h)
        largest = float(np.max(np.abs(speed), initial=0.0))
        v = largest * np.linspace(-1, 1, _POINTS) ** 3  # more points at low speeds
        x = float(np.sqrt(np.mean(position_along(arm, name, grid.q) ** 2)))
        load = float(np.mean(np.abs(transmitted @ h)) / (h @ h))
        effort, length = ("N", "m") if is_prismatic(arm, name) else ("N m", "rad")
        marks = _marks(speed, dots, v, sliding_effort([e for e in effects if e.coordinate == name], x, v, load))
        panels.append(Panel(name, marks, f"speed [{length}/s]", f"friction [{effort}]", height=200))
    caption = "Friction along each coordinate over its speed. Near zero speed, presliding makes the dots differ"
    return Plot("friction", caption, panels, columns=2)


def _torque(
    arm: Arm, effects: Sequence[DriveEffect], q: NDArray[np.float64], residuals: NDArray[np.float64]
) -> Plot | None:
    all_own = [e for e in effects if e.kind in POSITION_KINDS]
    panels = []
    for name in dict.fromkeys(e.coordinate for e in all_own if e.kind != "offset"):
        own = [e for e in all_own if e.coordinate == name]
        x = position_along(arm, name, q)
        curve = np.linspace(x.min(), x.max(), _POINTS)
        row = joint_row(arm, name)
        used = row != 0
        dots = sliding_effort(own, x, np.zeros_like(x)) + residuals[:, used] @ row[used] / (row @ row)
        effort, length = ("N", "m") if is_prismatic(arm, name) else ("N m", "rad")
        panels.append(
            Panel(
                name,
                _marks(x, dots, curve, sliding_effort(own, curve, np.zeros_like(curve))),
                f"position [{length}]",
                f"{'force' if effort == 'N' else 'torque'} [{effort}]",
                x_range=axis_range(x),
                height=200,
            )
        )
    caption = "Offset, cables and springs along each coordinate over its position, in the range of the recording"
    return Plot("torque_over_position", caption, panels, columns=2) if panels else None


def _marks(
    x: NDArray[np.float64], dots: NDArray[np.float64], curve_x: NDArray[np.float64], curve_y: NDArray[np.float64]
) -> list[Mark]:
    step = -(-len(x) // _DOTS)
    name = "measured minus all other efforts of the model"
    return [Curve(name, x[::step], dots[::step], MEASURED, "dots"), Curve("model", curve_x, curve_y, FITTED)]
