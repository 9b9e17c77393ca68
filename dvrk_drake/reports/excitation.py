"""Pages of a designed motion and of designed static poses."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.analysis.excitation.design import ExcitationDesign
from dvrk_drake.analysis.excitation.static_poses import StaticPoseDesign
from dvrk_drake.models.arm import Arm
from dvrk_drake.reports.colours import COMMANDED, LIMIT
from dvrk_drake.reports.page import Block, Page, Plot, Scene, Section, Table
from dvrk_drake.reports.playback import playback
from dvrk_drake.reports.plot import Curve, Guide, Mark, Panel, Style, joint_label, length_unit

#: Number of points per harmonic of a period in the plots: enough for a smooth curve.
_POINTS = 20


def motion_page(design: ExcitationDesign, *, next_step: str | None = None) -> Page:
    """Returns the page of a designed motion: expected error, positions and speeds over time.

    Args:
        design: Result of `design_excitation`.
        next_step: Suggested next command. None: the command that records the motion, with a placeholder for its file.
    """
    arm, motion = design.arm, design.motion
    t = np.linspace(0.0, motion.period, _POINTS * np.shape(motion.sine)[1] + 1)
    q, v = motion.evaluate(t)[:2]
    speeds = [f", at most {v_max:.2g} {length_unit(arm, j)}/s" for j, v_max in enumerate(np.abs(v).max(axis=0))]
    rows = [
        ("expected error [%]", f"{100 * design.expected_error:.2f}"),
        ("expected error of the best random motion [%]", f"{100 * design.random_error:.2f}"),
        ("base parameters known to 10 %", f"{design.known_parameters} of {design.num_parameters}"),
        ("condition number", f"{design.condition_number:.3g}"),
    ]
    note = (
        "The expected error is that of the efforts which an identified model predicts for random motions within the "
        "limits, relative to the RMS efforts."
    )
    return Page(
        f"Designed motion of {arm.name}",
        f"{arm.name}: motion of {motion.duration:g} s. Expected error of predicted efforts: "
        f"{100 * design.expected_error:.1f} % ({100 * design.random_error:.1f} % with the best random motion).",
        [
            Section("Information", [Table(("quantity", "value"), rows, note=note)]),
            Section("One period", [_view(arm, t, q), _position_plot(arm, t, q, "t [s]", "line", speeds)]),
        ],
        "good",
        next_step or f"dvrk-drake collect motion MOTION.yaml --arm {arm.source} --rehearse",
    )


def poses_page(design: StaticPoseDesign, *, next_step: str | None = None) -> Page:
    """Returns the page of designed static poses: expected error and positions.

    Args:
        design: Result of `design_poses`.
        next_step: Suggested next command. None: the command that measures the poses, with placeholders for its files.
    """
    arm, poses = design.arm, design.poses
    rows = [
        ("expected error [%]", f"{100 * design.expected_error:.2f}"),
        ("median expected error of random poses [%]", f"{100 * design.random_error:.2f}"),
        ("gravity parameters known to 10 %", f"{design.known_parameters} of {design.num_parameters}"),
    ]
    count = np.arange(1.0, len(poses) + 1)
    views: list[Block] = [
        _view(arm, count, poses, len(poses)),
        _position_plot(arm, count, poses, "pose [1]", "circles"),
    ]
    return Page(
        f"Designed static poses of {arm.name}",
        f"{arm.name}: {len(poses)} static poses. Expected error of predicted holding efforts: "
        f"{100 * design.expected_error:.1f} % ({100 * design.random_error:.1f} % with {len(poses)} random poses).",
        [Section("Information", [Table(("quantity", "value"), rows)]), Section("Poses in their order", views)],
        "good",
        next_step or f"dvrk-drake collect poses POSES.yaml --arm {arm.source} --output POSES.csv",
    )


def _view(arm: Arm, t: NDArray[np.float64], q: NDArray[np.float64], poses: int = 0) -> Scene:
    return Scene(partial(playback, arm, t, q), "Arm at the desired positions", float(t[0]), poses)


def _position_plot(
    arm: Arm,
    x: NDArray[np.float64],
    q: NDArray[np.float64],
    x_label: str,
    style: Style,
    remarks: Sequence[str] | None = None,
) -> Plot:
    """Returns the positions q (m, n) over x (m,), with the position limits and remarks (n,) in the titles."""
    panels = []
    for j, remark in enumerate(remarks or arm.num_joints * [""]):
        lower, upper = arm.position_lower[j], arm.position_upper[j]
        margin = 0.05 * (upper - lower)
        share = 100 * np.ptp(q[:, j]) / (upper - lower)
        marks: list[Mark] = [Guide("y", limit, None, LIMIT, "position limit") for limit in (lower, upper)]
        marks.append(Curve("desired position", x, q[:, j], COMMANDED, style))
        panels.append(
            Panel(
                f"{joint_label(arm, j)}: {share:.0f} % of the range{remark}",
                marks,
                x_label,
                f"q [{length_unit(arm, j)}]",
                y_range=(lower - margin, upper + margin),
                height=120,
            )
        )
    return Plot("positions", "Desired positions and position limits", panels, time=True, shared_x=True)
