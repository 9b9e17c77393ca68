"""Page of a simulation: positions, position errors and efforts over time."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.experiments.simulation import Simulation
from dvrk_drake.models.arm import Arm
from dvrk_drake.reports.colours import COMMANDED, LIMIT, MEASURED, NEUTRAL, REFERENCE
from dvrk_drake.reports.page import Page, Plot, Section, Table
from dvrk_drake.reports.plot import Curve, Guide, Mark, Panel, effort_unit, joint_label, length_unit

#: Smallest range of a position axis and of an error axis [rad]; a tenth of it in m. Smaller ranges would magnify the
#: noise of a joint at rest.
_SMALLEST_RANGE, _SMALLEST_ERROR_RANGE = 0.02, 0.004
#: Efforts above this share of the effort limit are drawn together with the limit.
_NEAR_LIMIT = 0.5


def simulation_page(simulation: Simulation, arm: Arm, *, next_step: str = "") -> Page:
    """Returns the largest tracking error or, without desired positions, the largest distance from the initial position.

    Args:
        simulation: Simulation.
        arm: Simulated arm.
        next_step: Suggested next command. "": there is none.
    """
    recording, desired = simulation.recording, simulation.desired
    # In mrad or mm: errors of a controlled arm are small.
    error = 1e3 * np.abs(recording.q - (recording.q[:1] if desired is None else desired))
    effort = np.abs(recording.measured_effort()).max(axis=0)
    range_share = 1e-3 * error.max(axis=0) / (arm.position_upper - arm.position_lower)
    j = int(np.argmax(range_share))
    what = "Largest motion from the start" if desired is None else "Largest tracking error"
    kind = "motion" if desired is None else "error"
    unit = f"m{length_unit(arm, j)}"
    rows = []
    for i, name in enumerate(arm.joint_names):
        share = f"{100 * effort[i] / arm.effort_limits[i]:.0f} %"
        rows.append((name, f"{error[:, i].max():.2f}", f"{error[-1, i]:.2f}", f"{effort[i]:.4f}", share))
    title = f"{arm.name}, simulated for {simulation.time[-1]:g} s"
    header = ("", f"largest {kind}", f"{kind} at the end", "largest effort", "effort / limit")
    table = Table(header, rows, f"{title} [mrad, N m; mm, N if prismatic]")
    largest = f"{error[:, j].max():.2f} {unit} ({arm.joint_names[j]}, {100 * range_share[j]:.2g} % of its range)"
    return Page(
        title,
        f"{what} relative to the range of the joint: {largest}, at the end {error[-1, j]:.2f} {unit}.",
        [Section("Joints", [table, _plot(simulation, arm)])],
        "good",
        next_step,
    )


def _plot(simulation: Simulation, arm: Arm) -> Plot:
    """Returns one row of panels per joint: position, position error if there are desired positions, and effort.

    Times at which the hand acts on the arm are shaded.
    """
    t, q, desired = simulation.time, simulation.recording.q, simulation.desired
    tau, panels = simulation.recording.measured_effort(), []
    hand: list[Mark] = [
        Guide("x", t[first], t[last], REFERENCE, "disturbance: the hand acts")
        for first, last in _intervals(np.any(simulation.hand != 0, axis=1))
    ]
    for j in range(arm.num_joints):
        unit, title, scale = length_unit(arm, j), joint_label(arm, j), 0.1 if arm.prismatic[j] else 1.0
        position: list[Mark] = [*hand, Curve("measured position and effort", t, q[:, j], MEASURED)]
        shown = [q[:, j]]
        error_panel = []
        if desired is not None:
            shown.append(desired[:, j])
            position.append(Curve("desired position", t, desired[:, j], COMMANDED, "dashed"))
            error = 1e3 * (q[:, j] - desired[:, j])
            marks = [*hand, Guide("y", 0.0, None, NEUTRAL, dashed=False), Curve("", t, error, MEASURED)]
            limits = _range(error, smallest=1e3 * _SMALLEST_ERROR_RANGE * scale)
            error_panel = [Panel(title, marks, "time [s]", f"error [m{unit}]", y_range=limits, height=130)]
        limits = _range(*shown, smallest=_SMALLEST_RANGE * scale)
        panels.append(Panel(title, position, "time [s]", f"position [{unit}]", y_range=limits, height=130))
        panels += [*error_panel, _effort_panel(arm, j, t, tau[:, j], hand)]
    quantities = "Position and effort" if desired is None else "Position, position error and effort"
    return Plot("simulation", f"{quantities} of each joint", panels, columns=2 if desired is None else 3)


def _effort_panel(arm: Arm, j: int, t: NDArray[np.float64], tau: NDArray[np.float64], hand: list[Mark]) -> Panel:
    limit = float(arm.effort_limits[j])
    share = float(np.abs(tau).max()) / limit
    marks = [*hand, Curve("", t, tau, MEASURED)]
    if share > _NEAR_LIMIT:
        marks += [Guide("y", sign * limit, None, LIMIT, "effort limit") for sign in (-1, 1)]
    unit = effort_unit(arm, j)
    title = f"{joint_label(arm, j)}: largest {100 * share:.0f} % of {limit:.3g} {unit}"
    shown = (tau, np.array([-limit, limit])) if share > _NEAR_LIMIT else (tau,)
    y_range = _range(*shown, smallest=0.02 * limit)
    return Panel(title, marks, "time [s]", f"effort [{unit}]", y_range=y_range, height=130)


def _intervals(active: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Returns the first and the last index of each run of true values (m,)."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], active, [False]]).astype(int)))
    return [(int(first), int(end) - 1) for first, end in edges.reshape(-1, 2)]


def _range(*values: NDArray[np.float64], smallest: float) -> tuple[float, float]:
    """Returns the range of values with a margin, at least `smallest`."""
    low, high = min(x.min() for x in values), max(x.max() for x in values)
    margin = max(0.05 * (high - low), (smallest - (high - low)) / 2)
    return float(low - margin), float(high + margin)
