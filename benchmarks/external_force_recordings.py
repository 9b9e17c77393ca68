"""Estimates the weights on a real PSM as forces over the whole motion, with a model of the motion without a weight.

    python benchmarks/external_force_recordings.py FOLDER

FOLDER contains psm_one_no_weight.csv, psm_one_105g_parallel.csv and psm_one_205g_insertion.csv in the coordinates
"wpi", with a header and times (docs/public_recordings.md). The model is identified from the first one, so its own
errors are those of the fit. The true force of a weight m is m (g - a), with the acceleration a of its position. The
first table has the components in the frame of the link that can be measured. Its truth for y is not exact, because z
cannot be measured and is assumed to be near 0. The second table has the joint efforts, whose truth needs no such
assumption. Ranges are those of the true values.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np
from timing import print_table

from dvrk_drake.analysis.external_force import estimate_force
from dvrk_drake.analysis.identification import identify
from dvrk_drake.analysis.observations.observations import Observations
from dvrk_drake.dynamics.kinematics import ArmFrame, Contact
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.recordings.formats import read_recording

#: File, link, mass [kg], and position in the link's frame [m]; see docs/payload.md for the source of the positions.
CASES = [
    ("psm_one_no_weight", "end_link", 0.0, [0.0, 0.023, 0.3913]),
    ("psm_one_105g_parallel", "bottom_bar_link", 0.105, [0.0, 0.165, 0.0563]),
    ("psm_one_205g_insertion", "end_link", 0.205, [0.0, 0.023, 0.3913]),
]
#: Joints that move the links.
JOINTS = ("yaw", "pitch")


def row(error: np.ndarray, truth: np.ndarray, widths: list[np.ndarray], used: np.ndarray) -> tuple[str, ...]:
    """Returns the cells for the rows that are used."""
    span = float(np.ptp(truth))
    rms = [float(np.sqrt(np.mean(x[used] ** 2))) for x in (truth, error)]
    inside = [f"{100 * np.mean((np.abs(error) <= width)[used]):.1f} %" for width in widths]
    share = f"{100 * rms[1] / span:.1f} %" if span else ""
    return (f"{rms[0]:.3f}", f"{span:.2f}", f"{rms[1]:.3f}", share, f"{np.median(widths[0][used]):.3f}", *inside)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="folder of the recordings, see above")
    options = parser.parse_args()
    arm = load_arm("psm")
    recordings = {name: read_recording(options.folder / f"{name}.csv", arm, "wpi") for name, *_ in CASES}
    model = identify(recordings["psm_one_no_weight"], arm).model
    forces, efforts = {}, {}
    for name, link, mass, point in CASES:
        days = [
            estimate_force(recordings[name], model, frame=link, point=point, axes="frame", same_day=same_day)
            for same_day in (True, False)
        ]
        grid, frame = Observations.for_model(recordings[name], model).grid, ArmFrame(arm, link)
        poses = [frame.pose(q) for q in grid.q]
        place = np.array([X @ np.array(point) for X in poses])
        velocity = np.gradient(place, grid.t[1] - grid.t[0], axis=0)
        weight = mass * (arm.gravity - np.gradient(velocity, grid.t[1] - grid.t[0], axis=0))
        in_base = Contact(arm, link, point)
        truths = (
            np.array([X.rotation().matrix().T @ f for X, f in zip(poses, weight, strict=True)]),
            np.array([in_base.jacobian(q).T @ f for q, f in zip(grid.q, weight, strict=True)]),
        )
        in_frame, at_joints = (grid.filter_efforts(grid.at_rows(truth, 0)) for truth in truths)
        for i in np.flatnonzero(np.any(days[0].measurable, axis=0)):
            used, widths = days[0].measurable[:, i], [day.half_width[:, i] for day in days]
            cells = row(days[0].force[:, i] - in_frame[:, i], in_frame[:, i], widths, used)
            forces[f"{name}, {'xyz'[i]}"] = (*cells, f"{100 * np.mean(used):.0f} %")
        for joint in JOINTS:
            j = arm.joint_names.index(joint)
            widths = [day.effort_half_width[:, j] for day in days]
            error = days[0].effort[:, j] - at_joints[:, j]
            efforts[f"{name}, {joint}"] = row(error, at_joints[:, j], widths, np.ones(len(error), dtype=bool))
    heading = [
        "RMS truth",
        "range",
        "RMS error",
        "share of range",
        "interval +-",
        "inside, same day",
        "inside, other day",
    ]
    print_table("force [N] in the frame of the link", [*heading, "measurable"], forces)
    print_table("external joint effort [N m]", heading, efforts)
    return 0


if __name__ == "__main__":
    sys.exit(main())
