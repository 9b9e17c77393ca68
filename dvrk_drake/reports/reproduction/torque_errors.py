"""Reproduces Fig. 4: torque errors of models at the static poses of the real arm."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.analysis.static.static_identification import StaticIdentification, identify_static
from dvrk_drake.experiments.reproduction.published import FIGURE_4_MEANS, PAPER_ARM, PaperRecordings
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.reports.colours import HELD_OUT, LIMIT, MEASURED, REFERENCE
from dvrk_drake.reports.figures.style import add_legend, joint_title, panel_grid, save_figure, set_title
from dvrk_drake.reports.reproduction.page import ResultTable, Section, numbers

_FILE = "fig4.png"
#: Smallest drawn squared error [(N m)^2]. Smaller squared errors are drawn at this value. They occur if an effort was
#: measured as exactly 0.
FLOOR = 1e-9


def reproduce_figure_4(
    recordings: PaperRecordings, folder: Path, progress: Callable[[float], object] = lambda share: None
) -> Section:
    """Computes the squared torque errors of joints 2-7 at the 72 poses of the paper, and writes fig4.png.

    Raises:
        RecordingError: The recording is missing.
    """
    recording, arm = recordings.poses, load_arm(PAPER_ARM)
    paper = identify_static(recording, arm, "paper")
    ours = identify_static(recording, arm, progress=progress)
    published = recordings.figure_4
    zero = recording.measured_effort()
    included = ~_excluded(ours)
    _plot(folder / _FILE, ours, paper, zero, included)
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
    shows = "Squared torque error of joints 2-7 at 72 poses, leave-one-out; errors below 1e-9 are drawn at 1e-9"
    better = sum(
        np.mean(ours.leave_one_out_residuals[included[:, j], j] ** 2)
        < np.mean(paper.leave_one_out_residuals[included[:, j], j] ** 2)
        for j in range(1, 7)
    )
    finding = (
        f"In cross-validation, our identification has a smaller torque error than the paper's on {better} of 6 joints."
    )
    return Section("fig4", "Fig. 4: torque errors", finding, remarks, (squared, left_out), {_FILE: shows})


def _excluded(ours: StaticIdentification) -> NDArray[np.bool_]:
    excluded = np.zeros(ours.recording.q.shape, dtype=bool)
    for measurement in ours.excluded:
        excluded[measurement.row, list(measurement.joints)] = True
    return excluded


def _plot(
    path: Path,
    ours: StaticIdentification,
    paper: StaticIdentification,
    zero: NDArray[np.float64],
    included: NDArray[np.bool_],
) -> None:
    arm = ours.model.arm
    figure, panels = panel_grid(6, columns=3, height=3.0)
    pose = np.arange(1, len(zero) + 1)
    for j, ax in enumerate(panels, start=1):
        for values, label, colour, marker in (
            (zero, "zero torque", MEASURED, "_"),
            (paper.leave_one_out_residuals, "the paper's least squares, leave-one-out", REFERENCE, "s"),
            (ours.leave_one_out_residuals, "ours, leave-one-out", HELD_OUT, "o"),
        ):
            squared = np.maximum(values[:, j] ** 2, FLOOR)
            use = included[:, j]
            ax.semilogy(pose[use], squared[use], marker, color=colour, markersize=3.5, label=label)
            ax.semilogy(pose[~use], squared[~use], "x", color=colour, markersize=5)
        ax.set_ylim(bottom=FLOOR / 2)
        ax.set_title(joint_title(arm, j))
        ax.set_ylabel("squared error [(N m)$^2$]")
        ax.set_xlabel("pose")
    panels[0].plot([], [], "x", color=LIMIT, label="excluded measurement (in the colour of its series)")
    set_title(
        figure,
        f"Fig. 4 reproduced: squared torque error at {len(zero)} poses of the paper. Each pose was not used to fit "
        "(leave-one-out)",
    )
    add_legend(figure)
    save_figure(figure, path)
