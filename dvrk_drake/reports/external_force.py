"""Page of an estimated external force."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.analysis.external_force import ExternalForce
from dvrk_drake.dynamics.kinematics import is_measurable
from dvrk_drake.models.effects_schema import half_width
from dvrk_drake.reports.colours import FITTED, HELD_OUT, NEUTRAL
from dvrk_drake.reports.page import Block, Page, Plot, Scene, Section, Table, Text, warning_texts
from dvrk_drake.reports.playback import frame_times, playback
from dvrk_drake.reports.plot import Band, Curve, Guide, Mark, Panel, decimated, effort_unit, joint_label

#: Largest number of plotted rows. Each curve has about this number of points, twice the pixels of a wide page.
_MAX_POINTS = 4000


def force_page(result: ExternalForce, *, model_path: str = "MODEL.yaml", file_options: str = "") -> Page:
    """Returns the page of an estimated force.

    Args:
        result: Result of `dvrk_drake.estimate_force`.
        model_path: Path of the model, for the suggested next command.
        file_options: Options with which the recording was read, beginning with a space, for the suggested next command.
    """
    arm = result.model.arm
    note = "The intervals contain 95 % of the errors on recordings similar to those of the model."
    plots: list[Block] = [_force_plot(result), _scene(result)] if np.any(result.measurable) else []
    return Page(
        f"External force on {arm.name}",
        _answer(result),
        [
            Section("Force", [_force_table(result), *plots, Text(note, show="page"), *warning_texts(result.warnings)]),
            Section("Joint efforts", [_effort_plot(result)]),
        ],
        "good" if np.any(result.measurable) else "warning",
        f"dvrk-drake force FREE_MOTION.csv --model {model_path}{file_options}",
        "Estimates the force of a motion without contact: the intervals of most rows must contain 0.",
    )


def _names(result: ExternalForce) -> list[str]:
    return ["along the direction"] if result.contact.components == ("direction",) else list(result.contact.components)


def _where(result: ExternalForce) -> str:
    return f"{result.frame}, {'axes of the frame' if result.contact.axes == 'frame' else 'base axes'}"


def _answer(result: ExternalForce) -> str:
    """Returns the largest force with its interval, and the components that are not measurable."""
    measurable = np.where(result.measurable, result.force, np.nan)
    if not np.any(result.measurable):
        return f"The arm cannot measure a force at {result.frame}: its joints move the point too little."
    size = np.sqrt(np.nansum(measurable**2, axis=1))
    largest = int(np.argmax(size))
    # Standard deviation of the length, along the estimated force.
    known = result.measurable[largest]
    along = measurable[largest, known] / max(size[largest], 1e-12)
    deviation = np.sqrt(along @ result.covariance[largest][np.ix_(known, known)] @ along)
    when = f"pose {largest + 1}" if result.t is None else f"{_x(result)[largest]:.2f} s"
    half = half_width(deviation, None)
    interval = f"95 % interval {size[largest] - half:.2f}..{size[largest] + half:.2f} N"
    answer = f"Largest force at {result.frame}: {size[largest]:.2f} N ({interval}), at {when}."
    hidden = [name for name, seen in zip(_names(result), result.measurable.mean(0), strict=True) if seen < 0.5]
    if hidden:
        answer += f" The arm cannot measure {', '.join(hidden)} in most poses."
    return answer


def _force_table(result: ExternalForce) -> Table:
    rows: list[tuple[str, ...]] = []
    for i, name in enumerate(_names(result)):
        seen = result.measurable[:, i]
        force, width = result.force[seen, i], result.half_width[seen, i]
        share = f"{100 * np.mean(seen):.0f} %"
        if not len(force):
            rows.append((name, "not measurable", "", "", "", share, ""))
            continue
        detected = f"{100 * np.mean(np.abs(force) > width):.0f} %"
        numbers = (np.mean(force), np.sqrt(np.mean(force**2)), np.max(np.abs(force)), np.median(width))
        rows.append((name, *(f"{x:.2f}" for x in numbers), share, detected))
    return Table(
        ("", "mean [N]", "RMS [N]", "largest [N]", "95 % interval, half width [N]", "measurable*", "not 0**"),
        rows,
        f"Force at {_where(result)}",
        "* share of the rows in which the joints determine the component. ** share of these rows in which the 95 % "
        "interval does not contain 0. half width: median.",
    )


def _force_plot(result: ExternalForce) -> Plot:
    hidden = ~result.measurable
    force, width = (np.where(hidden, np.nan, x) for x in (result.force, result.half_width))
    shown = [(i, name) for i, name in enumerate(_names(result)) if np.any(result.measurable[:, i])]
    panels = [_panel(result, name, force[:, i], width[:, i], "force [N]") for i, name in shown]
    return Plot("force", f"Force at {_where(result)}, with its 95 % interval", panels, time=True, shared_x=True)


def _scene(result: ExternalForce) -> Scene:
    """Returns the arm with the force and its ellipsoid. Poses without times follow each other every second."""
    x = _x(result)

    def html() -> str:
        from dvrk_drake.systems.arm_view.efforts import DrawnForce  # slow to import

        rows = np.unique(np.searchsorted(x, frame_times(float(x[0]), float(x[-1]))))
        forces, contact = [], result.contact
        for q, force, covariance in zip(result.q[rows], result.force[rows], result.covariance[rows], strict=True):
            directions = contact.directions(q)
            known = np.where(is_measurable(covariance), force, 0.0)
            forces.append(DrawnForce(contact.point(q), directions @ known, directions @ covariance @ directions.T))
        return playback(result.model.arm, x[rows], result.q[rows], forces=forces)

    caption = "Force on the arm. The ellipsoid contains it with 95 % probability. Click a plot to show a time."
    return Scene(html, caption, float(x[0]), len(x) if result.t is None else 0)


def _effort_plot(result: ExternalForce) -> Plot:
    arm, panels = result.model.arm, []
    for j, (effort, width) in enumerate(zip(result.effort.T, result.effort_half_width.T, strict=True)):
        panels.append(_panel(result, joint_label(arm, j), effort, width, f"effort [{effort_unit(arm, j)}]"))
    caption = "External joint efforts, with their 95 % intervals"
    return Plot("external_efforts", caption, panels, time=True, shared_x=True)


def _x(result: ExternalForce) -> NDArray[np.float64]:
    """Returns the times (m,) since the start of the recording [s], or the numbers of the poses, from 1."""
    if result.t is None or result.recording.t is None:
        return np.arange(1.0, len(result.force) + 1)
    return result.t - result.recording.t[0]


def _panel(
    result: ExternalForce, title: str, values: NDArray[np.float64], width: NDArray[np.float64], label: str
) -> Panel:
    """Returns a panel with values (m,) and their intervals over the time or the number of the pose."""
    x = _x(result)
    x_label = "pose [1]" if result.t is None else "time since the start of the recording [s]"
    rows = decimated(np.nan_to_num(values), -(-2 * len(values) // _MAX_POINTS))
    x, values, width = x[rows], values[rows], width[rows]
    marks: list[Mark] = [Guide("y", 0.0, None, NEUTRAL, dashed=False)]
    marks.append(Band("95 % interval", x, values - width, values + width, HELD_OUT))
    marks.append(Curve("estimate", x, values, FITTED, "circles" if result.t is None else "line"))
    return Panel(title, marks, x_label, label, height=150)
