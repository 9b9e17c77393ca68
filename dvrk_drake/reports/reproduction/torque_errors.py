"""Reproduces Fig. 4: torque errors of models at the static poses of the real arm."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.analysis.pose_identification import StaticIdentification, identify_static
from dvrk_drake.experiments.reproduction.published import FIGURE_4_MEANS, PAPER_ARM, PaperRecordings
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.reports.colours import HELD_OUT, LIMIT, MEASURED, REFERENCE
from dvrk_drake.reports.page import Plot
from dvrk_drake.reports.plot import Curve, Mark, Panel, Style, joint_label
from dvrk_drake.reports.reproduction.page import ResultTable, Section, numbers

#: Smallest drawn squared error [(N m)^2]. Smaller squared errors are drawn at this value. They occur if an effort was
#: measured as exactly 0.
FLOOR = 1e-9


def reproduce_figure_4(
    recordings: PaperRecordings, progress: Callable[[float], object] = lambda share: None
) -> Section:
    """Computes the squared torque errors of joints 2-7 at the 72 poses of the paper.

    Raises:
        RecordingError: The recording is missing.
    """
    recording, arm = recordings.poses, load_arm(PAPER_ARM)
    paper = identify_static(recording, arm, "paper")
    ours = identify_static(recording, arm, progress=progress)
    published = recordings.figure_4
    zero = recording.measured_effort()
    included = ~_excluded(ours)
    same = (
        "The reproduced squared errors differ from the published squared errors by at most "
        f"{np.abs(paper.residuals[:, 1:] ** 2 - published).max():.0e} (N m)^2. "
        if published is not None
        else ""
    )

    def rms(values: NDArray[np.float64], use: NDArray[np.bool_]) -> tuple[str, ...]:
        return numbers([np.sqrt(np.mean(values[use[:, j], j] ** 2)) for j in range(1, 7)], "{:.4f}")

    every = np.ones_like(included)
    joints = tuple(f"J{j}" for j in range(2, 8))
    squared = ResultTable(
        "fig4_mean_squared",
        "Fig. 4: mean squared torque error of the fit at 72 poses [(N m)^2]",
        ("", *joints),
        (
            ("published", *numbers(FIGURE_4_MEANS, "{:.2e}")),
            ("the paper's least squares, reproduced", *numbers(np.mean(paper.residuals[:, 1:] ** 2, axis=0), "{:.2e}")),
            ("zero torque", *numbers(np.mean(zero[:, 1:] ** 2, axis=0), "{:.2e}")),
            ("ours", *numbers(np.mean(ours.residuals[:, 1:] ** 2, axis=0), "{:.2e}")),
        ),
    )
    left_out = ResultTable(
        "fig4_left_out",
        "RMS torque error in cross-validation [N m], without excluded measurements and with all measurements",
        ("", *joints),
        (
            ("zero torque", *rms(zero, included)),
            ("the paper's, leave-one-out", *rms(paper.leave_one_out_residuals, included)),
            ("ours, leave-one-out", *rms(ours.leave_one_out_residuals, included)),
            (
                "ours, 10-fold, effects selected anew",
                *numbers([joint.rms_cross_validation_included for joint in ours.model.joints[1:]], "{:.4f}"),
            ),
            ("all measurements: zero torque", *rms(zero, every)),
            ("all measurements: the paper's", *rms(paper.leave_one_out_residuals, every)),
            ("all measurements: ours", *rms(ours.leave_one_out_residuals, every)),
        ),
    )
    worse = [f"J{j + 1}" for j in range(1, 7) if np.mean(paper.residuals[:, j] ** 2) > np.mean(zero[:, j] ** 2)]
    remarks = (
        f"Both methods use the recording of the paper ({len(recording)} poses of a real MTM). The paper's method is "
        f"unweighted least squares with twelve parameters (eq. 10). {same}On {', '.join(worse)}, the error of the "
        "paper's method is larger than the error of zero torque, even at the fitted poses. The torques of joints 2 "
        "and 3 are ten to a hundred times larger than the torques of these joints, and therefore determine the "
        "parameters.",
        "Our method differs in four points. Each joint is weighted by its inverse residual variance. Offsets, "
        "springs and cables are added if they reduce the cross-validation error. A joint gets zero torque if the "
        f"model does not reduce its error. Finally, {int(np.sum(~included))} measurements are excluded, because they "
        "were made at joint stops or are outliers (crosses in the figure). With all measurements, the paper's method "
        "has a smaller error on J2 than ours, because the paper's method fits the torque of the joint stop together "
        "with gravity.",
    )
    better = sum(
        np.mean(ours.leave_one_out_residuals[included[:, j], j] ** 2)
        < np.mean(paper.leave_one_out_residuals[included[:, j], j] ** 2)
        for j in range(1, 7)
    )
    finding = (
        f"In cross-validation, our identification has a smaller torque error than the paper's on {better} of 6 joints."
    )
    plot = _plot(ours, paper, zero, included)
    return Section("fig4", "Fig. 4: torque errors", finding, remarks, (squared, left_out), (plot,))


def _excluded(ours: StaticIdentification) -> NDArray[np.bool_]:
    excluded = np.zeros(ours.recording.q.shape, dtype=bool)
    for measurement in ours.excluded:
        excluded[measurement.row, list(measurement.joints)] = True
    return excluded


def _plot(
    ours: StaticIdentification, paper: StaticIdentification, zero: NDArray[np.float64], included: NDArray[np.bool_]
) -> Plot:
    """Returns the squared torque errors of joints 2-7 at each pose."""
    arm, panels = ours.model.arm, []
    pose = np.arange(1, len(zero) + 1)
    cases: tuple[tuple[str, NDArray[np.float64], str, Style], ...] = (
        ("zero torque", zero, MEASURED, "dots"),
        ("the paper's least squares, leave-one-out", paper.leave_one_out_residuals, REFERENCE, "diamonds"),
        ("ours, leave-one-out", ours.leave_one_out_residuals, HELD_OUT, "circles"),
    )
    for j in range(1, 7):
        marks: list[Mark] = []
        use = included[:, j]
        for name, values, colour, style in cases:
            squared = np.maximum(values[:, j] ** 2, FLOOR)
            marks.append(Curve(name, pose[use], squared[use], colour, style))
            marks.append(Curve("excluded measurement", pose[~use], squared[~use], LIMIT, "crosses"))
        labels = "pose [1]", "squared error [(N m)²]"
        panels.append(Panel(joint_label(arm, j), marks, *labels, log_y=True, height=230))
    caption = (
        f"Fig. 4 reproduced: squared torque error at {len(zero)} poses of the paper. Each pose was not used to fit "
        f"(leave-one-out). Errors below {FLOOR:g} are drawn at {FLOOR:g}"
    )
    return Plot("fig4", caption, panels, columns=2)
